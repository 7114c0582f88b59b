"""How precise is a pose: Monte Carlo over noise, against the covariance that theory predicts."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxvm.geometry import Pose, hat, pose_from_vector, so3_log
from jaxvm.network.draw import Noise
from jaxvm.pose.monocular import locate
from jaxvm.pose.refine import Refined
from jaxvm.pose.sighting import Sighting
from jaxvm.pose.station import Ranges, locate_from_station


class Setup(eqx.Module):
    """A target before a camera, and perhaps a laser range.

    Attributes:
        points: marks in target coordinates (m).
        camera_from_target: (turn, shift).
        focal: principal distance (px).
        sigma: noise of a pixel coordinate (px).
        range_sigma: noise of a distance along the optical axis to the target's plane (m);
            infinite without a rangefinder.
    """

    points: Float[Array, "n 3"]
    camera_from_target: Float[Array, "6"]
    focal: Float[Array, ""]
    sigma: Float[Array, ""]
    range_sigma: Float[Array, ""] = eqx.field(default_factory=lambda: jnp.asarray(jnp.inf))


class Precision(eqx.Module):
    """Errors of poses in repeated measurements, and their predicted covariance.

    Turns and shifts are those of the target's middle as the camera sees it: x, y across the optical
    axis, z along it.

    Attributes:
        error: (turn, shift) of each repetition (rad, m).
        covariance: predicted by the normal equations at the truth (Cramer-Rao).
    """

    error: Float[Array, "*b k 6"]
    covariance: Float[Array, "*b 6 6"]

    @property
    def measured(self) -> Float[Array, "*b 6"]:
        """RMS of the errors."""
        return jnp.sqrt(jnp.mean(self.error**2, axis=-2))

    @property
    def predicted(self) -> Float[Array, "*b 6"]:
        """Standard deviations that theory predicts."""
        return jnp.sqrt(jnp.diagonal(self.covariance, axis1=-2, axis2=-1))

    @property
    def along(self) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
        """Error along the optical axis (m): measured, predicted."""
        return self.measured[..., 5], self.predicted[..., 5]

    @property
    def across(self) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
        """Error across the optical axis (m), RMS of its two components: measured, predicted."""
        rms = jnp.sqrt(jnp.mean(self.measured[..., 3:5] ** 2, axis=-1))
        return rms, jnp.sqrt(jnp.mean(self.predicted[..., 3:5] ** 2, axis=-1))


def precision(setup: Setup, key: PRNGKeyArray, repetitions: int = 1000) -> Precision:
    """Monte Carlo of a pose, from its global start to the maximum of the likelihood.

    Pure: `jax.vmap` it over setups for a study over noise, distance, field or size. Processors take
    three times as long for that as for setup after setup, whose poses fit their caches.
    """
    keys = jax.random.split(key, repetitions)
    error = jax.vmap(lambda own: pose_error(setup, own))(keys)
    return Precision(error, predicted_covariance(setup))


def pose_error(
    setup: Setup, key: PRNGKeyArray, noise: Noise = jax.random.normal
) -> Float[Array, "6"]:
    """Error of a pose measured once: (turn, shift) of the target's middle (rad, m).

    Args:
        noise: numbers of zero mean and unit variance, of a key and a shape.
    """
    pose, middle, image = _seen(setup)
    of_image, of_range = jax.random.split(key)
    pixels = image + noise(of_image, image.shape) * setup.sigma / setup.focal
    # An infinite sigma whitens any noise to nothing.
    spread = jnp.where(jnp.isfinite(setup.range_sigma), setup.range_sigma, 0.0)
    distance = _rangefinder(setup).predicted(pose) + noise(of_range, (1,)) * spread
    start = locate(Sighting(setup.points, pixels, _whitener(setup))).best
    refined = _fused(setup, pixels, distance, start.observer_from_target)
    found = pose_from_vector(refined.observer_from_target)
    turn = so3_log(found.rotation @ pose.rotation.T)
    centre = pose.inverse().apply(middle)
    return jnp.concatenate([turn, found.apply(centre) - middle])


def predicted_covariance(setup: Setup) -> Float[Array, "6 6"]:
    """Covariance of `pose_error` that theory foretells."""
    pose, middle, image = _seen(setup)
    exact = _fused(setup, image, _rangefinder(setup).predicted(pose), setup.camera_from_target)
    # From the camera's centre to the target's middle: d + w x m.
    carry = jnp.eye(6).at[3:, :3].set(-hat(middle))
    return carry @ exact.covariance @ carry.T


def _seen(setup: Setup) -> tuple[Pose, Float[Array, "3"], Float[Array, "n 2"]]:
    """True pose, middle of the target, and ideal image points."""
    pose = pose_from_vector(setup.camera_from_target)
    seen = jax.vmap(pose.apply)(setup.points)
    return pose, jnp.mean(seen, axis=0), seen[:, :2] / seen[:, 2:]


def _whitener(setup: Setup) -> Float[Array, "n 2 2"]:
    return jnp.broadcast_to(jnp.eye(2) * setup.focal / setup.sigma, (len(setup.points), 2, 2))


def _rangefinder(setup: Setup) -> Ranges:
    return Ranges(
        station_from_rangefinder=jnp.zeros((1, 6)),
        point=jnp.zeros((1, 3)),
        to_plane=jnp.ones(1),
        distance=jnp.ones(1),
        sigma=jnp.ones(1) * setup.range_sigma,
    )


def _fused(setup: Setup, image, distance, start) -> Refined:
    ranges = eqx.tree_at(lambda r: r.distance, _rangefinder(setup), distance)
    own = Sighting(setup.points, image, _whitener(setup))
    one = jax.tree.map(lambda leaf: leaf[None], own)
    return locate_from_station(one, jnp.zeros((1, 6)), ranges, start)
