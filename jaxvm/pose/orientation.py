"""Absolute orientation with uncertainty: a pose from two sets of points that are not exact."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry import Pose, align, hat, so3_exp, vector_from_pose
from jaxvm.pose.refine import Refined

_STEPS = 10


def orient(
    points_a: Float[Array, "n 3"],
    points_b: Float[Array, "n 3"],
    covariance_a: Float[Array, "n 3 3"],
    covariance_b: Float[Array, "n 3 3"] | None = None,
    weight: Float[Array, " n"] | None = None,
) -> Refined:
    """Maximum-likelihood pose a_from_b of points with covariances in both frames.

    From the closed form (Arun 1987, Horn 1987, Umeyama 1991; `jaxvm.geometry.align`), which takes
    all points as equally precise in all directions, Gauss-Newton steps with their own covariances
    C = C_a + R C_b R^T.

    Args:
        points_a, points_b: the same points in both frames (m).
        covariance_a, covariance_b: of the points (m^2); those of b are exact without it.
        weight: 1 for the points that count, 0 for the others.
    """
    weight = jnp.ones(len(points_a)) if weight is None else weight
    counts = weight > 0.0
    points_a = jnp.where(counts[:, None], points_a, points_b)
    covariance_a = jnp.where(counts[:, None, None], covariance_a, jnp.eye(3))
    extra = jnp.zeros((3, 3)) if covariance_b is None else covariance_b
    pose, _ = align(points_a, points_b, weight)

    def normal(rotation, shift):
        seen = points_b @ rotation.T + shift
        information = weight[:, None, None] * jnp.linalg.inv(
            covariance_a + rotation @ extra @ rotation.T
        )
        e = seen - points_a
        slope = jax.vmap(lambda x: jnp.concatenate([-hat(x), jnp.eye(3)], axis=1))(seen)
        hessian = jnp.einsum("nia,nij,njb->ab", slope, information, slope)
        return jnp.einsum("ni,nij,nj->", e, information, e), hessian, (
            jnp.einsum("nia,nij,nj->a", slope, information, e)
        )  # fmt: skip

    def step(_, state):
        rotation, shift = state
        _, hessian, pull = normal(rotation, shift)
        change = -jnp.linalg.solve(hessian, pull)
        turn = so3_exp(change[:3])
        return turn @ rotation, turn @ shift + change[3:]

    rotation, shift = jax.lax.fori_loop(0, _STEPS, step, (pose.rotation, pose.shift))
    cost, hessian, _ = normal(rotation, shift)
    vector = vector_from_pose(Pose(rotation, shift))
    return Refined(vector, cost, jnp.linalg.inv(hessian), jnp.asarray(_STEPS))
