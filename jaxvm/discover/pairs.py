"""Two effects in place of what was found first.

A search that takes one effect after the other can begin with a name that has amplitudes enough to
take a part of two, and what comes after is named for the remainder. So the other leading names and
places get their turn: each with the best companion that it finds, against all that was found.
"""

from collections.abc import Iterator

from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.heldout import Split
from jaxvm.discover.hypotheses import FREE, Hypothesis
from jaxvm.discover.ranking import Ranking
from jaxvm.discover.revise import complexity
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import DECIDED, Candidate, Weighing, price, refit, shortlist, spread_of
from jaxvm.physics.forms import JUMPS
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.snooping import robust_variance

WIDE = 4
"""Columns from which a single name is suspected to hold two effects."""

MANY = 4
"""Findings beyond which no pair explains as much."""

_NARROW = 3
_FIRST, _THEN = 4, 2
"""Names that are tried first, and companions of each."""

_HOPEFUL = 0.6
"""Share of the first finding's evidence that another first name must have."""


def worth_a_second_thought(findings: list[Finding]) -> bool:
    """Whether findings may be a pair of others: a few, or one that is wide or has no name.

    Not after a free form (what jumps several times is none), and where there are many no pair will
    do.
    """
    if not 0 < len(findings) <= MANY:
        return False
    first = findings[0]
    if len(first.effect.amplitudes) > FREE and first.effect.form not in JUMPS.values():
        return False
    doubtful = len(first.effect.amplitudes) >= WIDE or not first.hypothesis.entries
    return len(findings) > 1 or doubtful


def other_beginnings(ranking: Ranking, plain: Adjustment, found: Hypothesis, n: int) -> list:
    """The leading narrow hypothesis of each name and place, without what was found.

    Args:
        ranking: of the plain fit.
        plain: that fit.
        found: the first finding.
        n: number of pixel coordinates that are fitted.
    """
    first: dict[tuple, tuple] = {}
    leading = _narrow(ranking, plain, n, 60)
    for item in leading:
        hypothesis = item[0]
        key = hypothesis.scope, hypothesis.entries[0].id
        if not hypothesis.same(found):
            first.setdefault(key, item)
    return [item for item in first.values() if item[1] > _HOPEFUL * leading[0][1]][:_FIRST]


def _narrow(ranking: Ranking, fit: Adjustment, n: int, count: int) -> list:
    """The leading hypotheses that have a name and few columns."""
    few = shortlist(ranking, fit.scene, Weighing.at(fit, ranking, n), count, _NARROW)
    return [item for item in few if item[0].entries]


def better_pair(
    plain: Adjustment,
    current: Adjustment,
    findings: list[Finding],
    others: list,
    tests: ScoreTests,
    parts: Split,
) -> tuple[Candidate, Candidate] | None:
    """A pair of effects with more evidence than all findings together, or None.

    Args:
        plain: the fit without any of them.
        current: the fit with all findings.
        findings: what was found.
        others: what to begin with instead (`other_beginnings`).
        tests: of all hypotheses, at any fit.
        parts: what is fitted.
    """
    best, least = None, DECIDED
    for pair in _pairs(plain, others, tests, parts):
        variance = min(current.variance_factor, pair[1].adjustment.variance_factor)
        drops = [2.0 * (plain.cost - pair[0].adjustment.cost)]
        drops.append(2.0 * (pair[0].adjustment.cost - pair[1].adjustment.cost))
        costs = []
        for c, drop in zip(pair, drops, strict=True):
            spread = spread_of(c.adjustment, -1, c.hypothesis, variance)
            costs.append(price(c.hypothesis, drop / variance, c.amplitudes, parts.n, spread))
        gained = 2.0 * (current.cost - pair[1].adjustment.cost) / variance
        gained += complexity(current, findings, variance, parts.n) - sum(costs)
        if gained > least:
            best, least = pair, gained
    return best


def _pairs(
    plain: Adjustment, others: list, tests: ScoreTests, parts: Split
) -> Iterator[tuple[Candidate, Candidate]]:
    for hypothesis, _, amplitudes in others:
        first = refit(plain, hypothesis, amplitudes, parts)
        if first is None:
            continue
        left = first.adjustment
        ranking = tests.at(left).score(robust_variance(left))
        for own, evidence, values in _narrow(ranking, left, parts.n, 12)[:_THEN]:
            second = refit(left, own, values, parts) if evidence > 0.0 else None
            if second is not None:
                yield first, second
