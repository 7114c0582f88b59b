"""Absolute orientation: the pose (and scale) that takes one set of points to another."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry.poses import Pose


def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Rotation R with the largest trace(R^T M), the nearest to a matrix M.

    By singular values with det R = +1 (Arun 1987, Umeyama 1991).
    """
    u, _, vt = jnp.linalg.svd(matrix)
    flip = jnp.array([1.0, 1.0, 0.0]) + jnp.array([0.0, 0.0, 1.0]) * jnp.linalg.det(u @ vt)
    return (u * flip) @ vt


def align(
    points_a: Float[Array, "n 3"],
    points_b: Float[Array, "n 3"],
    weights: Float[Array, " n"] | None = None,
    with_scale: bool = False,
) -> tuple[Pose, Float[Array, ""]]:
    """Pose a_from_b and scale that minimise sum w |a - (scale R b + t)|^2.

    The closed form of Arun (1987), Horn (1987) and Umeyama (1991). Without `with_scale` the scale
    is 1.
    """
    w = jnp.ones(len(points_a)) if weights is None else weights
    w = w / jnp.sum(w)
    mean_a, mean_b = w @ points_a, w @ points_b
    a, b = points_a - mean_a, points_b - mean_b
    moment = (a * w[:, None]).T @ b
    rotation = nearest_rotation(moment)
    spread = jnp.sum(w[:, None] * b**2)
    scale = jnp.where(with_scale, jnp.sum(rotation * moment) / spread, 1.0)
    return Pose(rotation, mean_a - scale * (rotation @ mean_b)), scale
