"""Four ways to adjust the same network to a given cost, and what each takes.

All see the same scene from the same start and are judged by the same cost. Whatever they need
beforehand (cycles, patterns, elimination order, scales) is timed as their preparation.
"""

import abc
import ctypes
import gc
import resource
import sys
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from layouts import Layout, reckoned

from jaxvm.compiling import compile_seconds
from jaxvm.network.cycles import fundamental_cycles
from jaxvm.network.scene import build
from jaxvm.solve import condition
from jaxvm.solve.large import minimise_large, scaled_large
from jaxvm.solve.lbfgs import minimise_lbfgs
from jaxvm.solve.problem import Problem, scene_problem
from jaxvm.solve.sparse import Pattern, SparseFactors
from jaxvm.solve.spgd import minimise_spgd

MEMORY_BYTES = 8e9
"""What dense matrices may take; beyond it a network is recorded as too large."""

_SHORT_S = 0.2
"""Runs shorter than this are repeated, and the least time counts."""

_ENOUGH_S = 0.1
"""Steps are timed over at least so long, or until a method goes no further."""

_LONG_S = 15.0
"""A first run that takes so long without its compiling is not repeated to be timed.

Python's own part of compiling, which nothing tells apart, is well below it.
"""

_MOST_LINEARISATIONS = 15
"""Of Gauss-Newton; from all starts here it needs seven."""


class TooLarge(MemoryError):
    """The matrices don't fit."""


@dataclass(frozen=True, eq=False)
class Contest:
    """One network for all methods.

    Attributes:
        seconds: what an evaluation of each method takes, as far as it is known.
    """

    layout: Layout
    seconds: dict[str, float] = field(default_factory=dict)

    @cached_property
    def _scene(self):
        return build(self.layout.recording())

    def problem(self, start: np.ndarray) -> Problem:
        """The unscaled problem from world_from_station at the start."""
        state = eqx.tree_at(lambda s: s.world_from_station, self._scene.state, jnp.asarray(start))
        return scene_problem(self._scene.with_state(state))

    @cached_property
    def optimum(self) -> float:
        """The least cost: Gauss-Newton from the true poses, converged."""
        problem, normal, factors = _sparse(self.problem(self.layout.truth))
        fit = minimise_large(problem, normal, factors, "gauss-newton")
        if not fit.why.startswith("converged"):
            raise RuntimeError(f"no optimum: {fit.why}")
        return float(fit.history[-1])

    @cached_property
    def first_costs(self) -> dict[str, float]:
        """Cost of each start."""
        starts = {"reckoned": self.layout.reckoned, "rough": self.layout.rough}
        return {name: _cost_at(self.problem(start)) for name, start in starts.items()}


def _sparse(problem: Problem):
    pattern = Pattern.of(problem)
    factors = SparseFactors(pattern)
    return *scaled_large(problem, pattern), factors


def _cost_at(problem: Problem) -> float:
    bare = eqx.tree_at(lambda p: p.packets, problem, ())
    return float(_cost(bare))


@eqx.filter_jit
def _cost(problem: Problem):
    return problem.cost(jnp.zeros(problem.n))


@dataclass(frozen=True)
class Outcome:
    """Where a run came to: cost, evaluations, steps, seconds, and why it ended."""

    cost: float
    evaluations: int
    steps: int
    seconds: float
    why: str


class Method(abc.ABC):
    """A way to lower the cost.

    Attributes:
        name, counts: for people: what it is called, what its evaluations are.
        few: evaluations that tell how long one takes.
    """

    name: ClassVar[str]
    counts: ClassVar[str]
    few: ClassVar[int]

    @abc.abstractmethod
    def prepare(self, contest: Contest, problem: Problem) -> Any:
        """What it needs before the first step."""

    @abc.abstractmethod
    def advance(self, tools: Any, target: float, most: int) -> Outcome:
        """Go on until the cost is at most `target`, or for so many evaluations."""


class Sparse(Method):
    """Parametric Gauss-Newton, sparse normal equations by CHOLMOD."""

    name = "sparse Gauss-Newton"
    counts = "linearisations of the whole network"
    few = 2

    def prepare(self, contest, problem):
        return _sparse(problem)

    def advance(self, tools, target, most):
        def run(limit):
            began = time.perf_counter()
            fit = minimise_large(*tools, "gauss-newton", rtol=0.0, atol=0.0, limit=limit)
            return fit, time.perf_counter() - began

        # It knows no target: a first run tells how many evaluations lead to it.
        limit = min(most, _MOST_LINEARISATIONS)
        there = np.flatnonzero(run(limit)[0].history <= target) if np.isfinite(target) else ()
        fit, seconds = run(int(there[0]) + 1 if len(there) else limit)
        cost, n = float(fit.history[-1]), fit.evaluations
        return Outcome(cost, n, max(n - 1, 1), seconds, fit.why)


class SPGD(Method):
    """Stochastic parallel gradient descent with the gains that it takes by default."""

    name = "SPGD"
    counts = "costs"
    few = 40

    def prepare(self, contest, problem):
        return _sparse(problem)[0]

    def advance(self, tools, target, most):
        began = time.perf_counter()
        found = minimise_spgd(
            tools, jax.random.key(0), target_cost=jnp.asarray(target), rtol=0.0,
            max_evaluations=most,
        )  # fmt: skip
        seconds, n = time.perf_counter() - began, found.evaluations
        return Outcome(found.cost, n, n // 2, seconds, found.why)


class LBFGS(Method):
    """L-BFGS by jaxopt."""

    name = "L-BFGS"
    counts = "costs with their gradient"
    few = 20

    def prepare(self, contest, problem):
        return _sparse(problem)[0]

    def advance(self, tools, target, most):
        began = time.perf_counter()
        found = minimise_lbfgs(
            tools, target_cost=jnp.asarray(target), rtol=0.0, max_evaluations=most
        )
        seconds, n = time.perf_counter() - began, found.evaluations
        return Outcome(found.cost, n, n, seconds, found.why)


class Condition(Method):
    """Classical condition adjustment with dense matrices on fundamental (breadth-first) cycles.

    It begins with the measured links whatever the start; its poses are reckoned from its corrected
    links along the tree of the start, so that before the first step they are the start.
    """

    name = "dense condition adjustment"
    counts = "linearisations of all cycles"
    few = 1

    def prepare(self, contest, problem):
        graph = contest.layout.graph
        n_cycles, n = len(graph.edges) - len(graph.names) + 1, len(graph.edges)
        # B as JAX makes it, turned over, and times the roots; B Q B^T, scaled, and its factor.
        needed = 8.0 * (3 * 36 * n_cycles * n + 3 * 36 * n_cycles**2)
        if needed > MEMORY_BYTES:
            raise TooLarge(f"too large: its matrices take {needed / 1e9:.3g} GB")
        cycles = fundamental_cycles(graph)
        return contest, problem, condition._closures(n, cycles)

    def advance(self, tools, target, most):
        # The loop of `adjust_conditions`, which tells nothing of the costs on its way.
        contest, problem, closures = tools
        graph = contest.layout.graph
        measured, roots = jnp.asarray(graph.pose), np.linalg.cholesky(graph.covariance)
        correction = np.zeros((len(measured), 6))
        seconds, cost, steps = 0.0, np.inf, 0
        while steps < most and cost > target:
            began = time.perf_counter()
            misclosure, b = condition._linearised(closures, measured, correction)
            w = misclosure.ravel() - b @ correction.ravel()
            correction = condition._System(b, roots).corrections(w)
            seconds += time.perf_counter() - began
            steps += 1
            cost = self._cost(contest, problem, correction)
        why = "reached" if cost <= target else f"stopped after {steps} evaluations"
        return Outcome(cost, steps, steps, seconds, why)

    def _cost(self, contest: Contest, problem: Problem, correction) -> float:
        graph, truth = contest.layout.graph, contest.layout.truth
        pose = condition._corrected(jnp.asarray(graph.pose), jnp.asarray(correction))
        corrected = replace(graph, pose=np.array(pose))
        return _cost_at(contest.problem(reckoned(corrected, truth[0])))


METHODS: dict[str, Method] = {
    "condition": Condition(),
    "sparse": Sparse(),
    "spgd": SPGD(),
    "lbfgs": LBFGS(),
}

RACES = {
    "optimum": ("reckoned", "dead reckoning to 1.01 times the optimal cost"),
    "early": ("reckoned", "dead reckoning to 1 % of its cost"),
    "rough": ("rough", "rough start to 1 % of its cost"),
}
"""Start and stopping rule of each race."""


def race(method: Method, contest: Contest, rule: str, limit_s: float) -> dict:
    """One method from one start to one target: the cell of a table.

    Seconds are those of a second run with the same shapes; compiling stands apart. Memory is how
    far the resident set rises above where it was before.
    """
    start, _ = RACES[rule]
    first, optimum = contest.first_costs[start], contest.optimum
    target = 1.01 * optimum if rule == "optimum" else 0.01 * first
    cell = {"target": target, "first": first, "optimum": optimum, "limit_s": limit_s}
    if target <= optimum:
        return cell | {"status": "below the optimum", "why": "no method can: it is not run"}
    if rule == "rough" and isinstance(method, Condition):
        return cell | {"status": "no such start", "why": "it begins with the measured links"}
    try:
        if method.name not in contest.seconds:
            step(method, contest)
    except TooLarge as error:
        return cell | {"status": "censored", "cost": first, "evaluations": 0, "why": str(error)}
    problem = contest.problem(getattr(contest.layout, start))
    most = int(np.clip(limit_s / contest.seconds[method.name], method.few, 2**40))
    with _Peak() as peak:
        began = time.perf_counter()
        tools = method.prepare(contest, problem)
        prepared = time.perf_counter() - began
        found = method.advance(tools, target, most)
    seconds = found.seconds
    for _ in range(4 if seconds < _SHORT_S else 0):
        seconds = min(seconds, method.advance(tools, target, most).seconds)
    status = "reached" if found.cost <= target else "censored"
    return cell | {
        "status": status, "cost": found.cost, "evaluations": found.evaluations,
        "seconds": seconds, "prepare_s": prepared, "peak_bytes": peak.bytes, "why": found.why,
    }  # fmt: skip


def step(method: Method, contest: Contest) -> dict:
    """Seconds and memory of one step, from dead reckoning; seconds that compiling took before.

    The contest then knows how long an evaluation takes.

    Raises:
        TooLarge: the matrices don't fit.
    """
    problem, compiling = contest.problem(contest.layout.reckoned), compile_seconds()

    def measured(evaluations: int) -> tuple[Outcome, dict]:
        with _Peak() as peak:
            began = time.perf_counter()
            tools = method.prepare(contest, problem)
            prepared = time.perf_counter() - began
            found = method.advance(tools, -np.inf, evaluations)
        return found, {"prepare_s": prepared, "peak_bytes": peak.bytes}

    found, cell = measured(method.few)
    compiling = compile_seconds() - compiling
    seconds = found.seconds - compiling
    if seconds < _LONG_S:
        many = method.few
        found, cell = measured(many)
        while found.seconds < _ENOUGH_S and found.evaluations >= many:
            many *= 4
            found, cell = measured(many)
        seconds = found.seconds
    contest.seconds[method.name] = max(seconds, 1e-6) / found.evaluations
    each = max(seconds, 1e-6) / found.steps
    return {"status": "reached", "step_s": each, "compile_s": compiling, **cell}


class _Peak:
    """How far the resident set rises meanwhile (bytes); Linux tells, and forgets when asked.

    Elsewhere it is what the highest mark of the process rises.
    """

    bytes: int

    def __enter__(self):
        gc.collect()
        if _CLEAR.exists():
            ctypes.CDLL(None).malloc_trim(0)
            _CLEAR.write_text("5")
        self._before = _resident("VmRSS")
        return self

    def __exit__(self, *_):
        self.bytes = max(_resident("VmHWM") - self._before, 0)


_CLEAR, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


def _resident(what: str) -> int:
    if _STATUS.exists():
        lines = _STATUS.read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith(what))
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
