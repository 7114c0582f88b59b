"""From mismatch to physics: the whole road, from a recording to named and proven findings.

Compare, score, test, model, weigh the doubles, prove on held-out epochs, and go on until nothing
significant is left. No finding is claimed that does not pass on epochs which were never fitted.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jaxvm.discover.accept import accept, short
from jaxvm.discover.advice import advise
from jaxvm.discover.cells import arrange
from jaxvm.discover.diagnosis import Diagnosis, Finding, Quality
from jaxvm.discover.gross import without_gross_errors
from jaxvm.discover.heldout import (
    HeldOut,
    Split,
    hold_out,
    split,
)
from jaxvm.discover.hypotheses import enumerate_hypotheses
from jaxvm.discover.locate import ResidualTable, locate, residual_table
from jaxvm.discover.noise import LONGEST, memory, multipliers
from jaxvm.discover.revise import prune, rename
from jaxvm.discover.scopes import sharing
from jaxvm.discover.score import Ranking, battery, score_residuals
from jaxvm.discover.select import refit, rivals, shortlist, stacked
from jaxvm.discover.visible import smallest_visible
from jaxvm.network.scene import Scene, build
from jaxvm.network.start import start
from jaxvm.physics.effects import Effect, capacity
from jaxvm.recording import Recording
from jaxvm.solve.adjust import Adjustment, adjust, reference_sigma
from jaxvm.solve.compiling import forget_compiled_if_many
from jaxvm.solve.covariance import standard_deviations
from jaxvm.solve.snooping import robust_variance

ALPHA = 0.01
"""Family-wise probability to claim something where nothing is hidden."""

ROOM = (16, 8)
"""Columns and constants kept free for effects to be found."""

FLIPS = 199
"""Repetitions of the null distribution."""

_ADVISED = 3


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
    forget_compiled_if_many()
    progress("start values from the data")
    effects = recording.model.effects if effects is None else effects
    scene = start(build(recording, ()))
    scene = scene.with_effects(effects, _room(effects))
    progress("fit of the plain model")
    parts, plain, n_rejected = _plain_fit(scene, every)
    plain, plain_heldout = parts.proven(plain)

    current, best_heldout = plain, plain_heldout
    findings: list[Finding] = []
    hopeless: set = set()
    unproven, p_value, families = "", 1.0, enumerate_hypotheses(plain.scene)
    signs = multipliers(len(parts.held), 1, FLIPS, seed)
    asked = None
    while True:
        progress(f"scoring hypotheses (round {len(findings) + 1})")
        variance = robust_variance(current)
        arrangement = arrange(current)
        asked = battery(current.scene, arrangement, families) if asked is None else asked
        ranking = score_residuals(current.scene, arrangement, asked, variance, signs)
        foremost = shortlist(ranking, current.scene, variance, parts.n, 12)
        p_value = ranking.p_value(ranking.best_z())
        if p_value > alpha:
            p_value = _p_without(foremost, ranking, current, arrangement, asked, parts, signs)
        if p_value > alpha or len(findings) == max_findings:
            break
        leading = [
            item for item in foremost if not any(item[0].covered(f.hypothesis) for f in findings)
        ]
        if not leading:
            unproven = "what an unnamed effect left over"
            break
        progress(f"{ranking.n} hypotheses, p = {p_value:.3g}: refitting the leading ones")
        accepted = accept(current, leading, parts, best_heldout, seed, hopeless)
        if isinstance(accepted, str):
            unproven = accepted
            break
        chosen = accepted.chosen
        weight, doubles = rivals(
            current.scene, arrangement, asked, accepted, leading, current, parts.n, signs
        )
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
                p_independent=p_value,
                z=ranking.best_z(),
                n_hypotheses=ranking.n,
                drop=2.0 * (current.cost - chosen.adjustment.cost),
                share=0.0,
                before=parts.residuals(current),
                after=parts.residuals(chosen.adjustment),
                gain=accepted.gain,
                ranking=tuple((short(h), e) for h, e, _ in leading),
                doubles=tuple(candidate.hypothesis for candidate in accepted.near),
                chosen=next(k for k, (h, *_) in enumerate(leading) if h.same(chosen.hypothesis)),
            )
        )
        progress(f"found: {chosen.effect.name} ({chosen.effect.scope.words()})")
        best_heldout = accepted.heldout
        current = replace(chosen.adjustment, scene=best_heldout.scene)
        former = findings
        current, findings = prune(current, findings, parts.n, parts.fit)
        if len(findings) < len(former):
            current, best_heldout = parts.proven(current)
            findings = _with_heir(current, findings, former, parts)
        findings = _confirmed(findings, current, arrangement, asked, parts, seed)
        if len(findings) > 1 and min(f.p_value for f in findings[-2:]) > alpha:
            break

    unconfirmed = [f.p_value for f in findings if f.p_value > alpha]
    if unconfirmed:
        p_value = min(unconfirmed)
        current, findings = _only_confirmed(current, findings, alpha, parts)
        current, best_heldout = parts.proven(current)
    names = [finding.hypothesis for finding in findings]
    if p_value > alpha:
        # While something is left, names can't be decided any better than when they were found.
        current, findings = rename(current, findings, parts.n, parts.fit)
    if [finding.hypothesis for finding in findings] != names:
        current, best_heldout = parts.proven(current)
        deviations = _deviations(current)[len(effects) :]
        findings = [
            replace(f, stds=f.stds or own) for f, own in zip(findings, deviations, strict=True)
        ]

    progress("final fit to all epochs")
    final = adjust(current.scene, weights=parts.sound, check=False)
    final = _with_best_instants(final, parts.sound)
    excess = 2.0 * plain.cost - current.variance_factor * plain.degrees_of_freedom
    findings = [replace(f, share=float(f.drop / max(excess, 1e-9))) for f in findings]
    findings = _with_final_values(final, findings, len(effects))
    findings = [
        replace(f, sharing=sharing(current, len(effects) + k, parts))
        for k, f in enumerate(findings)
    ]
    if any(finding.rivals for finding in findings):
        progress("weighing further recordings")
    findings = [_with_advice(final, f, len(effects) + k, parts) for k, f in enumerate(findings)]
    before = _table(plain, plain_heldout, scene, parts.sound)
    after = _table(final, None, scene, parts.sound)
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
        held=parts.held,
        heldout_before=plain_heldout,
        heldout_after=best_heldout,
        scene=final.scene,
        n_rejected=n_rejected,
        n_hypotheses=ranking.n,
        unproven=unproven,
        smallest=smallest_visible(ranking, robust_variance(current), current.scene),
        seconds=time.perf_counter() - began,
    )


def _with_advice(final: Adjustment, finding: Finding, place: int, parts: Split) -> Finding:
    """A finding with the further recordings that would tell it from its leading rivals."""
    # Another name for the same course, and what contains it, fits whatever is recorded further.
    own = finding.hypothesis
    others = [r.hypothesis for r in finding.rivals if not r.hypothesis.contains(own)]
    leading = tuple(others[:_ADVISED])
    if not leading:
        return finding
    found = advise(final.scene, parts.sound, place, leading, final.variance_factor)
    return replace(finding, advice=tuple(found))


def _plain_fit(scene: Scene, every: int) -> tuple[Split, Adjustment, int]:
    """The split, the plain model fitted to it, and the number of gross errors set aside."""
    held = hold_out(scene, every)
    parts = split(scene, held, tuple(np.ones(len(rows)) for rows in scene.tables))
    fitted = parts.fit(scene, check=True)
    fitted, parts, n_rejected = without_gross_errors(fitted, parts)
    return parts, fitted, n_rejected


def _p_without(
    foremost, ranking: Ranking, current: Adjustment, arrangement, asked, parts: Split, signs
) -> float:
    """The family-wise p-value of the best hypothesis, under what is left when it is fitted.

    A strong effect in few epochs is in the null distribution, too: under flipped signs something
    always follows it. What noise alone can't give is judged by the noise that is left over.
    """
    z = ranking.best_z()
    if not foremost or z < 2.0 * np.log(ranking.n / ALPHA):
        return ranking.p_value(z)
    without = refit(current, *foremost[0][::2], parts)
    if without is None:
        return ranking.p_value(z)
    left = stacked(without.adjustment)
    variance = robust_variance(without.adjustment)
    own = score_residuals(current.scene, arrangement, asked, variance, signs, residual=left)
    return own.p_value(z)


def _with_heir(
    current: Adjustment, findings: list[Finding], former: list[Finding], parts: Split
) -> list[Finding]:
    """Findings after some were dropped: what those showed, the strongest one shows now."""
    if not findings:
        return findings
    kept = {id(finding) for finding in findings}
    lost = max(finding.z for finding in former if id(finding) not in kept)
    effects, room = current.scene.fitted_effects(), current.scene.room
    first = len(effects) - len(findings)
    costs = [
        parts.fit(current.scene.with_effects((*effects[:k], *effects[k + 1 :]), room)).cost
        for k in range(first, len(effects))
    ]
    heir = int(np.argmax(costs))
    findings = list(findings)
    findings[heir] = replace(findings[heir], z=max(findings[heir].z, lost))
    return findings


def _confirmed(
    findings: list[Finding], current: Adjustment, arrangement, asked, parts: Split, seed: int
) -> list[Finding]:
    """Findings with their p-values under noise that remembers as long as what is left now.

    Noise with a memory looks like a smooth effect, and so does an effect that is not found yet:
    that is why earlier findings are looked at again after each new one.
    """
    scene = current.scene
    # Without a clock neighbours in the list are alike for other reasons (the board's attitude).
    window = memory(scene, parts.residuals(current)) if scene.recording.timed else 1
    if window == 1:
        return [replace(f, p_value=f.p_independent) for f in findings]
    n_epochs = len(scene.recording.time)
    window = min(2 * window, max(int(LONGEST * n_epochs), 2))
    remembering = multipliers(n_epochs, window, FLIPS, seed)
    left = score_residuals(
        scene,
        arrangement,
        asked,
        robust_variance(current),
        remembering,
        residual=stacked(current),
    )
    return [replace(f, p_value=max(left.p_value(f.z), f.p_independent)) for f in findings]


def _only_confirmed(
    current: Adjustment, findings: list[Finding], alpha: float, parts: Split
) -> tuple[Adjustment, list[Finding]]:
    """The model without the findings that noise with a memory explains."""
    given = len(current.scene.effects) - len(findings)
    effects = current.scene.fitted_effects()
    kept = [k for k, finding in enumerate(findings) if finding.p_value <= alpha]
    effects = (*effects[:given], *(effects[given + k] for k in kept))
    current = parts.fit(current.scene.with_effects(effects, current.scene.room))
    return current, [findings[k] for k in kept]


def _room(effects: tuple[Effect, ...]) -> tuple[int, int]:
    """Room for the effects given and those to be found; the same for few of them."""
    columns, constants = capacity(effects)
    return max(ROOM[0], columns + 8), max(ROOM[1], constants + 3)


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
        for other in {max(place - 1, 0), min(place + 1, len(between) - 1)} - {place}:
            effects = list(final.scene.fitted_effects())
            effects[k] = replace(effects[k], constants=(float(between[other]),))
            scene = final.scene.with_effects(tuple(effects), final.scene.room)
            tried = adjust(scene, weights=weights, rtol=1e-8, check=False)
            if tried.cost < final.cost:
                final = tried
    return final


def _with_final_values(final: Adjustment, findings: list[Finding], given: int) -> list[Finding]:
    """Findings with the values of the fit to all epochs."""
    values = zip(final.scene.fitted_effects(), _deviations(final), strict=True)
    pairs = zip(findings, list(values)[given:], strict=True)
    return [replace(f, final_effect=effect, final_stds=stds) for f, (effect, stds) in pairs]


def _deviations(adjustment: Adjustment) -> list[tuple[float, ...]]:
    """Standard deviations of every effect: its amplitudes, then its constants."""
    deviations = standard_deviations(adjustment, robust_variance(adjustment))
    amplitude, constant = np.asarray(deviations.amplitude), np.asarray(deviations.constant)
    return [
        tuple(map(float, (*amplitude[columns], *constant[constants])))
        for columns, constants in adjustment.scene.places()
    ]


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
