"""Estimators of a trial: from a problem, scaled and at its start, to unknowns. All are traced."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxvm.solve.descent import Stop
from jaxvm.solve.optimise import levenberg_marquardt
from jaxvm.solve.problem import Problem
from jaxvm.solve.spgd import descended


class Estimate(NamedTuple):
    """What an estimator found.

    Attributes:
        x: unknowns of the problem.
        cost: half the sum of (robust) squares there.
        converged: whether it is an estimate.
        evaluations: of normal equations, or of the cost.
    """

    x: Float[Array, " n"]
    cost: Float[Array, ""]
    converged: Bool[Array, ""]
    evaluations: Int[Array, ""]


Estimator = Callable[[Problem, PRNGKeyArray], Estimate]


class GaussNewton(eqx.Module):
    """Full steps until no unknown would move any more: for starts at or near the truth.

    The length of a step s is sqrt(s^T H s), the Newton decrement (Boyd and Vandenberghe 2004, sec.
    9.5.1): no combination of unknowns moves by more of its standard deviations. The next one is
    foretold from the last two, which shrink by at least the same factor again.

    Attributes:
        settled: length of a step (standard deviations) below which it has converged.
        most: bound on steps.
    """

    settled: Any = eqx.field(default=1e-6, converter=jnp.asarray)
    most: Any = eqx.field(default=20, converter=jnp.asarray)

    def __call__(self, problem: Problem, key: PRNGKeyArray) -> Estimate:
        def step(state):
            x, before, _, k = state
            normal = problem.normal(x)
            change = -normal.hessian.factorised().solve(normal.gradient)
            size = jnp.sqrt(jnp.maximum(-change @ normal.gradient, 0.0))
            return x + change, size, size * jnp.minimum(size / before, 1.0), k + 1

        def going(state):
            _, _, ahead, k = state
            return (ahead > self.settled) & (k < self.most)

        start = jnp.zeros(problem.n), jnp.array(0.0), jnp.array(jnp.inf), jnp.array(0)
        x, _, ahead, k = jax.lax.while_loop(going, step, start)
        return Estimate(x, problem.cost(x), ahead <= self.settled, k)


class LevenbergMarquardt(eqx.Module):
    """Damped steps: for starts that may be far, and robust losses.

    Attributes:
        limit: bound on evaluations.
        rtol: relative change of the cost at which it has converged.
        damping: of the first step, in units of the diagonal.
    """

    limit: Any = eqx.field(default=100, converter=jnp.asarray)
    rtol: Any = eqx.field(default=1e-12, converter=jnp.asarray)
    damping: Any = eqx.field(default=1e-3, converter=jnp.asarray)

    def __call__(self, problem: Problem, key: PRNGKeyArray) -> Estimate:
        solver = levenberg_marquardt(self.rtol, limit=self.limit, damping=self.damping)
        found = optx.least_squares(
            _residual, solver, jnp.zeros(problem.n), problem, max_steps=None, throw=False
        )
        evaluations = found.stats["evaluations"]
        good = (found.result == optx.RESULTS.successful) & (evaluations < self.limit)
        return Estimate(found.value, problem.cost(found.value), good, evaluations)


def _residual(x: Float[Array, " n"], problem: Problem):
    return problem.residual(x)


class Spgd(eqx.Module):
    """Stochastic parallel gradient descent, until the cost hardly falls any more or a limit."""

    max_evaluations: Any = eqx.field(default=20_000, converter=jnp.asarray)
    rtol: Any = eqx.field(default=1e-4, converter=jnp.asarray)

    def __call__(self, problem: Problem, key: PRNGKeyArray) -> Estimate:
        x, found = descended(problem, key, max_evaluations=self.max_evaluations, rtol=self.rtol)
        return Estimate(x, found["cost"], found["stop"] != Stop.FAILED, found["evaluations"])


ESTIMATORS = {
    "gauss-newton": GaussNewton,
    "levenberg-marquardt": LevenbergMarquardt,
    "spgd": Spgd,
}
"""Estimators of networks by name."""
