"""From mismatch to physics: the whole road, from a recording to named and proven findings.

Compare, score, test, model, weigh the doubles, prove on held-out epochs, and go on until nothing
significant is left. No finding is claimed that does not pass on epochs which were never fitted.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxvm.discover.diagnosis import Diagnosis, Finding, Quality
from jaxvm.discover.heldout import (
    HeldOut,
    evaluate,
    gain,
    hold_out,
    range_weights_of,
    weights_of,
)
from jaxvm.discover.hypotheses import Hypothesis, enumerate_hypotheses
from jaxvm.discover.locate import ResidualTable, locate, residual_table
from jaxvm.discover.revise import prune, rename
from jaxvm.discover.score import score
from jaxvm.discover.select import Candidate, identity, refit, rivals, shortlist
from jaxvm.discover.visible import smallest_visible
from jaxvm.network.scene import Scene, build
from jaxvm.network.start import start
from jaxvm.physics.effects import Effect, capacity
from jaxvm.recording import Recording
from jaxvm.solve.adjust import Adjustment, adjust, reference_sigma
from jaxvm.solve.covariance import standard_deviations
from jaxvm.solve.snooping import robust_variance

ALPHA = 0.01
"""Family-wise probability to claim something where nothing is hidden."""

GROSS = 12.0
"""Residuals beyond this many robust standard deviations are mistakes, not physics."""

_ROOM = (16, 8)
_CANDIDATES = 4
_NEAR = 30.0
_TIE = 0.05
_OPEN = 100.0, 0.02
_FLIPS = 299


@dataclass(frozen=True)
class _Fits:
    """Data split and what was fitted so far."""

    held: np.ndarray
    sound: tuple[np.ndarray, ...]
    weights: tuple[np.ndarray, ...]
    range_weights: np.ndarray | None


def diagnose(
    recording: Recording,
    effects: tuple[Effect, ...] | None = None,
    every: int = 3,
    alpha: float = ALPHA,
    max_findings: int = 8,
    seed: int = 0,
    progress: Callable[[str], None] = lambda line: None,
) -> Diagnosis:
    """Find the physics that a recording shows and its model lacks.

    Args:
        recording: measurements and the engineer's model.
        effects: physics already in the model, instead of what the recording's model has.
        every: every n-th epoch is held out.
        alpha: family-wise probability of a false claim.
        max_findings: bound on the number of findings.
        seed: of sign-flips and bootstrap.
        progress: called with a line for each stage.

    Raises:
        StartError: the data give no start values.
        RankDeficiency: the model has unknowns that the recording does not determine.
    """
    began = time.perf_counter()
    progress("start values from the data")
    effects = recording.model.effects if effects is None else effects
    scene = start(build(recording, ()))
    scene = scene.with_effects(effects, _room(effects))
    held = hold_out(scene, every)
    everything = tuple(np.ones(len(rows)) for rows in scene.tables)
    progress("fit of the plain model")
    split = _split(scene, held, everything)
    base = _fit(scene, split, check=True)
    sound = _sound(base, scene, held, everything)
    n_rejected = int(sum(np.sum(good == 0) for good in sound))
    split = _split(scene, held, sound)
    if n_rejected:
        base = _fit(base.scene, split)
    plain_heldout = evaluate(base.scene, held, sound)
    base = replace(base, scene=plain_heldout.scene)
    plain = base
    n = sum(int(w.sum()) * 2 for w in split.weights)

    def fit(scene: Scene) -> Adjustment:
        return _fit(scene, split)

    current, best_heldout = base, plain_heldout
    findings: list[Finding] = []
    hopeless: set = set()
    unproven, p_value, ranking = "", 1.0, None
    while True:
        progress(f"scoring hypotheses (round {len(findings) + 1})")
        families = enumerate_hypotheses(current.scene)
        variance = robust_variance(current)
        ranking, arrangement = score(current, families, variance, _FLIPS, seed)
        p_value = ranking.p_value(ranking.best_z())
        if p_value > alpha or len(findings) == max_findings:
            break
        progress(f"{ranking.n} hypotheses, p = {p_value:.3g}: refitting the leading ones")
        leading = shortlist(ranking, current.scene, variance, n, 12)
        accepted = _accept(current, leading, split, n, best_heldout, held, sound, seed, hopeless)
        if isinstance(accepted, str):
            unproven = accepted
            break
        chosen, doubles_too, heldout, proof = accepted
        weight, doubles = rivals(current.scene, arrangement, ranking, chosen, current, n)
        drop = 2.0 * (current.cost - chosen.adjustment.cost)
        findings.append(
            Finding(
                hypothesis=chosen.hypothesis,
                effect=chosen.effect,
                stds=_deviations(chosen.adjustment)[-1],
                final_effect=chosen.effect,
                final_stds=(),
                weight=weight,
                rivals=tuple(doubles[:8]),
                p_value=p_value,
                n_hypotheses=ranking.n,
                drop=drop,
                share=0.0,
                before=_fitted_residuals(current, split),
                after=_fitted_residuals(chosen.adjustment, split),
                gain=proof,
                ranking=tuple((_short(h), e) for h, e, _ in leading),
                doubles=doubles_too,
                chosen=next(k for k, (h, _, _) in enumerate(leading) if h is chosen.hypothesis),
            )
        )
        progress(f"found: {chosen.effect.name} ({chosen.effect.scope.words()})")
        current, best_heldout = replace(chosen.adjustment, scene=heldout.scene), heldout
        kept = len(findings)
        current, findings = prune(current, findings, n, fit)
        if len(findings) < kept:
            current, best_heldout = _proven(current, held, sound)

    names = [finding.hypothesis for finding in findings]
    if p_value > alpha:
        # While something is left, names can't be decided any better than when they were found.
        current, findings = rename(current, findings, n, fit)
    if [finding.hypothesis for finding in findings] != names:
        current, best_heldout = _proven(current, held, sound)
        deviations = _deviations(current)[len(effects) :]
        findings = [
            replace(f, stds=f.stds or own) for f, own in zip(findings, deviations, strict=True)
        ]

    progress("final fit to all epochs")
    whole = tuple(sound)
    final = _with_best_instants(_fit(current.scene, _Fits(held, sound, whole, None)), whole)
    excess = 2.0 * plain.cost - current.variance_factor * plain.degrees_of_freedom
    findings = [replace(f, share=float(f.drop / max(excess, 1e-9))) for f in findings]
    findings = _with_final_values(final, findings, len(effects))
    before = _table(plain, plain_heldout, scene, sound)
    after = _table(final, None, scene, sound)
    noise = np.sqrt(robust_variance(final)) * reference_sigma(scene)
    significant = p_value <= alpha
    return Diagnosis(
        recording=recording,
        verdict=_verdict(findings, significant),
        noise_px=float(noise),
        plain=_quality(plain, plain_heldout),
        final=_quality(current, best_heldout),
        findings=tuple(findings),
        significant_left=significant,
        left_p_value=p_value,
        located_before=tuple(locate(scene, before)[:8]),
        located_left=tuple(locate(final.scene, after)[:8]),
        before=before,
        after=after,
        held=held,
        heldout_before=plain_heldout,
        heldout_after=best_heldout,
        scene=final.scene,
        n_rejected=n_rejected,
        n_hypotheses=ranking.n,
        unproven=unproven,
        smallest=smallest_visible(ranking, robust_variance(current), current.scene),
        seconds=time.perf_counter() - began,
    )


def _proven(current: Adjustment, held, sound) -> tuple[Adjustment, HeldOut]:
    """The fit with its held-out epochs evaluated and their poses taken over."""
    heldout = evaluate(current.scene, held, sound)
    return replace(current, scene=heldout.scene), heldout


def _room(effects: tuple[Effect, ...]) -> tuple[int, int]:
    """Room for the effects given and those to be found; the same for few of them."""
    columns, constants = capacity(effects)
    return max(_ROOM[0], columns + 8), max(_ROOM[1], constants + 3)


def _split(scene: Scene, held: np.ndarray, sound) -> _Fits:
    return _Fits(held, sound, weights_of(scene, ~held, sound), range_weights_of(scene, ~held))


def _fit(scene: Scene, split: _Fits, check: bool = False) -> Adjustment:
    return adjust(scene, weights=split.weights, range_weights=split.range_weights, check=check)


def _sound(base: Adjustment, scene: Scene, held, everything) -> tuple[np.ndarray, ...]:
    """Observations without gross errors, by the plain model, in fitted and held-out epochs.

    What goes on, in most epochs of a mark or over most of an image, is physics and stays.
    """
    limit = GROSS * np.sqrt(robust_variance(base))
    inside = base.residuals()
    momentary = adjust(
        base.scene,
        weights=weights_of(scene, held, everything),
        range_weights=range_weights_of(scene, held),
        active=scene.unknowns.of_one_epoch,
        check=False,
    ).residuals()
    obs = scene.recording.observations
    n_marks = scene.first_point[-1]
    mark = obs.camera * n_marks + scene.first_point[obs.target] + obs.point
    image = obs.camera * len(held) + obs.epoch
    sound = []
    for rows, a, b in zip(scene.tables, inside.pixels, momentary.pixels, strict=True):
        beyond = np.maximum(np.abs(np.asarray(a)), np.abs(np.asarray(b))).max(axis=1) > limit
        alone = beyond
        for label in (mark[rows], image[rows]):
            share = np.bincount(label, beyond) / np.maximum(np.bincount(label), 1)
            alone = alone & (share[label] < 0.25)
        sound.append(1.0 - alone)
    return tuple(sound)


def _accept(
    current, leading, split: _Fits, n: int, heldout: HeldOut, held, sound, seed, hopeless: set
):
    """The best candidate that improves the held-out epochs, or the name of the one that failed.

    `hopeless` collects what can't be fitted or does not help there; it is not tried again.
    """
    room = (
        current.scene.network.effects.n_columns,
        current.scene.state.constant.shape[0],
    )

    # One tangent foretells a drop to a few percent: only near ties of the leading one need a refit.
    # Where none of them passes, named physics gets its turn; an unnamed effect must lead.
    least = leading[0][1] - max(_NEAR, _TIE * abs(leading[0][1]))
    near = [item for item in leading[:_CANDIDATES] if item[1] >= least]
    rest = [item for item in leading[len(near) :] if item[0].entries]
    for some in (near, rest[:_CANDIDATES]):
        refitted = []
        for hypothesis, _, amplitudes in some:
            key = (identity(hypothesis), hypothesis.course)
            if key in hopeless:
                continue
            candidate = refit(
                current, hypothesis, amplitudes, room, split.weights, split.range_weights, n
            )
            if candidate is None or candidate.evidence <= 0.0:
                hopeless.add(key)
            else:
                refitted.append(candidate)
        for candidate in sorted(refitted, key=lambda c: -_common_evidence(c, refitted, current, n)):
            tried = evaluate(candidate.adjustment.scene, held, sound)
            proof = gain(heldout, tried, seed)
            if proof.proven:
                gap = max(_OPEN[0], _OPEN[1] * abs(candidate.evidence))
                others = tuple(
                    c.hypothesis
                    for c in refitted
                    if c is not candidate and candidate.evidence - c.evidence < gap
                )
                return candidate, others, tried, proof
            hopeless.add((identity(candidate.hypothesis), candidate.hypothesis.course))
    return _short(leading[0][0])


def _common_evidence(candidate: Candidate, all_candidates, current: Adjustment, n: int) -> float:
    """Evidence with one variance for all candidates: the smallest that any of them reaches."""
    variance = min(c.adjustment.variance_factor for c in all_candidates)
    own = candidate.adjustment.variance_factor
    drop = 2.0 * (current.cost - candidate.adjustment.cost)
    return candidate.evidence + drop * (1.0 / variance - 1.0 / own)


def _with_best_instants(final: Adjustment, weights) -> Adjustment:
    """The final fit with every step at the instant that all epochs prefer.

    The fitted epochs alone leave open on which side an epoch between two of them lies.
    """
    time = np.asarray(final.scene.network.channels.epoch_time)
    between = 0.5 * (time[1:] + time[:-1]) - time[0]
    for k, effect in enumerate(final.scene.effects):
        if effect.form != "step":
            continue
        place = int(np.argmin(np.abs(between - effect.constants[0])))
        for other in between[max(place - 1, 0) : place + 2]:
            effects = list(final.scene.fitted_effects())
            effects[k] = replace(effects[k], constants=(float(other),))
            room = (final.scene.network.effects.n_columns, final.scene.state.constant.shape[0])
            scene = final.scene.with_effects(tuple(effects), room)
            tried = adjust(scene, weights=weights, rtol=1e-8, check=False)
            if tried.cost < final.cost:
                final = tried
    return final


def _fitted_residuals(adjustment: Adjustment, split: _Fits) -> np.ndarray:
    scene = adjustment.scene
    stacked = np.full((len(scene.recording.observations.epoch), 2), np.nan)
    for rows, weight, block in zip(
        scene.tables, split.weights, adjustment.residuals().pixels, strict=True
    ):
        own = np.asarray(block).copy()
        own[weight == 0] = np.nan
        stacked[rows] = own
    return stacked


def _with_final_values(final: Adjustment, findings: list[Finding], given: int) -> list[Finding]:
    """Findings with the values of the fit to all epochs."""
    values = zip(final.scene.fitted_effects(), _deviations(final), strict=True)
    pairs = zip(findings, list(values)[given:], strict=True)
    return [replace(f, final_effect=effect, final_stds=stds) for f, (effect, stds) in pairs]


def _deviations(adjustment: Adjustment) -> list[tuple[float, ...]]:
    """Standard deviations of every effect: its amplitudes, then its constants."""
    deviations = standard_deviations(adjustment, robust_variance(adjustment))
    amplitude, constant = np.asarray(deviations.amplitude), np.asarray(deviations.constant)
    result, column, first = [], 0, 0
    for effect in adjustment.scene.effects:
        n, m = effect.n_columns, len(effect.constants)
        own = (*amplitude[column : column + n], *constant[first : first + m])
        result.append(tuple(map(float, own)))
        column, first = column + n, first + m
    return result


def _table(fitted: Adjustment, heldout: HeldOut | None, scene: Scene, sound) -> ResidualTable:
    """Residuals in all epochs. A fit to some epochs is completed by the poses of the others."""
    reference = reference_sigma(scene)
    if heldout is None:
        return residual_table(scene, fitted.residuals().pixels, sound, reference)
    completed = adjust(
        fitted.scene,
        weights=tuple(sound),
        active=scene.unknowns.of_one_epoch,
        check=False,
    )
    return residual_table(scene, completed.residuals().pixels, sound, reference)


def _quality(fitted: Adjustment, heldout: HeldOut) -> Quality:
    square = sum(float(np.sum(np.asarray(b) ** 2)) for b in fitted.residuals().pixels)
    count = sum(2.0 * float(np.sum(np.asarray(f.weight) > 0))
                for f in fitted.problem.network.pixels)  # fmt: skip
    rms = np.sqrt(square / count) * reference_sigma(fitted.scene)
    return Quality(float(rms), heldout.rms_px, fitted.variance_factor)


def _verdict(findings: list[Finding], significant: bool) -> str:
    if not findings:
        return "unexplained" if significant else "consistent"
    return "partly explained" if significant else "explained"


def _short(hypothesis: Hypothesis) -> str:
    effect = hypothesis.effect(())
    parts = [effect.name]
    if effect.driver != "constant":
        parts.append(f"{effect.form} in {effect.driver}")
    parts.append(effect.scope.words())
    return " · ".join(parts)
