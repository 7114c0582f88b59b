"""Recordings of described networks, with their truth kept apart.

Simulation is the network's own prediction at true values, plus noise. What an engineer would know
is in the recording's model; true poses, and effects that the model has nothing of, are the truth.
"""

from dataclasses import replace

import numpy as np

from jaxvm.recording.model import Model
from jaxvm.recording.recording import Recording, no_observations
from jaxvm.scenes.describe import Description
from jaxvm.scenes.photograph import photographed
from jaxvm.scenes.placement import check_joined, place_stations, structure_of
from jaxvm.scenes.relate import measured_links, ties_of_lines
from jaxvm.scenes.truth import Simulated, Truth


def simulate_network(description: Description, seed: int = 0, noise: float = 1.0) -> Simulated:
    """A recording of a described network, and its truth.

    Args:
        description: the network.
        seed: draws the noise; the network itself is drawn by the description's own seed.
        noise: factor on the noise; 0 for exact measurements.

    Raises:
        RecordingError: the description asks for what can't be: a size, a name, a station that
            nobody sees; names the file, the line and the mend.
    """
    drawn, noisy = np.random.default_rng([description.seed, 1]), np.random.default_rng([seed, 2])
    structure = structure_of(description, drawn)
    placement = place_stations(description, structure, drawn)
    if description.observe == "links":
        model = Model(description.name, (), placement.stations(structure.names), ())
        none = no_observations()
        recording = Recording(model, np.zeros(1, int), np.zeros(1), {}, none, timed=False)
        made = Simulated(recording, Truth(structure.names, placement.vectors))
    else:
        made = photographed(description, structure, placement, drawn, noisy, noise)
    if description.observe == "pixels":
        return made
    ties = ties_of_lines(structure, placement)
    check_joined(description, structure, placement, ties)
    links = measured_links(ties, structure, placement, description.links, noisy, noise)
    return replace(made, recording=replace(made.recording, links=links))
