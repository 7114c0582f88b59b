"""Dynamics in discrete time, in steps of the epochs: ARX and output error.

    A(q) y_k = sum_i B_i(q) u_i,k-nk + (ARX: white noise e_k; output error: A(q) e_k)

All outputs of a camera share A, as they share its thermal body. ARX (equation error) is linear, and
biased where outputs are noisy; output error fits what the model simulates from its inputs alone
(Ljung 1999, 4.2 and 4.3). Poles are kept inside the unit circle, those of output error are real and
positive, as heat flows one way.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from jaxvm.identify.gains import SLOWEST, Fit, foretold_density, linear_gains, prior_widths
from jaxvm.identify.inputs import Inputs, are_power


@dataclass(frozen=True, eq=False)
class Orders:
    """Orders of a discrete model: na poles, nb coefficients of each input, nk steps late."""

    kind: Literal["ARX", "output error"]
    na: int
    nb: int
    nk: int = 0

    @property
    def name(self) -> str:
        """As it reads in a report."""
        return f"{self.kind}({self.na}, {self.nb}, {self.nk})"


@dataclass(frozen=True, eq=False)
class Difference:
    """A difference equation.

    Attributes:
        structure: its orders.
        inputs: names of the inputs.
        reference: value of every input from which it is counted.
        step: between samples (s).
        a: coefficients a_1, a_2, ... of A, without the leading 1.
        gain: b of every output, input by input [outputs, inputs * nb].
        centre: mean of every regressor over the training, so that the mean state is zero.
        gain_sigma: of the gains.
    """

    structure: Orders
    inputs: tuple[str, ...]
    reference: Float[np.ndarray, " inputs"]
    step: float
    a: Float[np.ndarray, " na"]
    gain: Float[np.ndarray, "outputs regressors"]
    centre: Float[np.ndarray, " regressors"]
    gain_sigma: Float[np.ndarray, "outputs regressors"]

    def response(self, inputs: Inputs) -> Float[np.ndarray, "epochs outputs"]:
        """Outputs at the epochs, simulated from the inputs alone, in equilibrium at first."""
        own = _Samples(inputs.only(self.inputs), self.reference, self.step)
        return (own.at_epochs(own.filtered(self.structure, self.a)) - self.centre) @ self.gain.T

    def stationary(self) -> Float[np.ndarray, "outputs inputs"]:
        """Change of every output for a lasting unit change of every input."""
        each = self.gain.reshape(len(self.gain), len(self.inputs), -1).sum(axis=2)
        return each / (1.0 + self.a.sum())

    def stationary_sigma(self) -> Float[np.ndarray, "outputs inputs"]:
        """Its standard deviations, as if the gains of one input were independent and `a` known."""
        each = (self.gain_sigma**2).reshape(len(self.gain), len(self.inputs), -1).sum(axis=2)
        return np.sqrt(each) / abs(1.0 + self.a.sum())


class _Samples:
    """Inputs in steps; the samples before the first epoch are those of the log."""

    def __init__(self, inputs: Inputs, reference: np.ndarray, step: float):
        epochs = inputs.time[inputs.epoch]
        before = max(int((epochs[0] - inputs.time[0]) / step), 0)
        count = before + int(np.ceil((epochs[-1] - epochs[0]) / step - 1e-6)) + 1
        self.time = epochs[0] + step * (np.arange(count) - before)
        self.epochs, self.before = epochs, before
        x = np.array([np.interp(self.time, inputs.time, values) for values in inputs.values])
        self.u = np.where(are_power(inputs.names)[:, None], x >= 0.0, x - reference[:, None])

    @property
    def slowest(self) -> float:
        """Largest modulus of a pole: that of the longest time constant that shows."""
        span = self.epochs[-1] - self.epochs[0]
        return float(np.exp(-SLOWEST * (self.time[1] - self.time[0]) / span))

    def late(self, orders: Orders) -> np.ndarray:
        """Inputs shifted by every delay [regressors, samples]; they stood still before."""
        steps = range(orders.nk, orders.nk + orders.nb)
        return np.array([np.append(np.full(k, row[0]), row[: len(row) - k]) for row in self.u
                         for k in steps])  # fmt: skip

    def filtered(self, orders: Orders, a: np.ndarray) -> np.ndarray:
        """Inputs behind 1 / A(q), every delay, in equilibrium at the first sample."""
        rows = self.late(orders)
        settled = rows[:, :1] / (1.0 + np.sum(a))
        moved = _behind(a, rows - rows[:, :1])
        return settled + moved

    def at_epochs(self, rows: np.ndarray) -> np.ndarray:
        """Rows at the epochs [epochs, rows]."""
        return np.array([np.interp(self.epochs, self.time, row) for row in rows]).T

    def states(self, a: np.ndarray) -> np.ndarray:
        """How every state at the first epoch dies away [epochs, na]."""
        out = []
        for k in range(len(a)):
            pulse = np.zeros(len(self.time) - self.before)
            pulse[k] = 1.0
            out.append(np.append(np.zeros(self.before), _behind(a, pulse)))
        return self.at_epochs(np.array(out)) if out else np.zeros((len(self.epochs), 0))


def _behind(a: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows behind 1 / A(q), from rest."""
    # A third of a second of imports, for which only who fits such models has to wait.
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], np.append(1.0, a), rows, axis=-1))


def is_even(time: Float[np.ndarray, " epochs"]) -> bool:
    """Whether epochs follow each other in equal steps, within a hundredth."""
    steps = np.diff(time)
    return len(steps) > 1 and bool(np.ptp(steps) < 0.01 * np.median(steps))


def fit_difference(
    inputs: Inputs,
    output: Float[np.ndarray, "epochs outputs"],
    sigma: Float[np.ndarray, "epochs outputs"],
    structure: Orders,
    blocks: np.ndarray,
    large: Float[np.ndarray, " outputs"],
) -> Fit:
    """Fit a structure, to all epochs and to all but each block in turn.

    Arguments and result are those of `jaxvm.identify.lags.fit`.

    Raises:
        ValueError: the epochs don't follow each other in equal steps.
    """
    epochs = inputs.time[inputs.epoch]
    if not is_even(epochs):
        raise ValueError("ARX and output error need epochs in equal steps; take time constants")
    reference = inputs.reference
    step = float(np.median(np.diff(epochs)))
    samples = _Samples(inputs, reference, step)
    ranges = np.repeat(inputs.ranges(), structure.nb)

    def solved(used: np.ndarray):
        weight = used[:, None] / sigma
        if structure.kind == "ARX":
            a = _equation_error(samples, output, weight, structure)
        else:
            a = _output_error(samples, output, weight, structure, large, ranges)
        found = samples.at_epochs(samples.filtered(structure, a))
        design = np.hstack([np.ones((len(output), 1)), found, samples.states(a)])
        return a, found, *linear_gains(design, output, weight, _widths(a, large, ranges))

    a, found, error, gains, variance, _ = solved(np.ones(len(output)))
    held_out = np.zeros(output.shape)
    for fold in np.unique(blocks):
        own = blocks == fold
        _, _, wrong, _, _, unsure = solved((~own).astype(float))
        held_out[own] = foretold_density(wrong[own], unsure[own], sigma[own])
    r = found.shape[1]
    centre, gain = found.mean(axis=0), gains[1 : 1 + r].T
    spread = np.sqrt(variance[1 : 1 + r].T)
    model = Difference(structure, inputs.names, reference, step, a, gain, centre, spread)
    chi = np.sum((error / sigma) ** 2, axis=1)
    count = structure.na + r * output.shape[1]
    return Fit(model, chi, held_out.sum(axis=1), count, (found - centre) @ gain.T)


def _widths(a: np.ndarray, large: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    """Prior widths; what counts is the lasting change, which the poles make larger than b."""
    return prior_widths(large, ranges / (1.0 + a.sum()), len(a))


def _equation_error(samples: _Samples, output, weight, orders: Orders) -> np.ndarray:
    """A of all outputs together by least squares of the equation error, made stable."""
    n, late = len(output), samples.at_epochs(samples.late(orders))
    first = orders.na
    normal, right = np.zeros((orders.na, orders.na)), np.zeros(orders.na)
    for own, w in zip(output.T, weight.T, strict=True):
        lagged = np.array([own[first - i : n - i] for i in range(1, orders.na + 1)]).T
        # An equation counts where all that enters it is used.
        used = np.min([w[first - i : n - i] for i in range(orders.na + 1)], axis=0)
        others = np.hstack([late[first:], np.ones((n - first, 1))]) * used[:, None]
        basis, _ = np.linalg.qr(others)
        x, y = lagged * used[:, None], own[first:] * used
        x, y = x - basis @ (basis.T @ x), y - basis @ (basis.T @ y)
        normal += x.T @ x
        right += x.T @ y
    a = -np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(orders.na), right)
    roots = np.roots(np.append(1.0, a))
    modulus = np.abs(roots)
    roots = np.where(modulus > 1.0, roots / np.maximum(modulus, 1e-9) ** 2, roots)
    limit = samples.slowest
    return np.real(np.poly(np.where(np.abs(roots) > limit, limit, roots)))[1:]


def _output_error(samples: _Samples, output, weight, orders: Orders, large, ranges) -> np.ndarray:
    """A with real positive poles, by least squares of what is simulated; gains are eliminated."""

    def poles(theta):
        return samples.slowest / (1.0 + np.exp(-theta))

    def residual(theta):
        a = np.poly(poles(theta))[1:]
        found = samples.at_epochs(samples.filtered(orders, a))
        design = np.hstack([np.ones((len(output), 1)), found, samples.states(a)])
        error = linear_gains(design, output, weight, _widths(a, large, ranges))[0]
        return np.append((error * weight).ravel(), 1e-3 * theta)

    # Poles of 3 to 100 steps, far apart at first.
    starts = np.array([[3.5], [1.5], [4.6]]) if orders.na == 1 else np.array(
        [np.linspace(0.5, 4.0, orders.na), np.linspace(2.0, 4.6, orders.na)]
    )  # fmt: skip
    best = min(starts, key=lambda theta: np.sum(residual(theta) ** 2))
    found = least_squares(residual, best, method="lm", max_nfev=60 * (orders.na + 1))
    return np.poly(poles(found.x))[1:]
