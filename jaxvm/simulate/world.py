"""The independent world of the demonstration: recordings whose hidden physics is known.

Nothing here uses the models with which a recording is analysed: the world is simulated from the
physics, in plain numpy and scipy, so that what a diagnosis finds in it is found honestly.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxvm.simulate.bodies import Site
from jaxvm.simulate.effects import HIDEABLE
from jaxvm.simulate.hidden import Truth
from jaxvm.simulate.optics import distances, photograph
from jaxvm.simulate.scene import EXTENTS, Size, build_site, of_day
from jaxvm.simulate.write import Photographs, SimulatedRecording, engineers_model, tables

TOUCHED_PX = 1e-9
"""A pixel coordinate that an effect changes by less is not affected by it."""


def simulate_deformation_scene(
    hide: Sequence[str] = ("plate-expansion",),
    seed: int = 0,
    size: Size = "full",
    strength: float = 1.0,
    day: int = 0,
) -> SimulatedRecording:
    """Record the deformation scene with effects hidden in it that recording.toml does not know.

    Args:
        hide: keys of `HIDEABLE`; empty for a recording that its model explains down to noise.
        seed: draws the scene, the weather, the noise and the sizes of the effects, each from a
            stream of its own: the same seed with another `hide` is the same scene and noise.
        size: "full" (97 epochs in 8 h, 6 x 6 marks) or "small" (40 epochs in 6.5 h, 5 x 5).
        strength: factor on the size of every hidden effect.
        day: of several recordings of one scene: the same bodies and effects in another weather,
            with other noise.

    Raises:
        ValueError: an unknown key, size, or a key given twice.
    """
    if isinstance(hide, str):
        hide = (hide,)
    for key in hide:
        if key not in HIDEABLE:
            raise ValueError(f'no effect "{key}" can be hidden; known: {", ".join(HIDEABLE)}')
    if len(set(hide)) < len(hide):
        raise ValueError(f"an effect is named twice in hide={list(hide)}")
    if size not in EXTENTS:
        raise ValueError(f'no size "{size}"; known: {", ".join(EXTENTS)}')

    plain = build_site(seed, size, day)
    as_modelled = record(plain)
    truth = []
    for key in hide:
        alone = build_site(seed, size, day)
        told = HIDEABLE[key].into(alone, seed, strength)
        truth.append(_measured(told, as_modelled, record(alone)))

    site = build_site(seed, size, day)
    for key in hide:
        HIDEABLE[key].into(site, seed, strength)
    noise = of_day(seed, 3, day)
    return SimulatedRecording(tables(site, *record(site), noise), engineers_model(plain), truth)


def record(site: Site) -> tuple[Photographs, np.ndarray]:
    """Noise-free pixels of every mark in every camera, and noise-free distances to the deck (m)."""
    photographs = {
        (camera.name, plate.name): photograph(site, camera, plate)
        for camera in site.cameras.values()
        for plate in site.plates.values()
    }
    return photographs, distances(site, site.rangefinder, site.plates["deck"])


def _measured(
    told: Truth,
    without: tuple[Photographs, np.ndarray],
    with_it: tuple[Photographs, np.ndarray],
) -> Truth:
    """A truth with the size of its changes of the measurements."""
    change = np.concatenate([(with_it[0][at] - without[0][at]).ravel() for at in without[0]])
    touched = np.abs(change) > TOUCHED_PX
    return replace(
        told,
        rms_px=float(np.sqrt(np.mean(change**2))),
        rms_affected_px=float(np.sqrt(np.mean(change[touched] ** 2))) if touched.any() else 0.0,
        rms_range_m=float(np.sqrt(np.mean((with_it[1] - without[1]) ** 2))),
    )
