"""Proof on held-out epochs: what was never fitted or used to choose.

Whole epochs are set aside before anything is fitted. A model is judged on them with everything held
that the other epochs determined; only the poses of the held-out epochs themselves are fitted, for
the plain and the extended model alike.

Where nothing is set aside, each third of the epochs is foretold from the other two (three-fold
cross-validation): what was chosen has seen them then, its numbers have not.
"""

from dataclasses import dataclass, replace

import numpy as np

from jaxvm.discover.constants import constants_held, jumps_of, other_instants, run_away
from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment, adjust, reference_sigma
from jaxvm.solve.covariance import amplitude_covariance

CONFIRMED = 0.8
"""Bootstrap probability of an improvement on held-out epochs with which a finding is claimed."""


_EVERY = 3
"""Of so many epochs one is set aside."""

_RTOL = 1e-7
"""Relative change of the cost at which a fit ends: a hundredth of a chi-square of 10^5.

What has play gives way in jerks, and would be followed for ever for less.
"""


@dataclass(frozen=True)
class HeldOut:
    """Errors of a model on held-out epochs.

    Attributes:
        rms_px: weighted RMS of one pixel coordinate.
        square: sum of squares of each held-out epoch (whitened).
        count: pixel coordinates in each held-out epoch.
        range_square: whitened sum of squares of ranges in the held-out epochs.
        scene: the scene with the poses of the held-out epochs fitted.
    """

    rms_px: float
    square: np.ndarray
    count: np.ndarray
    range_square: float
    scene: Scene

    @property
    def total(self) -> float:
        """Sum of squares of everything held out (whitened)."""
        return float(self.square.sum()) + self.range_square


@dataclass(frozen=True)
class Gain:
    """Improvement of one model over another on held-out epochs.

    Attributes:
        before_px, after_px: weighted RMS.
        share: share of the sum of squares that went, with its 95 % interval.
        probability: of an improvement, by the bootstrap.
        odds: twice the logarithm of the odds that the held-out epochs give (`Split.odds`); 0 where
            they were not asked for.
    """

    before_px: float
    after_px: float
    share: float
    interval: tuple[float, float]
    probability: float
    odds: float = 0.0

    @property
    def proven(self) -> bool:
        """Whether the held-out epochs agree that it improves.

        Their errors must be smaller, and either clearly so or with odds for it. The significance
        of a finding is tested on the fitted epochs; the held-out ones are fewer and only have to
        confirm it. A demand of 97.5 % here would lose every second effect that the test has rightly
        found near its limit.
        """
        return self.share > 0.0 and (self.probability >= CONFIRMED or self.odds > 0.0)


@dataclass(frozen=True)
class Split:
    """What is fitted and what is set aside.

    Attributes:
        held: True for the epochs that are set aside.
        sound: for each pixel table, 1 where the observation is no gross error.
        weights: for each pixel table, 1 where it is fitted.
        range_weights: the same for the ranges.
    """

    held: np.ndarray
    sound: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...]
    range_weights: np.ndarray | None

    @property
    def n(self) -> int:
        """Number of pixel coordinates that are fitted."""
        return sum(int(w.sum()) * 2 for w in self.weights)

    def fit(self, scene: Scene, check: bool = False, wanted: float = np.inf) -> Adjustment:
        """Adjustment of a scene to the fitted epochs, given up where it won't get to a cost.

        Nonlinear constants that run away, or break the fit down, are held where they began.
        """

        def fit(active: np.ndarray | None) -> Adjustment:
            return adjust(
                scene,
                weights=self.weights,
                range_weights=self.range_weights,
                active=active,
                rtol=_RTOL,
                damping=1e-6 if scene.effects else 1e-3,
                wanted=wanted,
                check=check,
            )

        fitted = fit(None)
        if fitted.failed or run_away(scene, fitted.scene):
            return fit(constants_held(scene))
        return fitted

    @property
    def judged(self) -> np.ndarray:
        """True for the epochs that models are judged on: those set aside, or all."""
        crossed = not self.held.any() and len(self.held) >= _EVERY
        return self.held | crossed

    def evaluate(self, scene: Scene) -> HeldOut:
        """Errors of a fitted scene on the epochs set aside, or of each third from the others."""
        if self.held.any() or not self.judged.any():
            return evaluate(scene, self.held, self.sound)
        found = []
        for k in range(_EVERY):
            part = split(scene, hold_out(scene, offset=k), self.sound)
            found.append((part.held, part.evaluate(part.fit(scene).scene)))
        return _together(found, scene)

    def proven(self, fitted: Adjustment) -> tuple[Adjustment, HeldOut]:
        """The fit with the epochs set aside evaluated, and their poses taken over."""
        heldout = self.evaluate(fitted.scene)
        return replace(fitted, scene=heldout.scene), heldout

    def undivided(self, scene: Scene) -> "Split":
        """The same with nothing set aside."""
        return split(scene, np.zeros(len(self.held), bool), self.sound)

    def odds(self, before: Adjustment, in_all: Adjustment, after: Adjustment) -> float:
        """Twice the log of the odds that the held-out epochs give to what a fit has more.

        That is 2 ln p(held | fitted, after) - 2 ln p(held | fitted, before), the density of each
        model's forecast taken with the uncertainty that the fitted epochs leave in all it knows
        (partial Bayes factor; O'Hagan 1995, eq. 2). Sums of squared errors, which know nothing of
        it, drown what is new wherever a forecast is vague. By the chain rule of probability it is
        what chi-square drops by in all epochs together, less what it drops by in the fitted ones,
        less what the further epochs sharpen the new unknowns by.

        Args:
            before, after: fits to the fitted epochs; the effects of `after` are those of `before`
                and more.
            in_all: the model of `before` fitted to all epochs.
        """
        everything = self.undivided(after.scene)
        after_in_all = everything.fit(after.scene)
        gained = in_all.cost - after_in_all.cost - (before.cost - after.cost)
        own = after.scene.places()[len(before.scene.effects) :]
        amplitudes = np.concatenate([np.arange(a.start, a.stop) for a, _ in own])
        spreads = (amplitude_covariance(fit, amplitudes) for fit in (after, after_in_all))
        (_, wide), (_, narrow) = map(np.linalg.slogdet, spreads)
        constants = sum(c.stop - c.start for _, c in own)
        sharper = wide - narrow + constants * np.log(everything.n / self.n)
        return float(2.0 * gained / after.variance_factor - sharper)

    def residuals(self, fitted: Adjustment) -> np.ndarray:
        """Whitened residuals [observations, 2] of the fitted epochs; NaN where not fitted."""
        return fitted_residuals(fitted, self.weights)


def split(scene: Scene, held: np.ndarray, sound: tuple[np.ndarray, ...]) -> Split:
    """The split of a recording into fitted and held-out epochs."""
    return Split(held, sound, weights_of(scene, ~held, sound), range_weights_of(scene, ~held))


def hold_out(scene: Scene, every: int = _EVERY, offset: int = -1) -> np.ndarray:
    """Epochs set aside: every third one (or every n-th), True where held out."""
    if every < 2:
        raise ValueError(f"every n-th epoch is held out with n at least 2, not {every}")
    return np.arange(len(scene.recording.time)) % every == offset % every


def weights_of(scene: Scene, epochs: np.ndarray, sound: tuple[np.ndarray, ...]):
    """Weights of all pixel tables: 1 in the chosen epochs where the observation is sound."""
    epoch = scene.recording.observations.epoch
    return tuple(
        epochs[epoch[rows]].astype(float) * good
        for rows, good in zip(scene.tables, sound, strict=True)
    )


def range_weights_of(scene: Scene, epochs: np.ndarray) -> np.ndarray | None:
    """Weights of the ranges: 1 in the chosen epochs."""
    ranges = scene.recording.ranges
    return None if ranges is None else epochs[ranges.epoch].astype(float)


def fitted_residuals(fitted: Adjustment, weights: tuple[np.ndarray, ...]) -> np.ndarray:
    """Whitened residuals [observations, 2], rows as in the recording; NaN where not fitted."""
    scene = fitted.scene
    found = np.full((len(scene.recording.observations.epoch), 2), np.nan)
    blocks = fitted.residuals().pixels
    for rows, weight, block in zip(scene.tables, weights, blocks, strict=True):
        own = np.asarray(block).copy()
        own[weight == 0] = np.nan
        found[rows] = own
    return found


def evaluate(scene: Scene, held: np.ndarray, sound: tuple[np.ndarray, ...]) -> HeldOut:
    """Errors of a fitted scene on the held-out epochs.

    A held-out epoch between two fitted ones of which one lies before a step and one after it takes
    the side that suits it, as it takes its own poses.
    """
    shown = _evaluate(scene, held, sound)
    for place in jumps_of(scene):
        for other in other_instants(shown.scene, place, ~held):
            tried = _evaluate(other, held, sound)
            shown = tried if tried.total < shown.total else shown
    return shown


def _together(parts: list[tuple[np.ndarray, HeldOut]], scene: Scene) -> HeldOut:
    """Errors on epochs that were set aside in turn, as of one scene."""
    square, count = np.zeros(len(parts[0][0])), np.zeros(len(parts[0][0]))
    for held, errors in parts:
        square[held], count[held] = errors.square, errors.count
    rms = float(np.sqrt(square.sum() / max(count.sum(), 1.0)))
    ranges = sum(errors.range_square for _, errors in parts)
    return HeldOut(rms * reference_sigma(scene), square, count, ranges, scene)


def _evaluate(scene: Scene, held: np.ndarray, sound: tuple[np.ndarray, ...]) -> HeldOut:
    """Errors of a fitted scene on the held-out epochs as it is."""
    weights = weights_of(scene, held, sound)
    fitted = adjust(
        scene,
        weights=weights,
        range_weights=range_weights_of(scene, held),
        active=_of_these(scene, weights),
        rtol=1e-7,
        damping=1e-6,
        check=False,
    )
    residuals = fitted.residuals()
    epoch = scene.recording.observations.epoch
    square, count = np.zeros(len(held)), np.zeros(len(held))
    for rows, weight, block in zip(scene.tables, weights, residuals.pixels, strict=True):
        np.add.at(square, epoch[rows], np.sum(np.asarray(block) ** 2, axis=1))
        np.add.at(count, epoch[rows], 2.0 * (weight > 0))
    # What an epoch has for itself fits its noise, too.
    square *= count / np.maximum(count - _amplitudes(scene, len(held)), 1.0)
    ranges = 0.0 if residuals.ranges is None else float(np.sum(np.asarray(residuals.ranges) ** 2))
    rms = float(np.sqrt(square[held].sum() / max(count[held].sum(), 1.0)))
    return HeldOut(rms * reference_sigma(scene), square[held], count[held], ranges, fitted.scene)


def _of_these(scene: Scene, weights) -> np.ndarray:
    """Unknowns that one epoch has for itself, of the epochs with weight alone."""
    felt = np.zeros(scene.network.effects.n_columns, bool)
    for factor, weight in zip(scene.network.pixels, weights, strict=True):
        own = np.asarray(factor.pattern)[: len(weight)][weight > 0]
        felt |= np.any(own != 0.0, axis=0)
    active = scene.unknowns.of_one_epoch
    columns = scene.unknowns.column[scene.network.layout.all("amplitude")]
    active[columns[~felt]] = False
    return active


def _amplitudes(scene: Scene, n_epochs: int) -> np.ndarray:
    """Number of amplitudes that each epoch has for itself."""
    number = np.zeros(n_epochs)
    for term in (term for effect in scene.effects for term in effect.terms):
        if term.driver == "epoch":
            number[int(term.constants[0])] += 1.0
    return number


def gain(before: HeldOut, after: HeldOut, seed: int = 0, repetitions: int = 2000) -> Gain:
    """Improvement with an interval from a bootstrap over held-out epochs.

    Where nothing was held out (fewer epochs than every third one needs) nothing is proven.
    """
    n = len(before.square)
    if not before.count.sum():
        return Gain(before.rms_px, after.rms_px, 0.0, (0.0, 0.0), 0.0)
    picks = np.random.default_rng(seed).integers(0, n, (repetitions, n))
    per_epoch = 1.0 / max(n, 1)
    old = before.square + before.range_square * per_epoch
    new = after.square + after.range_square * per_epoch
    shares = 1.0 - new[picks].sum(axis=1) / np.maximum(old[picks].sum(axis=1), 1e-300)
    low, high = np.quantile(shares, [0.025, 0.975])
    share = 1.0 - new.sum() / max(old.sum(), 1e-300)
    likely = float(np.mean(shares > 0.0))
    return Gain(before.rms_px, after.rms_px, float(share), (float(low), float(high)), likely)
