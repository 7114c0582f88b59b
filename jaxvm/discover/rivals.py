"""Rivals: what the recording can't tell from the chosen hypothesis at 20:1.

With e the chosen effect as it stands in the residuals and lambda = |e|^2 its drop of chi-square, a
hypothesis that explains the share rho^2 of e is worse by lambda (1 - rho^2): what the recording can
be expected to show. What it did show counts, too: of refitted hypotheses, and of leading ones that
were not worth a refit, as one tangent foretells it.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from jaxvm.discover.courses import Course
from jaxvm.discover.hypotheses import FREE, Family, Hypothesis
from jaxvm.discover.ranking import Ranking
from jaxvm.discover.scatter import families_of_images
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import (
    decisive_gap,
    log_prior,
    price_of_columns,
    price_of_constants,
    stacked,
    toll,
)
from jaxvm.discover.space import member
from jaxvm.physics.effects import Effect
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import Adjustment

MOST, PLACES = 12, 3
"""Names that are kept, and places of each."""

_ODDS = 20.0

_LEAST = 0.5
"""Share of the change that a hypothesis must explain of itself to be what others are held against:
of less its tangent says nothing."""


Kind = tuple[float, float, Hypothesis]
"""Log odds, gap and hypothesis of one driver and form."""


@dataclass(frozen=True)
class Rival:
    """A hypothesis that the recording can't tell from the chosen one.

    Attributes:
        hypothesis: what it is.
        gap: by how much it is expected to be worse (chi-square).
        weight: posterior weight among all doubles, over all drivers and forms.
        log_odds: of its best driver and form, against the chosen one.
        others: the same physics after other drivers, which it may follow as well.
        names: all that its combination may be called.
        kinds: of each driver and form the log odds, the gap and the hypothesis.
    """

    hypothesis: Hypothesis
    gap: float
    weight: float
    others: tuple[Hypothesis, ...] = ()
    names: tuple[str, ...] = ()
    log_odds: float = 0.0
    kinds: tuple[Kind, ...] = ()


@dataclass
class _Claim:
    """One name at one place, with all drivers and forms that do.

    A name shares its prior among them (`log_prior`), so that its weight is the sum over them: one
    with many forms would be too light by its best alone.
    """

    hypothesis: Hypothesis
    names: tuple[str, ...]
    gap: float
    log_odds: float
    of_kind: dict[tuple[str, str], Kind] = field(default_factory=dict)

    @property
    def weight(self) -> float:
        return _summed(self.of_kind.values())

    def of_driver(self) -> list[tuple[float, Hypothesis]]:
        """The best form of each driver, best first."""
        best: dict[str, tuple[float, Hypothesis]] = {}
        for odds, _, hypothesis in _best_first(self.of_kind.values()):
            best.setdefault(hypothesis.course.driver, (odds, hypothesis))
        return list(best.values())


def rivals(
    before: Adjustment,
    after: Adjustment,
    own: Hypothesis,
    effect: Effect,
    tests: ScoreTests,
    n: int,
    shown: Iterable[tuple[Hypothesis, np.ndarray, float]] = (),
    noise: float = 1.0,
    remembered: Iterable[Rival] = (),
) -> tuple[Rival, list[Rival]]:
    """The chosen hypothesis among its rivals, which are sorted by weight.

    Other names for the chosen combination are always rivals. One name at one place that may follow
    several drivers is one rival.

    Args:
        before, after: the fits without and with the chosen effect.
        own, effect: what was chosen, and its fitted values.
        tests: of all hypotheses, at the fit without it.
        n: number of pixel coordinates that are fitted.
        shown: hypotheses that the recording itself shows to be as good, with their amplitudes and
            by how much their evidence is behind in white noise.
        noise: by how much more than white noise it makes chi-square drop.
        remembered: rivals that it had in another fit.
    """
    variance = noise * after.variance_factor
    change = stacked(before) - stacked(after)
    full = float(np.sum(change**2)) / variance
    limit = decisive_gap(full)
    tolled = partial(toll, drop=full)
    claims: dict[tuple, _Claim] = {}
    own_amplitudes = np.asarray(effect.amplitudes)
    own_prior = log_prior(own, own_amplitudes)
    own_columns = price_of_columns(own, own_amplitudes, full, n)
    # What has fewer columns may be behind by what it saves.
    saved = own_columns - np.log(n) if len(own_amplitudes) <= FREE else 0.0

    def weigh(hypothesis: Hypothesis, amplitudes: np.ndarray, gap: float, fit: float) -> None:
        names = tuple(entry.id for entry in hypothesis.entries)
        for named in _one_by_one(hypothesis):
            prior = log_prior(named, np.asarray(amplitudes)) - own_prior
            count(named, names, gap, float(fit + prior))

    def count(named: Hypothesis, names: tuple[str, ...], gap: float, odds: float) -> None:
        claim = claims.setdefault(claim_of(named), _Claim(named, names, gap, -np.inf))
        if odds > claim.log_odds:
            claim.hypothesis, claim.names = named, names
            claim.gap, claim.log_odds = gap, odds
        kind = named.course.driver, named.course.form
        if kind not in claim.of_kind or odds > claim.of_kind[kind][0]:
            claim.of_kind[kind] = odds, gap, named

    scene, found = before.scene, []
    # Neither is among the hypotheses that are scored together: what every image has for itself, and
    # constants between those of the grid.
    of_images = any(term.driver == "epoch" for term in effect.terms)
    further = families_of_images(scene) if of_images else _at(tests.battery.families, effect)
    asked = [tests, *([tests.about(further)] if further else [])]
    alike = [some.score(variance, residual=change) for some in asked]
    # What its own tangent does not explain (the way from one fit to the other is no straight line)
    # speaks against no other hypothesis either.
    explained = _explained(alike[-1], own, effect, variance)
    full = float(np.clip(explained, _LEAST * full, full)) if explained > 0.0 else full
    for ranking in alike:
        found += list(_resembling(ranking, scene, own, full, variance, limit + saved))
    # The first ranking is over the grid; at the constants of the effect alone nothing has a price.
    prices = {_course_of(h): price for h, _, price, _ in reversed(found)}
    own_price = prices.get(_course_of(own), 0.0)
    for hypothesis, gap, _, amplitudes in found:
        columns = price_of_columns(hypothesis, amplitudes, full - gap, n) - own_columns
        if gap + min(columns, 0.0) <= limit:
            cost = columns + prices[_course_of(hypothesis)] - own_price
            weigh(hypothesis, amplitudes, gap, -0.5 * float(tolled(gap) + cost))
    own_cost = own_columns + price_of_constants(own, full, n)
    for hypothesis, amplitudes, in_white in shown:
        # What is plausible beforehand, and what columns and constants cost, is no matter of the
        # noise, nor of how exact forms are.
        prior = log_prior(hypothesis, np.asarray(amplitudes)) - own_prior
        cost = price_of_columns(hypothesis, amplitudes, full, n) - own_cost
        cost += price_of_constants(hypothesis, full, n)
        # What fits better and was not chosen did not improve the held-out epochs: no odds for it.
        behind = max((in_white + 2.0 * prior - cost) / noise, 0.0)
        if behind <= limit and not hypothesis.same(own):
            weigh(hypothesis, amplitudes, behind, -0.5 * float(tolled(behind) + cost))
    for rival in remembered:
        if not rival.hypothesis.same(own):
            count(rival.hypothesis, rival.names, rival.gap, rival.log_odds)
    weigh(own, own_amplitudes, 0.0, 0.0)

    total = np.logaddexp.reduce([claim.weight for claim in claims.values()])
    weights = {key: float(np.exp(claim.weight - total)) for key, claim in claims.items()}
    mine = claims.pop(claim_of(own))
    least = max(weights.values()) / _ODDS
    kept = [_rival(claim, weights[key]) for key, claim in claims.items() if weights[key] >= least]
    chief = replace(_rival(mine, weights[claim_of(own)], own.course.driver), hypothesis=own)
    return chief, _foremost(sorted(kept, key=lambda r: -r.weight))


def _foremost(ordered: list[Rival]) -> list[Rival]:
    """The leading names, and the leading places of each."""
    places: dict[tuple, int] = {}
    kept = []
    for rival in ordered:
        name, _ = claim_of(rival.hypothesis)
        if name in places or len(places) < MOST:
            places[name] = places.get(name, 0) + 1
            kept += [rival] if places[name] <= PLACES else []
    return kept


def _rival(claim: _Claim, weight: float, driver: str = "") -> Rival:
    first = driver or claim.hypothesis.course.driver
    ordered = claim.of_driver()
    least = ordered[0][0] - np.log(_ODDS)
    near = [h for odds, h in ordered if h.course.driver != first and odds > least]
    return Rival(
        claim.hypothesis,
        claim.gap,
        weight,
        tuple(near),
        claim.names,
        claim.log_odds,
        tuple(_best_first(claim.of_kind.values())),
    )


def _best_first(kinds: Iterable[Kind]) -> list[Kind]:
    return sorted(kinds, key=lambda kind: -kind[0])


def _summed(kinds: Iterable[Kind]) -> float:
    return float(np.logaddexp.reduce([odds for odds, *_ in kinds]))


def as_shown(rival: Rival, behind: float, drop: float) -> Rival:
    """A rival whose best driver and form, refitted, is behind by more than was expected.

    Args:
        rival: with a weight that is brought down by what the refit takes from its odds.
        behind: by how much it fits worse (chi-square).
        drop: of chi-square that both explain.
    """
    (odds, gap, hypothesis), *others = rival.kinds or (
        (rival.log_odds, rival.gap, rival.hypothesis),
    )
    taken = 0.5 * float(toll(max(behind, gap), drop) - toll(gap, drop))
    kinds = _best_first([(odds - taken, max(behind, gap), hypothesis), *others])
    log_odds, least, best = kinds[0]
    share = np.exp(_summed(kinds) - _summed([(odds, gap, hypothesis), *others]))
    return replace(
        rival,
        hypothesis=best,
        gap=least,
        log_odds=log_odds,
        weight=rival.weight * float(share),
        kinds=tuple(kinds),
    )


def claim_of(hypothesis: Hypothesis) -> tuple:
    """What is claimed, whatever drives it: a name, or the terms where there is none; the place."""
    names = tuple(entry.id for entry in hypothesis.entries[:1]) or hypothesis.group.terms
    return names, hypothesis.scope


def _course_of(hypothesis: Hypothesis) -> tuple:
    course = hypothesis.course
    return hypothesis.group, hypothesis.scope, course.driver, course.form


def _resembling(
    ranking: Ranking, scene, own: Hypothesis, full: float, variance: float, limit: float
):
    """Hypotheses that explain an effect up to the limit, and the chosen one.

    Yields (hypothesis, gap, price of its constants, amplitudes). Constants are integrated over
    their grid: one that may take any value costs nothing, one that must have a single value of
    the grid costs 2 ln (size of the grid).
    """
    for scores in ranking.scores:
        family = scores.family
        on_grid = np.where(scores.valid, scores.drop, -np.inf) / variance
        drops = np.minimum(family.at_peaks(on_grid), full)
        for kind, places in family.by_driver_and_form().items():
            best = drops[:, places].max(axis=1)
            mine = (own.course.driver, own.course.form) == kind
            for g, s in np.argwhere(best >= full - limit if not mine else np.isfinite(best)):
                if best[g, s] < full - limit and family.groups[g].terms != own.group.terms:
                    continue
                each = drops[g, places, s]
                mean = 2.0 * np.logaddexp.reduce(0.5 * each) - 2.0 * np.log(len(places))
                index = (g, places[int(np.argmax(each))], s)
                gap = float(max(full - best[g, s], 0.0))
                price = float(best[g, s] - mean)
                yield member(family, index, scene), gap, price, scores.amplitude[index]


def _explained(ranking: Ranking, own: Hypothesis, effect: Effect, variance: float) -> float:
    """What a hypothesis explains of its own effect, at its own constants; 0 where not asked."""
    course, drops = (effect.driver, effect.form, effect.constants), [0.0]
    for scores in ranking.scores:
        family = scores.family
        same = [
            c for c, o in enumerate(family.courses) if (o.driver, o.form, o.constants) == course
        ]
        # A mark is in the scope of all, and its group's own.
        place = [own.group.mark is not None or scope == own.scope for scope in family.scopes]
        for g in (g for g, group in enumerate(family.groups) if group == own.group):
            for c in same:
                drops += (scores.drop[g, c, place & scores.valid[g, c]] / variance).tolist()
    return max(drops)


def _at(families: tuple[Family, ...], effect: Effect) -> tuple[Family, ...]:
    """All groups with the refined constants of an effect; none where it has none."""
    found = []
    for family in families if effect.constants else ():
        # What jumps several times is asked wherever it may jump at all.
        kind = effect.driver, FORMS[effect.form].single
        own = family.by_driver_and_form().get(kind, [])
        first = own[0] if own else 0
        if own and family.valid[:, first].any():
            course = Course(effect.driver, effect.form, effect.constants, effect.reference)
            found.append(
                replace(
                    family,
                    courses=(course,),
                    valid=family.valid[:, first : first + 1],
                    kinds=(family.kinds[first],),
                    asked=(family.asked[first],),
                )
            )
    return tuple(found)


def _one_by_one(hypothesis: Hypothesis) -> list[Hypothesis]:
    """A hypothesis under each of its names alone; itself where it has none."""
    named = [replace(hypothesis, entries=(entry,)) for entry in hypothesis.entries]
    return named or [hypothesis]
