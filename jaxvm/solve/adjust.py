"""Adjustment of a scene, and the summary that a surveyor reads."""

import time
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.sharding import Mesh

from jaxvm.compiling import compile_seconds
from jaxvm.network.network import Residuals
from jaxvm.network.residual import residual
from jaxvm.network.scene import Scene
from jaxvm.solve.descent import Descent
from jaxvm.solve.gauge import check_gauge
from jaxvm.solve.large import check_large_gauge, minimise_large, prepared
from jaxvm.solve.lbfgs import minimise_lbfgs
from jaxvm.solve.optimise import METHODS, minimise
from jaxvm.solve.problem import Problem, normal_at, scaled, scene_problem
from jaxvm.solve.robust import Loss, SquaredLoss
from jaxvm.solve.sharing import SharedProblem
from jaxvm.solve.spgd import minimise_spgd


def _spgd(problem: Problem, max_steps: int) -> Descent:
    return minimise_spgd(problem, jax.random.key(0), max_evaluations=max(max_steps, _MOST_COSTS))


def _lbfgs(problem: Problem, max_steps: int) -> Descent:
    return minimise_lbfgs(problem, max_evaluations=max(max_steps, _MOST_COSTS))


DESCENTS = {"spgd": _spgd, "lbfgs": _lbfgs}
"""Methods of `adjust` that know the cost (and its gradient) alone."""

_MOST_COSTS = 200_000
"""Evaluations of the cost that such a method has at least."""

_SAME = 1.0
"""Sum of squared changes of whitened residuals up to which the patterns of effects are the same."""


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment.

    Attributes:
        scene: the scene at the adjusted values.
        problem: the scaled problem about the start; `x` is its solution.
        x: scaled increments.
        cost_before, cost: half the sum of (robust) squared whitened residuals.
        degrees_of_freedom: observations minus unknowns.
        evaluations, accepted: steps tried and taken.
        history: cost after each evaluation, or after those in `evaluations_at`.
        why: why it stopped.
        seconds, seconds_compiling: of this call.
        evaluations_at: evaluations at each entry of the history, where it does not have all.
    """

    scene: Scene
    problem: Problem
    x: jax.Array
    cost_before: float
    cost: float
    degrees_of_freedom: int
    evaluations: int
    accepted: int
    history: np.ndarray
    why: str
    seconds: float
    seconds_compiling: float
    evaluations_at: np.ndarray | None = None

    @property
    def variance_factor(self) -> float:
        """Twice the cost per degree of freedom: 1 when the model and the sigmas are right.

        Without a robust loss it is chi-square per degree of freedom. Also 1 where there is none
        (as many unknowns as observations): then only the sigmas tell how good the result is.
        """
        f = self.degrees_of_freedom
        return 2.0 * self.cost / f if f > 0 else 1.0

    @property
    def unit_variance(self) -> float:
        """Scale of covariances that trusts the residuals; 1 where a robust loss shrank them."""
        return self.variance_factor if isinstance(self.problem.loss, SquaredLoss) else 1.0

    @property
    def converged(self) -> bool:
        """Whether it stopped at a minimum."""
        return self.why.startswith("converged")

    @property
    def failed(self) -> bool:
        """Whether it broke down: singular equations, or a cost that is no number."""
        return self.why.startswith("failed") or not np.isfinite(self.cost)

    def residuals(self) -> Residuals:
        """Whitened residuals at the solution, without the padding of the tables."""
        network = self.problem.network
        return network.unpadded(residual(self.problem.state(self.x), network))

    def summary(self) -> str:
        """A few lines: cost, iterations, why it stopped, where the time went."""
        residuals = self.residuals()
        pixels = []
        if residuals.pixels:
            rms = pixel_rms(self.scene, residuals)
            pixels = [f"pixel RMS          {rms:.4f} px (weighted)"]
        ranges = self.scene.network.ranges
        weight = np.ones(0) if ranges is None else np.asarray(ranges.weight)[: ranges.n_real]
        if lost := int(np.sum(weight == 0.0)):
            pixels.append(f"left out           {lost} ranges to or from what nothing places then")
        return "\n".join(
            [
                f"cost               {self.cost_before:.8g} -> {self.cost:.8g}",
                f"variance factor    {self.variance_factor:.4g}"
                f"  ({self.degrees_of_freedom} degrees of freedom)",
                *pixels,
                f"evaluations        {self.evaluations}, of which {self.accepted} were steps",
                f"stopped            {self.why}",
                f"time               {self.seconds:.2f} s, of which compiling"
                f" {self.seconds_compiling:.2f} s",
            ]
        )


def adjust(
    scene: Scene,
    method: str = "levenberg-marquardt",
    loss: Loss | None = None,
    weights: tuple[np.ndarray, ...] | None = None,
    range_weights: np.ndarray | None = None,
    link_weights: np.ndarray | None = None,
    active: np.ndarray | None = None,
    rtol: float = 1e-12,
    damping: float = 1e-3,
    max_steps: int = 100,
    repeats: int = 8,
    wanted: float = np.inf,
    check: bool = True,
    mesh: Mesh | None = None,
) -> Adjustment:
    """Adjust a scene: find the free parameters that minimise the whitened residuals.

    The patterns of effects over observations (their radius, incidence, range...) are those of the
    start values. Where the solution moves them, it is adjusted again from there.

    Args:
        scene: scene at its start values.
        method: "levenberg-marquardt" or "gauss-newton"; "spgd" (stochastic parallel gradient
            descent) and "lbfgs" for comparison: these have rules of their own to stop, and at
            least 200,000 evaluations of the cost.
        loss: robust loss; least squares by default.
        weights: weight of every observation of every pixel table (0 sets it aside).
        range_weights, link_weights: the same for the ranges and for the links.
        active: unknowns that may move; all by default.
        rtol: relative change of the cost at which it stops.
        damping: first damping of Levenberg-Marquardt, relative to a unit diagonal.
        max_steps: bound on evaluations, each time.
        repeats: how often it may be repeated about the patterns of effects at the solution.
        wanted: cost above which the solution is of no use: it is given up where it won't get
            there (not with sparse factors, nor by descent).
        check: look for rank deficiency first.
        mesh: devices to share the observations out to (`jaxvm.solve.sharing`); one axis
            "observations". Not for sparse factors, which are on the host.

    Raises:
        RankDeficiency: unknowns that the observations don't determine, by name.
        ValueError: an unknown method, or a mesh with other axes.
    """
    known = (*METHODS, *DESCENTS)
    if method not in known:
        raise ValueError(f'there is no method "{method}" (there are: {", ".join(known)})')
    began, compiling = time.perf_counter(), compile_seconds()
    options: dict = dict(weights=weights, range_weights=range_weights, link_weights=link_weights)
    options |= dict(active=active, loss=loss, mesh=mesh)
    options |= dict(rtol=rtol, damping=damping, max_steps=max_steps, wanted=wanted)
    found = _adjusted(scene, method, check=check, **options)
    before = np.inf
    for _ in range(repeats):
        # A fit that creeps moves the patterns on for ever: it ends where they no longer settle.
        change = _moved(found) if found.converged else 0.0
        if not _SAME < change < 0.5 * before:
            break
        again, before = _adjusted(found.scene, method, check=False, **options), change
        if again.failed:
            break
        at = again.evaluations_at
        if at is not None and found.evaluations_at is not None:
            at = np.concatenate([found.evaluations_at, found.evaluations + at])
        found = replace(
            again,
            cost_before=found.cost_before,
            evaluations=found.evaluations + again.evaluations,
            accepted=found.accepted + again.accepted,
            history=np.concatenate([found.history, again.history]),
            evaluations_at=at,
        )
    return replace(
        found,
        seconds=time.perf_counter() - began,
        seconds_compiling=compile_seconds() - compiling,
    )


def _moved(found: Adjustment) -> float:
    """Sum of squared changes of whitened residuals by the patterns at the solution."""
    if not found.scene.effects:
        return 0.0
    network, state = found.problem.network, found.problem.state(found.x)
    anew = network.with_patterns_of(found.scene.network)
    old, new = jax.tree.leaves(residual(state, network)), jax.tree.leaves(residual(state, anew))
    return sum(
        float(np.sum((np.asarray(b) - np.asarray(a)) ** 2)) for a, b in zip(old, new, strict=True)
    )


def _adjusted(
    scene: Scene,
    method,
    loss,
    weights,
    range_weights,
    link_weights,
    active,
    rtol,
    damping,
    max_steps,
    wanted,
    check,
    mesh,
) -> Adjustment:
    """The adjustment with the patterns of the start values."""
    problem = scene_problem(scene, loss)
    if weights is not None:
        problem = with_weights(problem, weights)
    if range_weights is not None:
        # A range that says nothing stays without weight.
        problem = eqx.tree_at(
            lambda p: p.network.ranges.weight,
            problem,
            replace_fn=lambda own: own * _filled_up(range_weights, own),
        )
    if link_weights is not None:
        problem = eqx.tree_at(lambda p: p.network.links.weight, problem, jnp.asarray(link_weights))
    if active is not None:
        problem = eqx.tree_at(lambda p: p.active, problem, problem.active & jnp.asarray(active))
    if mesh is None and (host := prepared(problem)) is not None:
        return _adjusted_large(scene, *host, method, rtol, damping, max_steps, check)
    problem, normal = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    if check:
        check_gauge(normal, scene.unknowns)
    if method in DESCENTS:
        return _descended(scene, problem, normal.hessian.diagonal(), method, max_steps)
    solver = METHODS[method](
        jnp.asarray(rtol), limit=jnp.asarray(max_steps), damping=jnp.asarray(damping)
    )
    shared = problem if mesh is None else SharedProblem.of(problem, mesh)
    x, last = minimise(shared, normal, solver, wanted)
    history = np.asarray(last.history)
    return _result(
        scene,
        problem,
        x,
        normal.hessian.diagonal(),
        history[~np.isnan(history)],
        int(last.evaluations),
        int(last.accepted),
        _why(last, max_steps),
    )


def _result(
    scene: Scene, problem: Problem, x, diagonal, history, evaluations, accepted, why, at=None
) -> Adjustment:
    """What a minimisation found, whatever the method; the caller knows how long it took."""
    return Adjustment(
        scene=scene.with_state(problem.state(x)),
        problem=problem,
        x=x,
        cost_before=float(history[0]) if len(history) else float("nan"),
        cost=float(history[-1]) if len(history) else float("nan"),
        degrees_of_freedom=degrees_of_freedom(problem, diagonal),
        evaluations=evaluations,
        accepted=accepted,
        history=history,
        why=why,
        seconds=0.0,
        seconds_compiling=0.0,
        evaluations_at=at,
    )


def _descended(scene: Scene, problem: Problem, diagonal, method: str, max_steps) -> Adjustment:
    """The adjustment by a method that knows costs (and gradients) alone."""
    found = DESCENTS[method](problem, max_steps)
    count = found.evaluations
    return _result(
        scene,
        problem,
        found.x,
        diagonal,
        found.history,
        count,
        count,
        found.why,
        found.evaluations_at,
    )


def _adjusted_large(
    scene: Scene, problem: Problem, normal, factors, method, rtol, damping, max_steps, check
) -> Adjustment:
    """The adjustment of a large network, by a loop on the host."""
    if check:
        check_large_gauge(problem, normal, factors, scene.unknowns)
    if method in DESCENTS:
        return _descended(scene, problem, normal.diagonal(), method, max_steps)
    fit = minimise_large(
        problem, normal, factors, method, rtol=rtol, limit=max_steps, damping=damping
    )
    return _result(
        scene,
        problem,
        jnp.asarray(fit.x),
        normal.diagonal(),
        fit.history,
        fit.evaluations,
        fit.accepted,
        fit.why,
    )


def with_weights(problem: Problem, weights: tuple[np.ndarray, ...]) -> Problem:
    """The problem with other weights of the image points, one vector for each pixel table."""
    padded = []
    for factor, own in zip(problem.network.pixels, weights, strict=True):
        padded.append(_filled_up(own, factor.weight))
    return eqx.tree_at(lambda p: [f.weight for f in p.network.pixels], problem, padded)


def _filled_up(weights: np.ndarray, own) -> jax.Array:
    """Weights of the observations of a table, zero for its padding."""
    return jnp.asarray(np.append(weights, np.zeros(len(own) - len(weights))))


def degrees_of_freedom(problem: Problem, diagonal) -> int:
    """Weighted-in observations minus unknowns that any of them touches.

    `diagonal` is that of the normal matrix.
    """
    return n_used(problem) - int(np.sum(np.asarray(diagonal) > 0))


def n_used(problem: Problem) -> int:
    """Number of components of the weighted-in observations."""
    factors = problem.network.factors()
    return sum(int(np.sum(np.asarray(f.weight) > 0)) * f.sigma.shape[1] for f in factors)


def _why(last, max_steps) -> str:
    if int(last.evaluations) >= max_steps:
        return f"stopped after {max_steps} evaluations: not converged"
    if not bool(last.done):
        return "given up: the cost that is wanted is out of reach"
    if last.result == optx.RESULTS.successful:
        return "converged: the cost no longer changes"
    return "failed: the normal equations are singular"


def pixel_rms(scene: Scene, residuals: Residuals, rows=None) -> float:
    """Weighted RMS of pixel residuals in units of the noise the recording states for sigma = 1.

    Each component counts with (median sigma / sigma)^2: with the detector's weights w = 1/sigma it
    is the RMS of w * (predicted - measured) in pixels.
    """
    square = np.concatenate([np.asarray(block) ** 2 for block in residuals.pixels])
    chosen = square if rows is None else square[rows]
    return float(np.sqrt(np.mean(chosen)) * reference_sigma(scene))


def reference_sigma(scene: Scene) -> float:
    """Sigma (px) that pixel residuals are quoted for: the most frequent one of the recording."""
    values, counts = np.unique(scene.recording.observations.sigma, return_counts=True)
    return float(values[np.argmax(counts)])
