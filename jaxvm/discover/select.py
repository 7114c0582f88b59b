"""Choose among hypotheses: refit the leading ones, weigh fit, size of the model and plausibility.

The evidence is on the scale of chi-square (twice the log of a posterior weight, Laplace/BIC):

    E = drop / variance - columns ln n + 2 ln prior.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxvm.discover.constants import constants_held, sensible
from jaxvm.discover.heldout import Split
from jaxvm.discover.hypotheses import FREE, Hypothesis
from jaxvm.discover.one_course import lost_by_one_course
from jaxvm.discover.ranking import Ranking, top
from jaxvm.discover.sides import on_better_sides
from jaxvm.network.scene import Scene
from jaxvm.physics.catalogue import Entry
from jaxvm.physics.effects import Effect, room_for
from jaxvm.physics.forms import FORMS, N_KNOTS
from jaxvm.physics.ports import PORT_INDEX, PORTS
from jaxvm.solve.adjust import Adjustment, adjust
from jaxvm.solve.covariance import amplitude_covariance

DECIDED = 2.0 * np.log(20.0)
"""Gap in chi-square at which one hypothesis is twenty times as likely as another."""

_COARSE = 1e-3
"""Share of an effect's drop that its form leaves open.

No effect follows its driver quite as a form says. Where chi-square runs to ten thousands the
remainder outweighs any odds between rivals that differ by less than that.
"""

_ALIKE = 0.1
"""Difference of foretold evidence of two forms that say the same."""

CLEAR = 15.0
"""Difference of foretold evidence between two courses of the same terms that a refit won't turn."""

SOUGHT = ("step", "staircase", "hysteresis", "hysteresis with state")
"""Forms that are asked at few constants and gain most by better ones: no tangent leads there."""

_RTOL, _MAX_STEPS, _MAX_STEPS_WIDE = 1e-6, 40, 10

_WIDE = 3.0
"""Prior standard deviation of the amplitudes of a free form, over their median size."""

_SHARP = 0.3
"""Information on the log of a constant per unit of drop of chi-square, times its prior's width.

A time constant that is off by a factor of e leaves about a tenth of an effect unexplained.
"""

_MIMICRY = 0.1
"""Weight of a named free form: it can mimic much that has another name, or none."""

_QUIETEST = 0.01
"""Share of the variance that is left at least when the best hypothesis is taken out."""

UNNAMED_PRIOR = 0.01
"""Weight of a hypothesis that no engineer has a name for, against one of the catalogue."""


@dataclass(frozen=True)
class Weighing:
    """Evidence that is foretold of hypotheses, before any of them is refitted.

    Attributes:
        variance: of unit weight, of the residuals without any of them.
        n: number of pixel coordinates that are fitted.
        quiet: what `variance` will be with the best hypothesis of few columns.
            What is large is noise to itself. Beside it one column more or less is cheap, and is not
            when that noise is gone: hypotheses of few columns pay for them and their constants in
            the noise that will be left. One of many columns takes some of it for itself, and pays
            in full.
    """

    variance: float
    n: int
    quiet: float = np.inf

    def __call__(self, hypothesis: Hypothesis, drop: float, amplitudes: np.ndarray) -> float:
        noise = min(self.quiet, self.variance) if len(amplitudes) <= FREE else self.variance
        return noise / self.variance * evidence(hypothesis, drop, amplitudes, noise, self.n)

    @classmethod
    def at(cls, fit: Adjustment, ranking: Ranking, n: int) -> "Weighing":
        """For the scores of all hypotheses at a fit."""
        variance = ranking.scores[0].variance
        left = (2.0 * fit.cost - ranking.most(FREE)) / fit.degrees_of_freedom
        return cls(variance, n, max(left, _QUIETEST * variance))


@dataclass(frozen=True)
class Candidate:
    """A hypothesis refitted together with everything found so far."""

    hypothesis: Hypothesis
    adjustment: Adjustment
    evidence: float

    @property
    def effect(self) -> Effect:
        """The effect with its refitted values."""
        return self.adjustment.scene.fitted_effects()[-1]

    @property
    def amplitudes(self) -> np.ndarray:
        """Its refitted amplitudes."""
        return np.asarray(self.effect.amplitudes)


def decisive_gap(drop):
    """Gap in chi-square at which one of two hypotheses is out that explain an effect of a drop."""
    return DECIDED + _COARSE * drop


def toll(gap, drop):
    """What a gap takes of the odds, in chi-square: up to the one that decides it is shrunk.

    The forms are not exact enough for less. What is more counts in full.
    """
    limit = decisive_gap(drop)
    return DECIDED * np.minimum(gap, limit) / limit + np.maximum(gap - limit, 0.0)


def log_prior(hypothesis: Hypothesis, amplitudes: np.ndarray) -> float:
    """Log plausibility: named physics of a plausible size is preferred.

    Every name shares its prior among the drivers and forms in which it was asked: one of fifty
    courses that happens to fit a little better is no better than the only constant.
    """
    asked = hypothesis.alternatives
    mimicry = np.log(_MIMICRY) if len(hypothesis.group.terms) > FREE else 0.0
    own = [
        _log_size(entry, hypothesis, amplitudes) - np.log(asked.get(entry.id, 1)) + mimicry
        for entry in hypothesis.entries
    ]
    return float(max([*own, np.log(UNNAMED_PRIOR) - np.log(asked.get("", 1))]))


def _log_size(entry: Entry, hypothesis: Hypothesis, amplitudes: np.ndarray) -> float:
    """Log plausibility of an effect's size under one of its names.

    Of terms of several units those count that have the unit in which the size is given.
    """
    units = [PORTS[PORT_INDEX[term.port]].unit for term in hypothesis.group.terms]
    form = FORMS[hypothesis.course.form]
    counted = [basis in (form.sized_by or form.bases[:1]) for basis in form.bases]
    # Of a rival that was not fitted no amplitudes are known.
    each = np.reshape(amplitudes, (-1, len(form.bases)))[:, counted]
    known = zip(each, units, strict=False)
    size = float(np.linalg.norm([a for own, unit in known for a in own if unit == units[0]]))
    if size == 0.0:
        return 0.0
    low, high = entry.plausible
    return -3.0 * max(np.log10(low / size), np.log10(size / high), 0.0)


def best_named(hypothesis: Hypothesis, amplitudes: np.ndarray) -> Hypothesis:
    """The hypothesis with its names in the order in which they fit the size."""
    order = sorted(hypothesis.entries, key=lambda e: -_log_size(e, hypothesis, amplitudes))
    return replace(hypothesis, entries=tuple(order))


def evidence(
    hypothesis: Hypothesis,
    drop: float,
    amplitudes: np.ndarray,
    variance: float,
    n: int,
    spread: np.ndarray | None = None,
) -> float:
    """Evidence of a hypothesis from its drop of chi-square, for a variance of unit weight.

    `spread` is the covariance of the amplitudes for that variance, where they were fitted.
    """
    return drop / variance - price(hypothesis, drop / variance, amplitudes, n, spread)


def price(
    hypothesis: Hypothesis, drop: float, amplitudes, n: int, spread: np.ndarray | None = None
) -> float:
    """What a hypothesis costs: columns, constants, implausibility (on the scale of chi-square)."""
    columns = price_of_columns(hypothesis, amplitudes, drop, n, spread)
    constants = price_of_constants(hypothesis, drop, n)
    return columns + constants - 2.0 * log_prior(hypothesis, np.asarray(amplitudes))


def price_of_constants(hypothesis: Hypothesis, drop: float, n: int) -> float:
    """What the constants of a hypothesis cost.

    Each that is refined costs what the drop lets it be known by (Laplace): next to nothing where
    any value does, as much as a column where one value alone does. Seams, where the fields of a
    sensor join, are sought like instants, and cost as much.
    """
    own = FORMS[hypothesis.course.form].constants[: len(hypothesis.course.constants)]
    refined = min(np.log1p(_SHARP * max(drop, 0.0)), np.log(n))
    seams = {term.constants for term in hypothesis.group.terms if term.basis == "step"}
    known = sum(refined if constant.refined else np.log(n) for constant in own)
    return float(known + len(seams) * np.log(n))


def spread_of(
    fitted: Adjustment, place: int, hypothesis: Hypothesis, variance: float
) -> np.ndarray | None:
    """Covariance of the amplitudes of an effect of a fit, if its price depends on it."""
    if not FORMS[hypothesis.course.form].one_course or len(hypothesis.group.terms) == 1:
        return None
    own, _ = fitted.scene.places()[place]
    return variance * amplitude_covariance(fitted, np.arange(own.start, own.stop))


def price_of_columns(
    hypothesis: Hypothesis, amplitudes, drop: float, n: int, spread: np.ndarray | None = None
) -> float:
    """What the amplitudes of a hypothesis cost: ln n each.

    Of a map with many tiles each knows little: their prior has the width that the tiles themselves
    show (empirical Bayes), and costs 1 + ln(drop / columns) for each of them, which is less than
    the ln n of a single unknown. Amounts of epochs that are set aside stay zero and cost nothing.
    Where all terms may follow one course, the amplitudes cost no more than that model does, and
    what it loses; the covariance of the amplitudes (`spread`) tells it.
    """
    form = FORMS[hypothesis.course.form]
    columns = int(np.count_nonzero(amplitudes)) or len(amplitudes)
    if len(amplitudes) > FREE and form.name not in N_KNOTS:
        return float(columns * min(np.log(n), 1.0 + np.log(max(drop / columns, 1.0))))
    price = float(columns * np.log(n))
    terms, bases = len(hypothesis.group.terms), len(form.bases)
    if spread is None or not form.one_course or len(amplitudes) != terms * bases:
        return price
    fewer = (terms + bases - 1) * float(np.log(n))
    return min(price, fewer + lost_by_one_course(np.asarray(amplitudes), spread, bases))


def identity(hypothesis: Hypothesis) -> tuple:
    """What makes two hypotheses different physics: names, driver and place, not constants."""
    names = tuple(entry.id for entry in hypothesis.entries[:1]) or hypothesis.group.terms
    return names, hypothesis.course.driver, hypothesis.scope


def shortlist(
    ranking: Ranking, scene: Scene, weigh: Weighing, count: int, columns: int | None = None
):
    """The best hypotheses by evidence, one for each physics, place and kind of course.

    Returns (hypothesis, evidence, one-step amplitudes), best first; with at most so many `columns`.
    Those that are behind, but may catch up on a finer grid, come on top.
    """
    seen: dict[tuple, float] = {}
    chosen, behind = [], 0
    weighed = [
        (hypothesis, weigh(hypothesis, drop, amplitudes), amplitudes)
        for hypothesis, drop, amplitudes in top(ranking, scene, 400, columns)
    ]
    for hypothesis, own, amplitudes in sorted(weighed, key=lambda item: -item[1]):
        # The same terms at the same place in another course: only if it is nearly as good, or may
        # become so on a finer grid.
        place = (hypothesis.group, hypothesis.scope)
        key = (identity(hypothesis), hypothesis.course.form)
        # What settles and what fades are one where the model has a constant of its own beside them.
        at = (identity(hypothesis), hypothesis.course.constants)
        alike = abs(seen.get(at, np.inf) - own) < _ALIKE
        is_behind = seen.get(place, own) - own > CLEAR
        if alike:
            seen.setdefault(key, own)
        if key in seen or (is_behind and hypothesis.course.form not in SOUGHT):
            continue
        seen.setdefault(place, own)
        seen[key] = seen[at] = own
        behind += is_behind
        chosen.append((hypothesis, own, amplitudes))
        if len(chosen) - min(behind, count) == count:
            break
    return chosen


def refit(base: Adjustment, hypothesis: Hypothesis, amplitudes, split: Split) -> Candidate | None:
    """Refit everything with a hypothesis in, nonlinear constants free.

    A fit that creeps (a free-form curve beside a lens that can nearly do the same) counts with what
    it has reached. None where it fails.
    """
    # From amplitude zero the first step moves everything together.
    effects = (*base.scene.fitted_effects(), hypothesis.effect(0.0 * amplitudes))
    scene = base.scene.with_effects(effects, room_for(effects, base.scene.room))

    def fit(scene: Scene, freed: bool = False) -> Adjustment:
        return adjust(
            scene,
            weights=split.weights,
            range_weights=split.range_weights,
            active=None if freed else constants_held(scene, since=len(effects) - 1),
            rtol=_RTOL,
            damping=1e-6,
            max_steps=_MAX_STEPS_WIDE if len(amplitudes) > FREE else _MAX_STEPS,
            check=False,
        )

    scene = with_spread(scene, -1, hypothesis, fit)
    # At amplitude zero nothing shows what a constant does: it is freed at the amplitudes.
    fitted = fit(scene)
    if effects[-1].constants and not fitted.failed:
        freed = fit(fitted.scene, freed=True)
        # The grid's constants are good enough when a refined one runs away.
        if not freed.failed and sensible(scene, freed.scene.fitted_effects()[-1]):
            fitted = freed
    if fitted.failed:
        return None
    fitted = on_better_sides(fitted, fit, split.weights)
    effect = fitted.scene.fitted_effects()[-1]
    variance = fitted.variance_factor
    drop = 2.0 * (base.cost - fitted.cost)
    spread = spread_of(fitted, -1, hypothesis, variance)
    own = evidence(hypothesis, drop, np.asarray(effect.amplitudes), variance, split.n, spread)
    # Of several names for the same the size decides which comes first.
    named = best_named(hypothesis, np.asarray(effect.amplitudes))
    known = (*effects[:-1], replace(named.effect(0.0 * amplitudes), spread=effect.spread))
    fitted = replace(fitted, scene=replace(fitted.scene, effects=known))
    return Candidate(named, fitted, own)


def with_spread(
    scene: Scene, place: int, hypothesis: Hypothesis, fit: Callable[[Scene], Adjustment]
) -> Scene:
    """The scene with the prior of an effect's amplitudes as wide as their size says, if it is wide.

    What some tiles or knots can't know, the others tell: their spread (empirical Bayes). What has a
    name begins with the spread that its name foresees: with none at all, what is nearly another
    pose would grow until it mimics something else.
    """
    if hypothesis.n_columns <= FREE:
        return scene

    def spread(size: float) -> Scene:
        effects = list(scene.effects)
        effects[place] = replace(effects[place], spread=_WIDE * size)
        return scene.with_effects(tuple(effects), scene.room)

    middles = [float(np.sqrt(np.prod(entry.plausible))) for entry in hypothesis.entries]
    first = fit(spread(min(middles)) if middles else scene)
    own = np.asarray(first.scene.fitted_effects()[place].amplitudes)
    return spread(float(np.median(np.abs(own))))


def stacked(adjustment: Adjustment) -> np.ndarray:
    """Whitened residuals of the tables on which effects act, padded to one width."""
    residuals = adjustment.residuals()
    blocks = [np.asarray(b) for b in residuals.pixels]
    if residuals.ranges is not None:
        ranges = np.asarray(residuals.ranges)
        blocks.append(np.pad(ranges, [(0, 0), (0, blocks[0].shape[1] - 1)]))
    return np.concatenate(blocks)
