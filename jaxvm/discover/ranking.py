"""What the scores say: which hypotheses lead, and how likely noise alone gives as much."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import gammaln

from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Family, Hypothesis
from jaxvm.discover.space import member
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Effect, Scope


@dataclass(frozen=True)
class Scores:
    """Scores of one family: arrays [groups, courses, scopes].

    Attributes:
        family: the hypotheses.
        drop: predicted drop of chi-square (of residuals with unit variance).
        z: the same as a surprise, about -2 ln p, comparable whatever the number of columns.
        amplitude: one-step amplitudes [groups, courses, scopes, columns].
        seen: share of the effect that the model does not absorb.
        null: largest z of each group under flipped signs [groups, repetitions].
        valid: hypotheses that were scored.
    """

    family: Family
    drop: np.ndarray
    z: np.ndarray
    amplitude: np.ndarray
    seen: np.ndarray
    null: np.ndarray
    valid: np.ndarray
    variance: float

    @property
    def n(self) -> int:
        """Number of hypotheses scored."""
        return int(self.valid.sum())


@dataclass(frozen=True)
class Ranking:
    """All families' scores, and the distribution of the largest z under noise."""

    scores: tuple[Scores, ...]
    null: np.ndarray

    @property
    def n(self) -> int:
        """Number of hypotheses scored."""
        return sum(s.n for s in self.scores)

    def best_z(self) -> float:
        """Largest statistic."""
        return max((float(s.z[s.valid].max()) for s in self.scores if s.n), default=-np.inf)

    def most(self, columns: int) -> float:
        """Largest predicted drop of chi-square with at most so many columns."""
        few = (s for s in self.scores if s.n and s.amplitude.shape[-1] <= columns)
        return max((float(s.drop[s.valid].max()) for s in few), default=0.0)

    def left_at(self, ports: set[str], scope: Scope) -> float:
        """Probability that noise alone gives as much as is left at some ports of some bodies.

        The family is that of the hypotheses about these ports, of any course: what the best course
        of its kind should have explained.
        """
        largest, nulls = -np.inf, []
        for scores in self.scores:
            own = [s for s, other in enumerate(scores.family.scopes) if other == scope]
            for g, group in enumerate(scores.family.groups):
                z = np.where(scores.valid[g][:, own], scores.z[g][:, own], -np.inf)
                if {term.port for term in group.terms} <= ports and np.isfinite(z).any():
                    largest = max(largest, float(z.max()))
                    nulls.append(scores.null[g])
        # Each repetition has one largest value of all of them, as the family of everything has.
        return _p_value(largest, np.max(nulls, axis=0)) if nulls else 1.0

    def left_in_harmonics(self, effect: Effect) -> float:
        """Probability that noise alone gives what is left at a half and a third of a period.

        A sawtooth, or what goes to and fro by steps, is no oscillation; 1 for other forms.
        """
        if effect.form != "periodic":
            return 1.0
        ports, p, asked = {term.port for term in effect.terms}, 1.0, 0
        for scores in self.scores:
            own = scores.family.by_driver_and_form().get((effect.driver, "periodic"), [])
            if not own:
                continue
            rate = np.array([1.0 / scores.family.courses[k].constants[0] for k in own])
            near = {own[int(np.argmin(np.abs(rate - n / effect.constants[0])))] for n in (2, 3)}
            for g, group in enumerate(scores.family.groups):
                if {term.port for term in group.terms} <= ports:
                    here = [s == effect.scope for s in scores.family.scopes]
                    z = scores.z[g][sorted(near)][:, here]
                    asked += z.size
                    p = min(p, float(np.exp(-0.5 * z.max(initial=0.0))))
        return min(p * asked, 1.0)

    def p_value(self, z: float) -> float:
        """Probability that noise alone gives a statistic this large anywhere (family-wise)."""
        return _p_value(z, self.null)

    def p_at(self, z: float, group: Group) -> float:
        """The same for the terms of one group alone: any course, any body.

        Of what was not scored among the others (a wave, amounts of every image): anywhere.
        """
        own = [s.null[g] for s in self.scores for g, o in enumerate(s.family.groups) if o == group]
        return _p_value(z, np.max(own, axis=0) if own else self.null)

    def is_beyond_gaussian(self, z: float, alpha: float) -> bool:
        """Whether Gaussian noise gives a statistic this large anywhere less often than alpha."""
        return z > 2.0 * np.log(self.n / alpha)


def _p_value(z: float, null: np.ndarray) -> float:
    """Probability of a statistic this large, by those of random repetitions."""
    return float((1 + np.sum(null >= z)) / (1 + len(null)))


def surprise(
    chi_square: Float[np.ndarray, "..."], columns: Float[np.ndarray, "..."] | float
) -> Float[np.ndarray, "..."]:
    """About -2 ln p of a chi-square statistic: comparable whatever the number of columns.

    The leading term of the upper tail, p ~ x^(s-1) e^-x / Gamma(s) with s = columns/2, x = half the
    statistic; below the mean, where it does not hold, the statistic is taken at the mean.
    """
    x = 0.5 * np.maximum(chi_square, columns)
    half = 0.5 * np.asarray(columns, float)
    return 2.0 * (x - (half - 1.0) * np.log(x) + gammaln(half))


def top(
    ranking: Ranking, scene: Scene, count: int, columns: int | None = None
) -> list[tuple[Hypothesis, float, np.ndarray]]:
    """The leading hypotheses by z: (hypothesis, drop, one-step amplitudes).

    With at most so many `columns`, where that is given.
    Courses that differ only in their constants (instants, lags, periods) count as one: the best.
    """
    entries = []
    for scores in ranking.scores:
        if columns is not None and scores.amplitude.shape[-1] > columns:
            continue
        z = np.where(scores.valid, scores.z, -np.inf)
        drop = scores.family.at_peaks(np.where(scores.valid, scores.drop, -np.inf))
        best = scores.family.with_best_constants(z)
        entries += [(z[index], scores, drop, index) for index in best]
    entries.sort(key=lambda entry: -entry[0])
    return [
        (member(s.family, index, scene), float(drop[index]), s.amplitude[index])
        for _, s, drop, index in entries[:count]
    ]


def spread_of_constant(ranking: Ranking, hypothesis: Hypothesis, scene: Scene) -> float:
    """Standard deviation of the first constant of a hypothesis over the courses that were asked.

    The posterior over the grid, with a flat prior: weights exp(drop / 2). It is not less than what
    the step of the grid leaves open.
    """
    for scores, g, own, s in where(ranking, hypothesis, scene):
        at = np.array([scores.family.courses[k].constants[0] for k in own])
        drop = np.where(scores.valid[g, own, s], scores.drop[g, own, s], -np.inf)
        weight = np.exp(0.5 * (drop - drop.max()) / scores.variance)
        mean = float(weight @ at / weight.sum())
        step = float(np.median(np.diff(np.unique(at)))) if len(at) > 1 else 0.0
        return float(np.hypot(np.sqrt(weight @ (at - mean) ** 2 / weight.sum()), step / 3.5))
    return 0.0


def where(ranking: Ranking, hypothesis: Hypothesis, scene: Scene):
    """Yields scores, group, courses and scope of a hypothesis, whatever its constants."""
    kind = hypothesis.course.driver, hypothesis.course.form
    for scores in ranking.scores:
        family = scores.family
        own = family.by_driver_and_form().get(kind, [])
        for g in (g for g, group in enumerate(family.groups) if group == hypothesis.group and own):
            for s in map(int, np.flatnonzero(scores.valid[g, own].any(axis=0))):
                if member(family, (g, own[0], s), scene).scope == hypothesis.scope:
                    yield scores, g, own, s
