"""Deformation: smooth modes of a structure that carry its stations along, epoch by epoch.

A mode is a field of displacements over the structure, in its own axes: x along, y to the left, z
up, from the place where nothing moves. A station turns with half the curl of the field, as a body
on a beam does; plane sections stay plane (Euler and Bernoulli).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "n 3"]

Mode = Callable[[Points, float, float], Points]
"""Displacement for unit amplitude, of places (m), half-length (m) and height (m)."""


def bending(at: Points, length: float, height: float) -> Points:
    """Up or down with constant curvature: unit amplitude at the far end."""
    x, _, z = at.T
    s = x / length
    return np.stack([-2.0 * s * z / length, 0.0 * x, s**2], axis=1)


def sway(at: Points, length: float, height: float) -> Points:
    """Sideways with constant curvature, along the structure and up its towers."""
    x, y, z = at.T
    s, up = x / length, z / height
    return np.stack([-2.0 * s * y / length, s**2 + up**2, -2.0 * up * y / height], axis=1)


def torsion(at: Points, length: float, height: float) -> Points:
    """Twist about the long axis, in proportion to the way: unit angle (rad) at the far end."""
    x, y, z = at.T
    s = x / length
    return np.stack([0.0 * x, -s * z, s * y], axis=1)


def settling(at: Points, length: float, height: float) -> Points:
    """Down, most at the far end, with no slope there."""
    x, _, z = at.T
    s = np.pi * x / length
    slope = 0.5 * np.pi / length * np.sin(s)
    return np.stack([slope * z, 0.0 * x, -0.5 * (1.0 - np.cos(s))], axis=1)


Course = Callable[[np.ndarray, float], np.ndarray]
"""Factor of a mode at times (s), for a period (s)."""

MODES: dict[str, tuple[Mode, Course]] = {
    "bending_m": (bending, lambda t, p: np.sin(2.0 * np.pi * t / p)),
    "sway_m": (sway, lambda t, p: np.sin(4.0 * np.pi * t / p)),
    "torsion_rad": (torsion, lambda t, p: np.sin(2.0 * np.pi * t / p + np.pi / 3.0)),
    "settling_m": (settling, lambda t, p: -np.expm1(-3.0 * t / p)),
}
"""Modes by their key of [deformation], each with its course in time."""


def displacements(
    position: Points,
    axis: tuple[float, float, float],
    origin: Float[np.ndarray, "3"],
    amplitude: dict[str, float],
    time: Float[np.ndarray, " epochs"],
    period: float,
) -> tuple[Float[np.ndarray, "n epochs 3"], Float[np.ndarray, "n epochs 3"]]:
    """Turns (rad) and shifts (m) of stations in the world's axes, at each epoch.

    Args:
        position: of the stations that move (m).
        axis, origin: of the structure, in the world.
        amplitude: of each mode, by its key.
        time: of the epochs (s).
        period: of bending and torsion (s); sway has half of it, settling a third as time constant.
    """
    along = np.asarray(axis)
    # Rows are the structure's axes in the world.
    axes = np.stack([along, np.cross([0.0, 0.0, 1.0], along), [0.0, 0.0, 1.0]])
    at = (position - origin) @ axes.T
    length = max(float(np.abs(at[:, 0]).max(initial=0.0)), 1e-6)
    height = max(float(np.abs(at[:, 2]).max(initial=0.0)), 0.1 * length)
    turn, shift = np.zeros((2, len(position), len(time), 3))
    for key, size in amplitude.items():
        mode, course = MODES[key]
        moved = size * course(time, period)
        shift += mode(at, length, height)[:, None] * moved[:, None]
        turn += _half_curl(mode, at, length, height)[:, None] * moved[:, None]
    return turn @ axes, shift @ axes


def _half_curl(mode: Mode, at: Points, length: float, height: float) -> Points:
    """Rotation vector of a field of displacements, by central differences."""
    h = 1e-4 * length
    # slope[j] is the derivative of the field along axis j.
    slope = [
        (mode(at + h * e, length, height) - mode(at - h * e, length, height)) / (2.0 * h)
        for e in np.eye(3)
    ]
    dx, dy, dz = slope
    return 0.5 * np.stack([dy[:, 2] - dz[:, 1], dz[:, 0] - dx[:, 2], dx[:, 1] - dy[:, 0]], axis=1)
