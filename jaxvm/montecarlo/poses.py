"""Monte Carlo of single poses: a target before a camera, with or without a laser range."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from jaxvm.montecarlo.trials import Traced, Trial, fingerprint, name_of
from jaxvm.network.draw import Noise
from jaxvm.pose.precision import Setup, pose_error, predicted_covariance


class PoseTrial(eqx.Module):
    """One trial: draw a setup and its image, locate the target, compare.

    Attributes:
        setup: the target before the camera, or how one is drawn from a key.
        noise: its distribution, in units of the sigmas.
    """

    setup: Setup | Callable[[PRNGKeyArray], Setup]
    noise: Noise

    def __call__(self, key: PRNGKeyArray) -> Trial:
        if isinstance(self.setup, Setup):
            setup = self.setup
        else:
            key, own = jax.random.split(key)
            setup = self.setup(own)
        error = pose_error(setup, key, self.noise)
        sigma = jnp.sqrt(jnp.diagonal(predicted_covariance(setup)))
        return Trial(
            {"turn": error[:3], "shift": error[3:]},
            sigma={"turn": sigma[:3], "shift": sigma[3:]},
        )


def pose_study(
    setup: Setup | Callable[[PRNGKeyArray], Setup],
    noise: Noise = jax.random.normal,
    told: dict[str, Any] | None = None,
) -> Traced:
    """The study of one pose, from its global start to the maximum of the likelihood.

    Errors are turns and shifts of the target's middle in the axes of the camera (rad, m), each with
    the standard deviation that theory foretells for this very setup.

    Args:
        setup: one target before a camera, or a function that draws one from a key.
        noise: its distribution; normal by default.
        told: what else the study is, for a file.
    """
    trial = PoseTrial(setup, noise)
    about = {"kind": "pose", "noise": name_of(noise), "numbers": fingerprint(trial)}
    return Traced(trial, about | (told or {}))
