"""The last names of findings, when all of them are in the model.

While others were missing, a finding was named for what it and they have in common. Now each is
tried under other names beside all the others, is weighed against its rivals again, and is led by
the likeliest of them, where held-out epochs don't speak against it.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.heldout import HeldOut, Split
from jaxvm.discover.hypotheses import FREE
from jaxvm.discover.revise import given_effects, hidden, likelier, rename
from jaxvm.discover.rivals import claim_of, rivals
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import Weighing, shortlist
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.snooping import robust_variance

WORSE = 1.01
"""Rise of the held-out RMS that other names may bring: what differs less is noise."""

_WIDER = 1.2
"""Inflation by noise from which the rivals of a finding are weighed again: more of them stay."""

_LEADING, _NAMES = 60, 3
"""Leading hypotheses among which names are looked for, and names tried for each finding."""

_BEHIND, _TIE = 10.0, 0.01
"""Foretold evidence by which another name may fall behind and still be tried, and the share of a
large one: fits are curved."""

Named = tuple[Adjustment, list[Finding]]
"""A fit and the findings that are the last of its effects."""


@dataclass(frozen=True)
class Naming:
    """What names are judged by.

    Attributes:
        tests: of all hypotheses, at any fit.
        parts: what is fitted and what is held out.
        heldout: errors that other names may not raise.
    """

    tests: ScoreTests
    parts: Split
    heldout: HeldOut
    _left: dict[int, tuple[Adjustment, Adjustment, ScoreTests]] = field(default_factory=dict)
    """By the place of a finding the last fit with it, that without it, and the tests of that: where
    no name changed, rivals are weighed by what names were looked for with."""

    def last(self, current: Adjustment, findings: list[Finding], replaced: bool = False) -> Named:
        """The fit and its findings with their last names, weights and rivals.

        A finding whose name has changed has no standard deviations (`Finding.stds`) yet. One that
        `replaced` another was named and weighed beside that one.
        """
        named = current, findings
        if len(findings) > 1 or (findings and replaced):
            named = current, [self.with_names_to_try(*named, k) for k in range(len(findings))]
            named = self._renamed(*named)
            named = self._weighed(*named, [True] * len(named[1]))
            if any(r.weight > f.weight for f in named[1] for r in f.rivals):
                named = self._renamed(*named)
                named = self._weighed(*named, [not f.rivals and not f.stds for f in named[1]])
        elif any(finding.noise > _WIDER for finding in findings):
            named = self._weighed(*named, [True])
        # Doubles that are likelier than what fits best lead.
        for k in range(len(named[1])):
            named = self._unless_worse(named, likelier(*named, k, self.parts.fit))
        return named

    def with_names_to_try(self, current: Adjustment, findings: list[Finding], k: int) -> Finding:
        """A finding with the names that lead in its place beside the others.

        While others were missing, what takes a part of both may have led, or a stranger's sensor
        and a play of its own. Rivals are known by what the finding explains; here counts what the
        data have in its place. For what has no name, names are looked for at its own place.
        """
        finding = findings[k]
        if hidden(current, findings, k):
            return finding
        without, tests = self._without(current, findings, k)
        ranking = tests.score(robust_variance(without))
        weigh = Weighing.at(without, ranking, self.parts.n)
        leading = shortlist(ranking, current.scene, weigh, _LEADING, FREE)
        own = finding.hypothesis
        least = next((e - max(_BEHIND, _TIE * e) for h, e, _ in leading if h.same(own)), -np.inf)
        if own.entries:
            first = {claim_of(own): own}
            for hypothesis, evidence, _ in leading:
                if hypothesis.entries and evidence > least:
                    first.setdefault(claim_of(hypothesis), hypothesis)
            _, *named = first.values()
        else:
            named = [h for h, *_ in leading if h.entries and h.scope == own.scope]
        return replace(finding, alternatives=(*named[:_NAMES], *finding.alternatives))

    def _renamed(self, current: Adjustment, findings: list[Finding]) -> Named:
        """Better names beside all the others."""
        other = rename(current, findings, self.parts.n, self.parts.fit)
        return self._unless_worse((current, findings), other)

    def _unless_worse(self, named: Named, other: Named) -> Named:
        """Other names, where held-out epochs don't speak against them."""
        if other[1] is named[1]:
            return named
        shown = self.parts.evaluate(other[0].scene)
        return other if shown.rms_px <= WORSE * self.heldout.rms_px else named

    def _weighed(self, current: Adjustment, findings: list[Finding], which: list[bool]) -> Named:
        """Findings of which some are weighed among their rivals once more."""
        chosen = zip(findings, which, strict=True)
        return current, [
            self._weighed_again(current, findings, k) if own else finding
            for k, (finding, own) in enumerate(chosen)
        ]

    def _weighed_again(self, current: Adjustment, findings: list[Finding], k: int) -> Finding:
        """A finding among its rivals with all the others in the model, and with those it had.

        Beside amounts of every image that can follow it all names are alike: it keeps those it had.
        """
        finding = findings[k]
        if hidden(current, findings, k):
            return finding
        without, tests = self._without(current, findings, k)
        chief, doubles = rivals(
            without,
            current,
            finding.hypothesis,
            current.scene.fitted_effects()[given_effects(current, findings) + k],
            tests,
            self.parts.n,
            noise=finding.noise,
            remembered=finding.rivals,
        )
        return replace(finding, weight=chief.weight, others=chief.others, rivals=tuple(doubles))

    def _without(
        self, current: Adjustment, findings: list[Finding], k: int
    ) -> tuple[Adjustment, ScoreTests]:
        """The fit with all findings but one, and its tests."""
        place = given_effects(current, findings) + k
        known = self._left.get(place)
        if known is None or known[0] is not current:
            effects = current.scene.fitted_effects()
            others = (*effects[:place], *effects[place + 1 :])
            without = self.parts.fit(current.scene.with_effects(others, current.scene.room))
            known = self._left[place] = current, without, self.tests.at(without)
        return known[1:]
