"""Look at earlier findings again once later ones are in the model.

While a second effect was still missing, the first may have got the name of a near double, or may be
superfluous now. What is no longer needed goes; a double that fits better takes the name.
"""

from dataclasses import replace
from typing import Protocol

import numpy as np

from jaxvm.discover.constants import sensible
from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.hypotheses import FREE, Hypothesis
from jaxvm.discover.rivals import Rival, as_shown
from jaxvm.discover.select import (
    price,
    price_of_columns,
    price_of_constants,
    spread_of,
    with_spread,
)
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Effect, room_for
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import amplitude_covariance, wald_drops


class Fit(Protocol):
    """Adjusts a scene, or gives it up where it won't get to the cost that is wanted."""

    def __call__(self, scene: Scene, *, wanted: float = ...) -> Adjustment: ...


_MOST_TRIED = 12
"""Alternatives that are fitted at most, those of the first findings first: what was named while
most was missing is the likeliest to be wrong."""

_MOVING = {
    *("sensor.cx", "sensor.cy", "mount.turn_x", "mount.turn_y"),
    *("medium.bend_u", "medium.bend_v", "medium.wedge_x", "medium.wedge_y"),
}
"""Ports that move an image as a whole: amounts at some follow what happens at the others."""

_HIDDEN = 0.5
"""Share of its drop of chi-square below which a finding is hidden by amounts of every image."""

_REFITTED = 4
"""Doubles that are refitted at most before the likeliest of them leads."""

_LIKELIER = 2.0
"""Odds from which a double leads in place of what fits best; less is within what odds are worth."""


def given_effects(current: Adjustment, findings: list[Finding]) -> int:
    """Number of effects before the findings: the engineer's model has them itself."""
    return len(current.scene.effects) - len(findings)


def prune(
    current: Adjustment, findings: list[Finding], n: int, fit: Fit
) -> tuple[Adjustment, list[Finding]]:
    """Drop an earlier finding that the later ones made superfluous (Wald test against BIC).

    Amounts of every image can follow whatever has a course, but must be larger for it: what the
    course saves them counts for it.
    """
    given = given_effects(current, findings)
    effects = current.scene.fitted_effects()
    for k, (drop, cost) in enumerate(_worth(current, findings, n)[:-1]):
        if drop >= cost:
            continue
        kept = (*effects[: given + k], *effects[given + k + 1 :])
        without = fit(current.scene.with_effects(kept, current.scene.room))
        if drop + _wider(given + k, current, without, n) < cost:
            return without, findings[:k] + findings[k + 1 :]
    return current, findings


def _wider(k: int, current: Adjustment, without: Adjustment, n: int) -> float:
    """What amounts of every image cost more without the effect at place k, which they may follow.

    Those that can't do not grow. The price of an amount goes with the logarithm of what all of them
    explain, that is of their square; it is at most ln n.
    """
    effects, cost = current.scene.fitted_effects(), 0.0
    others = (*effects[:k], *effects[k + 1 :])
    for one, other in zip(others, without.scene.fitted_effects(), strict=True):
        if _has_amounts(one):
            old, new = (float(np.sum(np.square(e.amplitudes))) for e in (one, other))
            used = int(np.count_nonzero(other.amplitudes))
            cost += used * float(np.clip(np.log(new / max(old, 1e-300)), 0.0, np.log(n)))
    return cost


def follows(one: Effect, effect: Effect) -> bool:
    """Whether one has an amount in every image with which it can take the course of an effect."""
    ports = {term.port for term in one.terms if term.driver == "epoch"}
    own = {term.port for term in effect.terms}
    reach = ports | _MOVING if ports & _MOVING else ports
    return _has_amounts(one) and own <= reach and one.scope == effect.scope


def _has_amounts(effect: Effect) -> bool:
    """Whether an effect has an amount for every image."""
    epochs = any(term.driver == "epoch" for term in effect.terms)
    return epochs and len(effect.amplitudes) > FREE


def followed(findings: list[Finding], k: int) -> bool:
    """Whether another finding has amounts of every image that can take the course of the k-th."""
    return any(f is not findings[k] and follows(f.effect, findings[k].effect) for f in findings)


def hidden(current: Adjustment, findings: list[Finding], k: int) -> bool:
    """Whether what was found of the k-th is now taken for the most part by amounts of every image.

    Also where these act elsewhere: at the only camera that sees its target, say. What is left of it
    can no longer tell its name.
    """
    if followed(findings, k):
        return True
    if not any(f is not findings[k] and _has_amounts(f.effect) for f in findings):
        return False
    return lost_without(current, findings)[k] < _HIDDEN * findings[k].drop


def rename(
    current: Adjustment, findings: list[Finding], n: int, fit: Fit
) -> tuple[Adjustment, list[Finding]]:
    """Give each finding the name that fits best beside all the others.

    What led when it was found is tried again in its place, and so is what outweighs it now. A name
    that makes another finding superfluous wins by what that one cost. What amounts of every image
    can follow fits under any name beside them, and keeps its own.
    """
    k, left = 0, _MOST_TRIED
    while k < len(findings):
        finding = findings[k]
        if hidden(current, findings, k):
            k += 1
            continue
        heavier = [r.hypothesis for r in finding.rivals if r.weight > finding.weight]
        others = [h for h in finding.alternatives if not h.same(finding.hypothesis)][:left]
        left -= len(others)
        for other in (*others, *heavier):
            if not other.same(findings[k].hypothesis):
                current, findings, k = _better(current, findings, k, other, n, fit)
        k += 1
    return current, findings


def _better(
    current: Adjustment, findings: list[Finding], k: int, other: Hypothesis, n: int, fit: Fit
) -> tuple[Adjustment, list[Finding], int]:
    """Findings with another hypothesis in place of the k-th, where that has more evidence.

    And the place of that one: others may be superfluous then.
    """
    scene, given = current.scene, given_effects(current, findings)
    effects = list(scene.fitted_effects())
    effects[given + k] = other.effect(np.zeros(other.n_columns))
    # Even if it made all the others superfluous, it would have to come so far down.
    variance = current.variance_factor
    saved = 0.5 * variance * complexity(current, findings, variance, n)
    scene = with_spread(scene.with_effects(tuple(effects), scene.room), given + k, other, fit)
    tried = fit(scene, wanted=current.cost + saved)
    if not (tried.converged and sensible(tried.scene, tried.scene.fitted_effects()[given + k])):
        return current, findings, k
    renamed = replace(findings[k], hypothesis=other, stds=(), rivals=(), weight=1.0)
    new = [*findings[:k], renamed, *findings[k + 1 :]]
    needless = [j for j in _superfluous(tried, new, n) if j != k]
    if needless:
        effects = tried.scene.fitted_effects()
        kept = tuple(e for j, e in enumerate(effects) if j - given not in needless)
        tried = fit(scene.with_effects(kept, scene.room))
        new = [finding for j, finding in enumerate(new) if j not in needless]
    new = with_effects(new, tried)
    variance = min(current.variance_factor, tried.variance_factor)
    gained = 2.0 * (current.cost - tried.cost) / variance
    cost = complexity(tried, new, variance, n) - complexity(current, findings, variance, n)
    if not tried.converged or gained <= cost:
        return current, findings, k
    return tried, new, k - sum(j < k for j in needless)


def likelier(
    current: Adjustment, findings: list[Finding], k: int, fit: Fit
) -> tuple[Adjustment, list[Finding]]:
    """Findings whose k-th has the name of a double that is clearly likelier than what fits best.

    What fits best by a little may be the less plausible one by far: the refit tells whether it is a
    little. One that has a name leads what has none as soon as it is as likely.
    """
    refitted: list[Hypothesis] = []
    while True:
        finding = findings[k]
        named = [rival for rival in finding.rivals if rival.hypothesis.entries]
        best = max(named, key=lambda rival: rival.weight, default=None)
        odds = _LIKELIER if finding.hypothesis.entries else 1.0
        if best is None or best.weight < odds * finding.weight:
            return current, findings
        tried = _in_place(current, findings, k, best.hypothesis, fit)
        if not tried.converged:
            return current, findings
        one = finding.noise * min(current.variance_factor, tried.variance_factor)
        behind = 2.0 * (tried.cost - current.cost) / one
        known = len(refitted) == _REFITTED or any(best.hypothesis.same(h) for h in refitted)
        if known or behind <= best.gap:
            return tried, with_effects(
                [*findings[:k], _led_by(finding, best), *findings[k + 1 :]], tried
            )
        refitted.append(best.hypothesis)
        shown = as_shown(best, behind, finding.drop / one)
        findings = [*findings[:k], _with_rival(finding, best, shown), *findings[k + 1 :]]


def _in_place(
    current: Adjustment, findings: list[Finding], k: int, hypothesis: Hypothesis, fit: Fit
) -> Adjustment:
    """The fit with another hypothesis in place of the k-th finding."""
    scene, place = current.scene, given_effects(current, findings) + k
    effects = list(scene.fitted_effects())
    effects[place] = hypothesis.effect(np.zeros(hypothesis.n_columns))
    scene = scene.with_effects(tuple(effects), room_for(tuple(effects), scene.room))
    return fit(with_spread(scene, place, hypothesis, fit))


def _with_rival(finding: Finding, rival: Rival, other: Rival) -> Finding:
    """A finding with another weight of one of its rivals, among which all of it is shared."""
    total = 1.0 - rival.weight + other.weight
    rivals = [other if r is rival else r for r in finding.rivals]
    rivals = [replace(r, weight=r.weight / total) for r in rivals]
    return replace(
        finding,
        weight=finding.weight / total,
        rivals=tuple(sorted(rivals, key=lambda rival: -rival.weight)),
    )


def _led_by(finding: Finding, best: Rival) -> Finding:
    """A finding that has the name of one of its rivals, and its own among them."""
    before = Rival(finding.hypothesis, 0.0, finding.weight, finding.others)
    others = [
        replace(
            rival,
            log_odds=rival.log_odds - best.log_odds,
            kinds=tuple((odds - best.log_odds, *kind) for odds, *kind in rival.kinds),
        )
        for rival in (*finding.rivals, before)
        if rival is not best
    ]
    return replace(
        finding,
        hypothesis=best.hypothesis,
        stds=(),
        weight=best.weight,
        others=best.others,
        rivals=tuple(sorted(others, key=lambda rival: -rival.weight)),
    )


def with_effects(findings: list[Finding], fitted: Adjustment) -> list[Finding]:
    """Findings with the values of a fit that has them all."""
    effects = fitted.scene.fitted_effects()
    effects = effects[given_effects(fitted, findings) :]
    return [
        replace(finding, effect=effect, final_effect=effect)
        for finding, effect in zip(findings, effects, strict=True)
    ]


def complexity(current: Adjustment, findings: list[Finding], variance: float, n: int) -> float:
    """What the findings of a fit cost together."""
    given, cost = given_effects(current, findings), 0.0
    for k, f in enumerate(findings):
        spread = spread_of(current, given + k, f.hypothesis, variance)
        cost += price(f.hypothesis, f.drop / variance, f.effect.amplitudes, n, spread)
    return cost


def _superfluous(current: Adjustment, findings: list[Finding], n: int) -> list[int]:
    """Findings that the others make superfluous (Wald test against BIC)."""
    worth = _worth(current, findings, n)
    return [k for k, (drop, cost) in enumerate(worth) if drop < cost]


def _worth(current: Adjustment, findings: list[Finding], n: int) -> list[tuple[float, float]]:
    """Of each finding the drop of chi-square that is left, and what it costs."""
    variance, found = current.variance_factor, []
    spread = amplitude_covariance(current)
    for finding, own in zip(findings, _places(current, findings), strict=True):
        effect, drop = finding.effect, wald_drops(current, [own], spread)[0] / variance
        known = variance * spread[np.ix_(own, own)]
        columns = price_of_columns(finding.hypothesis, effect.amplitudes, drop, n, known)
        found.append((drop, columns + price_of_constants(finding.hypothesis, drop, n)))
    return found


def lost_without(current: Adjustment, findings: list[Finding]) -> list[float]:
    """Rise of twice the cost without each finding, all others refitted (Wald)."""
    return wald_drops(current, _places(current, findings))


def _places(current: Adjustment, findings: list[Finding]) -> list[np.ndarray]:
    """Numbers of the amplitudes of each finding."""
    places = current.scene.places()[given_effects(current, findings) :]
    return [np.arange(own.start, own.stop) for own, _ in places]
