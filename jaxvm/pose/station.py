"""Pose of a target from a station: several cameras, laser ranges, or both, at once.

The unknowns are a turn and a shift of the target as the station sees it. Image points and ranges
are whitened together, so that each weighs what it knows.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from jaxvm.geometry import Pose, pose_from_vector, so3_exp, vector_from_pose
from jaxvm.physics.chain import Aim, Circumstances, predict_range
from jaxvm.physics.ports import PortValues
from jaxvm.pose.monocular import locate
from jaxvm.pose.orientation import orient
from jaxvm.pose.refine import Refined
from jaxvm.pose.sighting import Sighting
from jaxvm.pose.triangulate import optimal

_STEPS, _RTOL = 100, 1e-10


class Ranges(eqx.Module):
    """Distances from the rangefinders of a station to a target.

    Attributes:
        station_from_rangefinder: (turn, shift); the beam is the instrument's z axis.
        point: the mark in target coordinates (m); not read where the beam meets the plane.
        to_plane: 1 where the beam meets the target's plane z = 0, 0 for the distance to a mark.
        distance: what was measured (m).
        sigma: its standard deviation (m).
    """

    station_from_rangefinder: Float[Array, "m 6"]
    point: Float[Array, "m 3"]
    to_plane: Float[Array, " m"]
    distance: Float[Array, " m"]
    sigma: Float[Array, " m"]

    def residuals(self, station_from_target: Pose) -> Float[Array, " m"]:
        """Whitened (predicted - measured)."""
        return (self.predicted(station_from_target) - self.distance) / self.sigma

    def predicted(self, station_from_target: Pose) -> Float[Array, " m"]:
        """Distances (m): along the beam to the plane, n.(t - o) / (n.d), or to the mark."""

        # The plain chain reads none of its circumstances.
        none = Circumstances(*[jnp.zeros(())] * len(Circumstances._fields))

        def one(vector, point, to_plane):
            own = vector_from_pose(station_from_target)
            aim = Aim(vector, jnp.zeros(6), jnp.zeros(6), own, point)
            return predict_range(aim, none, to_plane, PortValues())

        return jax.vmap(one)(self.station_from_rangefinder, self.point, self.to_plane)


def locate_from_station(
    sightings: Sighting,
    station_from_camera: Float[Array, "c 6"],
    ranges: Ranges | None = None,
    start: Float[Array, "6"] | None = None,
) -> Refined:
    """Maximum-likelihood pose station_from_target from the cameras and rangefinders of a station.

    Args:
        sightings: of every camera, stacked: [c, n, ...].
        station_from_camera: (turn, shift) of every camera.
        ranges: of the station's rangefinders.
        start: station_from_target; without it that of the camera that knows it best.
    """
    cameras = jax.vmap(lambda v: pose_from_vector(v).inverse())(station_from_camera)
    if start is None:
        start = _start(sightings, station_from_camera)

    def residuals(pose: Pose):
        def of_camera(camera, sighting):
            seen = jax.vmap((camera @ pose).apply)(sighting.points)
            error = seen[:, :2] / seen[:, 2:] - sighting.image
            return jnp.einsum("nij,nj->ni", sighting.whitener, error)

        seen = jax.vmap(of_camera)(cameras, sightings).ravel()
        return seen if ranges is None else jnp.concatenate([seen, ranges.residuals(pose)])

    return most_likely(residuals, start)


def locate_body(sightings: Sighting, station_from_camera: Float[Array, "c 6"]) -> Refined:
    """Pose station_from_target in two steps: marks are triangulated, then oriented absolutely.

    The classical way, with the covariances of the triangulated marks; `locate_from_station` does it
    in one step.
    """
    cameras = jax.vmap(lambda v: pose_from_vector(v).inverse())(station_from_camera)
    each = jax.vmap(optimal, in_axes=(None, 1, 1))(cameras, sightings.image, sightings.whitener)
    seen = jnp.all(jnp.any(sightings.whitener != 0.0, axis=(2, 3)), axis=0)
    return orient(each.point, sightings.points[0], each.covariance, weight=seen.astype(float))


def most_likely(
    residuals: Callable[[Pose], Float[Array, " r"]], start: Float[Array, "6"]
) -> Refined:
    """The pose with the least sum of squared whitened residuals near a start.

    Levenberg-Marquardt over a turn and a shift of what is seen, X -> exp(w) X + d.
    """

    def moved(pose: Pose, change):
        turn = so3_exp(change[:3])
        return Pose(turn @ pose.rotation, turn @ pose.shift + change[3:])

    first = pose_from_vector(start)
    found = optx.least_squares(
        lambda change, _: residuals(moved(first, change)),
        optx.LevenbergMarquardt(rtol=_RTOL, atol=_RTOL),
        jnp.zeros(6),
        max_steps=_STEPS,
        throw=False,
    )
    pose = moved(first, found.value)
    e, slope = residuals(pose), jax.jacfwd(lambda c: residuals(moved(pose, c)))(jnp.zeros(6))
    covariance = jnp.linalg.inv(slope.T @ slope)
    return Refined(vector_from_pose(pose), e @ e, covariance, found.stats["num_steps"])


def _start(sightings: Sighting, station_from_camera) -> Float[Array, "6"]:
    """Pose by the camera whose marks are the most precise for their number."""
    found = jax.vmap(locate)(sightings).best
    size = jnp.linalg.det(found.covariance)
    best = jnp.argmin(jnp.where(jnp.isfinite(found.cost), size, jnp.inf))
    seen = pose_from_vector(station_from_camera[best]) @ pose_from_vector(
        found.observer_from_target[best]
    )
    return vector_from_pose(seen)
