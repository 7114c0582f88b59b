"""Distributions of noise beside the normal one, all with zero mean and unit variance.

Anything that is called with a key and a shape is one (`jaxvm.network.draw.Noise`); measurements
multiply it by their sigmas. Normal noise is `jax.random.normal`.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxvm.network.draw import Noise


class StudentT(eqx.Module):
    """Heavy tails: Student's t with more than two degrees of freedom."""

    freedom: Any = eqx.field(default=5.0, converter=jnp.asarray)

    def __call__(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "..."]:
        scale = jnp.sqrt((self.freedom - 2.0) / self.freedom)
        return scale * jax.random.t(key, self.freedom, shape)


class Laplace(eqx.Module):
    """Two-sided exponential."""

    def __call__(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "..."]:
        return jax.random.laplace(key, shape) / jnp.sqrt(2.0)


class Uniform(eqx.Module):
    """Between -sqrt(3) and sqrt(3), as rounding is."""

    def __call__(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "..."]:
        return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0) * jnp.sqrt(3.0)


class Outliers(eqx.Module):
    """Normal, but a share of the numbers is a factor larger (Tukey 1960); unit variance in all."""

    share: Any = eqx.field(default=0.01, converter=jnp.asarray)
    factor: Any = eqx.field(default=10.0, converter=jnp.asarray)

    def __call__(self, key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "..."]:
        which, values = jax.random.split(key)
        size = jnp.where(jax.random.bernoulli(which, self.share, shape), self.factor, 1.0)
        variance = 1.0 + self.share * (self.factor**2 - 1.0)
        return size * jax.random.normal(values, shape) / jnp.sqrt(variance)


KINDS: dict[str, Callable[..., Any]] = {
    "normal": lambda: jax.random.normal,
    "student-t": StudentT,
    "laplace": Laplace,
    "uniform": Uniform,
    "outliers": Outliers,
}
"""Noise by name, with its numbers after colons: `student-t:4`, `outliers:0.02:10`."""


def noise_by_name(text: str) -> Noise:
    """Noise of a name and its numbers.

    Raises:
        ValueError: there is none of this name, or its numbers are none that it takes.
    """
    name, *numbers = text.split(":")
    known = f"there are {', '.join(KINDS)}; numbers follow: student-t:4, outliers:0.02:10"
    if name not in KINDS:
        raise ValueError(f'there is no noise "{name}" ({known})')
    try:
        values = [float(number) for number in numbers]
        noise = KINDS[name](*values)
    except (ValueError, TypeError):
        raise ValueError(f'noise "{text}" has numbers that it does not take ({known})') from None
    if name == "student-t" and not float(noise.freedom) > 2.0:
        raise ValueError(f'noise "{text}" has no variance: more than 2 degrees of freedom are due')
    if name == "outliers" and not (0.0 <= float(noise.share) <= 1.0 and float(noise.factor) > 0.0):
        raise ValueError(f'noise "{text}": a share from 0 to 1 and a factor above 0 are due')
    return noise
