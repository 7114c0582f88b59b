"""What one camera saw of a target: marks, their ideal image points, and the noise of those."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry import LensFamily


class Sighting(eqx.Module):
    """Marks of one target in one image of one camera.

    Image points are ideal: principal distance 1, without distortion. With each goes a matrix W that
    whitens it: W (predicted - measured) has unit covariance, to first order in the noise, whatever
    the lens. A mark that was not seen has W = 0.

    Attributes:
        points: marks in target coordinates (m).
        image: ideal image points.
        whitener: W, in units of one over the ideal image.
    """

    points: Float[Array, "n 3"]
    image: Float[Array, "n 2"]
    whitener: Float[Array, "n 2 2"]


def sighting(
    points: Float[Array, "n 3"],
    pixels: Float[Array, "n 2"],
    focal: Float[Array, "2"],
    centre: Float[Array, "2"],
    lens: LensFamily,
    coefficients: Float[Array, " k"],
    sigma: Float[Array, " n"] | float = 1.0,
) -> Sighting:
    """Marks seen at pixels by a calibrated camera.

    Args:
        points: marks in target coordinates (m).
        pixels: where they were measured (px); NaN for a mark that was not seen.
        focal, centre: principal distance and principal point (px).
        lens: family of the lens; its rays must have z > 0.
        coefficients: of the lens.
        sigma: standard deviation of a pixel coordinate (px).
    """
    distorted = (pixels - centre) / focal
    rays = jax.vmap(lambda at: lens.undistort(coefficients, at))(distorted)
    image = rays[:, :2] / rays[:, 2:]

    def pixel(ideal):
        return lens.distort(coefficients, jnp.append(ideal, 1.0)) * focal

    slope = jax.vmap(jax.jacfwd(pixel))(image)
    sigma = jnp.broadcast_to(jnp.asarray(sigma, float), image.shape[:1])
    seen = jnp.isfinite(image).all(axis=1)
    whitener = jnp.where(seen[:, None, None], slope / sigma[:, None, None], 0.0)
    return Sighting(points, jnp.where(seen[:, None], image, 0.0), whitener)
