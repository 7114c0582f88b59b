"""Gauss-Newton and Levenberg-Marquardt on normal equations, as one optimistix solver.

optimistix's own least-squares solvers hand a linear solver the whole Jacobian; here the problem
(`jaxvm.solve.problem.Problem`, passed as `args`) gives its normal equations in arrow form, and
optimistix's descents (Newton, damped Newton) and searches (learning rate, trust region) do the
rest.
"""

from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxvm.compiling import program
from jaxvm.solve.arrow import NormalCholesky
from jaxvm.solve.problem import Normal, Problem, normal_at

_HISTORY = 512

_MOST_CUTS = 2
"""Rejections in a row after which damping grows no faster."""

_GRANTED, _SLOWEST = 3.0, 0.9
"""What a minimisation may gain beyond what its steps promise, and the slowest rate it is given."""


_CURVED = 2
"""Trials worse than foretold from which on a minimisation follows the curve of its valley."""

_MOST_BENT = 0.375
"""Length of the correction for curvature, in lengths of the step, from which it is not trusted.

Transtrum and Sethna (2012): twice the second-order correction at most 0.75 of the step.
"""


class HasNormal(Protocol):
    """What gives normal equations: a problem, or one that is shared out to devices."""

    def normal(self, x: Any) -> Normal: ...


class _State(eqx.Module):
    first: Bool[Array, ""]
    trial: Float[Array, " n"]
    info: Any
    search: Any
    descent: Any
    failed: Float[Array, ""]  # step size at which the descent gave no step; infinite where it did
    done: Bool[Array, ""]
    result: optx.RESULTS
    evaluations: Int[Array, ""]
    accepted: Int[Array, ""]
    history: Float[Array, " steps"]  # accepted cost after each evaluation


class _Region(eqx.Module):
    step_size: Float[Array, ""]
    rejected: Int[Array, ""]  # trials in a row


class Relaxing(optx.ClassicalTrustRegion):
    """Trust region that starts near Gauss-Newton, opens fast, and closes faster and faster.

    Unknowns are scaled to a unit diagonal, so the damping is relative. Where trials are rejected in
    a row, damping grows tenfold, then a hundredfold, then a thousandfold each time (as Nielsen's
    rule does, 1999): what began near Gauss-Newton is soon where damping matters.
    """

    damping: float | Float[Array, ""] = 1e-3

    high_cutoff: float = 0.75
    low_cutoff: float = 1e-4
    high_constant: float = 10.0
    low_constant: float = 0.1

    def init(self, y, f_info_struct) -> Any:
        return _Region(1.0 / jnp.asarray(self.damping), jnp.array(0))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state: Any) -> Any:
        size, accept, result, _ = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        again = jnp.minimum(state.rejected, _MOST_CUTS)
        size = jnp.where(accept, size, size * self.low_constant**again)
        return size, accept, result, _Region(size, jnp.where(accept, 0, state.rejected + 1))


class NormalEquationSolver(optx.AbstractLeastSquaresSolver):
    """Least squares by normal equations: a descent, a search, and a statistical stopping rule.

    The problem is passed as `args`. It stops when a hardly damped step changes the cost, or
    promises to change it, by no more than `rtol` of itself plus `atol`, or when damping can't find
    a lower cost any more: after a rejection the next step promises no more than that. The cost is
    half a chi-square, so a change of `atol` moves no combination of unknowns by more than
    sqrt(2 atol) of its standard deviation. A last step that promises so little is taken unseen.
    Where the descent gives no step (a damped matrix that is not positive definite), that counts as
    a rejected trial; it is a failure where damping grows no further.
    """

    rtol: float | Float[Array, ""]
    atol: float | Float[Array, ""]
    limit: int | Int[Array, ""]  # evaluations; data, so that another bound is no other program
    norm: Any
    descent: optx.AbstractDescent
    search: optx.AbstractSearch

    def _info(self, y, problem):
        return _as_info(normal_at(problem, y))

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return self.begin(y, eqx.filter_eval_shape(self._info, y, args))

    def begin(self, y, shape):
        """State before the first step; `shape` is the structure of the normal equations."""
        blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
        return _State(
            first=jnp.array(True),
            trial=y,
            info=blank,
            search=self.search.init(y, shape),
            descent=self.descent.init(y, blank),
            failed=jnp.array(jnp.inf),
            done=jnp.array(False),
            result=optx.RESULTS.successful,
            evaluations=jnp.array(0),
            accepted=jnp.array(0),
            history=jnp.full(_HISTORY, jnp.nan),
        )

    def step(self, fn, y, args, options, state, tags):
        return *self.advance(y, state, self._info(state.trial, args)), None

    def advance(self, y, state, info):
        """Accept or reject the trial point by its normal equations, and propose the next one."""
        # A trial that never left the accepted point would count as a cost that changes no more.
        info = eqx.tree_at(lambda i: i.f, info, jnp.where(_gave(state), info.f, jnp.inf))
        size, accept, search_result, search = self.search.step(
            state.first, y, state.trial, state.info, info, state.search
        )
        accept = accept & (jnp.isfinite(info.f) | state.first)

        def choose(new, old):
            return jax.tree.map(lambda a, b: jnp.where(accept, a, b), new, old)

        y = jnp.where(accept, state.trial, y)
        kept = choose(info, state.info)
        little = self.rtol * kept.f + self.atol
        settled = (jnp.abs(state.info.f - info.f) <= little) & (size >= 1.0)
        stuck = ~accept & (size < 1e-12)
        done = ~state.first & (settled | stuck)
        descent = self.descent.query(y, kept, state.descent)
        change, descent_result = self.descent.step(size, descent)
        failed = descent_result != optx.RESULTS.successful
        hopeless = failed & ((size < 1e-12) | (size >= state.failed))
        # What the next step promises, by the quadratic model.
        promised = -jnp.sum(change * (kept.grad + 0.5 * kept.hessian.mv(change)))
        ends = ~failed & (promised <= little)
        unseen = ends & (size >= 1.0) & ~done
        y = jnp.where(unseen, y + change, y)
        done = done | unseen | (ends & ~accept)
        result = optx.RESULTS.where(hopeless, descent_result, search_result)
        state = _State(
            first=jnp.array(False),
            trial=y + change,
            info=kept,
            search=search,
            descent=descent,
            failed=jnp.where(failed, size, jnp.inf),
            done=done | hopeless | (state.evaluations + 1 >= self.limit),
            result=result,
            evaluations=state.evaluations + 1,
            accepted=state.accepted + accept,
            history=state.history.at[state.evaluations].set(kept.f, mode="drop"),
        )
        return y, state

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {
            "evaluations": state.evaluations,
            "accepted": state.accepted,
            "history": state.history,
        }  # fmt: skip


def _gave(state: _State) -> Bool[Array, ""]:
    """Whether the descent gave the step that leads to the trial."""
    return jnp.isinf(state.failed)


def minimise(
    problem: HasNormal, normal: Normal, solver: NormalEquationSolver, wanted: float = np.inf
):
    """Drive a solver from x = 0, where the normal equations are known already.

    The same as `optimistix.least_squares`, step by step from outside, so that the one compiled
    program for the normal equations serves here, too; compiling is what most calls wait for.

    Args:
        problem: gives the normal equations at any x.
        normal: these at x = 0.
        solver: descent, search and rule to stop.
        wanted: cost above which the solution is of no use: the drive ends where it won't get there.

    Returns:
        The solution x, the solver's last state.
    """
    info = _as_info(normal)
    y, state = _begin(solver, info)
    y, state = _advance(solver, y, state, info)
    follows = isinstance(solver.search, Relaxing)
    curved = problem if follows and isinstance(problem, Problem) else None
    doubts, here = 0, None
    while not (bool(state.done) or (np.isfinite(wanted) and _out_of_reach(state, wanted))):
        if curved is None:
            y, state = _advance(solver, y, state, _as_info(problem.normal(state.trial)))
            continue
        before, tables = state, curved.linearised(state.trial)
        y, state = _advance(solver, y, state, _as_info(curved.assembled(tables)))
        if int(state.accepted) > int(before.accepted):
            here = tables
        doubts += not _trusts_more(before, state)
        if doubts >= _CURVED and not bool(state.done):
            here = curved.linearised(y) if here is None else here
            state = _bent(solver, y, state, curved.bend(here, y, state.trial - y))
    return y, state


def _trusts_more(before: _State, after: _State) -> bool:
    """Whether the last trial was as good as the normal equations had foretold."""
    return bool(after.search.step_size > before.search.step_size)


@program
def _bent(solver: NormalEquationSolver, y, state: _State, bend: Float[Array, " n"]) -> _State:
    """The state with a trial that follows the curve of the valley, where it is a gentle one.

    The residuals along a step v are r + J v + r'' / 2; what the bend r'' adds is taken off by the
    same damped normal equations (geodesic acceleration; Transtrum, Machta and Sethna, 2011). A
    straight step in a curved, narrow valley (a tilted sensor beside a centre that is free) is
    rejected again and again until it is short.
    """
    info = eqx.tree_at(lambda info: info.grad, state.info, bend)
    descent = solver.descent.query(y, info, state.descent)
    correction, result = solver.descent.step(state.search.step_size, descent)
    correction = 0.5 * correction
    gentle = jnp.linalg.norm(correction) <= _MOST_BENT * jnp.linalg.norm(state.trial - y)
    taken = gentle & (result == optx.RESULTS.successful)
    trial = jnp.where(taken, state.trial + correction, state.trial)
    return eqx.tree_at(lambda state: state.trial, state, trial)


def _out_of_reach(state: _State, wanted: float) -> bool:
    """Whether the costs so far, gains shrinking as they do, end far above the one that is wanted.

    Three accepted costs give the rate; steps to come promise the rest of the geometric series
    (Aitken, 1926), and so many times more is granted.
    """
    costs = np.asarray(state.history)[: int(state.evaluations)]
    accepted = np.append(costs[:1], costs[1:][np.diff(costs) < 0.0])
    if len(accepted) < 3:
        return False
    first, last = -np.diff(accepted[-3:])
    rate = min(last / first, _SLOWEST)
    return bool(accepted[-1] - _GRANTED * last * rate / (1.0 - rate) > wanted)


def _as_info(normal: Normal):
    return optx.FunctionInfo.EvalGradHessian(normal.cost, normal.gradient, normal.hessian)


@program
def _begin(solver: NormalEquationSolver, info):
    y = jnp.zeros_like(info.grad)
    return y, solver.begin(y, info)


@program
def _advance(solver: NormalEquationSolver, y, state, info):
    return solver.advance(y, state, info)


def gauss_newton(
    rtol: float | Float[Array, ""] = 1e-12,
    atol: float | Float[Array, ""] = 1e-9,
    limit: int | Int[Array, ""] = 100,
    damping: float | Float[Array, ""] = 0.0,
) -> NormalEquationSolver:
    """Full Gauss-Newton steps: fastest near the solution, may diverge far from it."""
    del damping
    return NormalEquationSolver(
        rtol=rtol,
        atol=atol,
        limit=limit,
        norm=optx.max_norm,
        descent=optx.NewtonDescent(linear_solver=NormalCholesky()),
        search=optx.LearningRate(1.0),
    )


def levenberg_marquardt(
    rtol: float | Float[Array, ""] = 1e-12,
    atol: float | Float[Array, ""] = 1e-9,
    limit: int | Int[Array, ""] = 100,
    damping: float | Float[Array, ""] = 1e-3,
) -> NormalEquationSolver:
    """Damped steps with a trust region: the default."""
    return NormalEquationSolver(
        rtol=rtol,
        atol=atol,
        limit=limit,
        norm=optx.max_norm,
        descent=optx.DampedNewtonDescent(linear_solver=NormalCholesky()),
        search=Relaxing(damping=damping),
    )


METHODS = {"gauss-newton": gauss_newton, "levenberg-marquardt": levenberg_marquardt}
"""Methods of `adjust` by name."""
