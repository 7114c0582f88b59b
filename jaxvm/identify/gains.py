"""Gains: what enters a dynamic model linearly, with physical priors, and how a fit is judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from jaxvm.identify.difference import Difference
    from jaxvm.identify.lags import Lags

LOOSE = 2.0
"""Prior width of a gain: so many large drifts for a range of the input (`Inputs.ranges`)."""

SLOWEST = 6.0
"""A time constant is at most the span of the epochs over this; longer ones fit what is once."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model, and how well it foretells what it was not fitted to.

    Attributes:
        model: fitted to all epochs.
        chi: sum over modes of (error / sigma)^2 at every epoch, fitted to all.
        held_out: where an epoch's block was not fitted, minus twice the logarithm of the density
            that was foretold: e^2 / s^2 + ln(s^2 / sigma^2), with s^2 of the noise and the gains.
        unknowns: number of constants and gains.
        courses: outputs at the epochs, the mean taken off.
    """

    model: Lags | Difference
    chi: Float[np.ndarray, " epochs"]
    held_out: Float[np.ndarray, " epochs"]
    unknowns: int
    courses: Float[np.ndarray, "epochs outputs"]


def foretold_density(error, variance, sigma) -> np.ndarray:
    """Minus twice the logarithm of the foretold density of errors, over that of no error at all.

    Args:
        error: measured minus foretold.
        variance: of what is foretold.
        sigma: noise.
    """
    wider = 1.0 + variance / sigma**2
    return (error / sigma) ** 2 / wider + np.log(wider)


def prior_widths(
    large: Float[np.ndarray, " outputs"], ranges: Float[np.ndarray, " r"], states: int
) -> Float[np.ndarray, "1+r+states outputs"]:
    """Prior standard deviations of the mean, of the gains of regressors, and of states at first."""
    each = np.concatenate([[10.0], LOOSE / ranges, np.full(states, LOOSE)])
    return each[:, None] * large


@jax.jit
def gains_at(design, z, weight, widths):
    """Gains [regressors, outputs], their variances, and those of what they foretell."""

    def one(own, w, width):
        unit = design * width
        a = unit * w[:, None]
        inverse = jnp.linalg.inv(a.T @ a + jnp.eye(design.shape[1]))
        foretold = jnp.sum((unit @ inverse) * unit, axis=1)
        gains = width * (inverse @ (a.T @ (own * w)))
        return gains, width**2 * jnp.diag(inverse), foretold

    return jax.vmap(one, in_axes=(1, 1, 1), out_axes=1)(z, weight, widths)


def linear_gains(design, z, weight, widths) -> tuple[np.ndarray, ...]:
    """Errors, gains [regressors, outputs], their variances, and those of what they foretell.

    Args:
        design: regressors [epochs, regressors].
        z, weight: outputs and 1 / sigma, 0 where not used [epochs, outputs].
        widths: prior standard deviations of the gains [regressors, outputs].
    """
    found = gains_at(*map(jnp.asarray, (design, z, weight, widths)))
    gains, variance, foretold = map(np.asarray, found)
    return z - design @ gains, gains, variance, foretold
