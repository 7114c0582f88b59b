"""Pose of a target from one camera: orthogonal iteration with a global start, both minima.

The object-space error of Lu, Hager and Mjolsness (2000) has one deep minimum, and for a plane seen
from afar a second one, tilted to the other side (Schweighofer and Pinz 2006). `locate` starts from
the rotations near the flat directions of the error's quadratic form (Terzakis and Lourakis 2020),
goes to the minimum of each by Newton steps, tries the mirrored pose of the best one, too, and
refines both to maximum likelihood (`jaxvm.pose.refine`). `orthogonal_iteration` is that of Lu,
Hager and Mjolsness: it gets to a minimum of the same error in many more steps, from weak
perspective.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxvm.geometry import (
    Pose,
    nearest_rotation,
    pose_from_vector,
    so3_exp,
    so3_log,
    vector_from_pose,
)
from jaxvm.pose.object_space import ObjectSpace, object_space
from jaxvm.pose.refine import Refined, refine
from jaxvm.pose.sighting import Sighting

_EIGENVECTORS = 4
"""Flat directions that serve as starts, with both signs: three are exactly flat for a plane."""

_NEWTON_STEPS = 12

_SAME = 1e-4
"""Angle (rad) within which two minima are one."""


class Minimum(eqx.Module):
    """A minimum of the object-space error.

    Attributes:
        pose: camera_from_target.
        error: E (m^2).
        iterations: until it stood still.
    """

    pose: Pose
    error: Float[Array, ""]
    iterations: Int[Array, ""]


class Monocular(eqx.Module):
    """Pose of a target from one image.

    Attributes:
        best, second: maximum-likelihood poses camera_from_target with chi-square and covariance,
            the better one first. Where there is no second minimum its cost is infinite.
    """

    best: Refined
    second: Refined


def locate(sighting: Sighting) -> Monocular:
    """Pose of a target from one image, at the maximum of the likelihood; both minima of a plane.

    Four marks or more, no three of four on a line. Pure and jitted under `vmap`.
    """
    weight = _weights(sighting)
    frame, space = _centred(sighting, weight)
    first = _global_minimum(space)
    other = _polished(space, _mirrored(space, first))
    # The mirror of a target that is no plane may lead back, or behind the camera.
    apart = jnp.linalg.norm(so3_log(other.T @ first)) > _SAME
    both = jax.tree.map(
        lambda a, b: jnp.stack([a, b]), space.pose(first) @ frame, space.pose(other) @ frame
    )
    vectors = jax.vmap(vector_from_pose)(both)
    refined = jax.vmap(lambda start: refine(sighting, start))(vectors)
    apart &= (
        jnp.linalg.norm(refined.observer_from_target[0] - refined.observer_from_target[1]) > _SAME
    )
    cost = jnp.where(jnp.array([True, False]) | apart, refined.cost, jnp.inf)
    cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
    refined = eqx.tree_at(lambda r: r.cost, refined, cost)
    order = jnp.argsort(cost)
    best, second = (jax.tree.map(lambda leaf, k=k: leaf[order[k]], refined) for k in (0, 1))
    return Monocular(best, second)


def orthogonal_iteration(
    sighting: Sighting,
    start: Float[Array, "6"] | None = None,
    tolerance: float = 1e-12,
    most: int = 2000,
) -> Minimum:
    """Orthogonal iteration (Lu, Hager, Mjolsness 2000) from a start, or from its global one.

    Every step replaces the marks by their nearest points on the rays and takes the rotation that
    brings them there; the error never grows. It converges linearly (a plane seen from afar needs
    some 200 steps), to the minimum of the error in space, which is not that of the likelihood.

    Args:
        sighting: marks and ideal image points.
        start: camera_from_target as (turn, shift); weak perspective without it.
        tolerance: turn (rad) of a step at which it stops.
        most: bound on the number of steps.
    """
    frame, space = _centred(sighting, _weights(sighting))
    if start is None:
        rotation = _weak_perspective(sighting, frame)
    else:
        rotation = (pose_from_vector(start) @ frame.inverse()).rotation

    def moves(state):
        _, moved, count = state
        return (moved > tolerance) & (count < most)

    def step(state):
        rotation, _, count = state
        new = _step(space, rotation)
        return new, jnp.linalg.norm(new - rotation), count + 1

    state = rotation, jnp.asarray(jnp.inf), jnp.asarray(0)
    rotation, _, count = jax.lax.while_loop(moves, step, state)
    return Minimum(space.pose(rotation) @ frame, space.error(rotation), count)


def _weights(sighting: Sighting) -> Float[Array, " n"]:
    """Weight of each mark: its information over the mean one; 0 where it was not seen."""
    information = jnp.einsum("nij,nij->n", sighting.whitener, sighting.whitener)
    return information / jnp.maximum(information.mean(), 1e-300)


def _centred(sighting: Sighting, weight) -> tuple[Pose, ObjectSpace]:
    """principal_from_target, and the object-space error over principal axes.

    There a plane is z = 0, so that its mirrored pose has a closed form.
    """
    points = sighting.points
    mean = weight @ points / weight.sum()
    spread = jnp.einsum("n,nc,nd->cd", weight, points - mean, points - mean)
    _, axes = jnp.linalg.eigh(spread)
    axes = axes[:, ::-1]
    axes = axes * jnp.array([1.0, 1.0, jnp.linalg.det(axes)])
    frame = Pose(axes.T, -axes.T @ mean)
    return frame, object_space((points - mean) @ axes, sighting.image, weight)


def _step(space: ObjectSpace, rotation: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """One orthogonal iteration: the marks' nearest points on the rays, and the rotation to them.

    sum w V (R p + t) (p - mean)^T = R C - mat(Omega r), because F (R p + t) sums to zero.
    """
    pull = (space.omega @ rotation.reshape(9)).reshape(3, 3)
    return nearest_rotation(rotation @ space.spread - pull)


def _weak_perspective(sighting: Sighting, frame: Pose) -> Float[Array, "3 3"]:
    """Rotation of an object at one depth: the start of Lu, Hager and Mjolsness."""
    weight = _weights(sighting)
    centred = jax.vmap(frame.apply)(sighting.points)
    rays = jnp.concatenate([sighting.image, jnp.ones((len(sighting.image), 1))], axis=1)
    return nearest_rotation(jnp.einsum("n,na,nc->ac", weight, rays, centred))


def _global_minimum(space: ObjectSpace) -> Float[Array, "3 3"]:
    """The best rotation of all starts that has the target before the camera."""
    _, vectors = jnp.linalg.eigh(space.omega)
    flat = vectors[:, :_EIGENVECTORS].T.reshape(-1, 3, 3)
    starts = jax.vmap(nearest_rotation)(jnp.concatenate([flat, -flat]))
    found = jax.vmap(lambda start: _polished(space, start))(starts)
    error = jax.vmap(space.error)(found)
    error = jnp.where(jax.vmap(lambda r: _before(space, r))(found), error, jnp.inf)
    return found[jnp.argmin(jnp.where(jnp.isnan(error), jnp.inf, error))]


def _before(space: ObjectSpace, rotation: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """Whether the middle of the target is before the camera."""
    return space.pose(rotation).shift[2] > 0.0


def _mirrored(space: ObjectSpace, rotation: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The plane tilted to the other side: S R diag(1, 1, -1), S = I - 2 v v^T about the ray v.

    At weak perspective both are seen alike.
    """
    shift = space.pose(rotation).shift
    ray = shift / jnp.linalg.norm(shift)
    mirror = jnp.eye(3) - 2.0 * ray[:, None] * ray[None, :]
    return mirror @ rotation * jnp.array([1.0, 1.0, -1.0])


def _polished(space: ObjectSpace, rotation: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The minimum of the object-space error near a rotation: Newton steps that never go up."""

    def step(_, state):
        rotation, error, damping = state
        gradient, hessian = space.derivatives(rotation)
        values, axes = jnp.linalg.eigh(hessian)
        # Uphill directions are taken downhill.
        size = jnp.abs(values) + damping * jnp.abs(values).max() + 1e-300
        turn = -axes @ ((axes.T @ gradient) / size)
        new = so3_exp(turn) @ rotation
        new_error = space.error(new)
        better = new_error < error
        return (
            jnp.where(better, new, rotation),
            jnp.where(better, new_error, error),
            jnp.where(better, 0.1 * damping, jnp.maximum(10.0 * damping, 1e-3)),
        )

    state = rotation, space.error(rotation), jnp.asarray(1e-3)
    return jax.lax.fori_loop(0, _NEWTON_STEPS, step, state)[0]
