"""What a scene consists of, as it really is (not as the engineer believes)."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass
class Camera:
    """A camera and its lens.

    Attributes:
        station: place in the scene's stations.
        size: width and height (px).
        focal, centre: principal distances and principal point (px).
        brown: k1, k2, p1, p2, k3 of a lens that images straight rays; None for a wide lens.
        wide: (a3, a5, a7) of r = theta + a3 theta^3 + ..., for a wide lens.
        turn, shift: axes (columns) and pupil of the camera in its station.
        on_s: time of power-on (s).
        known: what the engineer writes about it in recording.toml.
    """

    name: str
    station: int
    size: tuple[int, int]
    focal: np.ndarray
    centre: np.ndarray
    brown: np.ndarray | None
    wide: np.ndarray | None
    turn: np.ndarray
    shift: np.ndarray
    on_s: float
    known: dict[str, Any] = field(default_factory=dict)


@dataclass
class Station:
    """What carries cameras; turn and shift bring station axes to the world."""

    name: str
    turn: np.ndarray
    shift: np.ndarray
    free: bool = False


@dataclass
class Target:
    """A body with marks; poses of all epochs, `turn` [epochs, 3, 3] and `shift` [epochs, 3]."""

    name: str
    names: list[str]
    points: np.ndarray
    moving: bool
    free: bool
    turn: np.ndarray
    shift: np.ndarray
    grid: tuple[int, int, float] | None = None


@dataclass
class Finder:
    """A rangefinder: beam along z from `shift`, axes `turn` in its station.

    `marks` are the marks whose distances it takes; empty: the beam's way to the plane z = 0.
    """

    name: str
    station: int
    turn: np.ndarray
    shift: np.ndarray
    target: int
    marks: list[int]


@dataclass
class Scene:
    """Everything of one recording before noise.

    Attributes:
        t: middle of the exposures (s).
        exposure: exposure times (s) of the epochs.
        sees: (camera, target) pairs that are recorded.
        path: trajectory of the moving target where it is fast, or None.
        weather: the conditions, see heat.Weather.
        sigma_px, sigma_m: noise of a pixel coordinate and of a range.
        tells_power: whether the engineer noted when cameras were switched on.
        restart_s: when all cameras were switched on again, or None.
        began_s: how long after the plain recording began; what goes with time has gone on.
    """

    kind: str
    seed: int
    plan: str | None
    size: str
    t: np.ndarray
    exposure: np.ndarray
    cameras: list[Camera]
    stations: list[Station]
    targets: list[Target]
    finders: list[Finder]
    sees: list[tuple[int, int]]
    up: np.ndarray
    sigma_px: float
    sigma_m: float
    path: Any = None
    weather: Any = None
    priors: list[dict] = field(default_factory=list)
    tells_power: bool = False
    restart_s: float | None = None
    began_s: float = 0.0
    with_finder: bool = False
