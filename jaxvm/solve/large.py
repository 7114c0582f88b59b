"""Gauss-Newton and Levenberg-Marquardt for large networks: a loop on the host about CHOLMOD.

As in `jaxvm.solve.optimise` damping is relative to a unit diagonal and the stop is statistical; how
damping changes differs (`_changed`), for here every step counts.
"""

import time
from dataclasses import dataclass
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxvm.network.unknowns import Unknowns
from jaxvm.solve.gauge import RankDeficiency, deficiency, named_direction
from jaxvm.solve.problem import Problem, to_unit_diagonal
from jaxvm.solve.schur import SchurFactors, schur_normal
from jaxvm.solve.schur_pattern import SchurPattern
from jaxvm.solve.sparse import Pattern, SparseFactors, SparseNormal, sparse_normal, total_cost

_MOST_DAMPING, _LEAST_DAMPING = 1e12, 1e-12
_UNSEEN = 1e-20
"""Sum of squared residual changes by a unit vector of scaled unknowns that shows nothing at all.

Rounding leaves 1e-30. The eigenvalues of a long chain fall with the fourth power of its length:
those of the matrix, which rounding touches at 1e-16, can't tell a weak network from a broken one.
"""


_DENSE = 1500
"""Shared unknowns beyond which a dense arrow is slower than sparse factors, and soon too large."""


_WIDE = 1_000_000
"""Couplings of groups with shared unknowns beyond which those that are zero are left out."""


_MOSTLY_LOCAL = 4.0
"""Local over shared unknowns beyond which groups are eliminated first in a sparse matrix, too."""


def is_large(problem: Problem) -> bool:
    """Whether covariances of a problem come from sparse factors on the host."""
    s, groups, d = problem.sizes
    return s > _DENSE or s * groups * d > 50_000_000


class Equations(Protocol):
    """Normal equations of a problem at one x."""

    @property
    def pattern(self) -> Any: ...
    @property
    def cost(self) -> float: ...
    @property
    def gradient(self) -> Any: ...
    def diagonal(self) -> Float[np.ndarray, " n"]: ...
    def at(self, problem: Problem, x: Any) -> Any: ...


class Factors(Protocol):
    """Place for the factors of damped normal equations.

    `bends` says that the problem is far from linear where damping is low: points in space.
    """

    bends: bool

    def factorise(self, normal: Any, damping: float = 0.0) -> bool: ...
    def damped(self, normal: Any) -> Float[np.ndarray, " n"]: ...
    def solve(self, right: Any) -> Any: ...


def prepared(problem: Problem) -> tuple[Problem, Equations, Factors] | None:
    """A problem with unknowns scaled to a unit diagonal, its normal equations at x = 0, and a place
    for their factors; None where the dense arrow is quicker.

    Many groups that each touch few of the shared unknowns are eliminated one by one
    (`jaxvm.solve.schur`), what is left is dense or sparse; where most unknowns are shared,
    everything is one sparse matrix (`jaxvm.solve.sparse`).
    """
    s, groups, d = problem.sizes
    dense = s <= _DENSE
    if s * groups * d > _WIDE and (dense or groups * d > _MOSTLY_LOCAL * s):
        pattern = SchurPattern.of(problem, dense=dense)
        if pattern is not None:
            normal = schur_normal(problem, pattern, jnp.zeros(problem.n))
            return *_unit(problem, normal), SchurFactors(pattern)
    if not is_large(problem):
        return None
    pattern = Pattern.of(problem)
    return *scaled_large(problem, pattern), SparseFactors(pattern)


@dataclass(frozen=True)
class LargeFit:
    """Solution of a large problem, and how it was reached."""

    x: Float[np.ndarray, " n"]
    history: Float[np.ndarray, " evaluations"]  # cost at the best point after each evaluation
    seconds: Float[np.ndarray, " evaluations"]  # since the call
    evaluations: int
    accepted: int
    why: str


def scaled_large(problem: Problem, pattern: Pattern) -> tuple[Problem, SparseNormal]:
    """The problem with unknowns scaled to a unit diagonal, and its normal equations at x = 0."""
    return _unit(problem, sparse_normal(problem, pattern, jnp.zeros(problem.n)))


def _unit(problem: Problem, normal):
    problem, scale = to_unit_diagonal(problem, normal.diagonal())
    return problem, normal.rescaled(scale)


def minimise_large(
    problem: Problem,
    normal: Equations,
    factors: Factors,
    method: str,
    rtol: float = 1e-12,
    atol: float = 1e-9,
    limit: int = 100,
    damping: float = 1e-4,
) -> LargeFit:
    """Minimise a scaled problem from x = 0, given its normal equations there.

    It stops when a hardly damped step is foretold to change the cost by no more than `rtol` of
    itself plus `atol`, or when damping can't find a lower cost any more.

    Args:
        problem: with unknowns scaled to a unit diagonal.
        normal: at x = 0.
        factors: for the pattern of `normal`.
        method: "gauss-newton" takes full steps; "levenberg-marquardt" damps them.
        rtol, atol: of the cost.
        limit: bound on evaluations.
        damping: the first one of Levenberg-Marquardt.
    """
    began = time.perf_counter()
    x, history, seconds, accepted = np.zeros(problem.n), [normal.cost], [0.0], 0
    refused = 0
    careful = method == "levenberg-marquardt"
    damping = damping if careful else 0.0
    why = f"stopped after {limit} evaluations: not converged"
    while len(history) < limit:
        if not factors.factorise(normal, damping):
            if not careful or damping > _MOST_DAMPING:
                why = "failed: the normal equations are singular"
                break
            damping = max(10.0 * damping, _LEAST_DAMPING)
            continue
        step = -np.asarray(factors.solve(normal.gradient))
        # step^T H step = -(gradient + damping D step)^T step, D what damping is relative to
        damped = damping * float(step @ (factors.damped(normal) * step))
        foretold = -0.5 * float(np.asarray(normal.gradient) @ step) + 0.5 * damped
        if abs(foretold) <= rtol * normal.cost + atol and damping <= 1.0:
            # The last step: its cost is wanted, no equations for a further one.
            cost = total_cost(problem, jnp.asarray(x + step))
            lower = cost <= normal.cost
            if lower:
                x, accepted = x + step, accepted + 1
            history.append(cost if lower else normal.cost)
            seconds.append(time.perf_counter() - began)
            why = "converged: the cost no longer changes"
            break
        at = jnp.asarray(x + step)
        # After a refusal another one is likely: the cost tells it for less than the equations.
        trial = None if refused else normal.at(problem, at)
        cost = total_cost(problem, at) if trial is None else trial.cost
        gained = normal.cost - cost
        better = np.isfinite(cost) and (not careful or gained > 1e-4 * foretold)
        settled = abs(gained) <= rtol * normal.cost + atol
        if better:
            normal = normal.at(problem, at) if trial is None else trial
            x, accepted = x + step, accepted + 1
        history.append(normal.cost)
        seconds.append(time.perf_counter() - began)
        if settled and damping <= 1.0:
            why = "converged: the cost no longer changes"
            break
        if not better and not careful:
            why = "failed: the cost is no number after a full step"
            break
        if not better and damping > _MOST_DAMPING:
            why = "converged: no step lowers the cost any more"
            break
        if careful:
            ratio = gained / foretold if foretold > 0.0 else -1.0
            refused = 0 if better else refused + 1
            damping = _changed(damping, ratio, refused, factors.bends)
    return LargeFit(x, np.array(history), np.array(seconds), len(history), accepted, why)


def _changed(damping: float, ratio: float, refused: int, bends: bool) -> float:
    """Less after a step that went as foretold; ever more after bad ones in a row.

    The weak modes of a large network need a damping near nothing, and every step counts: where the
    linear model foretells a step exactly it falls steeply. Where a problem bends it falls to a
    third at most, less where less was gained, and doubles, then grows fourfold, ... after refused
    steps (Nielsen 1999): in a curved valley larger changes have every other step refused.
    """
    if refused:
        return (2.0 if bends else 10.0) ** refused * damping
    if bends:
        factor = max(1.0 / 3.0, 1.0 - (2.0 * min(ratio, 1.0) - 1.0) ** 3)
    else:
        factor = 1e-3 if ratio > 0.98 else 0.1 if ratio > 0.25 else 1.0
    return max(factor * damping, _LEAST_DAMPING)


def check_large_gauge(
    problem: Problem, normal: Equations, factors: Factors, unknowns: Unknowns
) -> None:
    """Raise RankDeficiency, naming the unknowns, where a scaled problem is singular.

    The least eigenvector comes from inverse iteration; whether any observation sees it, from the
    residual's own derivative along it.
    """
    shift = 0.0 if factors.factorise(normal) else 1e-12
    if shift and not factors.factorise(normal, shift):
        raise RankDeficiency("the normal equations are not finite; mend the start values")
    used = normal.diagonal() > 0.0
    vector = np.where(used, np.random.default_rng(0).standard_normal(normal.pattern.n), 0.0)
    for _ in range(4):
        vector = np.where(used, factors.solve(vector), 0.0)
        vector /= np.linalg.norm(vector)
    eigenvalue = float(_seen(problem, jnp.asarray(vector)))
    if not eigenvalue > _UNSEEN:
        raise deficiency([named_direction(eigenvalue, vector, unknowns.names())])


@eqx.filter_jit
def _seen(problem: Problem, direction):
    """Sum of squared changes of the whitened residuals along a direction of the unknowns."""
    _, change = jax.jvp(problem.residual, (jnp.zeros(problem.n),), (direction,))
    return sum(jnp.sum(block**2) for block in jax.tree.leaves(change))
