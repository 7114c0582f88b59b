"""Points from rays: mid-point, linear, and optimal triangulation from two or more cameras."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry import Pose

_STEPS = 8


class Triangulated(eqx.Module):
    """A point seen by several cameras.

    Attributes:
        point: in the common frame (m).
        covariance: of the point (m^2).
        cost: chi-square of the image points.
    """

    point: Float[Array, "3"]
    covariance: Float[Array, "3 3"]
    cost: Float[Array, ""]


def mid_point(origin: Float[Array, "c 3"], direction: Float[Array, "c 3"]) -> Float[Array, "3"]:
    """Point with the least sum of squared distances (m) from lines: of two, their mid-point.

    Args:
        origin: a point on each line (m).
        direction: of each line, of any length.
    """
    unit = direction / jnp.linalg.norm(direction, axis=1, keepdims=True)
    across = jnp.eye(3) - unit[:, :, None] * unit[:, None, :]
    return jnp.linalg.solve(across.sum(axis=0), jnp.einsum("cij,cj->i", across, origin))


def linear(camera_from_world: Pose, image: Float[Array, "c 2"]) -> Float[Array, "3"]:
    """Linear triangulation (DLT; Hartley and Zisserman 2004, section 12.2).

    It minimises an algebraic error, and is best where all cameras are equally far.

    Args:
        camera_from_world: poses of the cameras, stacked.
        image: ideal image points (principal distance 1).
    """
    rows = jnp.concatenate([camera_from_world.rotation, camera_from_world.shift[:, :, None]], 2)
    equations = image[:, :, None] * rows[:, 2:] - rows[:, :2]  # c 2 4
    _, _, vt = jnp.linalg.svd(equations.reshape(-1, 4), full_matrices=False)
    return vt[-1, :3] / vt[-1, 3]


def optimal(
    camera_from_world: Pose, image: Float[Array, "c 2"], whitener: Float[Array, "c 2 2"]
) -> Triangulated:
    """Maximum-likelihood point: Gauss-Newton on whitened image errors from the linear one.

    Args:
        camera_from_world: poses of the cameras, stacked.
        image: ideal image points.
        whitener: W with W (predicted - measured) of unit covariance.
    """

    def residual(point):
        def one(camera, measured, w):
            seen = camera.apply(point)
            return w @ (seen[:2] / seen[2] - measured)

        return jax.vmap(one)(camera_from_world, image, whitener).ravel()

    def step(_, point):
        e, slope = residual(point), jax.jacfwd(residual)(point)
        return point - jnp.linalg.solve(slope.T @ slope, slope.T @ e)

    point = jax.lax.fori_loop(0, _STEPS, step, linear(camera_from_world, image))
    e, slope = residual(point), jax.jacfwd(residual)(point)
    return Triangulated(point, jnp.linalg.inv(slope.T @ slope), e @ e)
