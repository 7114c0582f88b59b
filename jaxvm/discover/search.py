"""The search: score, test, refit, prove, and again, until nothing significant is left."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from jaxvm.discover.accept import Accepted, accept, alternatives, as_good, is_determined, short
from jaxvm.discover.curved import with_curved
from jaxvm.discover.detail import with_detail
from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.doubt import doubted
from jaxvm.discover.finer import at_finer_constants, said, with_slow_beginnings
from jaxvm.discover.heldout import HeldOut, Split, gain
from jaxvm.discover.jumps import with_jumps
from jaxvm.discover.naming import WORSE, Naming
from jaxvm.discover.noise import Correlation, Met, met, random_signs
from jaxvm.discover.pairs import better_pair, other_beginnings, worth_a_second_thought
from jaxvm.discover.ranking import Ranking, spread_of_constant, surprise
from jaxvm.discover.revise import lost_without, prune, with_effects
from jaxvm.discover.rivals import rivals
from jaxvm.discover.scatter import ALIKE, likeness, of_each_image
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import Candidate, Weighing, identity, refit, shortlist, stacked
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.discover.waves import strongest_wave
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import effect_deviations
from jaxvm.solve.snooping import robust_variance

ALPHA = 0.01
"""Family-wise probability to claim something where nothing is hidden."""

_TURNS = 3
"""Findings that in turn only took the place of another, until they are as good as each other."""

FLIPS = 199
"""Repetitions of the null distribution."""


@dataclass
class Search:
    """Where the search stands.

    Attributes:
        parts: what is fitted and what is held out.
        current: the fit with everything found so far.
        heldout: its errors on the held-out epochs.
        given: number of effects that the engineer's model has itself.
        alpha: family-wise probability of a false claim.
        seed: of sign-flips and bootstrap.
        findings: what was found.
        p_value: family-wise p-value of the best hypothesis that is left.
        unproven: the significant one that did not pass on the held-out epochs, in words.
        ranking: the last scores of all hypotheses.
    """

    parts: Split
    current: Adjustment
    heldout: HeldOut
    given: int
    alpha: float = ALPHA
    seed: int = 0
    findings: list[Finding] = field(default_factory=list)
    p_value: float = 1.0
    unproven: str = ""
    ranking: Ranking = field(init=False)
    first: Ranking = field(init=False)
    _weigh: Weighing = field(init=False)
    _tests: ScoreTests = field(init=False)
    _signs: np.ndarray = field(init=False)
    _hopeless: set = field(default_factory=set)
    _superfluous: set = field(default_factory=set)
    _finer: dict[tuple, Ranking] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._signs = random_signs(len(self.parts.held), FLIPS, self.seed)
        families = enumerate_hypotheses(self.current.scene)
        self._tests = ScoreTests.of(self.current, families)

    def run(self, most: int, progress: Callable[[str], None]) -> None:
        """Search until nothing significant is left, at most so many findings are made.

        They have the names under which they were found until the search is settled.
        """
        plain, heldout = self.current, self.heldout
        first = self.first = self._search(most, progress)
        # What noise with a memory explains needs no other pair.
        confirmed = any(finding.p_value <= self.alpha for finding in self.findings)
        if confirmed and worth_a_second_thought(self.findings):
            progress("trying pairs of other effects")
            others = other_beginnings(first, plain, self.findings[0].hypothesis, self.parts.n)
            pair = better_pair(plain, self.current, self.findings, others, self._tests, self.parts)
            if pair is not None and self._may_replace(pair[1]):
                self.current, self.heldout, self.findings = plain, heldout, []
                self._hopeless, self._superfluous = set(), set()
                self._take_pair(pair, progress)
                self._search(most, progress)

    def _search(self, most: int, progress: Callable[[str], None]) -> Ranking:
        """Take one effect after the other; returns the first scores."""
        first, turns = None, 0
        for _ in range(3 * most + 1):
            progress(f"scoring hypotheses (round {len(self.findings) + 1})")
            leading = [
                item
                for item in self._score()
                if not any(item[0].covered(f.hypothesis) for f in self.findings)
            ]
            first = first or self.ranking
            if len(self.findings) == most or turns == _TURNS:
                break
            leading, self._finer = at_finer_constants(
                leading, self._tests, self.ranking, self._weigh
            )
            leading = with_slow_beginnings(leading, self.ranking, self.current.scene)
            known = [finding.hypothesis for finding in self.findings]
            leading = with_curved(leading, self.ranking, self.current.scene, known)
            if self.p_value <= self.alpha:
                leading = with_jumps(leading, self._tests, self.ranking, self._weigh)
            accepted = self._accepted(leading, progress)
            scored = self.p_value
            # What no course explains may be a wave, or differ from image to image.
            for others in (self._waves, self._images):
                if accepted is None:
                    leading, self.p_value = others()
                    accepted = self._accepted(leading, progress)
                    scored = min(scored, self.p_value)
            if accepted is None:
                self.p_value = scored
                break
            self.unproven = ""
            effect, before = accepted.chosen.effect, len(self.findings)
            self._take(accepted, leading)
            progress(f"found: {effect.name} ({effect.scope.words()})")
            turns = turns + 1 if len(self.findings) <= before else 0
            if len(self.findings) > 1 and min(f.p_value for f in self.findings[-2:]) > self.alpha:
                break
        return first or self.ranking

    def _score(self):
        """Score all hypotheses; the leading ones."""
        current = self.current
        variance = robust_variance(current)
        self._tests = self._tests.at(current)
        self.ranking = self._tests.score(variance, self._signs)
        self._weigh = Weighing.at(current, self.ranking, self.parts.n)
        foremost = shortlist(self.ranking, current.scene, self._weigh, 12)
        self.p_value = self.ranking.p_value(self.ranking.best_z())
        if self.p_value > self.alpha and foremost:
            self.p_value = self._p_without(*foremost[0][::2])
        return foremost

    def _accepted(self, leading, progress: Callable[[str], None]) -> Accepted | None:
        """The hypothesis that is significant and that the held-out epochs prove."""
        if self.p_value > self.alpha:
            return None
        if not leading:
            self.unproven = self.unproven or "what an unnamed effect left over"
            return None
        number = self.ranking.n
        progress(f"{number} hypotheses, p = {self.p_value:.3g}: refitting the leading ones")
        found = accept(
            self.current,
            leading,
            self.parts,
            self.heldout,
            self.seed,
            self._hopeless,
            # Under random signs with all that is there, not only under what is left.
            ask_odds=self.ranking.p_value(self.ranking.best_z()) <= self.alpha,
        )
        if isinstance(found, str):
            self.unproven = self.unproven or found
            return None
        return found

    def _waves(self):
        """The strongest wave over an image, and its p-value; it is not among what is scored."""
        current = self.current
        wave, p, drop = strongest_wave(current.scene, self.parts.residuals(current), self.seed)
        evidence = drop / robust_variance(current)
        return self._hopeful([(wave, evidence, np.zeros(wave.n_columns))], p)

    def _images(self):
        """What every image has for itself, and its p-value; it is not among what is scored."""
        current = self.current
        alike = likeness(current.scene, self.parts.residuals(current))
        # Where neighbours are only a little alike, it may be noise that they share.
        if 0.0 < alike <= ALIKE:
            return [], 1.0
        variance = robust_variance(current)
        return self._hopeful(
            *of_each_image(current.scene, self._tests, variance, self.parts.n, self._left_by)
        )

    def _hopeful(self, leading, p: float):
        """What has not failed yet, and the p-value of the first."""
        hopeful = [
            item for item in leading if (identity(item[0]), item[0].course) not in self._hopeless
        ]
        return hopeful, p if hopeful else 1.0

    def _p_without(self, hypothesis, amplitudes) -> float:
        """The family-wise p-value of the best hypothesis, under what is left when it is fitted.

        A strong effect in few epochs is in the null distribution, too: under flipped signs
        something always follows it. What noise alone can't give is judged by the noise that is
        left over.
        """
        z = self.ranking.best_z()
        if not self.ranking.is_beyond_gaussian(z, self.alpha):
            return self.p_value
        without = refit(self.current, hypothesis, amplitudes, self.parts)
        if without is None:
            return self.p_value
        variance = robust_variance(without.adjustment)
        return self._tests.score(variance, self._signs, stacked(without.adjustment)).p_value(z)

    def _left_by(self, hypothesis, amplitudes) -> np.ndarray | None:
        """Whitened residuals that a hypothesis leaves; None where it can't be fitted."""
        fitted = refit(self.current, hypothesis, amplitudes, self.parts)
        return None if fitted is None else stacked(fitted.adjustment)

    def _take(self, accepted: Accepted, leading) -> None:
        """Take an accepted hypothesis into the model, and look at the earlier findings again."""
        parts = self.parts
        finding = self._finding(accepted, leading)
        former = [*self.findings, finding]
        self.heldout = accepted.heldout
        current = replace(accepted.chosen.adjustment, scene=accepted.heldout.scene)
        self.current, self.findings = prune(current, former, parts.n, parts.fit)
        if len(self.findings) < len(former):
            # What later findings made superfluous does not come back.
            kept = [finding.hypothesis for finding in self.findings]
            gone = [f.hypothesis for f in former if f.hypothesis not in kept]
            self._superfluous |= {(identity(h), h.course) for h in gone}
            self.current, self.heldout = parts.proven(self.current)
            self.findings = self._with_heir(former)
        # What did not help before may help beside the new one.
        self._hopeless = set(self._superfluous)
        self.findings = self._confirmed()

    def _may_replace(self, candidate: Candidate) -> bool:
        """Whether a fit is as good on the held-out epochs as what was found, and determined."""
        shown = self.parts.evaluate(candidate.adjustment.scene)
        as_good = shown.rms_px <= WORSE * self.heldout.rms_px
        return as_good and is_determined(candidate, shown)

    def _take_pair(self, pair, progress: Callable[[str], None]) -> None:
        """Take hypotheses that were fitted already, as if each had led, while they are significant.

        What led beside them took parts of both, and is no rival.
        """
        for candidate in pair:
            self._score()
            if self.p_value > self.alpha:
                return
            shown = self.parts.evaluate(candidate.adjustment.scene)
            proof = gain(self.heldout, shown, self.seed)
            leading = [(candidate.hypothesis, candidate.evidence, candidate.amplitudes)]
            self._take(Accepted(candidate, (), shown, proof, (candidate,)), leading)
            progress(f"found: {candidate.effect.name} ({candidate.effect.scope.words()})")
        # The first was fitted without the second.
        deviations = effect_deviations(self.current)[self.given :]
        self.findings = [
            # An instant that no fit refines keeps the spread of those that did nearly as well.
            replace(f, stds=tuple(new or old for new, old in zip(own, f.stds, strict=True)))
            for f, own in zip(with_effects(self.findings, self.current), deviations, strict=True)
        ]

    def _finding(self, accepted: Accepted, leading) -> Finding:
        chosen, parts, current = accepted.chosen, self.parts, self.current
        chief, doubles = rivals(
            current,
            chosen.adjustment,
            chosen.hypothesis,
            chosen.effect,
            self._tests,
            parts.n,
            as_good(accepted, leading),
        )
        return Finding(
            hypothesis=chosen.hypothesis,
            effect=chosen.effect,
            stds=self._deviations(chosen),
            final_effect=chosen.effect,
            final_stds=(),
            weight=chief.weight,
            others=chief.others,
            rivals=tuple(doubles),
            p_value=self.p_value,
            p_independent=self.p_value,
            n_hypotheses=self.ranking.n,
            drop=2.0 * (current.cost - chosen.adjustment.cost),
            share=0.0,
            before=parts.residuals(current),
            after=parts.residuals(chosen.adjustment),
            gain=accepted.gain,
            ranking=tuple((short(h), e) for h, e, _ in leading),
            doubles=tuple(candidate.hypothesis for candidate in accepted.near),
            alternatives=alternatives(accepted, leading),
            chosen=next(k for k, (h, *_) in enumerate(leading) if h.same(chosen.hypothesis)),
        )

    def _deviations(self, chosen: Candidate) -> tuple[float, ...]:
        """Standard deviations of amplitudes and constants; of an instant by its posterior."""
        stds = effect_deviations(chosen.adjustment)[-1]
        form = FORMS[chosen.hypothesis.course.form]
        if not form.constants or form.constants[0].refined:
            return stds
        ranking = self._finer.get(said(chosen.hypothesis), self.ranking)
        spread = spread_of_constant(ranking, chosen.hypothesis, self.current.scene)
        return (*stds[: chosen.effect.n_columns], spread, *stds[chosen.effect.n_columns + 1 :])

    def _with_heir(self, former: list[Finding]) -> list[Finding]:
        """Findings after some were dropped: what those showed, the strongest one shows now."""
        findings = list(self.findings)
        if not findings:
            return findings
        lost = lost_without(self.current, findings)
        heir = int(np.argmax(lost))
        findings[heir] = replace(findings[heir], drop=max(findings[heir].drop, lost[heir]))
        return findings

    def _confirmed(self) -> list[Finding]:
        """Findings with their p-values under noise that is as correlated as what is left now.

        Noise with a memory looks like a smooth effect, and so does an effect that is not found yet:
        that is why earlier findings are looked at again after each new one.
        """
        noise = Correlation.of(self.current, self.parts.residuals(self.current))
        own = met(self.current, noise)[self.given :]
        found = [replace(f, noise=m.inflation) for f, m in zip(self.findings, own, strict=True)]
        if noise.white:
            return [replace(f, p_value=f.p_independent) for f in found]
        variance = robust_variance(self.current)
        left = self._tests.score(variance, self._signs, stacked(self.current))

        def again(finding: Finding, met: Met) -> Finding:
            z = float(surprise(np.array(finding.drop / variance / met.inflation), met.freedom))
            p = left.p_value(z)
            if left.is_beyond_gaussian(z, self.alpha):
                # What gives as much has another cause, which is still to be found: it speaks
                # against the finding only as far as it may be taken for it.
                p = min(p, left.p_at(z, finding.hypothesis.group))
            return replace(finding, p_value=max(p, finding.p_independent))

        return [again(finding, met) for finding, met in zip(found, own, strict=True)]

    def set_aside(self, parts: Split) -> None:
        """Go on without some more observations, with everything that was found, as it was found."""
        self.parts = parts
        self.current, self.heldout = parts.proven(parts.fit(self.current.scene))
        self._score()
        self.findings = self._confirmed()

    def settle(self) -> None:
        """Drop what noise with a memory explains, and give the findings their last names."""
        parts = self.parts
        # What a finding that goes had taken of the noise counts for the others again.
        while unconfirmed := [f.p_value for f in self.findings if f.p_value > self.alpha]:
            # What is left and failed on the held-out epochs is as significant as before.
            left = [self.p_value] if self.unproven else []
            self.p_value = min([*unconfirmed, *left])
            self._drop_unconfirmed()
            self.current, self.heldout = parts.proven(self.current)
            self.findings = self._confirmed()
        names = [finding.hypothesis for finding in self.findings]
        naming = Naming(self._tests, parts, self.heldout)
        replaced = bool(self._superfluous)
        self.current, self.findings = naming.last(self.current, self.findings, replaced)
        if [finding.hypothesis for finding in self.findings] != names:
            self.current, self.heldout = parts.proven(self.current)
            deviations = effect_deviations(self.current)[self.given :]
            pairs = zip(self.findings, deviations, strict=True)
            self.findings = [replace(f, stds=f.stds or own) for f, own in pairs]
        before = self.current
        self.current, self.heldout, self.findings = with_detail(
            self.current, self.heldout, self.findings, parts, self.seed
        )
        if self.current is not before:
            self._score()
            self.unproven = self.unproven if self.p_value <= self.alpha else ""
        significant = self.p_value <= self.alpha
        self.findings = doubted(self.findings, self.ranking, significant)

    def _drop_unconfirmed(self) -> None:
        effects = self.current.scene.fitted_effects()
        kept = [k for k, finding in enumerate(self.findings) if finding.p_value <= self.alpha]
        effects = (*effects[: self.given], *(effects[self.given + k] for k in kept))
        scene = self.current.scene
        self.current = self.parts.fit(scene.with_effects(effects, scene.room))
        self.findings = [self.findings[k] for k in kept]
