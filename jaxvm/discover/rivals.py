"""Rivals: hypotheses that the recording can't tell from the chosen one at 20:1."""

from dataclasses import dataclass, replace

import numpy as np

from jaxvm.discover.accept import Accepted
from jaxvm.discover.cells import Arrangement
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.score import Battery, score_residuals, top
from jaxvm.discover.select import DECIDED, identity, log_prior, stacked
from jaxvm.solve.adjust import Adjustment


@dataclass(frozen=True)
class Rival:
    """A hypothesis that the recording can't tell from the chosen one."""

    hypothesis: Hypothesis
    gap: float
    weight: float


def rivals(
    before: Adjustment,
    arrangement: Arrangement,
    battery: Battery,
    accepted: Accepted,
    leading,
    n: int,
    signs: np.ndarray,
) -> tuple[float, list[Rival]]:
    """Hypotheses that the recording can't tell from the chosen one at 20:1.

    With e the chosen effect as it stands in the residuals and lambda = |e|^2 its drop of
    chi-square, a hypothesis that explains the share rho^2 of e is worse by lambda (1 - rho^2): what
    the recording can be expected to show. What it did show counts, too: of refitted ones (`near`),
    and of `leading` ones that were not worth a refit, as one tangent foretells it.
    Other names for the chosen combination are always rivals.

    Returns:
        The posterior weight of the chosen one, and its rivals with theirs.
    """
    scene, chosen, near = before.scene, accepted.chosen, accepted.near
    variance = chosen.adjustment.variance_factor
    change = stacked(before) - stacked(chosen.adjustment)
    full = float(np.sum(change**2)) / variance
    still = np.zeros_like(signs)
    alike = score_residuals(scene, arrangement, battery, variance, still, residual=change)
    own_identity = identity(chosen.hypothesis)
    penalty = len(chosen.effect.amplitudes) + len(chosen.effect.constants)
    own_prior = log_prior(chosen.hypothesis, np.asarray(chosen.effect.amplitudes))
    found: dict[tuple, Rival] = {}

    def weigh(hypothesis: Hypothesis, amplitudes: np.ndarray, gap: float, fit: float) -> None:
        for named in _one_by_one(hypothesis):
            key = identity(named)
            log_odds = fit + log_prior(named, np.asarray(amplitudes)) - own_prior
            if key != own_identity and (key not in found or log_odds > found[key].weight):
                found[key] = Rival(named, gap, float(log_odds))

    for hypothesis, drop, amplitudes in top(alike, scene, 400):
        gap = max(full - drop / variance, 0.0)
        if gap <= DECIDED:
            cost = len(amplitudes) + len(hypothesis.course.constants) - penalty
            weigh(hypothesis, amplitudes, float(gap), -0.5 * (gap + cost * np.log(n)))
    for other in near:
        behind = chosen.evidence - other.evidence
        if behind <= DECIDED and not any(
            r.hypothesis.same(other.hypothesis) for r in found.values()
        ):
            amplitudes = np.asarray(other.effect.amplitudes)
            gap = 2.0 * (other.adjustment.cost - chosen.adjustment.cost) / variance
            prior = log_prior(other.hypothesis, amplitudes) - own_prior
            weigh(other.hypothesis, amplitudes, max(float(gap), 0.0), -0.5 * behind - prior)
    refitted = [candidate.hypothesis for candidate in accepted.tried]
    foretold = [own for h, own, _ in leading if h.same(chosen.hypothesis)]
    for hypothesis, own, amplitudes in leading if foretold else ():
        behind = max(foretold[0] - own, 0.0)
        named = bool(hypothesis.entries)
        if named and behind <= DECIDED and not any(r.same(hypothesis) for r in refitted):
            prior = log_prior(hypothesis, np.asarray(amplitudes)) - own_prior
            weigh(hypothesis, amplitudes, behind, -0.5 * behind - prior)
    weigh(chosen.hypothesis, np.asarray(chosen.effect.amplitudes), 0.0, 0.0)
    odds = np.array([0.0, *(r.weight for r in found.values())])
    weights = np.exp(odds - np.logaddexp.reduce(odds))
    pairs = zip(found.values(), weights[1:], strict=True)
    kept = [replace(r, weight=float(w)) for r, w in pairs if w >= 0.01]
    return float(weights[0]), sorted(kept, key=lambda r: -r.weight)


def _one_by_one(hypothesis: Hypothesis) -> list[Hypothesis]:
    """A hypothesis under each of its names alone; itself where it has none."""
    named = [replace(hypothesis, entries=(entry,)) for entry in hypothesis.entries]
    return named or [hypothesis]
