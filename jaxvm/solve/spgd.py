"""Stochastic parallel gradient descent: minimise by costs alone, two for each step.

All unknowns are perturbed at once by +-sigma, s = +-1 at random (Vorontsov & Carhart 1997, Opt.
Lett. 22, 907; the same as SPSA, Spall 1992, IEEE Trans. Autom. Control 37, 332):

    dJ = J(u + sigma s) - J(u - sigma s),   slope = dJ / (2 sigma),   u <- u - eta slope s,

with eta = 2 gamma sigma^2 in the letters of the former. On a quadratic cost with gradient g and
Hessian H a step brings on average

    E[J_next - J] = -eta |g|^2 + eta^2/2 (tr H |g|^2 + 2 g'Hg - 2 sum_i H_ii g_i^2),

so the best gain is about 1 / tr H, and a step is worth a gradient step of that length: to gain a
factor e along the softest direction takes tr H / lambda_min steps. On unknowns that are scaled to a
unit diagonal tr H is their number.

Perturbing uncoupled groups of unknowns one after the other (Vorontsov & Carhart 2006) is not here:
on one scalar cost it changes nothing, tr H and the steps for a round change alike; it pays only
where each group has a cost of its own.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

from jaxvm.solve.descent import Descent, History, Stop, descent
from jaxvm.solve.problem import Problem


class Experience(eqx.Module):
    """What the last step taught.

    Attributes:
        eta, slope: its gain and the slope it followed.
        rise: how far the cost rose, negative where it fell.
        exact: whether the rise is free of what the perturbations add to the costs.
        setback: whether the step was so bad that it was taken back.
    """

    eta: Float[Array, ""]
    slope: Float[Array, ""]
    rise: Float[Array, ""]
    exact: Bool[Array, ""]
    setback: Bool[Array, ""]


class AbstractGain(eqx.Module):
    """Rule for the gain eta of each step.

    Attributes:
        guarded: whether a step that makes things far worse is taken back.
    """

    guarded: ClassVar[bool] = True

    @abc.abstractmethod
    def init(self, trace: Float[Array, ""]) -> Any:
        """State of the rule, where tr H is expected to be `trace`."""

    @abc.abstractmethod
    def at(self, state, step: Int[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Gain of this step, and its amplitude relative to the first one."""

    @abc.abstractmethod
    def learn(self, state, last: Experience) -> Any:
        """State after the last step."""


class ConstantGain(AbstractGain):
    """The same gain eta at every step, whatever comes (Vorontsov & Carhart 1997)."""

    guarded: ClassVar[bool] = False

    eta: float | Float[Array, ""] = eqx.field(converter=jnp.asarray)

    def init(self, trace):
        return None

    def at(self, state, step):
        return jnp.asarray(self.eta), jnp.ones(())

    def learn(self, state, last):
        return state


class SpallGain(AbstractGain):
    """Decaying gain and amplitude, a/(A+k+1)^0.602 and c/(k+1)^0.101 (Spall 1998).

    The exponents are those that Spall gives for finite samples. They are meant for noisy costs; one
    without noise is descended faster at a constant gain.

    Attributes:
        first: gain of the first step in units of 1 / tr H.
        stability: A, about a tenth of the steps to come.
    """

    first: float | Float[Array, ""] = eqx.field(default=1.0, converter=jnp.asarray)
    stability: float | Float[Array, ""] = eqx.field(default=1000.0, converter=jnp.asarray)

    def init(self, trace):
        return self.first / trace

    def at(self, state, step):
        decay = (self.stability + 1.0) / (self.stability + step + 1.0)
        return state * decay**0.602, (step + 1.0) ** -0.101

    def learn(self, state, last):
        return jnp.where(last.setback, state / _RETREAT, state)


class _Trace(eqx.Module):
    """Running sums over steps, of slope^2 s'Hs and of slope^2, and tr H from them."""

    bent: Float[Array, ""]
    weight: Float[Array, ""]
    trace: Float[Array, ""]


class TraceGain(AbstractGain):
    """Gain 1 / tr H, with tr H measured on the way and no further evaluation.

    A step changes the cost by -eta slope^2 + eta^2/2 slope^2 s'Hs, so each step tells s'Hs over its
    own length, with all that is not quadratic. Weighted by slope^2 its mean is the very quantity in
    the mean change of the cost, tr H + 2 (g'Hg - sum_i H_ii g_i^2) / |g|^2. (It is the second
    difference of the cost over sigma^2 where the steps are as short as sigma.)

    Attributes:
        factor: gain in units of 1 / tr H. 1 brings most in the next step; up to 1.5 is faster on
            the long way down soft directions, 2 goes nowhere any more.
        memory: steps that the running mean looks back.
    """

    factor: float | Float[Array, ""] = eqx.field(default=1.0, converter=jnp.asarray)
    memory: float | Float[Array, ""] = eqx.field(default=64.0, converter=jnp.asarray)

    def init(self, trace):
        return _Trace(jnp.zeros(()), jnp.zeros(()), trace)

    def at(self, state, step):
        return self.factor / state.trace, jnp.ones(())

    def learn(self, state, last):
        square = last.slope**2
        # What was expected counts as much as the first eight steps.
        weight = jnp.where(state.weight > 0.0, state.weight, 8.0 * square)
        bent = jnp.where(state.weight > 0.0, state.bent, weight * state.trace)
        keep = 1.0 - 1.0 / self.memory
        weight = keep * weight + square
        bent = keep * bent + 2.0 * (last.rise + last.eta * square) / last.eta**2
        # Where the cost bends down or hardly at all the gain grows, but not all at once.
        trace = jnp.maximum(bent / weight, state.trace / 1.1)
        learnt = _Trace(bent, weight, trace)
        careful = _Trace(_RETREAT * state.bent, state.weight, _RETREAT * state.trace)
        usable = last.exact & (square > 0.0) & jnp.isfinite(last.rise)
        return _choose(last.setback, careful, _choose(usable, learnt, state))


_RETREAT = 4.0
"""What a gain is divided by when a step was taken back."""

_SETBACK = 10.0
"""A step is taken back when the cost rises by so many times what a step should bring it down.

On a quadratic cost with the right gain that takes s'Hs = 22 tr H; s'Hs has a mean of tr H.
"""

_AMPLITUDE = 1e-3
"""Perturbation in units of scaled unknowns.

With a unit diagonal this is a thousandth of the standard deviation that an unknown has when the
others are known. On the networks of the tests, from starts thousands of these off to the solution,
the slope errs by 1e-9 to 1e-7 of itself: rounding of the cost makes it worse below (10 times at
1e-4), the third derivative above (30 times at 1e-2 near the solution).
"""


class _State(eqx.Module):
    steps: Int[Array, ""]
    evaluations: Int[Array, ""]
    velocity: Float[Array, " n"]
    gain: Any
    eta: Float[Array, ""]  # of the last step, as the next two
    slope: Float[Array, ""]
    cost: Float[Array, ""]
    expected: Float[Array, ""]  # running mean of eta slope^2
    first: Float[Array, ""]
    best: Float[Array, " n"]
    best_cost: Float[Array, ""]
    best_before: Float[Array, ""]  # when it was last looked at for progress
    looked: Int[Array, ""]
    stop: Int[Array, ""]
    done: Bool[Array, ""]
    history: History


class SPGD(optx.AbstractMinimiser):
    """Stochastic parallel gradient descent as an optimistix minimiser.

    For any `fn(y, args) -> scalar` through `optimistix.minimise`; the default gain expects unknowns
    that are scaled to a unit diagonal of the Hessian, but corrects itself. The solution is the
    point of the lowest cost met. A last step without perturbation gives its exact cost. Costs on
    the way are means of the two perturbed ones, sigma^2/2 s'Hs higher than those of the points.

    Attributes:
        key: of the perturbations.
        gain: rule of the gain.
        momentum: share of a step that goes on in the next one (heavy ball). The gain is shared out
            over the steps, so that one rule serves with and without. It delays the random
            steps and doesn't reduce them: at a constant gain it changes nothing, and `TraceGain`
            takes its overshoot for curvature and becomes slower.
        amplitude: sigma of the first step.
        trace: expected tr H; by default the number of unknowns.
        target_cost: cost at which it stops.
        target_share: share of the first cost at which it stops.
        max_evaluations: bound on evaluations of the cost.
        rtol: relative decrease of the lowest cost within `patience` steps below which it stops.
        patience: steps; by default ten for each unknown, that is about ten gradient steps.
    """

    key: PRNGKeyArray
    gain: AbstractGain = eqx.field(default_factory=TraceGain)
    momentum: Any = eqx.field(default=0.0, converter=jnp.asarray)
    amplitude: Any = eqx.field(default=_AMPLITUDE, converter=jnp.asarray)
    trace: Any = None
    target_cost: Any = eqx.field(default=-jnp.inf, converter=jnp.asarray)
    target_share: Any = eqx.field(default=-jnp.inf, converter=jnp.asarray)
    max_evaluations: Any = eqx.field(default=1_000_000, converter=jnp.asarray)
    rtol: Any = eqx.field(default=1e-4, converter=jnp.asarray)
    patience: Any = None
    # Part of every optimistix solver; the rule of stopping here has no use for them.
    atol: float = 0.0
    norm: Any = optx.max_norm

    def _trace(self, u):
        return jnp.asarray(u.size if self.trace is None else self.trace, u.dtype)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        u, _ = ravel_pytree(y)
        nothing, endless = jnp.zeros((), u.dtype), jnp.full((), jnp.inf, u.dtype)
        trace = self._trace(u)
        return _State(
            steps=jnp.array(0),
            evaluations=jnp.array(0),
            velocity=jnp.zeros_like(u),
            gain=self.gain.init(trace),
            eta=1.0 / trace,
            slope=nothing,
            cost=endless,
            expected=nothing,
            first=endless,
            best=u,
            best_cost=endless,
            best_before=endless,
            looked=jnp.array(0),
            stop=jnp.array(int(Stop.RUNNING)),
            done=jnp.array(False),
            history=History.empty(),
        )

    def step(self, fn, y, args, options, state: _State, tags):
        u, unravel = ravel_pytree(y)
        closing = state.stop != Stop.RUNNING
        eta, width = self.gain.at(state.gain, state.steps)
        sigma = jnp.where(closing, 0.0, self.amplitude * width)
        s = jax.random.rademacher(jax.random.fold_in(self.key, state.steps), u.shape, u.dtype)
        pair = jnp.stack([u + sigma * s, u - sigma * s])
        (above, below), aux = jax.vmap(lambda point: fn(unravel(point), args))(pair)
        cost, evaluations = 0.5 * (above + below), state.evaluations + 2
        starting = state.steps == 0
        first = jnp.where(starting, cost, state.first)

        # Judge the last step.
        rise, brought = cost - state.cost, state.eta * state.slope**2
        # What perturbations add to a cost, and its rounding, are no rise.
        noise = sigma**2 * self._trace(u) + 1e-13 * jnp.abs(cost)
        too_far = rise > _SETBACK * (brought + state.expected + noise)
        setback = self.gain.guarded & ~starting & (too_far | ~jnp.isfinite(cost))
        exact = (state.eta * state.slope) ** 2 > 10.0 * sigma**2
        learnt = self.gain.learn(
            state.gain, Experience(state.eta, state.slope, rise, exact, setback)
        )
        gain = _choose(starting, state.gain, learnt)

        # Take the next one.
        better = cost < state.best_cost
        best = jnp.where(better, u, state.best)
        best_cost = jnp.where(better, cost, state.best_cost)
        eta, _ = self.gain.at(gain, state.steps)
        still = setback | closing
        slope = jnp.where(still, 0.0, (above - below) / (2.0 * jnp.where(still, 1.0, sigma)))
        push = (1.0 - self.momentum) * eta * slope
        velocity = jnp.where(still, 0.0, self.momentum * state.velocity - push * s)
        expected = state.expected + (eta * slope**2 - state.expected) / 64.0

        # Whether it is enough.
        patience = 10 * u.size if self.patience is None else self.patience
        look = state.steps - state.looked >= patience
        gained = state.best_before - best_cost
        failed = ~jnp.isfinite(cost) & (starting | (not self.gain.guarded))
        stop = _first_of(
            (closing, state.stop),
            (failed, Stop.FAILED),
            (best_cost <= self.target_cost, Stop.TARGET),
            (best_cost <= self.target_share * first, Stop.SHARE),
            (look & ~(gained > self.rtol * jnp.abs(best_cost)), Stop.SLOW),
            (evaluations + 4 > self.max_evaluations, Stop.LIMIT),
        )
        back = setback | (stop != Stop.RUNNING)
        state = _State(
            steps=state.steps + 1,
            evaluations=evaluations,
            velocity=velocity,
            gain=gain,
            eta=eta,
            slope=slope,
            cost=jnp.where(back & ~closing, best_cost, cost),
            expected=expected,
            first=first,
            best=best,
            best_cost=best_cost,
            best_before=jnp.where(look | starting, best_cost, state.best_before),
            looked=jnp.where(look, state.steps, state.looked),
            stop=stop,
            done=closing,
            history=state.history.noted(cost, evaluations, closing),
        )
        aux = jax.tree.map(lambda leaf: leaf[0], aux)
        return unravel(jnp.where(back, best, u + velocity)), state, aux

    def terminate(self, fn, y, args, options, state: _State, tags):
        results = optx.RESULTS
        result = results.where(
            state.stop == Stop.LIMIT, results.nonlinear_max_steps_reached, results.successful
        )
        failed = state.done & (state.stop == Stop.FAILED)
        result = results.where(failed, results.nonlinear_divergence, result)
        return state.done, results.where(state.done, result, results.successful)

    def postprocess(self, fn, y, aux, args, options, state: _State, tags, result):
        _, unravel = ravel_pytree(y)
        stats = {
            "cost": state.cost,
            "evaluations": state.evaluations,
            "history": state.history,
            "stop": state.stop,
            "gain": state.eta,
        }
        return unravel(state.best), aux, stats


def _choose(wanted: Bool[Array, ""], a: PyTree, b: PyTree) -> PyTree:
    return jax.tree.map(lambda x, y: jnp.where(wanted, x, y), a, b)


def _first_of(*cases: tuple[Bool[Array, ""], Any]) -> Int[Array, ""]:
    """The value of the first condition that holds; running where none does."""
    conditions, values = zip(*cases, strict=True)
    return jnp.select([*conditions], [jnp.asarray(v, int) for v in values], int(Stop.RUNNING))


def minimise_spgd(
    problem: Problem,
    key: PRNGKeyArray,
    *,
    gain: AbstractGain | None = None,
    momentum: float = 0.0,
    max_evaluations: int = 1_000_000,
    target_cost: float | None = None,
    target_share: float | None = None,
    rtol: float = 1e-4,
) -> Descent:
    """Stochastic parallel gradient descent of a scaled problem from x = 0.

    One compiled loop; a problem with tables of the same shapes runs without compiling again.

    Args:
        problem: with unknowns scaled to a unit diagonal (`jaxvm.solve.problem.scaled`).
        key: of the perturbations: the same key gives the same result.
        gain: rule of the gain; `TraceGain` by default, which needs no tuning.
        momentum: of the heavy ball, 0 to below 1.
        max_evaluations: bound on evaluations of the cost, two for each step.
        target_cost: cost (half a chi-square) at which it stops; none by default.
        target_share: share of the first cost at which it stops; none by default.
        rtol: stop where the cost falls by less than this share of itself within ten steps for each
            unknown. On ill-conditioned networks that comes long before the minimum.

    Raises:
        ValueError: a momentum that is not between 0 and 1.
    """
    if not 0.0 <= momentum < 1.0:
        raise ValueError(f"a momentum of {momentum} never comes to rest (take 0 to below 1)")
    none = -jnp.inf
    x, stats = descended(
        problem,
        key,
        gain=TraceGain() if gain is None else gain,
        momentum=momentum,
        target_cost=none if target_cost is None else target_cost,
        target_share=none if target_share is None else target_share,
        max_evaluations=max_evaluations,
        rtol=rtol,
    )
    return descent(
        x=x,
        cost=stats["cost"],
        history=stats["history"],
        evaluations=stats["evaluations"],
        stop=stats["stop"],
        limit=max_evaluations,
    )


def descended(
    problem: Problem, key: PRNGKeyArray, **rules: Any
) -> tuple[Float[Array, " n"], dict[str, Any]]:
    """Unknowns that a scaled problem comes to from x = 0, and the solver's statistics; traced.

    `rules` are attributes of `SPGD`.
    """
    n = jnp.sum(problem.active)
    solver = SPGD(key=key, trace=n.astype(float), patience=10 * n, **rules)
    # The packets are for normal equations; without them fewer problems differ in shape.
    bare = eqx.tree_at(lambda p: p.packets, problem, ())
    found = optx.minimise(_cost, solver, jnp.zeros(problem.n), bare, max_steps=None, throw=False)
    return jnp.where(problem.active, found.value, 0.0), found.stats


def _cost(x: Float[Array, " n"], problem: Problem) -> Float[Array, ""]:
    return problem.cost(x)
