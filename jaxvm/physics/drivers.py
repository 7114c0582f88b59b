"""Drivers: what an effect depends on.

Time-like drivers are channels (recorded quantities, time, time since power-on). Observation-like
drivers are computed for each observation from the present model; they are circumstances, not
unknowns, and are held while a model is fitted. The place in the image is the *predicted* one, the
phase within a pixel included: the measured one contains the residual, and a pattern made of
residuals explains noise. (A mark at rest shows noise e at phase phi; e sin 2 pi (phi + e) does not
average out.)
"""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.compiling import program
from jaxvm.geometry.poses import pose_from_vector
from jaxvm.physics.blocks import by_blocks, hosted, roomy
from jaxvm.physics.chain import Aim, Circumstances, Sight, predict_range
from jaxvm.physics.effects import Channels, Term
from jaxvm.physics.forms import BASES, bump
from jaxvm.physics.ports import PortValues

OBSERVATION_DRIVERS: dict[str, str] = {
    "one": "1",
    "row": "image height",
    "column": "image width",
    "radius": "half diagonal",
    "image_x": "half diagonal",
    "image_y": "half diagonal",
    "pixel_u": "px",
    "pixel_v": "px",
    "range": "m",
    "inverse_range": "1/m",
    "incidence": "rad",
    "motion_u": "px/s",
    "motion_v": "px/s",
    "target_x": "half width",
    "target_y": "half height",
    "checker": "1",
    "mark": "1",
    "epoch": "1",
    "along_beam": "1",
    "up_x": "1",
    "up_y": "1",
    "up_z": "1",
    "target_up_x": "1",
    "target_up_y": "1",
    "target_up_z": "1",
    "radius2_over_range": "half diagonal²/m",
    "level_x": "m",
    "level_y": "m",
    "height": "m",
}
"""Observation-like drivers and their units."""

PLANES: dict[str, tuple[str, str, float]] = {
    "image": ("image_x", "image_y", 0.4),
    "fine image": ("image_x", "image_y", 0.22),
    "finest image": ("image_x", "image_y", 0.095),
    "plate": ("target_x", "target_y", 0.5),
    "fine plate": ("target_x", "target_y", 0.25),
    "pixels": ("pixel_u", "pixel_v", 1.0),
}
"""Two observation-like drivers together, and the spacing of the tiles of a map over them."""

PLANE_BASES = ("tile", "sine", "cosine")
"""Patterns over a plane: a bump about a place, or a wave of so many cycles per unit along both."""

OWN_BODY, OWN_POWER_ON = "own_body_degC", "time since own power-on"
"""Drivers that each camera has for itself."""

POWER_ON = "time since power-on of "
"""Name of the driver of a camera's power-on, before the name of the camera."""

SESSION = "time since the session's start"
"""Driver of recordings with several sessions."""

OBSERVATION_DRIVER_INDEX = {name: i for i, name in enumerate(OBSERVATION_DRIVERS)}


class ChannelUnit(NamedTuple):
    """What the unit at the end of a channel's name says: the kind of quantity, and how it reads."""

    kind: str
    unit: str


CHANNEL_UNITS: dict[str, ChannelUnit] = {
    "_degC": ChannelUnit("temperature", "K"),  # an effect counts differences
    "_K": ChannelUnit("temperature", "K"),
    "_pct": ChannelUnit("humidity", "%"),
    "_hPa": ChannelUnit("pressure", "hPa"),
    "_W_m2": ChannelUnit("irradiance", "W/m²"),
    "_m_s": ChannelUnit("wind", "m/s"),
    "_K_per_m": ChannelUnit("gradient", "K/m"),
    "_ms": ChannelUnit("exposure", "ms"),
    "_Hz": ChannelUnit("frame rate", "Hz"),
    "_lux": ChannelUnit("light", "lx"),
}
"""Units of recorded channels by the ending of their names."""


def channel_unit(name: str) -> ChannelUnit | None:
    """Kind and unit of a recorded channel, None where its name does not tell."""
    return next((known for end, known in CHANNEL_UNITS.items() if name.endswith(end)), None)


def channel_kind(name: str) -> str:
    """Kind of a recorded channel by its name: "temperature", "humidity", ..., else "quantity"."""
    known = channel_unit(name)
    return known.kind if known else "quantity"


def observation_drivers(
    sight: Sight,
    circumstances: Circumstances,
    predicted: Float[Array, "2"],
    image_size: Float[Array, "2"],
    level: Float[Array, "3 3"],
) -> Float[Array, " drivers"]:
    """All observation-like drivers of one observation, in the order of OBSERVATION_DRIVERS.

    `image_x`, `image_y` and `radius` count from the principal point in half image diagonals;
    `row` and `column` from the middle of the image; `incidence` is the angle between the line of
    sight and the target's normal; `checker` is +1 and -1 in turn over the marks of a grid, NaN
    without one; `mark` is the number of the mark among all targets', `epoch` that of the epoch;
    `along_beam` goes from -1 to 1 over a station's cameras; `level_x`, `level_y` and `height` are
    how far the mark is from the camera along the `level` axes (`chain.level_axes`).
    """
    at = circumstances
    world_from_target = sight.world_from_target
    world_from_camera = pose_from_vector(sight.world_from_station) @ pose_from_vector(
        sight.station_from_camera
    )
    camera_from_world = world_from_camera.inverse()
    mark_cam = camera_from_world.apply(world_from_target.apply(sight.point))
    distance = jnp.linalg.norm(mark_cam)
    ray = mark_cam / distance
    normal = camera_from_world.rotation @ world_from_target.rotation[:, 2]
    cosine = normal @ ray
    up_cam = camera_from_world.rotation @ level[:, 2]
    up_target = world_from_target.rotation.T @ level[:, 2]
    from_camera = level.T @ (world_from_camera.rotation @ mark_cam)

    arm_world = world_from_target.rotation @ sight.point
    speed = camera_from_world.rotation @ (at.velocity[:3] + jnp.cross(at.velocity[3:], arm_world))
    motion = sight.focal * (speed[:2] - ray[:2] / ray[2] * speed[2]) / mark_cam[2]

    half_diagonal = 0.5 * jnp.linalg.norm(image_size)
    from_centre = (predicted - sight.centre) / half_diagonal
    radius = jnp.linalg.norm(from_centre)
    in_image = (predicted + 0.5) / image_size - 0.5
    in_target = (sight.point - at.target_centre)[:2] / at.target_half_size
    return jnp.stack(
        [
            jnp.ones(()),
            in_image[1],
            in_image[0],
            radius,
            from_centre[0],
            from_centre[1],
            predicted[0],
            predicted[1],
            distance,
            1.0 / distance,
            jnp.arccos(jnp.clip(jnp.abs(cosine), 0.0, 1.0)),
            motion[0],
            motion[1],
            in_target[0],
            in_target[1],
            at.checker,
            at.mark,
            at.epoch,
            at.along_beam,
            up_cam[0],
            up_cam[1],
            up_cam[2],
            up_target[0],
            up_target[1],
            up_target[2],
            radius**2 / distance,
            from_camera[0],
            from_camera[1],
            from_camera[2],
        ]
    )


def range_drivers(
    aim: Aim, circumstances: Circumstances, to_plane: Float[Array, ""]
) -> Float[Array, " drivers"]:
    """Observation-like drivers of one distance; NaN for those that only an image has.

    `incidence` is the angle between the beam and the target's normal. The beam is the instrument's
    z axis where it meets a plane, and the line to the mark where a mark is measured.
    """
    finder_from_target = (
        pose_from_vector(aim.world_from_station) @ pose_from_vector(aim.station_from_rangefinder)
    ).inverse() @ aim.world_from_target
    to_mark = finder_from_target.apply(aim.point)
    forward = jnp.array([0.0, 0.0, 1.0])
    beam = jnp.where(to_plane > 0.5, forward, to_mark / jnp.linalg.norm(to_mark))
    cosine = beam @ finder_from_target.rotation[:, 2]
    distance = predict_range(aim, circumstances, to_plane, PortValues())
    known = {
        "one": jnp.ones(()),
        "range": distance,
        "inverse_range": 1.0 / distance,
        "incidence": jnp.arccos(jnp.clip(jnp.abs(cosine), 0.0, 1.0)),
    }
    return jnp.stack([known.get(name, jnp.full((), jnp.nan)) for name in OBSERVATION_DRIVERS])


def driven_by(driver: str) -> set[str]:
    """Columns of a table of drivers that a pattern of this driver reads."""
    return set(PLANES[driver][:2]) if driver in PLANES else {driver}


def patterns(
    terms: Sequence[Term], drivers: Float[Array | np.ndarray, "observations drivers"]
) -> Float[Array, "observations terms"]:
    """Patterns of terms with one driver and one basis, which differ in their constants.

    They are 0 where the driver has no meaning (NaN).
    """
    driver, basis = terms[0].driver, terms[0].basis
    constants = np.array([(*term.constants, 1.0, 1.0)[:2] for term in terms], float)
    (table,) = hosted(drivers)
    array: Any = np if isinstance(table, np.ndarray) else jnp
    if driver in PLANES:
        x_name, y_name, width = PLANES[driver]
        columns = [OBSERVATION_DRIVER_INDEX[name] for name in (x_name, y_name)]
        x = table[:, np.array(columns)]
        tile, wave = partial(_spots, width=width), partial(_waves, name=basis)
        evaluate, known = tile if basis == "tile" else wave, array.isfinite(x).all(axis=1)
    else:
        x = table[:, OBSERVATION_DRIVER_INDEX[driver]]
        evaluate, known = partial(_bases, name=basis), array.isfinite(x)
    # Few numbers of terms are few programs.
    values = by_blocks(evaluate, x, roomy(constants, least=1))[:, : len(terms)]
    return array.where(known[:, None], values, 0.0)


@program
def _bases(x, constants, name: str):
    x = jnp.where(jnp.isfinite(x), x, 0.0)
    return jax.vmap(lambda own: BASES[name](x, x, own), out_axes=1)(constants)


@program
def _waves(x, constants, name: str):
    ones = jnp.ones(2)
    return jax.vmap(lambda own: BASES[name](x @ own, x[:, 0], ones), out_axes=1)(constants)


@jax.jit
def _spots(x, constants, width):
    def one(own):
        return bump(x[:, 0], own[0], width) * bump(x[:, 1], own[1], width)

    return jax.vmap(one, out_axes=1)(constants)


def build_channels(
    epoch_time: Float[np.ndarray, " epochs"],
    recorded: dict[str, Float[np.ndarray, " times"]],
    recorded_time: Float[np.ndarray, " times"] | None,
    power_on: dict[str, tuple[float, ...]],
    timed: bool = True,
    starts: Float[np.ndarray, " sessions"] | None = None,
    cameras: tuple[str, ...] = (),
) -> Channels:
    """Channels of a recording: its own, time (s since the first epoch), time since power-on.

    `power_on` maps a camera to its moments of power-on on the recording's clock (s). Where only the
    order of the epochs is known (not `timed`), there is "order" in place of "time". What is warmer
    than the air bends: the difference of each temperature against the ambient one is a channel,
    too, and so is the temperature of each camera's own body, and the time since its own power-on,
    where all `cameras` have one. Where there are several sessions (`starts`, s), the time since the
    start of each is one.
    """
    grid = epoch_time if recorded_time is None else recorded_time
    # As round as the grid: no start comes after the sample that stands for it.
    moments = {name: np.round(np.asarray(own, float), 6) for name, own in power_on.items()}
    sessions = np.zeros(1) if starts is None else np.round(np.asarray(starts, float), 6)
    # What jumps (an effect at its instant, a clock that starts anew) jumps between two samples: the
    # epochs have to be on the grid to be on one side or the other.
    finer = np.unique(np.round(np.concatenate([grid, epoch_time]), 6))
    recorded = {name: np.interp(finer, grid, values) for name, values in recorded.items()}
    grid = finer
    if len(grid) == 1:
        # Forms with a memory need two samples; nothing changes between them.
        grid = grid[0] + np.array([0.0, 1.0])
        recorded = {name: np.repeat(values, 2) for name, values in recorded.items()}
    rows: dict[str, tuple[str, np.ndarray]] = {"constant": ("constant", np.ones_like(grid))}
    rows |= {name: ("quantity", np.asarray(values)) for name, values in recorded.items()}
    rows |= {name: ("difference", values) for name, values in _differences(recorded).items()}
    if len(epoch_time) > 1:
        name = "time" if timed else "order"
        rows[name] = (name, grid - epoch_time[0])
    if timed and len(sessions) > 1:
        rows[SESSION] = ("time", since(grid, sessions))
    rows |= {POWER_ON + camera: ("power-on", since(grid, own)) for camera, own in moments.items()}
    names = list(rows)
    reads = {name: (place,) * max(len(cameras), 1) for place, name in enumerate(names)}
    for name, kind, of_camera in (
        (OWN_BODY, "own", "body_{}_degC"),
        (OWN_POWER_ON, "power-on", POWER_ON + "{}"),
    ):
        each = [of_camera.format(camera) for camera in cameras]
        if len(each) > 1 and all(own in rows for own in each):
            rows[name] = kind, np.mean([rows[own][1] for own in each], axis=0)
            reads[name] = tuple(names.index(own) for own in each)
    if len(rows) == len(names):
        reads = {name: own[:1] for name, own in reads.items()}
    return Channels(
        time=jnp.asarray(grid, float),
        values=jnp.asarray(np.stack([values for _, values in rows.values()]), float),
        epoch_time=jnp.asarray(epoch_time, float),
        reads=jnp.asarray(list(reads.values())),
        names=tuple(rows),
        kinds=tuple(kind for kind, _ in rows.values()),
    )


def _differences(recorded: dict[str, Float[np.ndarray, " times"]]) -> dict[str, np.ndarray]:
    """Temperatures of bodies against that of the air (K)."""
    air, bodies = air_and_bodies(recorded)
    return {f"{name} - {air}": recorded[name] - recorded[air] for name in bodies if air}


def air_and_bodies(names: Iterable[str]) -> tuple[str, tuple[str, ...]]:
    """The channel of the air's temperature, "" without one, and those of bodies."""
    warm = [name for name in names if channel_kind(name) == "temperature"]
    air = next((name for name in warm if name.startswith(("ambient", "air"))), "")
    return air, tuple(name for name in warm if name.startswith("body_"))


def since(time: np.ndarray, moments: np.ndarray) -> np.ndarray:
    """Time since the latest of the moments (s); negative before the first."""
    latest = np.maximum(np.searchsorted(moments, time, side="right") - 1, 0)
    return time - moments[latest]


all_observation_drivers = jax.vmap(observation_drivers, in_axes=(0, 0, 0, 0, None))
"""`observation_drivers` of a table of observations."""

all_range_drivers = jax.vmap(range_drivers)
"""`range_drivers` of a table of distances."""
