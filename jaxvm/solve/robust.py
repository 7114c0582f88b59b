"""Losses of squared whitened residuals: plain, Huber, Cauchy, and a redescending one.

A loss maps the squared norm s of one observation's whitened residual to rho(s), with rho(s) = s for
small residuals; its derivative is the weight of iteratively reweighted least squares.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

Squares = Float[Array, " observations"]


class Loss(eqx.Module):
    """A robust loss: its value and its derivative with respect to s."""

    @abc.abstractmethod
    def value(self, square: Squares) -> Squares:
        """rho(s)."""

    @abc.abstractmethod
    def weight(self, square: Squares) -> Squares:
        """rho'(s), between 0 and 1."""


class SquaredLoss(Loss):
    """Least squares."""

    def value(self, square: Squares) -> Squares:
        return square

    def weight(self, square: Squares) -> Squares:
        return jnp.ones_like(square)


class HuberLoss(Loss):
    """Quadratic up to `threshold` standard deviations, then linear (Huber 1964)."""

    threshold: float | Float[Array, ""] = 2.5

    def value(self, square: Squares) -> Squares:
        t = jnp.asarray(self.threshold)
        safe = jnp.maximum(square, t**2)
        return jnp.where(square <= t**2, square, 2.0 * t * jnp.sqrt(safe) - t**2)

    def weight(self, square: Squares) -> Squares:
        t = jnp.asarray(self.threshold)
        return t / jnp.sqrt(jnp.maximum(square, t**2))


class CauchyLoss(Loss):
    """Logarithmic beyond `threshold` standard deviations."""

    threshold: float | Float[Array, ""] = 2.5

    def value(self, square: Squares) -> Squares:
        t2 = jnp.asarray(self.threshold) ** 2
        return t2 * jnp.log1p(square / t2)

    def weight(self, square: Squares) -> Squares:
        return 1.0 / (1.0 + square / jnp.asarray(self.threshold) ** 2)


class TukeyLoss(Loss):
    """Bounded: observations beyond `threshold` standard deviations have no weight (Tukey 1974)."""

    threshold: float | Float[Array, ""] = 6.0

    def value(self, square: Squares) -> Squares:
        t2 = jnp.asarray(self.threshold) ** 2
        inside = jnp.maximum(1.0 - square / t2, 0.0)
        return t2 / 3.0 * (1.0 - inside**3)

    def weight(self, square: Squares) -> Squares:
        t2 = jnp.asarray(self.threshold) ** 2
        return jnp.maximum(1.0 - square / t2, 0.0) ** 2


LOSSES: dict[str, type[Loss]] = {
    "squared": SquaredLoss,
    "huber": HuberLoss,
    "cauchy": CauchyLoss,
    "tukey": TukeyLoss,
}
"""Losses by name."""
