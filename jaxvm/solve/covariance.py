"""Covariance of any quantity of an adjusted scene, and the precision of its unknowns.

The covariance of q(state) is Q H^-1 Q^T with Q = dq/dx and H the Gauss-Newton matrix; it is never
formed for all unknowns. `scale` multiplies it: 1 trusts the stated sigmas, the variance factor
trusts the residuals.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.compiling import program
from jaxvm.network.network import Residuals
from jaxvm.network.state import State
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.arrow import ArrowFactors, factorise
from jaxvm.solve.gauge import RankDeficiency
from jaxvm.solve.large import is_large
from jaxvm.solve.problem import Problem, normal_at
from jaxvm.solve.selected import SelectedInverse
from jaxvm.solve.snooping import robust_variance
from jaxvm.solve.sparse import Pattern, SparseFactors, sparse_normal

_COLUMNS = 8
"""Columns are solved for in multiples of so many: one effect more is no other program."""


def covariance(
    adjustment: Adjustment,
    quantity: Callable[[State], Float[Array, " m"]],
    scale: float = 1.0,
) -> Float[Array, "m m"]:
    """Covariance (units of the quantity, squared) of `quantity(state)` at the solution.

    `quantity` must be differentiable; it may combine any fields of the state, such as the pose of
    one target relative to another.
    """
    rows = _derivative(adjustment.problem, adjustment.x, quantity)
    return scale * rows @ _solve(_factors(adjustment), rows.T)


def _factors(adjustment: Adjustment) -> ArrowFactors | SparseFactors:
    """The factorised normal matrix at the solution."""
    if is_large(adjustment.problem):
        factors = SparseFactors(Pattern.of(adjustment.problem))
        normal = sparse_normal(adjustment.problem, factors.pattern, adjustment.x)
        if not factors.factorise(normal):
            raise RankDeficiency(
                "the normal equations at the solution are singular: there is no covariance; "
                "adjust with check=True to have the unknowns named"
            )
        return factors
    return _factorised(normal_at(adjustment.problem, adjustment.x).hessian)


_factorised = program(factorise)


def _solve(factors: ArrowFactors | SparseFactors, right):
    if isinstance(factors, SparseFactors):
        return factors.solve(np.asarray(right))
    return _solved(factors, right)


@program
def _solved(factors: ArrowFactors, right):
    return factors.solve(right)


@program
def _derivative(problem: Problem, x, quantity):
    return jax.jacrev(lambda y: jnp.ravel(quantity(problem.state(y))))(x)


def wald_drops(
    adjustment: Adjustment, groups: list[np.ndarray], spread: np.ndarray | None = None
) -> list[float]:
    """How much chi-square would rise if groups of amplitudes were held at zero: a^T C^-1 a.

    Each group lists amplitudes by their number; `spread` is the covariance of all amplitudes, where
    it is known already.
    """
    spread = amplitude_covariance(adjustment) if spread is None else spread
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
    units = np.zeros((problem.n, len(columns)))
    units[columns, np.arange(len(columns))] = 1.0
    inverse = np.asarray(_solve(_factors(adjustment), jnp.asarray(units)))[columns]
    factor = np.asarray(problem.factor)[positions]
    spread = factor[:, None] * inverse * factor
    return spread if chosen is None else spread[np.ix_(chosen, chosen)]


def influence(adjustment: Adjustment, positions: np.ndarray) -> Residuals:
    """Weights with which whitened residuals enter the estimates at positions of the flat state.

    The columns of J H^-1, in the units of the parameters: an estimate errs by minus the sum of its
    weights times the whitened noise. White noise of unit variance gives it the sum of their squares
    as its variance; what noise of another covariance gives it is found in the same way. Blocks of
    residuals get a last axis, one entry for each position; zero where a parameter is held.
    """
    problem = adjustment.problem
    columns = np.asarray(problem.column)[positions]
    units = np.zeros((problem.n, _COLUMNS * -(-len(columns) // _COLUMNS)))
    live = np.flatnonzero(columns < problem.n)
    units[columns[live], live] = np.asarray(problem.factor)[positions[live]]
    steps = np.asarray(_solve(_factors(adjustment), jnp.asarray(units)))[:, : len(columns)]
    weights = _along(problem, adjustment.x, steps)
    return problem.network.unpadded(weights)


def _along(problem: Problem, x, steps: Float[np.ndarray, "n k"]) -> Residuals:
    """Change of all residuals along each of some steps, packet by packet of their Jacobian."""
    padded = np.concatenate([steps, np.zeros((1, steps.shape[1]))])
    changes = []
    for table, packets in zip(problem.linearised(x), problem.packets, strict=True):
        rows, jacobian = np.asarray(packets.rows), np.asarray(table.jacobian)
        n, components, live = jacobian.shape
        change = np.zeros((n + 1, components, steps.shape[1]))
        for own, columns in zip(rows, np.asarray(packets.columns), strict=True):
            block = jacobian[own[own < n]].reshape(-1, live) @ padded[columns]
            change[own[own < n]] = block.reshape(-1, components, steps.shape[1])
        changes.append(change[:n])
    return problem.network.residuals(changes)


def pose_covariances(
    adjustment: Adjustment, table: str = "world_from_station", scale: float = 1.0
) -> Float[np.ndarray, "rows 6 6"]:
    """Covariance of every pose of a table of the state: turn (rad), then shift (m).

    Zero where it is held (spare rows are), NaN where it is free and no observation touches it. The
    turn is that of the pose's rotation vector.
    """
    problem = adjustment.problem
    layout = problem.network.layout
    positions = layout.slots(table, np.arange(layout.shapes[table][0]))
    columns, factor = np.asarray(problem.column)[positions], np.asarray(problem.factor)[positions]
    if is_large(problem):
        selected = SelectedInverse.of(adjustment.problem, adjustment.x)
        inverse, touched = selected.blocks(columns), selected.diagonal() > 0.0
    else:
        inverse = np.zeros((*columns.shape, 6))
        factors = _factors(adjustment)
        assert isinstance(factors, ArrowFactors)
        touched = np.asarray(factors.touched)
        for row, own in enumerate(columns):
            live = np.flatnonzero(own < problem.n)
            if not len(live):
                continue
            units = np.zeros((problem.n, 6))
            units[own[live], live] = 1.0
            solved = np.asarray(_solve(factors, jnp.asarray(units)))
            inverse[row][np.ix_(live, live)] = solved[own[live]][:, live]
    unseen = ~np.append(touched, True)[np.minimum(columns, problem.n)].all(axis=1)
    inverse[unseen] = np.nan
    return scale * factor[:, :, None] * inverse * factor[:, None, :]


def standard_deviations(adjustment: Adjustment, scale: float = 1.0) -> State:
    """Standard deviation of every parameter of the state.

    Zero where it is held, NaN where it is free and no observation touches it.
    """
    problem = adjustment.problem
    if is_large(problem):
        inverse = SelectedInverse.of(problem, adjustment.x)
        variance, touched = inverse.diagonal(), inverse.diagonal() > 0.0
        variance = np.append(np.where(np.asarray(problem.active), variance, 0.0), 0.0)
        flat = jnp.abs(problem.factor) * jnp.sqrt(variance[np.asarray(problem.column)])
    else:
        factors = _factors(adjustment)
        assert isinstance(factors, ArrowFactors)
        touched = factors.touched
        flat = _marginals(problem.column, problem.factor, problem.active, factors)
    unknown = np.append(np.asarray(problem.active) & ~np.asarray(touched), False)
    flat = jnp.where(unknown[np.asarray(problem.column)], jnp.nan, flat)
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


@program
def _marginals(column, factor, active, factors: ArrowFactors):
    """Square roots of the diagonal of H^-1, in the units of the parameters."""
    s, groups, d = factors.arrow.sizes
    shared = jnp.linalg.inv(factors.reduced) if s else jnp.zeros((0, 0))
    half = jax.vmap(jnp.linalg.inv)(factors.local) if groups else jnp.zeros((0, d, d))
    # V^-1 and its correction V^-1 W S^-1 W^T V^-1 through the shared unknowns.
    spread = jnp.einsum("gea,ges->gas", half, factors.coupled)
    through = jnp.einsum("gas,ts->gat", spread, shared)
    local = jnp.sum(half**2, axis=1) + jnp.sum(through**2, axis=2)
    variance = jnp.concatenate([jnp.sum(shared**2, axis=0), jnp.ravel(local), jnp.zeros(1)])
    active = jnp.concatenate([active, jnp.zeros(1, bool)])
    variance = jnp.where(active, variance, 0.0)
    return jnp.abs(factor) * jnp.sqrt(variance[column])
