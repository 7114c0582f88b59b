"""What speaks against the course that a finding was given, though nothing else is claimed."""

from dataclasses import replace

from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.hypotheses import FREE
from jaxvm.discover.ranking import Ranking

DOUBT = 0.1
"""Weight taken from a name where something speaks against it (`doubted`): a cautious choice.

It keeps every such name below the 95 % from which a reader may call it sure.
"""

DOUBTFUL = 0.05
"""Probability of what is left at a finding's own ports from which its course is doubted."""


def doubted(findings: list[Finding], ranking: Ranking, significant: bool) -> list[Finding]:
    """Findings with less weight where something is left: it may be that of which one is a part.

    What is left need not be significant among all hypotheses; at the finding's own ports, or in its
    harmonics, it speaks against the course that was named. So does another finding at the same
    place: one course that has no name is easily taken for two (`_completes`). A free form fits what
    has another name, or none, as well as its own, and what it does not fit quite is a smaller
    finding that has a name.

    Args:
        findings: all of them.
        ranking: scores of all hypotheses with all findings in the model.
        significant: whether anything is left among all hypotheses.
    """
    return [
        _less_sure(own)
        if significant
        or _left_over(own, ranking)
        or any(_completes(f, own) or _mimics(f, own) for f in findings)
        else own
        for own in findings
    ]


def _left_over(finding: Finding, ranking: Ranking) -> bool:
    """Whether more is left at a finding's ports, or in its harmonics, than noise leaves."""
    effect = finding.effect
    left = ranking.left_at({term.port for term in effect.terms}, effect.scope)
    return min(left, ranking.left_in_harmonics(effect)) <= DOUBTFUL


def _completes(other: Finding, finding: Finding) -> bool:
    """Whether another finding at the same place may be the rest of the same course.

    At the same ports, with the same driver, or an amount that every image has for itself.
    """
    if other is finding or other.effect.scope != finding.effect.scope:
        return False
    ports = {term.port for term in finding.effect.terms}
    return (
        any(term.port in ports or term.driver == "epoch" for term in other.effect.terms)
        or other.effect.driver == finding.effect.driver != "constant"
    )


def _mimics(other: Finding, finding: Finding) -> bool:
    """Whether one is a free form that explains as much."""
    return len(other.effect.amplitudes) > FREE and other.drop >= finding.drop


def _less_sure(finding: Finding) -> Finding:
    sure = 1.0 - DOUBT
    others = tuple(replace(r, weight=sure * r.weight) for r in finding.rivals)
    return replace(finding, weight=sure * finding.weight, rivals=others)
