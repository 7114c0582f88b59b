"""The deformation scene: two cameras on a mast watch a moving deck and two fixed plates for hours.

World: x right, y away from the mast, z up. Station and plates: x right, y down, z away.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxvm.simulate.bodies import Camera, Placement, Plate, Rangefinder, Site, Times
from jaxvm.simulate.optics import brown_lens
from jaxvm.simulate.thermal import CameraBody, Signal, make_weather

Size = Literal["full", "small"]

IMAGE_SIZE = (2448, 2048)
BEFORE_S = 3 * 3600.0
"""The weather log starts this long before the first epoch (s)."""

WORLD_FROM_LEVEL = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0])
"""Turns x right, y down, z away into x right, y away, z up."""


@dataclass(frozen=True)
class Extent:
    """How much is recorded."""

    epochs: int
    every_s: float
    side: int  # marks along one side of a plate

    def times(self, rng: np.random.Generator) -> Times:
        """Recorded times (s): an even rhythm, a few seconds late each time."""
        rhythm = self.every_s * np.arange(self.epochs)
        return np.round(rhythm + rng.uniform(0.0, 8.0, self.epochs), 3)


EXTENTS: dict[str, Extent] = {
    "full": Extent(epochs=97, every_s=300.0, side=6),
    "small": Extent(epochs=40, every_s=600.0, side=5),
}


@dataclass(frozen=True)
class PlatePlan:
    """Where a plate stands in station coordinates (m), how wide it is, how it leans (degrees)."""

    middle: tuple[float, float, float]
    width_m: float
    lean_deg: tuple[float, float, float]


PLATES: dict[str, PlatePlan] = {
    "reference_near": PlatePlan((-0.98, 0.64, 5.0), 1.6, (7.0, 27.0, -2.0)),
    "deck": PlatePlan((1.42, -0.12, 8.0), 1.8, (-28.0, 8.0, 3.0)),
    "reference_far": PlatePlan((-2.20, -2.10, 12.0), 1.8, (18.0, -23.0, 4.0)),
}


@dataclass(frozen=True)
class DeckMotion:
    """The deck swings within seconds and deforms within hours.

    Position (m, world) and turn (rad, world axes) about the middle are sums of sines; rows are
    the sines, columns the six components.
    """

    amplitude: Float[np.ndarray, "sines 6"]
    pulsation: Float[np.ndarray, " sines"]  # rad/s
    phase: Float[np.ndarray, "sines 6"]
    rest: Placement  # world from plate
    middle: Float[np.ndarray, "3"]  # plate coordinates

    def __call__(self, t: Times) -> Placement:
        angle = self.pulsation[:, None] * t[:, None, None] + self.phase
        moved = (self.amplitude * np.sin(angle)).sum(axis=1)
        rotation = Rotation.from_rotvec(moved[:, 3:]) * self.rest.rotation
        centre = self.rest.outward(self.middle) + moved[:, :3]
        return Placement(rotation, centre - rotation.apply(self.middle))


def deck_motion(
    rng: np.random.Generator, rest: Placement, middle: Float[np.ndarray, "3"]
) -> DeckMotion:
    """Slow sag and twist (millimetres to centimetres, hours) under a sway of some seconds."""
    slow_period = np.array([1.1, 2.3, 5.2]) * 3600.0 * rng.uniform(0.9, 1.1, 3)
    sway_period = np.array([5.1, 7.3, 9.7]) * rng.uniform(0.95, 1.05, 3)
    slow = np.array([0.004, 0.003, 0.008, 0.0004, 0.0003, 0.0003])
    sway = np.array([0.055, 0.025, 0.036, 0.0030, 0.0030, 0.0040])
    amplitude = np.concatenate(
        [slow * rng.uniform(0.5, 1.2, (3, 6)), sway * rng.uniform(0.6, 1.1, (3, 6))]
    )
    pulsation = 2 * np.pi / np.concatenate([slow_period, sway_period])
    phase = rng.uniform(0.0, 2 * np.pi, (6, 6))
    return DeckMotion(amplitude, pulsation, phase, rest, middle)


def velocity(plate: Plate, t: Times) -> Float[np.ndarray, "n 6"]:
    """Velocity of a plate's origin (m/s) and its angular rate (rad/s), world axes."""
    h = 1e-3
    ahead, behind = plate.place(t + h), plate.place(t - h)
    rate = (ahead.rotation * behind.rotation.inv()).as_rotvec() / (2 * h)
    return np.column_stack([(ahead.shift - behind.shift) / (2 * h), rate])


def of_day(seed: int, stream: int, day: int) -> np.random.Generator:
    """Draws of a stream of a scene that are others every day."""
    return np.random.default_rng([seed, stream, day] if day else [seed, stream])


def build_site(seed: int, size: Size, day: int = 0) -> Site:
    """The site with nothing hidden: every body behaves as the recording will say it does.

    On another `day` it has another weather.
    """
    extent = EXTENTS[size]
    scene, sky = np.random.default_rng([seed, 1]), of_day(seed, 2, day)
    epoch_t = extent.times(scene)
    weather = make_weather(sky, -BEFORE_S, epoch_t[-1] + 300.0)
    station = Placement(
        WORLD_FROM_LEVEL * Rotation.from_rotvec(scene.normal(0.0, 0.02, 3)),
        np.array([0.0, 0.0, 6.0]) + scene.normal(0.0, 0.1, 3),
    )

    plates = {}
    for name, plan in PLATES.items():
        plates[name] = _plate(scene, name, plan, extent.side, station)

    switched_on = np.round(scene.uniform(-60.0, -10.0, 2), 1)
    bodies = {
        "left": CameraBody(scene.uniform(1.1, 1.4), switched_on[0], sunlit_m2=0.0010),
        "right": CameraBody(
            scene.uniform(0.9, 1.2),
            switched_on[1],
            sunlit_m2=0.0,
            housing_j_per_k=140.0,
            to_air_w_per_k=0.10,
        ),
    }
    stands = {"left": (-0.6, 5.0, 1.6), "right": (0.6, -5.0, -2.1)}  # x (m), yaw, roll (degrees)
    cameras = {
        name: _camera(
            scene, name, *stands[name], body, body.housing(weather.ambient, weather.irradiance)
        )
        for name, body in bodies.items()
    }

    index_point = np.array([0.05, -0.12, 0.04]) + scene.normal(0.0, 0.01, 3)
    aim = np.array(PLATES["deck"].middle) - index_point + scene.normal(0.0, 0.03, 3)
    disto = Rangefinder("disto", Placement(_turn_z_to(aim), index_point), index=np.zeros_like)
    return Site(
        epoch_t,
        weather,
        station,
        np.array([0.0, 0.0, 1.0]),
        cameras,
        plates,
        disto,
        index_slope=np.zeros_like,
    )


def _plate(
    rng: np.random.Generator, name: str, plan: PlatePlan, side: int, station: Placement
) -> Plate:
    lean = np.array(plan.lean_deg) + rng.uniform(-3.0, 3.0, 3)
    rotation = station.rotation * Rotation.from_euler("xyz", lean, degrees=True)
    centre = station.outward(np.array(plan.middle) + rng.uniform(-0.05, 0.05, 3))
    spacing = round(plan.width_m / (side - 1), 4)
    middle = np.array([1.0, 1.0, 0.0]) * spacing * (side - 1) / 2
    rest = Placement(rotation, centre - rotation.apply(middle))
    moves = name == "deck"
    place = deck_motion(rng, rest, middle) if moves else lambda t: rest
    return Plate(name, side, spacing, moves, place, shape=lambda t, nominal: nominal)


def _camera(
    rng: np.random.Generator,
    name: str,
    x: float,
    yaw_deg: float,
    roll_deg: float,
    body: CameraBody,
    housing: Signal,
) -> Camera:
    angles = np.array([0.0, yaw_deg, roll_deg]) + rng.uniform(-0.5, 0.5, 3)
    rest = Placement(
        Rotation.from_euler("xyz", angles, degrees=True),
        np.array([x, 0.0, 0.0]) + rng.normal(0.0, 0.02, 3),
    )
    width, height = IMAGE_SIZE
    focal = 3000.0 * (1.0 + rng.uniform(-0.004, 0.004)) * (1.0 + rng.uniform(0.0, 2e-4, 2))
    centre = np.array([(width - 1) / 2, (height - 1) / 2]) + rng.uniform(-12.0, 12.0, 2)
    typical = np.array([-0.110, 0.095, 3e-4, -2e-4, -0.020])
    distortion = np.round(typical * rng.uniform(0.7, 1.3, 5), 7)
    return Camera(
        name,
        IMAGE_SIZE,
        distortion,
        rest,
        powered_on_s=float(body.powered_on_s),
        housing=housing,
        focal=lambda t: np.broadcast_to(focal, (t.size, 2)),
        centre=lambda t: np.broadcast_to(centre, (t.size, 2)),
        lens=brown_lens(distortion),
        turn=lambda t: np.zeros((t.size, 3)),
        shift=lambda t: np.zeros((t.size, 3)),
        delay=np.zeros_like,
        detect=lambda pixel: pixel,
    )


def _turn_z_to(direction: Float[np.ndarray, "3"]) -> Rotation:
    """The smallest rotation that takes +z to a direction."""
    d = direction / np.linalg.norm(direction)
    axis = np.cross([0.0, 0.0, 1.0], d)
    sine = np.linalg.norm(axis)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, d[2]))
