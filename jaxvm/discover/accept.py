"""Accept a hypothesis: refit the leading ones; the best that improves held-out epochs wins."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from jaxvm.discover.heldout import Gain, HeldOut, Split, gain
from jaxvm.discover.hypotheses import FREE, Hypothesis
from jaxvm.discover.select import Candidate, identity, refit
from jaxvm.physics.catalogue.entry import EACH
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import effect_deviations

_CANDIDATES = 4
_NEAR = 30.0

STRONG = 20.0
"""Evidence from which the held-out epochs are asked for their odds where their errors don't tell.

The held-out third alone shows a weak effect badly, and worst where its forecast is vague.
"""

_FREE_LEAST, _FREE_LEAST_OF_EPOCHS = 20.0, 30.0
"""Evidence that a free form must promise before it is fitted: with less it follows noise.

One with an amount for every epoch follows whatever comes and goes, in held-out epochs, too.
"""

_TRIED_AGAIN, _HOPEFUL = 6, 0.75
"""Leading hypotheses that are tried again in place of a finding; their share of its evidence."""

_TIE = 0.05
_OPEN = 100.0, 0.02


@dataclass(frozen=True)
class Accepted:
    """A candidate that passed on the held-out epochs.

    Attributes:
        chosen: the candidate, refitted.
        near: others that were refitted and fell behind only a little, best first.
        heldout: its errors on the held-out epochs.
        gain: what it improves there.
        tried: everything that was refitted.
    """

    chosen: Candidate
    near: tuple[Candidate, ...]
    heldout: HeldOut
    gain: Gain
    tried: tuple[Candidate, ...]


def accept(
    current: Adjustment,
    leading,
    split: Split,
    heldout: HeldOut,
    seed: int,
    hopeless: set,
    ask_odds: bool = False,
) -> Accepted | str:
    """The best candidate that improves the held-out epochs, or the name of the one that failed.

    Args:
        current: the fit so far.
        leading: hypotheses with the evidence foretold and one-step amplitudes, best first.
        split, heldout: what is fitted, and the errors of the fit so far on what is not.
        seed: of the bootstrap.
        hopeless: collects what can't be fitted or does not help there; it is not tried again.
        ask_odds: whether errors that are hardly smaller leave it to the odds. These suppose noise
            that is the same in all epochs: where what differs from image to image is still to be
            found, whatever happens to follow it has odds for it.
    """
    in_all = cache(lambda: split.undivided(current.scene).fit(current.scene))
    # One tangent foretells a drop to a few percent: only near ties of the leading one need a refit.
    # Where none of them passes, named physics gets its turn; an unnamed effect must lead.
    least = leading[0][1] - max(_NEAR, _TIE * abs(leading[0][1]))
    near = [item for item in leading[:_CANDIDATES] if item[1] >= least]
    rest = [item for item in leading[len(near) :] if item[0].entries]
    groups = [near, rest[:_CANDIDATES]]
    asked: set[tuple] = set()
    tried: list[Candidate] = []
    refitted: list[Candidate] = []
    while groups:
        some = [item for item in groups.pop(0) if _key(item[0]) not in asked | hopeless]
        asked |= {_key(hypothesis) for hypothesis, *_ in some}
        best = max((c.evidence for c in refitted), default=-np.inf)
        fitted = _refits(current, some, split, best, hopeless)
        tried += fitted
        refitted = _comparable(refitted + [c for c in fitted if c.evidence > 0.0], current)
        for candidate in refitted:
            if _key(candidate.hypothesis) in hopeless:
                continue
            promising = _promising(leading, candidate, asked | hopeless)
            if promising:
                groups.insert(0, promising[:_CANDIDATES])
                break
            shown = split.evaluate(candidate.adjustment.scene)
            proof = gain(heldout, shown, seed)
            strong = candidate.evidence > STRONG and _is_foretold(candidate)
            if ask_odds and strong and proof.share > 0.0 and not proof.proven:
                after = replace(candidate.adjustment, scene=shown.scene)
                proof = replace(proof, odds=split.odds(current, in_all(), after))
            if proof.proven and is_determined(candidate, shown):
                near = _close_behind(candidate, refitted)
                return Accepted(candidate, near, shown, proof, tuple(_comparable(tried, current)))
            hopeless.add(_key(candidate.hypothesis))
        else:
            refitted = []
    return short(leading[0][0])


def _refits(current: Adjustment, some, split: Split, best: float, hopeless: set) -> list[Candidate]:
    """What can be fitted, as it comes; what can't, or explains nothing, is hopeless."""
    fitted: list[Candidate] = []
    # Free forms come last: what a name explains as well needs no wide fit.
    for hypothesis, foretold, amplitudes in sorted(some, key=lambda item: len(item[2]) > FREE):
        if len(amplitudes) > FREE and foretold < max(best, _least(hypothesis)):
            continue
        candidate = refit(current, hypothesis, amplitudes, split)
        if candidate is None or candidate.evidence <= 0.0:
            hopeless.add(_key(hypothesis))
        if candidate is not None:
            fitted.append(candidate)
            best = max(best, candidate.evidence)
    return fitted


def _close_behind(chosen: Candidate, refitted: list[Candidate]) -> tuple[Candidate, ...]:
    """Others that fell behind only a little."""
    gap = max(_OPEN[0], _OPEN[1] * abs(chosen.evidence))
    return tuple(c for c in refitted if c is not chosen and chosen.evidence - c.evidence < gap)


def _key(hypothesis: Hypothesis) -> tuple:
    """What is fitted once."""
    return identity(hypothesis), hypothesis.course


def _promising(leading, candidate: Candidate, known: set[tuple]) -> list:
    """What promises clearly more than a candidate gave that kept less than its tangent promised."""
    return [
        item
        for item in leading
        if _key(item[0]) not in known
        and len(item[2]) <= FREE
        and item[1] - max(_NEAR, _TIE * item[1]) > candidate.evidence
    ]


def _is_foretold(candidate: Candidate) -> bool:
    """Whether fitted epochs foretell others: the amount of an epoch foretells none of another.

    Few columns do, and the amounts of marks, of which a name says how large they are.
    """
    amounts = any(term.driver == "epoch" for term in candidate.effect.terms)
    return len(candidate.amplitudes) <= FREE or bool(candidate.hypothesis.entries and not amounts)


def is_determined(candidate: Candidate, shown: HeldOut) -> bool:
    """Whether the fit, completed by the held-out epochs, has a size for what it added.

    An image or a mark that was never seen has no amount of its own, and needs none.
    """
    completed = replace(candidate.adjustment, scene=shown.scene)
    sized = np.isfinite(effect_deviations(completed)[-1])
    bases = len(FORMS[candidate.effect.form].bases)
    of_all = [t.driver not in EACH for t in candidate.effect.terms for _ in range(bases)]
    needed = np.append(of_all, np.ones(len(sized) - len(of_all))).astype(bool)
    return bool(sized.any() and sized[needed].all())


def _least(hypothesis: Hypothesis) -> float:
    """Evidence that a free form must promise."""
    of_epochs = any(term.driver == "epoch" for term in hypothesis.group.terms)
    return _FREE_LEAST_OF_EPOCHS if of_epochs else _FREE_LEAST


def _comparable(candidates: list[Candidate], current: Adjustment) -> list[Candidate]:
    """Candidates with their evidence for one variance, the least that any reaches, best first.

    By its own variance what fits worse is behind by the drop of all times the difference, too.
    """
    variance = min((c.adjustment.variance_factor for c in candidates), default=1.0)

    def common(candidate: Candidate) -> Candidate:
        drop = 2.0 * (current.cost - candidate.adjustment.cost)
        more = drop * (1.0 / variance - 1.0 / candidate.adjustment.variance_factor)
        return replace(candidate, evidence=candidate.evidence + more)

    return sorted(map(common, candidates), key=lambda c: -c.evidence)


def alternatives(accepted: Accepted, leading) -> tuple[Hypothesis, ...]:
    """What was refitted, and what else led with few columns, if it was not far behind."""
    chosen = accepted.chosen.hypothesis
    best = next(c.evidence for c in accepted.tried if c.hypothesis.same(chosen))
    tried = [c.hypothesis for c in accepted.tried if c.evidence > _HOPEFUL * best]
    least = _HOPEFUL * leading[0][1]
    others = [h for h, own, amplitudes in leading if len(amplitudes) <= FREE and own > least]
    others = [h for h in others if not any(h.same(one) for one in tried)]
    return tuple((tried + others)[:_TRIED_AGAIN])


def as_good(accepted: Accepted, leading):
    """What was refitted and fell behind a little, and named ones that one tangent foretells."""
    chosen = accepted.chosen
    for other in accepted.near:
        yield (
            other.hypothesis,
            np.asarray(other.effect.amplitudes),
            chosen.evidence - other.evidence,
        )
    refitted = [candidate.hypothesis for candidate in accepted.tried]
    foretold = [own for h, own, _ in leading if h.same(chosen.hypothesis)]
    for hypothesis, own, amplitudes in leading if foretold else ():
        if hypothesis.entries and not any(r.same(hypothesis) for r in refitted):
            yield hypothesis, amplitudes, max(foretold[0] - own, 0.0)


def short(hypothesis: Hypothesis) -> str:
    """A hypothesis in a few words."""
    effect = hypothesis.effect(())
    parts = [effect.name]
    if effect.driver != "constant":
        parts.append(f"{effect.form} in {effect.driver}")
    parts.append(effect.scope.words())
    return " · ".join(parts)
