"""Drivers: what an effect depends on.

Time-like drivers are channels (recorded quantities, time, time since power-on). Observation-like
drivers are computed for each observation from the present model; they are circumstances, not
unknowns, and are held while a model is fitted. The place in the image is the *predicted* one, the
phase within a pixel included: the measured one contains the residual, and a pattern made of
residuals explains noise. (A mark at rest shows noise e at phase phi; e sin 2 pi (phi + e) does not
average out.)
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.geometry.poses import pose_from_vector
from jaxvm.physics.chain import Circumstances, Sight
from jaxvm.physics.effects import Channels, Term
from jaxvm.physics.forms import BASES

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
    "incidence_u": "1",
    "incidence_v": "1",
    "motion_u": "px/s",
    "motion_v": "px/s",
    "target_x": "half width",
    "target_y": "half height",
    "up_x": "1",
    "up_y": "1",
    "up_z": "1",
}
"""Observation-like drivers and their units."""

OBSERVATION_DRIVER_INDEX = {name: i for i, name in enumerate(OBSERVATION_DRIVERS)}


def observation_drivers(
    sight: Sight,
    circumstances: Circumstances,
    predicted: Float[Array, "2"],
    image_size: Float[Array, "2"],
    up: Float[Array, "3"],
) -> Float[Array, " drivers"]:
    """All observation-like drivers of one observation, in the order of OBSERVATION_DRIVERS.

    `image_x`, `image_y` and `radius` count from the principal point in half image diagonals;
    `row` and `column` from the middle of the image; `incidence` is the angle between the line of
    sight and the target's normal, `incidence_u, _v` the image direction into which the normal
    leans times sin i cos i (the pattern of the eccentricity of circular marks).
    """
    at = circumstances
    world_from_target = pose_from_vector(sight.world_from_target)
    world_from_camera = pose_from_vector(sight.world_from_station) @ pose_from_vector(
        sight.station_from_camera
    )
    camera_from_world = world_from_camera.inverse()
    mark_cam = camera_from_world.apply(world_from_target.apply(sight.point))
    distance = jnp.linalg.norm(mark_cam)
    ray = mark_cam / distance
    normal = camera_from_world.rotation @ world_from_target.rotation[:, 2]
    cosine = normal @ ray
    lean = (normal - cosine * ray)[:2]
    up_cam = camera_from_world.rotation @ up

    arm_world = world_from_target.rotation @ sight.point
    speed = camera_from_world.rotation @ (at.velocity[:3] + jnp.cross(at.velocity[3:], arm_world))
    motion = sight.focal * (speed[:2] - ray[:2] / ray[2] * speed[2]) / mark_cam[2]

    half_diagonal = 0.5 * jnp.linalg.norm(image_size)
    from_centre = (predicted - sight.centre) / half_diagonal
    in_image = (predicted + 0.5) / image_size - 0.5
    in_target = (sight.point - at.target_centre)[:2] / at.target_half_size
    return jnp.stack(
        [
            jnp.ones(()),
            in_image[1],
            in_image[0],
            jnp.linalg.norm(from_centre),
            from_centre[0],
            from_centre[1],
            predicted[0],
            predicted[1],
            distance,
            1.0 / distance,
            jnp.arccos(jnp.clip(jnp.abs(cosine), 0.0, 1.0)),
            lean[0] * cosine,
            lean[1] * cosine,
            motion[0],
            motion[1],
            in_target[0],
            in_target[1],
            up_cam[0],
            up_cam[1],
            up_cam[2],
        ]
    )


def pattern(
    term: Term, drivers: Float[Array, "observations drivers"]
) -> Float[Array, " observations"]:
    """Pattern of one term over a table of observations."""
    x = drivers[:, OBSERVATION_DRIVER_INDEX[term.driver]]
    constants = jnp.asarray((*term.constants, 1.0, 1.0)[:2])
    basis: Callable = BASES[term.basis]
    return basis(x, x, constants)


def build_channels(
    epoch_time: Float[np.ndarray, " epochs"],
    recorded: dict[str, Float[np.ndarray, " times"]],
    recorded_time: Float[np.ndarray, " times"] | None,
    power_on: dict[str, float],
    timed: bool = True,
) -> Channels:
    """Channels of a recording: its own, time (s since the first epoch), time since power-on.

    `power_on` maps a camera to its moment of power-on on the recording's clock (s). Where only the
    order of the epochs is known (not `timed`), there is "order" in place of "time".
    """
    grid = epoch_time if recorded_time is None else recorded_time
    if len(grid) == 1:
        # Forms with a memory need two samples; nothing changes between them.
        grid = grid[0] + np.array([0.0, 1.0])
        recorded = {name: np.repeat(values, 2) for name, values in recorded.items()}
    rows: dict[str, tuple[str, np.ndarray]] = {"constant": ("constant", np.ones_like(grid))}
    rows |= {name: ("quantity", np.asarray(values)) for name, values in recorded.items()}
    if len(epoch_time) > 1:
        name = "time" if timed else "order"
        rows[name] = (name, grid - epoch_time[0])
    rows |= {
        f"time since power-on of {camera}": ("power-on", grid - moment)
        for camera, moment in power_on.items()
    }
    return Channels(
        time=jnp.asarray(grid, float),
        values=jnp.asarray(np.stack([values for _, values in rows.values()]), float),
        epoch_time=jnp.asarray(epoch_time, float),
        names=tuple(rows),
        kinds=tuple(kind for kind, _ in rows.values()),
    )


all_observation_drivers = jax.vmap(observation_drivers, in_axes=(0, 0, 0, 0, None))
"""`observation_drivers` of a table of observations."""
