"""Covariance of any quantity of an adjusted scene, and the precision of its unknowns.

The covariance of q(state) is Q H^-1 Q^T with Q = dq/dx and H the Gauss-Newton matrix; it is never
formed for all unknowns. `scale` multiplies it: 1 trusts the stated sigmas, the variance factor
trusts the residuals.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.network.state import State
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.arrow import ArrowFactors, factorise
from jaxvm.solve.problem import Problem, normal_at
from jaxvm.solve.snooping import robust_variance


def covariance(
    adjustment: Adjustment,
    quantity: Callable[[State], Float[Array, " m"]],
    scale: float = 1.0,
) -> Float[Array, "m m"]:
    """Covariance (units of the quantity, squared) of `quantity(state)` at the solution.

    `quantity` must be differentiable; it may combine any fields of the state, such as the pose of
    one target relative to another.
    """
    return scale * _covariance(adjustment.problem, adjustment.x, _factors(adjustment), quantity)


def _factors(adjustment: Adjustment) -> ArrowFactors:
    """The factorised normal matrix at the solution."""
    return _factorised(normal_at(adjustment.problem, adjustment.x).hessian)


_factorised = eqx.filter_jit(factorise)


@eqx.filter_jit
def _covariance(problem: Problem, x, factors: ArrowFactors, quantity):
    rows = jax.jacrev(lambda y: jnp.ravel(quantity(problem.state(y))))(x)
    return rows @ factors.solve(rows.T)


def wald_drops(adjustment: Adjustment, groups: list[np.ndarray]) -> list[float]:
    """How much chi-square would rise if groups of amplitudes were held at zero: a^T C^-1 a.

    Each group lists amplitudes by their number.
    """
    spread = amplitude_covariance(adjustment)
    values = np.asarray(adjustment.scene.state.amplitude)
    return [
        float(values[own] @ np.linalg.solve(spread[np.ix_(own, own)], values[own]))
        for own in groups
    ]


def amplitude_covariance(
    adjustment: Adjustment, chosen: np.ndarray | None = None
) -> Float[np.ndarray, "columns columns"]:
    """Covariance of the amplitudes of effects (of the chosen ones), for unit variance."""
    problem = adjustment.problem
    positions = problem.network.layout.all("amplitude")
    columns = np.asarray(problem.column)[positions]
    inverse = np.asarray(_inverse_columns(_factors(adjustment), jnp.asarray(columns)))[columns]
    factor = np.asarray(problem.factor)[positions]
    spread = factor[:, None] * inverse * factor
    return spread if chosen is None else spread[np.ix_(chosen, chosen)]


@eqx.filter_jit
def _inverse_columns(factors: ArrowFactors, columns):
    count = columns.shape[0]
    return factors.solve(
        jnp.zeros((factors.arrow.in_size(), count)).at[columns, jnp.arange(count)].set(1.0)
    )


def standard_deviations(adjustment: Adjustment, scale: float = 1.0) -> State:
    """Standard deviation of every parameter of the state; zero where it is held."""
    flat = _marginals(adjustment.problem, _factors(adjustment))
    return adjustment.problem.network.layout.restore(jnp.sqrt(scale) * flat)


def effect_deviations(adjustment: Adjustment) -> list[tuple[float, ...]]:
    """Standard deviations of every effect: its amplitudes, then its constants.

    The variance of unit weight is that of the residuals, robustly estimated.
    """
    deviations = standard_deviations(adjustment, robust_variance(adjustment))
    amplitude, constant = np.asarray(deviations.amplitude), np.asarray(deviations.constant)
    return [
        tuple(map(float, (*amplitude[columns], *constant[constants])))
        for columns, constants in adjustment.scene.places()
    ]


@eqx.filter_jit
def _marginals(problem: Problem, factors: ArrowFactors):
    """Square roots of the diagonal of H^-1, in the units of the parameters."""
    s, groups, d = problem.sizes
    shared = jnp.linalg.inv(factors.reduced) if s else jnp.zeros((0, 0))
    half = jax.vmap(jnp.linalg.inv)(factors.local) if groups else jnp.zeros((0, d, d))
    # V^-1 and its correction V^-1 W S^-1 W^T V^-1 through the shared unknowns.
    spread = jnp.einsum("gea,ges->gas", half, factors.coupled)
    through = jnp.einsum("gas,ts->gat", spread, shared)
    local = jnp.sum(half**2, axis=1) + jnp.sum(through**2, axis=2)
    variance = jnp.concatenate([jnp.sum(shared**2, axis=0), jnp.ravel(local), jnp.zeros(1)])
    active = jnp.concatenate([problem.active, jnp.zeros(1, bool)])
    variance = jnp.where(active, variance, 0.0)
    return jnp.abs(problem.factor) * jnp.sqrt(variance[problem.column])
