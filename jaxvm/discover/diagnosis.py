"""What a diagnosis says: findings, quality before and after, what is left."""

from dataclasses import dataclass, field

import numpy as np

from jaxvm.discover.advice import Advice
from jaxvm.discover.collocation import Signal
from jaxvm.discover.heldout import Gain, HeldOut
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.locate import Place, ResidualTable
from jaxvm.discover.rivals import Rival
from jaxvm.discover.scopes import Sharing
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Effect
from jaxvm.recording import Recording


@dataclass(frozen=True)
class Finding:
    """One proven effect.

    Attributes:
        hypothesis: what it is.
        effect: with amplitudes and constants as they were found, in the fitted epochs.
        stds: standard deviations of the amplitudes, then of the constants.
        final_effect, final_stds: the same from all epochs, together with all later findings.
        weight: posterior weight among its doubles.
        others: the same physics after other drivers, which it may follow as well.
        rivals: hypotheses that this recording can't tell from it.
        p_value: family-wise, under noise that remembers as long as the residuals do.
        p_independent: the same for noise that is independent from epoch to epoch.
        noise: by how much more correlated noise makes chi-square drop than white noise does.
        n_hypotheses: how many were tried.
        drop: of chi-square in the fitted epochs, by the stated sigmas.
        share: of the plain model's excess chi-square that it explains.
        before, after: whitened pixel residuals of the fitted epochs without and with it, rows in
            the order of the recording's observations; NaN where not fitted.
        gain: on held-out epochs.
        ranking: leading hypotheses at the time, as (words, evidence).
        doubles: hypotheses that fitted nearly as well then.
        alternatives: those that led then; they are tried again at the end.
        chosen: place of this one among them.
        sharing: how the bodies of its kind share it; None where there is only one.
        advice: further recordings that would tell it from its rivals, best first.
    """

    hypothesis: Hypothesis
    effect: Effect
    stds: tuple[float, ...]
    final_effect: Effect
    final_stds: tuple[float, ...]
    weight: float
    others: tuple[Hypothesis, ...]
    rivals: tuple[Rival, ...]
    p_value: float
    p_independent: float
    n_hypotheses: int
    drop: float
    share: float
    before: np.ndarray
    after: np.ndarray
    gain: Gain
    ranking: tuple[tuple[str, float], ...]
    doubles: tuple[Hypothesis, ...]
    alternatives: tuple[Hypothesis, ...]
    chosen: int
    sharing: Sharing | None = None
    advice: tuple[Advice, ...] = ()
    noise: float = 1.0


@dataclass(frozen=True)
class Quality:
    """How well a model fits: weighted RMS (px) fitted and held out, chi-square per freedom."""

    rms_px: float
    heldout_rms_px: float
    chi2_per_dof: float


@dataclass(frozen=True)
class Diagnosis:
    """Everything that a report says.

    Attributes:
        recording: what was diagnosed.
        verdict: "consistent", "explained", "partly explained" or "unexplained".
        noise_px: robust standard deviation of one pixel coordinate after the last fit.
        plain, final: quality of the first and the last model.
        findings: in the order in which they were found.
        significant_left: whether something significant is left over.
        left_p_value: its family-wise p-value.
        located_before, located_left: where residuals are large, before and after.
        before, after: residual tables of the plain and the last model (all epochs).
        held: epochs that were set aside; all where each third was foretold from the others.
        second_look: whether what was found was chosen with all epochs: two thirds did not show it.
        heldout_before, heldout_after: squares by held-out epoch.
        scene: the last model, fitted to all epochs.
        signal: what the marks of an image share at random; None where nothing is proven.
        signal_share: of the plain model's excess chi-square that the signal explains.
        likeness: correlation of neighbouring marks in one image, of what is left.
        n_rejected: gross errors set aside.
        n_hypotheses: hypotheses in the last round.
        unproven: the leading name for what is left, where it did not pass on held-out epochs.
        smallest: smallest amplitude that the recording could show, by catalogue entry.
        absorbed: catalogue entries that it can't show, for the plain model's unknowns absorb them.
        seconds: wall time.
    """

    recording: Recording
    verdict: str
    noise_px: float
    plain: Quality
    final: Quality
    findings: tuple[Finding, ...]
    significant_left: bool
    left_p_value: float
    located_before: tuple[Place, ...]
    located_left: tuple[Place, ...]
    before: ResidualTable
    after: ResidualTable
    held: np.ndarray
    second_look: bool
    heldout_before: HeldOut
    heldout_after: HeldOut
    scene: Scene
    signal: Signal | None
    signal_share: float
    likeness: float
    n_rejected: int
    n_hypotheses: int
    unproven: str
    smallest: dict[str, tuple[float, str]] = field(default_factory=dict)
    absorbed: tuple[str, ...] = ()
    seconds: float = 0.0
