"""Free-form hypotheses: for physics that has no name in the catalogue.

Curves: a port runs freely with time or with a recorded quantity (cubic B-splines). Maps: the
detector errs, or a plate stands off its plane, by a smooth surface over the image or the plate.
"""

import numpy as np

from jaxvm.network.scene import Scene
from jaxvm.physics.forms import N_KNOTS

CURVED = (
    ("mount.turn_x", "mount.turn_y", "mount.turn_z"),
    ("mount.turn_x",),
    ("mount.turn_y",),
    ("mount.turn_z",),
    ("mount.shift_x", "mount.shift_y", "mount.shift_z"),
    ("station.turn_x", "station.turn_y", "station.turn_z"),
    ("station.shift_x", "station.shift_y", "station.shift_z"),
    ("structure.turn_x", "structure.turn_y", "structure.turn_z"),
    ("structure.shift_x", "structure.shift_y", "structure.shift_z"),
    ("sensor.cx", "sensor.cy"),
    ("sensor.focal",),
    ("lens.k1",),
    ("target.scale",),
    ("target.bow_x", "target.bow_y"),
    ("medium.layers_x", "medium.layers_y", "medium.layers_up"),
    ("clock.offset",),
    ("range.offset",),
)
"""Ports, together or alone, that a free-form curve may drive."""


CURVED_FAST = (
    ("mount.turn_x", "mount.turn_y"),
    ("mount.turn_x",),
    ("mount.turn_y",),
    ("sensor.focal",),
    ("target.scale",),
)
"""The same for a fine curve of time: it has so many unknowns that only what matters is asked."""


def curve_constants(low: float, high: float, form: str = "curve") -> tuple[float, float]:
    """First knot and spacing of a free-form curve between two values of its driver."""
    spacing = (high - low) / (N_KNOTS[form] - 3)
    return low - spacing, spacing


def curved_drivers(scene: Scene, form: str = "curve") -> list[tuple[str, tuple[float, float]]]:
    """Time-like drivers that a curve may follow, with the constants of the curve.

    A curve follows recorded quantities, too, a fine one time alone.
    """
    channels = scene.network.channels
    time = np.asarray(channels.epoch_time)
    if len(time) < 2 * N_KNOTS[form]:
        return []
    found = []
    for name, kind in zip(channels.names, channels.kinds, strict=True):
        values = np.interp(time, channels.time, np.asarray(channels.values)[channels.index(name)])
        followed = ("time", "quantity") if form == "curve" else ("time",)
        if kind in followed and np.ptp(values) > 0.0:
            constants = curve_constants(float(values.min()), float(values.max()), form)
            found.append((name, constants))
    return found
