"""From mismatch to physics: the whole road, from a recording to named and proven findings.

Compare, score, test, model, weigh the doubles, prove on held-out epochs, and go on until nothing
significant is left. No finding is claimed that does not pass on epochs which were never fitted.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jaxvm.compiling import forget_compiled_if_many
from jaxvm.discover.advice import advise, under_its_name
from jaxvm.discover.averaged import with_forms
from jaxvm.discover.collocation import collocate
from jaxvm.discover.constants import run_away
from jaxvm.discover.diagnosis import Diagnosis, Finding, Quality
from jaxvm.discover.first_states import with_first_states
from jaxvm.discover.gross import without_gross_errors
from jaxvm.discover.heldout import (
    HeldOut,
    Split,
    fitted_residuals,
    hold_out,
    split,
)
from jaxvm.discover.inputs import variances_by_inputs
from jaxvm.discover.instants import at_best_instants, with_spread
from jaxvm.discover.locate import ResidualTable, locate, residual_table
from jaxvm.discover.noise import Correlation, levels, met
from jaxvm.discover.scatter import ALIKE, likeness
from jaxvm.discover.scopes import sharing
from jaxvm.discover.search import ALPHA, Search
from jaxvm.discover.visible import absorbed, smallest_visible
from jaxvm.network.scene import Scene, build
from jaxvm.network.start import start
from jaxvm.physics.effects import Effect, capacity
from jaxvm.physics.forms import FORMS
from jaxvm.recording import Recording
from jaxvm.solve.adjust import Adjustment, adjust, reference_sigma
from jaxvm.solve.covariance import effect_deviations
from jaxvm.solve.snooping import robust_variance

_BEGINNINGS = 2
"""Times that the search begins, without the gross errors that showed at the end of the last."""

ROOM = (16, 8)
"""Columns and constants kept free for effects to be found."""


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
    found, plain, plain_heldout, n_rejected = _searched(
        scene, every, alpha, seed, max_findings, progress
    )
    if not found.findings:
        second = _second_look(found, plain, alpha, seed, max_findings, progress)
        found, plain, plain_heldout = second or (found, plain, plain_heldout)
    parts = found.parts
    current, findings = found.current, found.findings

    progress("final fit to all epochs")
    everything = parts.undivided(scene)
    final = everything.fit(current.scene)
    final, instants = at_best_instants(final, findings, len(effects), parts.sound)
    final = _with_first_states(final, parts.sound)
    signal = collocate(current, found.heldout, parts, seed)
    heldout = found.heldout if signal is None else signal.heldout
    # Share of chi-square that is left when the signal is foretold.
    kept = 1.0 if signal is None else 1.0 - 0.5 * signal.drop / current.cost
    excess = 2.0 * plain.cost - kept * current.variance_factor * plain.degrees_of_freedom
    findings = [replace(f, share=float(f.drop / max(excess, 1e-9))) for f in findings]
    findings = _with_final_values(final, findings, len(effects), parts.sound)
    findings = [with_spread(f, own) for f, own in zip(findings, instants, strict=True)]
    findings = [with_forms(final, f, len(effects) + k, parts.sound) for k, f in enumerate(findings)]
    findings = [
        replace(f, sharing=sharing(current, len(effects) + k, parts, f.noise))
        for k, f in enumerate(findings)
    ]
    if any(finding.rivals for finding in findings):
        progress("weighing further recordings")
    findings = [_with_advice(final, f, len(effects) + k, parts) for k, f in enumerate(findings)]
    before = _table(plain, plain_heldout, scene, parts.sound)
    after = _table(final, None, scene, parts.sound)
    noise = np.sqrt(kept * robust_variance(final)) * reference_sigma(scene)
    alike = likeness(current.scene, parts.residuals(current))
    significant = found.p_value <= alpha or (alike > ALIKE and signal is None)
    return Diagnosis(
        recording=recording,
        verdict=_verdict(len(findings) + (signal is not None), significant),
        noise_px=float(noise),
        plain=_quality(plain, plain_heldout),
        final=_quality(current, heldout, kept),
        findings=tuple(findings),
        significant_left=significant,
        left_p_value=found.p_value,
        located_before=tuple(locate(scene, before)[:8]),
        located_left=tuple(locate(final.scene, after)[:8]),
        before=before,
        after=after,
        held=parts.judged,
        second_look=bool(parts.judged.any() and not parts.held.any()),
        heldout_before=plain_heldout,
        heldout_after=heldout,
        scene=final.scene,
        signal=signal,
        signal_share=0.0 if signal is None else float(signal.drop / max(excess, 1e-9)),
        likeness=alike,
        n_rejected=n_rejected,
        n_hypotheses=found.ranking.n,
        unproven=found.unproven,
        smallest=smallest_visible(found.ranking, robust_variance(current), current.scene),
        absorbed=absorbed(found.first, scene),
        seconds=time.perf_counter() - began,
    )


def _with_advice(final: Adjustment, finding: Finding, place: int, parts: Split) -> Finding:
    """A finding with the further recordings that would tell it from its rivals."""
    # Another name for the same course, and what contains it, fits whatever is recorded further;
    # and what may have this name, too, says nothing against it.
    own = {entry.id for entry in finding.hypothesis.entries[:1]}
    others = [
        r
        for r in finding.rivals
        if not r.hypothesis.contains(finding.hypothesis)
        and not (own & {*r.names} and not own & {e.id for e in r.hypothesis.entries})
    ]
    found = advise(
        final.scene,
        parts.sound,
        place,
        others,
        final.variance_factor * finding.noise,
        log_odds=[
            2.0 * float(np.log(max(finding.weight, 1e-9) / rival.weight)) for rival in others
        ],
        others=under_its_name(finding.hypothesis, finding.others),
        among=min(finding.weight + sum(rival.weight for rival in finding.rivals), 1.0),
    )
    return replace(finding, advice=tuple(found))


def _searched(
    scene: Scene,
    every: int,
    alpha: float,
    seed: int,
    most: int,
    progress: Callable[[str], None],
) -> tuple[Search, Adjustment, HeldOut, int]:
    """A search that is through, the plain fit and its held-out errors, and the gross errors.

    What is found may have concealed gross errors, which end a search once they show: signs that
    flip leave them as large as they are. It begins again without them, and what it found before
    needs no last names. The few that show only beside what it then finds are set aside where it
    stands.
    """
    parts, plain, n_rejected = _plain_fit(scene, every)
    begun = 0
    while True:
        plain, heldout = parts.proven(plain)
        found, begun = Search(parts, plain, heldout, len(scene.effects), alpha, seed), begun + 1
        is_last = begun == _BEGINNINGS
        found.run(most, progress)
        cleaner, n = _laid_bare(found)
        if n and is_last:
            found.set_aside(cleaner)
            plain, heldout = cleaner.proven(cleaner.fit(scene))
            n_rejected, n = n, 0
        if not n:
            found.settle()
            cleaner, n = (found.parts, 0) if is_last else _laid_bare(found)
            if not n:
                return found, plain, heldout, n_rejected
        progress(f"{n} gross errors show beside what was found: beginning again without them")
        parts, n_rejected, plain = cleaner, n, cleaner.fit(scene)


def _second_look(
    found: Search,
    plain: Adjustment,
    alpha: float,
    seed: int,
    most: int,
    progress: Callable[[str], None],
) -> tuple[Search, Adjustment, HeldOut] | None:
    """The search once more, with all epochs; the plain fit to them and its errors.

    Two thirds of the epochs may not show what all of them do. What is chosen by all of them has
    each third foretold from the other two, and must be twice as rare under noise. None where
    nothing is found, or there are too few epochs.
    """
    parts = found.parts.undivided(plain.scene)
    if not parts.judged.any():
        return None
    progress("a second look, at all epochs")
    plain = parts.fit(plain.scene)
    heldout = parts.evaluate(plain.scene)
    second = Search(parts, plain, heldout, found.given, 0.5 * alpha, seed)
    second.run(most, progress)
    if second.findings:
        second.settle()
    return (second, plain, heldout) if second.findings else None


def _laid_bare(found: Search) -> tuple[Split, int]:
    """The split without the gross errors that show beside what was found, and their number.

    0 where they are those that are set aside already.
    """
    if not found.findings:
        return found.parts, 0
    _, cleaner, n = without_gross_errors(found.current, found.parts)
    known = all(map(np.array_equal, cleaner.sound, found.parts.sound))
    return (found.parts, 0) if known else (cleaner, n)


def _plain_fit(scene: Scene, every: int) -> tuple[Split, Adjustment, int]:
    """The split, the plain model fitted to it, and the number of gross errors set aside."""
    held = hold_out(scene, every)
    parts = split(scene, held, tuple(np.ones(len(rows)) for rows in scene.tables))
    fitted = parts.fit(scene, check=True)
    fitted, parts, n_rejected = without_gross_errors(fitted, parts)
    return parts, fitted, n_rejected


def _room(effects: tuple[Effect, ...]) -> tuple[int, int]:
    """Room for the effects given and those to be found; the same for few of them."""
    columns, constants = capacity(effects)
    return max(ROOM[0], columns + 8), max(ROOM[1], constants + 3)


def _with_first_states(final: Adjustment, weights) -> Adjustment:
    """The final fit with lags that need not have started in equilibrium."""
    scene = with_first_states(final.scene)
    if scene is final.scene:
        return final
    tried = adjust(scene, weights=weights, rtol=1e-8, check=False)
    return final if tried.failed or run_away(scene, tried.scene) else tried


def _with_final_values(
    final: Adjustment, findings: list[Finding], given: int, sound: tuple[np.ndarray, ...]
) -> list[Finding]:
    """Findings with the values of the fit to all epochs.

    Noise that is correlated widens them, and so do errors of the log; where a camera is noisier
    than others, what it shows is known less well. An instant that no fit refines keeps the spread
    of those that did nearly as well.
    """
    left = fitted_residuals(final, sound)
    noise = Correlation.of(final, left)
    values = zip(
        final.scene.fitted_effects(),
        effect_deviations(final),
        met(final, noise, levels(final, left)),
        variances_by_inputs(final),
        strict=True,
    )
    return [
        replace(
            f,
            final_effect=effect,
            final_stds=_spreads(f, effect, np.array(stds), noise.ratio, by_inputs),
            noise=noise.inflation,
        )
        # After the findings come first states.
        for f, (effect, stds, noise, by_inputs) in zip(findings, list(values)[given:], strict=False)
    ]


def _spreads(f: Finding, effect: Effect, stds, ratio, by_inputs) -> tuple[float, ...]:
    """Standard deviations of a finding's final amplitudes and constants.

    What the final fit held has those of the search. Where it held a constant that a fit may refine
    (it ran away: what settles so slowly is a ramp), amplitudes are no better known than in the
    search, beside that constant.
    """
    found = np.sqrt(ratio * np.square(stds) + by_inputs)
    former = np.array(f.stds or stds)
    constants = FORMS[effect.form].constants
    lost = stds[effect.n_columns :][[constant.refined for constant in constants]] == 0.0
    if lost.any():
        found = np.maximum(found, former)
    return tuple(np.where(stds > 0.0, found, former).tolist())


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


def _quality(fitted: Adjustment, heldout: HeldOut, kept: float = 1.0) -> Quality:
    square = sum(float(np.sum(np.asarray(b) ** 2)) for b in fitted.residuals().pixels)
    count = sum(2.0 * float(np.sum(np.asarray(f.weight) > 0))
                for f in fitted.problem.network.pixels)  # fmt: skip
    rms = np.sqrt(kept * square / count) * reference_sigma(fitted.scene)
    return Quality(float(rms), heldout.rms_px, kept * fitted.variance_factor)


def _verdict(n: int, significant: bool) -> str:
    if not n:
        return "unexplained" if significant else "consistent"
    return "partly explained" if significant else "explained"
