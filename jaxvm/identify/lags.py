"""Thermal dynamics in continuous time: every output a sum of first-order lags of every input.

A body of several parts that exchange heat has real poles only, the same for all that drives it and
for all that drifts with it. Time constants are therefore shared by ambient temperature, own power
and all parameters of a camera, and any positive value is stable. Order 0 is static. A lag is exact
for inputs that are linear between samples, whatever the sampling (MATHEMATICS 1.5).

Gains enter linearly and are eliminated (variable projection, Golub and Pereyra 1973); only the time
constants and the delay are searched for.
"""

from dataclasses import dataclass
from functools import partial
from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxvm.identify.gains import SLOWEST, Fit, foretold_density, gains_at, prior_widths
from jaxvm.identify.inputs import Inputs, are_power
from jaxvm.physics.blocks import rounded
from jaxvm.physics.forms import first_order_lag

_LATEST = 20.0
"""Largest delay, in epochs; negative ones tell of a clock that is wrong."""

_STARTS = 9
"""Time constants on the grid of starts."""


@dataclass(frozen=True, eq=False)
class Structure:
    """Which regressors a model has.

    Attributes:
        order: number of time constants; 0 is static.
        power: largest power of the inputs that act at once: 0 (no drift), 1 or 2.
        delayed: whether inputs come late by a time of their own.
    """

    order: int
    power: int = 1
    delayed: bool = False

    def regressor_ranges(self, ranges: Float[np.ndarray, " inputs"]) -> np.ndarray:
        """Ranges of all regressors in their order, from those of the inputs."""
        powers = [ranges**k for k in range(1, self.power + 1)]
        return np.concatenate([np.zeros(0), *powers, *[ranges] * self.order])

    @property
    def name(self) -> str:
        """As it reads in a report."""
        if self.order == 0:
            text = ("no drift", "static, linear", "static, parabola")[self.power]
        else:
            text = f"{self.order} time constant{'s' if self.order > 1 else ''}"
        return f"{text}, delayed" if self.delayed else text


@dataclass(frozen=True, eq=False)
class Lags:
    """A model in continuous time.

    Attributes:
        structure: which regressors.
        inputs: names of the inputs.
        reference: value of every input from which it is counted.
        tau: time constants (s), the shortest first.
        delay: by which inputs come late (s).
        gain: of every output on every regressor [outputs, regressors].
        centre: mean of every regressor over the training, so that the mean state is zero.
        tau_sigma, delay_sigma: standard deviations.
        gain_sigma: of the gains.
    """

    structure: Structure
    inputs: tuple[str, ...]
    reference: Float[np.ndarray, " inputs"]
    tau: Float[np.ndarray, " order"]
    delay: float
    gain: Float[np.ndarray, "outputs regressors"]
    centre: Float[np.ndarray, " regressors"]
    tau_sigma: Float[np.ndarray, " order"]
    delay_sigma: float
    gain_sigma: Float[np.ndarray, "outputs regressors"]

    def response(self, inputs: Inputs) -> Float[np.ndarray, "epochs outputs"]:
        """Outputs at the epochs; every lag is in equilibrium where the log begins."""
        found = regressors(inputs.only(self.inputs), self.reference, self.structure,
                           self.tau, self.delay)  # fmt: skip
        return (found - self.centre) @ self.gain.T

    def stationary(self) -> Float[np.ndarray, "outputs inputs"]:
        """Change of every output for a lasting unit change of every input."""
        return self._over_lags(self.gain)

    def stationary_sigma(self) -> Float[np.ndarray, "outputs inputs"]:
        """Its standard deviations, as if those of the lags of one input were independent."""
        return np.sqrt(self._over_lags(self.gain_sigma**2))

    def _over_lags(self, gain: np.ndarray) -> Float[np.ndarray, "outputs inputs"]:
        m, k = len(self.inputs), self.structure.power
        lagged = gain[:, m * k :].reshape(len(gain), self.structure.order, m).sum(axis=1)
        return lagged + (gain[:, :m] if k else 0.0)


def regressors(
    inputs: Inputs, reference, structure: Structure, tau, delay: float
) -> Float[np.ndarray, "epochs regressors"]:
    """Regressors at the epochs: every input at once, its square, and behind every lag."""
    data = padded(inputs, np.asarray(reference))
    found = regressors_at(data, jnp.asarray(tau, float), jnp.asarray(delay, float), structure.power)
    return np.asarray(found)[: len(inputs.epoch)]


class Padded(eqx.Module):
    """Inputs with spare samples, so that a log of another length is no other program.

    Attributes:
        time: grid of times (s).
        x: inputs, less their references.
        power: whether an input is the time since a power-on.
        epoch: place of every epoch on the grid; the last one again and again in the padding.
    """

    time: Float[Array, " times"]
    x: Float[Array, "inputs times"]
    power: Bool[Array, " inputs"]
    epoch: Int[Array, " epochs"]


def padded(inputs: Inputs, reference: Float[np.ndarray, " inputs"]) -> Padded:
    """Inputs as a traced program takes them."""
    time, x = inputs.time, inputs.values
    power = are_power(inputs.names)
    x = np.where(power[:, None], x, x - reference[:, None])
    spare = rounded(len(time)) - len(time)
    step = time[-1] - time[-2] if len(time) > 1 else 1.0
    time = np.append(time, time[-1] + step * np.arange(1, spare + 1))
    x = np.concatenate([x, np.repeat(x[:, -1:], spare, axis=1)], axis=1)
    n = rounded(len(inputs.epoch))
    epoch = np.append(inputs.epoch, np.full(n - len(inputs.epoch), inputs.epoch[-1]))
    return Padded(jnp.asarray(time), jnp.asarray(x), jnp.asarray(power), jnp.asarray(epoch))


@partial(jax.jit, static_argnames="power")
def regressors_at(
    data: Padded, tau: Float[Array, " order"], delay: Float[Array, ""], power: int
) -> Float[Array, "epochs regressors"]:
    """Regressors of padded inputs, differentiable by time constants and delay."""
    late = data.time - delay

    def course(x, is_power):
        on = jnp.where(is_power, jnp.where(x >= 0.0, 1.0, 0.0), x)
        return jnp.where(is_power, on, jnp.interp(late, data.time, x))

    def lagged(x, is_power, one):
        since = -jnp.expm1(-jnp.maximum(x, 0.0) / one)
        behind = first_order_lag(course(x, is_power), data.time, one)
        return jnp.where(is_power, since, behind)

    now = jax.vmap(course)(data.x, data.power)
    rows = [jnp.zeros((0, len(data.time))), *(now**k for k in range(1, power + 1))]
    if tau.shape[0]:
        each = jax.vmap(lambda one: jax.vmap(lagged, (0, 0, None))(data.x, data.power, one))(tau)
        rows.append(each.reshape(-1, len(data.time)))
    return jnp.concatenate(rows)[:, data.epoch].T


def fit(
    inputs: Inputs,
    output: Float[np.ndarray, "epochs outputs"],
    sigma: Float[np.ndarray, "epochs outputs"],
    structure: Structure,
    blocks: np.ndarray,
    large: Float[np.ndarray, " outputs"],
) -> Fit:
    """Fit a structure, to all epochs and to all but each block in turn.

    The state of every lag at the first epoch is a nuisance unknown, and so is the mean.

    Args:
        inputs: whose epochs are those of the output.
        output: trajectories.
        sigma: their standard deviations.
        blocks: number of the block of each epoch.
        large: what a large drift is; gains have priors of this size.
    """
    reference = inputs.reference
    data = padded(inputs, reference)
    n, spare = len(output), len(data.epoch) - len(output)
    pad = ((0, spare), (0, 0))
    z = jnp.asarray(np.pad(output, pad))
    weight = np.pad(1.0 / sigma, pad)
    folds = np.unique(blocks)
    left_out = np.pad(np.array([blocks == fold for fold in folds]), ((0, 0), (0, spare)))
    weights = jnp.asarray(np.concatenate([weight[None], weight * ~left_out[:, :, None]]))
    shape = (structure.order, structure.power, structure.delayed)
    scale = prior_widths(large, structure.regressor_ranges(inputs.ranges()), structure.order)
    span = float(inputs.time[inputs.epoch[-1]] - inputs.time[inputs.epoch[0]])
    step = float(np.median(np.diff(inputs.time[inputs.epoch])))
    start = _start(data, z, weights[0], scale, shape, step, span)
    bounds = np.log([0.1 * step, span / SLOWEST])
    theta = _solve(data, z, weights, jnp.asarray(scale), start, jnp.asarray(bounds), step, shape)
    theta = np.sort(np.asarray(theta)[:, : structure.order], axis=1), np.asarray(theta)[:, -1]
    packed = np.column_stack(theta)
    size, limits = jnp.asarray(scale), jnp.asarray(bounds)
    found = [
        _errors(jnp.asarray(own), data, z, w, size, limits, step, shape)
        for own, w in zip(packed, weights, strict=True)
    ]
    error, gains, variance, _ = (np.asarray(part) for part in found[0])
    held_out = np.zeros((n, output.shape[1]))
    for fold, other in zip(folds, found[1:], strict=True):
        own = blocks == fold
        wrong, unsure = (np.asarray(part)[:n][own] for part in (other[0], other[3]))
        held_out[own] = foretold_density(wrong, unsure, sigma[own])
    tau, delay = _constants(jnp.asarray(packed[0]), structure.order, bounds, step)
    tau, delay = np.asarray(tau), float(delay) if structure.delayed else 0.0
    found = regressors(inputs, reference, structure, tau, delay)
    r = found.shape[1]
    gain = gains[1 : 1 + r].T
    spread = _theta_sigma(packed[0], data, z, weights[0], scale, bounds, step, shape)
    # The response to a delay has a kink at every sample.
    unsure = float(np.hypot(spread[-1], step / np.sqrt(12.0)))
    model = Lags(
        structure, inputs.names, reference, tau, delay, gain, found.mean(axis=0),
        tau * spread[: structure.order], unsure if structure.delayed else 0.0,
        np.sqrt(variance[1 : 1 + r].T),
    )  # fmt: skip
    count = structure.order + structure.delayed + r * output.shape[1]
    courses = (found - found.mean(axis=0)) @ gain.T
    chi = np.sum((error[:n] / sigma) ** 2, axis=1)
    return Fit(model, chi, held_out.sum(axis=1), count, courses)


def _constants(theta, order: int, bounds, step):
    """Time constants (s) and delay (s) from what is searched, kept within bounds smoothly."""
    low, high = bounds[0], bounds[1]
    tau = jnp.exp(low + (high - low) * jax.nn.sigmoid(theta[:order]))
    return tau, _LATEST * step * jnp.tanh(theta[-1])


def _design(theta, data: Padded, bounds, step, shape):
    """Mean, regressors, and the states at the first epoch."""
    order, power, delayed = shape
    tau, delay = _constants(theta, order, bounds, step)
    found = regressors_at(data, tau, delay if delayed else 0.0, power)
    since = data.time[data.epoch] - data.time[data.epoch[0]]
    states = jnp.exp(-since[:, None] / tau) if order else jnp.zeros((len(since), 0))
    return jnp.concatenate([jnp.ones((len(since), 1)), found, states], axis=1)


@partial(jax.jit, static_argnames="shape")
def _errors(theta, data, z, weight, scale, bounds, step, shape):
    design = _design(theta, data, bounds, step, shape)
    gains, variance, foretold = gains_at(design, z, weight, scale)
    return z - design @ gains, gains, variance, foretold


@partial(jax.jit, static_argnames="shape")
def _costs(thetas, data, z, weight, scale, bounds, step, shape):
    def cost(theta):
        return jnp.sum(
            (_errors(theta, data, z, weight, scale, bounds, step, shape)[0] * weight) ** 2
        )

    return jax.lax.map(cost, thetas)


def _start(data, z, weight, scale, shape, step, span):
    """The best of a grid of time constants."""
    order, _, delayed = shape
    bounds = jnp.log(jnp.asarray([0.1 * step, span / SLOWEST]))
    # Values of the logistic scale that lie evenly between an interval and half the longest one.
    low, high = (np.log(t) for t in (step, 0.5 * span / SLOWEST))
    width = np.log(span / SLOWEST / (0.1 * step))
    share = (np.linspace(low, high, _STARTS) - np.log(0.1 * step)) / width
    grid = np.log(share / (1.0 - share))
    delays = (-0.3, 0.0, 0.3) if delayed else (0.0,)
    thetas = [[*own, delay] for own in combinations(grid, order) for delay in delays]
    if len(thetas) == 1:
        return jnp.asarray(thetas[0])
    costs = _costs(jnp.asarray(thetas), data, z, weight, jnp.asarray(scale), bounds, step, shape)
    return jnp.asarray(thetas[int(np.argmin(np.asarray(costs)))])


@partial(jax.jit, static_argnames="shape")
def _solve(data, z, weights, scale, start, bounds, step, shape):
    """Time constants and delay of every fold."""
    order, _, delayed = shape
    if order == 0 and not delayed:
        return jnp.repeat(start[None], len(weights), axis=0)

    def one(weight):
        def residual(theta, _):
            error, *_ = _errors(theta, data, z, weight, scale, bounds, step, shape)
            held = 0.0 if delayed else 1e-3 * theta[-1]
            return (error * weight).reshape(-1), held, 1e-3 * theta

        solver = optx.LevenbergMarquardt(rtol=1e-7, atol=1e-9)
        return optx.least_squares(residual, solver, start, max_steps=60, throw=False).value

    return jax.lax.map(one, weights)


def _theta_sigma(theta, data, z, weight, scale, bounds, step, shape) -> np.ndarray:
    """Relative standard deviations of the time constants, and that of the delay (s)."""
    order, _, delayed = shape
    if order == 0 and not delayed:
        return np.zeros(1)
    slope = np.asarray(
        _slope(
            jnp.asarray(theta),
            data,
            z,
            weight,
            jnp.asarray(scale),
            jnp.asarray(bounds),
            step,
            shape,
        )
    )
    free = np.arange(len(theta)) if delayed else np.arange(order)
    slope = slope[:, free]
    inverse = np.linalg.pinv(slope.T @ slope)
    spread = np.zeros(order + 1)
    spread[free] = np.sqrt(np.diag(inverse))
    factors = np.asarray(
        jax.jacfwd(lambda t: jnp.append(jnp.log(_constants(t, order, bounds, step)[0]),
                                        _constants(t, order, bounds, step)[1]))(jnp.asarray(theta))
    )  # fmt: skip
    return np.abs(np.diag(factors)) * spread


@partial(jax.jit, static_argnames="shape")
def _slope(theta, data, z, weight, scale, bounds, step, shape):
    def residual(t):
        return (_errors(t, data, z, weight, scale, bounds, step, shape)[0] * weight).reshape(-1)

    return jax.jacfwd(residual)(theta)
