"""L-BFGS by jaxopt, with and without bounds; jaxopt is no longer developed: it stays in here."""

import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxvm.solve.descent import Descent, History, Stop, descent
from jaxvm.solve.problem import Problem

with warnings.catch_warnings():
    # It announces its end whenever it is imported.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt

_PATIENCE = 5
"""Iterations in a row that change the cost too little before it ends."""


class _Loop(eqx.Module):
    x: Float[Array, " n"]
    inner: Any
    best: Float[Array, " n"]
    best_cost: Float[Array, ""]
    quiet: Int[Array, ""]  # iterations that changed the cost too little
    stop: Int[Array, ""]
    history: History


def minimise_lbfgs(
    problem: Problem,
    *,
    max_evaluations: int = 10_000,
    target_cost: float | None = None,
    rtol: float = 1e-11,
    bounds: tuple[Float[Array, " n"], Float[Array, " n"]] | None = None,
) -> Descent:
    """L-BFGS (Nocedal & Wright 2006, algorithm 7.5) of a scaled problem from x = 0.

    With bounds it is L-BFGS-B (Byrd, Lu, Nocedal & Zhu 1995). One compiled loop; a problem with
    tables of the same shapes runs without compiling again. An evaluation is one of the cost with
    its gradient, about four times the work of the cost alone.

    Args:
        problem: with unknowns scaled to a unit diagonal (`jaxvm.solve.problem.scaled`).
        max_evaluations: bound on evaluations; the last line search may exceed it by sixty.
        target_cost: cost (half a chi-square) at which it stops; none by default.
        rtol: stop where five iterations in a row change the cost by less than this share of it.
        bounds: least and greatest x, infinite where there is none; x = 0 must be within. A
            parameter p is bounded by (p_min - p_0) / factor, its `factor` being the problem's.

    Raises:
        ValueError: bounds that exclude the start.
    """
    if bounds is not None:
        lower, upper = (jnp.broadcast_to(jnp.asarray(b, float), (problem.n,)) for b in bounds)
        if bool(jnp.any((lower > 0.0) | (upper < 0.0))):
            raise ValueError("the start, x = 0, is outside of the bounds: widen them")
        bounds = lower, upper
    # The packets are for normal equations; without them fewer problems differ in shape.
    bare = eqx.tree_at(lambda p: p.packets, problem, ())
    target = jnp.asarray(-jnp.inf if target_cost is None else target_cost)
    limit = jnp.asarray(max_evaluations)
    last = _descend(bare, bounds, limit, target, jnp.asarray(rtol))
    return descent(
        x=jnp.where(problem.active, last.best, 0.0),
        cost=last.best_cost,
        history=last.history,
        evaluations=last.inner.num_fun_eval,
        stop=last.stop,
        limit=max_evaluations,
    )


@eqx.filter_jit
def _descend(problem: Problem, bounds, limit, target, rtol) -> _Loop:
    # Of jaxopt's line searches the zoom needed up to twice the evaluations and holds eight copies
    # of the gradient to compile, backtracking three. It shortens by 0.8: 60 times go down to 1e-6.
    options: Any = dict(linesearch="backtracking", maxls=60, tol=0.0)
    options |= dict(fun=jax.value_and_grad(problem.cost), value_and_grad=True)
    x = jnp.zeros(problem.n)
    if bounds is None:
        solver = jaxopt.LBFGS(**options)
        extra = ()
    else:
        solver = jaxopt.LBFGSB(**options)
        extra = (bounds,)
    inner: Any = solver.init_state(x, *extra)

    def going(loop: _Loop) -> Bool[Array, ""]:
        return loop.stop == Stop.RUNNING

    def step(loop: _Loop) -> _Loop:
        x, inner = solver.update(loop.x, loop.inner, *extra)
        cost = inner.value
        quiet = jnp.abs(loop.inner.value - cost) <= rtol * jnp.abs(cost)
        quiet = jnp.where(quiet, loop.quiet + 1, 0)
        better = cost < loop.best_cost
        best_cost = jnp.where(better, cost, loop.best_cost)
        stop = _stop(cost, best_cost, quiet, inner.num_fun_eval)
        best = jnp.where(better, x, loop.best)
        history = loop.history.noted(best_cost, inner.num_fun_eval, stop != Stop.RUNNING)
        return _Loop(x, inner, best, best_cost, quiet, stop, history)

    def _stop(cost, best_cost, quiet, evaluations):
        cases = [
            (~jnp.isfinite(cost), Stop.FAILED),
            (best_cost <= target, Stop.TARGET),
            (quiet >= _PATIENCE, Stop.SETTLED),
            (evaluations >= limit, Stop.LIMIT),
        ]
        values = [jnp.asarray(int(value)) for _, value in cases]
        return jnp.select([case for case, _ in cases], values, int(Stop.RUNNING))

    none, first = jnp.zeros((), int), inner.value
    stop = _stop(first, first, none, inner.num_fun_eval)
    history = History.empty().noted(first, inner.num_fun_eval, True)
    start = _Loop(x, inner, x, first, none, stop, history)
    return jax.lax.while_loop(going, step, start)
