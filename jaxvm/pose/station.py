"""Pose of a target from a station: several cameras, laser ranges, or both, at once.

The unknowns are a turn and a shift of the target as the station sees it. Image points and ranges
are whitened together, so that each weighs what it knows.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry import Pose, pose_from_vector, so3_exp, vector_from_pose
from jaxvm.pose.monocular import locate
from jaxvm.pose.orientation import orient
from jaxvm.pose.refine import Refined
from jaxvm.pose.sighting import Sighting
from jaxvm.pose.triangulate import optimal

_STEPS = 30


class Ranges(eqx.Module):
    """Distances from the rangefinders of a station to a target.

    Attributes:
        station_from_rangefinder: (turn, shift); the beam is the instrument's z axis.
        point: the mark in target coordinates (m), or any point of the plane.
        to_plane: 1 where the beam meets the target's plane z = const, 0 for the distance to a mark.
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

        def one(vector, point, to_plane):
            seen = pose_from_vector(vector).inverse() @ station_from_target
            mark, normal = seen.apply(point), seen.rotation[:, 2]
            across = jnp.where(to_plane > 0.5, normal[2], 1.0)
            distance = jnp.sqrt(jnp.where(to_plane > 0.5, 1.0, mark @ mark))
            return jnp.where(to_plane > 0.5, normal @ mark / across, distance)

        return jax.vmap(one)(self.station_from_rangefinder, self.point, self.to_plane)


def locate_from_station(
    sightings: Sighting,
    station_from_camera: Float[Array, "c 6"],
    ranges: Ranges | None = None,
    start: Float[Array, "6"] | None = None,
) -> Refined:
    """Maximum-likelihood pose station_from_target from the cameras and rangefinders of a station.

    Args:
        sightings: of every camera, stacked: [c, n, ...]; with ranges alone missing cameras are no
            help, at least one camera is needed.
        station_from_camera: (turn, shift) of every camera.
        ranges: of the station's rangefinders.
        start: station_from_target; without it that of the camera that sees most, and with a range
            moved along its axis.
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

    def linearised(pose: Pose):
        slope = jax.jacfwd(lambda change: residuals(moved(pose, change)))(jnp.zeros(6))
        e = residuals(pose)
        return e @ e, slope.T @ e, slope.T @ slope

    def step(state):
        pose, cost, pull, hessian, damping, count, _ = state
        damped = hessian + damping * jnp.diag(jnp.diag(hessian))
        change = -jnp.linalg.solve(damped, pull)
        new = moved(pose, change)
        new_cost, new_pull, new_hessian = linearised(new)
        better = new_cost <= cost
        still = -change @ pull <= 1e-14 * cost + 1e-20
        kept = jax.tree.map(
            lambda a, b: jnp.where(better, a, b),
            (new, new_cost, new_pull, new_hessian),
            (pose, cost, pull, hessian),
        )
        damping = jnp.where(better, 0.1 * damping, jnp.maximum(10.0 * damping, 1e-3))
        return *kept, damping, count + 1, still

    pose = pose_from_vector(start)
    state = pose, *linearised(pose), jnp.asarray(1e-6), jnp.asarray(0), jnp.asarray(False)
    pose, cost, _, hessian, _, count, _ = jax.lax.while_loop(
        lambda s: ~s[-1] & (s[-2] < _STEPS), step, state
    )
    return Refined(vector_from_pose(pose), cost, jnp.linalg.inv(hessian), count)


def _start(sightings: Sighting, station_from_camera) -> Float[Array, "6"]:
    """Pose by the camera whose marks are the most precise for their number."""
    found = jax.vmap(locate)(sightings).best
    size = jnp.linalg.det(found.covariance)
    best = jnp.argmin(jnp.where(jnp.isfinite(found.cost), size, jnp.inf))
    seen = pose_from_vector(station_from_camera[best]) @ pose_from_vector(
        found.observer_from_target[best]
    )
    return vector_from_pose(seen)
