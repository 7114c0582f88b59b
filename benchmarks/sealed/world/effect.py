"""What an effect is, the site where it is drawn, and the list that the effects enter."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .courses import Course

KINDS = ("board", "wide", "station", "stereo", "relay")
EFFECTS: dict = {}


@dataclass(frozen=True)
class Effect:
    """Concealable physics: its key, rows of the catalogue, scene kinds; `draw` places it."""

    key: str
    rows: tuple[int, ...]
    kinds: tuple[str, ...]
    outside: bool
    place: str
    draw: Callable


@dataclass
class Draft:
    """An effect at its place, of open size.

    Attributes:
        hooks: functions of `chain`'s steps for a physical size.
        low, high: plausible sizes (of either sign).
        ports: port -> factor of the size, in the vocabulary of the design.
        fixed: the size comes in whole steps and is not scaled.
    """

    where: dict
    hooks: Callable
    low: float
    high: float
    course: Course
    ports: dict[str, float] = field(default_factory=dict)
    fixed: bool = False
    sign: float = 1.0


def effect(key, rows, kinds, place="camera", outside=False):
    """Enter a drawing function into the list; `kinds` is a word of initials or a tuple."""
    initials = {"b": "board", "w": "wide", "s": "station", "v": "stereo", "r": "relay"}
    kinds = tuple(initials[c] for c in kinds)

    def enter(draw):
        EFFECTS[key] = Effect(key, rows, kinds, outside, place, draw)
        return draw

    return enter


@dataclass
class Site:
    """Where one effect is drawn: the plain scene, its own random stream, and the chosen bodies."""

    scene: object
    rng: np.random.Generator
    cameras: list[int]
    station: int
    target: int
    finder: int

    @property
    def length(self):
        return float(self.scene.t[-1])

    @property
    def half(self):
        """Half size of the target (m)."""
        points = self.scene.targets[self.target].points
        return 0.5 * float(np.ptp(points[:, :2], axis=0).max())

    @property
    def middle(self):
        points = self.scene.targets[self.target].points
        return 0.5 * (points.min(axis=0) + points.max(axis=0)) * [1.0, 1.0, 0.0]

    def between(self, low, high):
        """Log-uniform."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def even(self, low, high):
        return float(self.rng.uniform(low, high))

    def way(self):
        """A unit vector in the plane."""
        angle = self.rng.uniform(0.0, 2.0 * np.pi)
        return np.array([np.cos(angle), np.sin(angle)])

    def axis(self, flat=False):
        """A unit vector: across the line of sight, or now and then along it."""
        if flat or self.rng.random() < 0.8:
            return np.append(self.way(), 0.0)
        return np.array([0.0, 0.0, 1.0])

    def names(self):
        return [self.scene.cameras[k].name for k in self.cameras]

    def draft(self, hooks, low, high, course, ports=None, where=None, fixed=False):
        """A draft at the cameras, unless `where` says otherwise, with a random sign."""
        if where is None:
            where = {"camera": self.names()}
        sign = float(self.rng.choice([-1.0, 1.0]))
        ports = (ports or {}) if course.plain else {}
        if self.scene.kind == "wide":  # its lens is written in angles, Brown's numbers are not
            ports = {p: a for p, a in ports.items() if p[:6] not in ("lens.k", "lens.p")}
        return Draft(where, hooks, low, high, course, ports, fixed, sign)

    def at_target(self):
        return {"target": [self.scene.targets[self.target].name]}

    def at_station(self):
        return {"station": [self.scene.stations[self.station].name]}


def choose(scene, rng, place):
    """Draw the cameras, station, target and rangefinder of an effect.

    place: "camera" (one, or all alike in one of four), "body" (one, that static targets watch),
    "station", "target" (any), "static" (a target that stands), "finder", "pair".
    """
    count = len(scene.cameras)
    usable = list(range(count - 1)) if scene.kind == "relay" else list(range(count))
    cameras = [int(rng.choice(usable))]
    if place == "camera" and count > 1 and rng.random() < 0.25:
        cameras = list(range(count))
    station = scene.cameras[cameras[0]].station
    if scene.kind == "relay" and place == "station":
        station = int(rng.integers(len(scene.stations)))
    still = [k for k, t in enumerate(scene.targets) if not t.moving]
    targets = list(range(len(scene.targets)))
    if scene.kind == "relay":
        targets = still
    target = int(rng.choice(still if place == "static" and still else targets))
    return Site(scene, rng, cameras, station, target, 0)
