"""The things on the simulated site: plates, cameras, a rangefinder, the air between them.

What a body does (where it is, how it is shaped, when it exposes) is a plain function of time that
is kept on the body. An effect is hidden by giving a body another function.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxvm.simulate.thermal import Signal, Weather

Times = Float[np.ndarray, " n"]
Points = Float[np.ndarray, "n 3"]
Pixels = Float[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Placement:
    """Rigid placement(s): X_outer = rotation X_inner + shift (m). One, or one for each row."""

    rotation: Rotation
    shift: Float[np.ndarray, "*n 3"]

    @staticmethod
    def of(turn_rad: Float[np.ndarray, "3"], shift_m: Float[np.ndarray, "3"]) -> "Placement":
        """Placement of a rotation vector (rad) and a shift (m)."""
        return Placement(Rotation.from_rotvec(turn_rad), np.asarray(shift_m, dtype=float))

    def outward(self, inner: Points) -> Points:
        """Outer coordinates of points given in inner ones."""
        return self.rotation.apply(inner) + self.shift

    def inward(self, outer: Points) -> Points:
        """Inner coordinates of points given in outer ones."""
        return self.rotation.inv().apply(outer - self.shift)

    def table(self) -> dict[str, list[float]]:
        """As recording.toml wants it."""
        return {"turn_rad": self.rotation.as_rotvec().tolist(), "shift_m": self.shift.tolist()}


@dataclass
class Plate:
    """A square grid of marks; mark "r/c" has nominal coordinates (c, r, 0) * spacing."""

    name: str
    side: int
    spacing_m: float
    moves: bool
    place: Callable[[Times], Placement]  # world from plate
    shape: Callable[[Times, Points], Points]  # true plate coordinates of nominal ones

    @property
    def nominal(self) -> Points:
        row, column = np.divmod(np.arange(self.side**2), self.side)
        return np.column_stack([column, row, 0 * row]) * self.spacing_m

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        return self.nominal.mean(axis=0)

    @property
    def half_m(self) -> float:
        """Half the side of the grid of marks (m)."""
        return 0.5 * (self.side - 1) * self.spacing_m

    @property
    def mark_names(self) -> list[str]:
        return [f"{i // self.side}/{i % self.side}" for i in range(self.side**2)]


@dataclass
class Camera:
    """A camera on the mast. Frame: x right, y down, z forward; pixel (0, 0) is a pixel centre."""

    name: str
    image_size: tuple[int, int]  # width, height
    distortion: Float[np.ndarray, "5"]  # k1 k2 p1 p2 k3, as calibrated
    rest: Placement  # station from camera, undisturbed
    powered_on_s: float
    housing: Signal  # degC
    focal: Callable[[Times], Pixels]
    centre: Callable[[Times], Pixels]
    lens: Callable[[Pixels], Pixels]  # distorted of ideal, both at principal distance 1
    turn: Callable[[Times], Points]  # rad, about the camera's own axes
    shift: Callable[[Times], Points]  # m, along the station's axes
    delay: Callable[[Float[np.ndarray, " n"]], Times]  # s after the recorded time, of the row
    detect: Callable[[Pixels], Pixels]  # measured of true

    def place(self, t: Times) -> Placement:
        """Station from camera at each time."""
        turned = self.rest.rotation * Rotation.from_rotvec(self.turn(t))
        return Placement(turned, self.rest.shift + self.shift(t))


@dataclass
class Rangefinder:
    """A distance meter: the beam leaves the index point along its own +z."""

    name: str
    place: Placement  # station from rangefinder
    index: Callable[[Times], Times]  # m, added to every distance


@dataclass
class Site:
    """Everything that is there, at the epochs of one recording."""

    epoch_t: Times
    weather: Weather
    station: Placement  # world from station
    up: Float[np.ndarray, "3"]
    cameras: dict[str, Camera]
    plates: dict[str, Plate]
    rangefinder: Rangefinder
    index_slope: Callable[[Times], Times]  # 1/m, growth of the air's refractive index upwards


def plus(before: Callable, more: Callable) -> Callable:
    """The sum of two functions of the same arguments."""
    return lambda *at: before(*at) + more(*at)


def after(first: Callable, then: Callable) -> Callable:
    """One function of one argument after the other."""
    return lambda x: then(first(x))


def along(axis: str, size: Callable[[Times], Times]) -> Callable[[Times], Points]:
    """A vector in time along one axis, "x", "y" or "z"."""
    unit = np.eye(3)["xyz".index(axis)]
    return lambda t: size(t)[:, None] * unit
