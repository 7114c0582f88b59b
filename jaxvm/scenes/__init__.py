"""Networks to simulate: ships, tunnels, bridges, wind tunnels, chains and graphs from a short TOML.

`jaxvm.scenes.describe` lists every key. The scenes of `jaxvm.simulate` are another thing: a world
of its own, which shares no model with the network.
"""

from jaxvm.scenes.describe import Description
from jaxvm.scenes.layouts import LAYOUTS, Layout, Plan, Structure
from jaxvm.scenes.make import simulate_network
from jaxvm.scenes.parse import parse_description
from jaxvm.scenes.read import description_text, example_names, read_description
from jaxvm.scenes.truth import Simulated, Truth, truth_folder

__all__ = [
    "Description",
    "description_text",
    "LAYOUTS",
    "Layout",
    "Plan",
    "Simulated",
    "Structure",
    "Truth",
    "example_names",
    "parse_description",
    "read_description",
    "simulate_network",
    "truth_folder",
]
