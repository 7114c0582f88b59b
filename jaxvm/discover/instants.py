"""Steps among the leading hypotheses: at their best instants, and as slow beginnings.

The grid of all hypotheses is coarse. A step in a gap beside the true one is wrong in all the epochs
between, and what settles slowly from there on would then fit better than the step itself.
"""

from dataclasses import replace

import numpy as np

from jaxvm.discover.courses import Course, gaps
from jaxvm.discover.hypotheses import Family, Hypothesis
from jaxvm.discover.ranking import Ranking, where
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import evidence
from jaxvm.discover.space import member
from jaxvm.network.scene import Scene

Leading = list[tuple[Hypothesis, float, np.ndarray]]
"""Hypotheses with their evidence and one-step amplitudes."""

_BEGINNINGS = 4
"""Leading hypotheses among which a step is tried as a slow beginning, too."""

_REACH = 2
"""Points of the grid on either side of the best between which the instant is sought."""


def at_their_instants(
    leading: Leading, tests: ScoreTests, ranking: Ranking, n: int
) -> tuple[Leading, dict[tuple, Ranking]]:
    """The leading ones, with steps in the gap between epochs where they fit best.

    And the scores of all gaps about them, by what such a hypothesis says (`said`). `n` is the
    number of pixel coordinates that are fitted.
    """
    found, finer = [], {}
    variance = ranking.scores[0].variance
    for hypothesis, own, amplitudes in leading:
        gap_scores = step_at_every_gap(tests, ranking, hypothesis, variance)
        best = None if gap_scores is None else best_instant(gap_scores, hypothesis, tests)
        if best is not None:
            hypothesis, drop, amplitudes = best
            own = evidence(hypothesis, drop, amplitudes, variance, n)
            finer[said(hypothesis)] = gap_scores
        found.append((hypothesis, own, amplitudes))
    return sorted(found, key=lambda item: -item[1]), finer


def said(hypothesis: Hypothesis) -> tuple:
    """What a hypothesis says, under any name."""
    return hypothesis.group, hypothesis.course, hypothesis.scope


def with_slow_beginnings(leading: Leading, ranking: Ranking, scene: Scene) -> Leading:
    """The leading ones, and right after each step what settles from its moment on."""
    found: Leading = []
    for hypothesis, own, amplitudes in leading:
        found.append((hypothesis, own, amplitudes))
        slow = begun_slowly(ranking, hypothesis, scene)
        if slow is not None and len(found) <= _BEGINNINGS:
            found.append((slow, own, amplitudes))
    return found


def step_at_every_gap(
    tests: ScoreTests, ranking: Ranking, hypothesis: Hypothesis, variance: float
) -> Ranking | None:
    """Scores of a step at all gaps about its instant; None for another form, or where none is new.

    The terms and the place are those of the hypothesis.
    """
    course, scene = hypothesis.course, tests.scene
    if course.form != "step":
        return None
    for scores, g, own, s in where(ranking, hypothesis, scene):
        family = scores.family
        grid = np.unique([family.courses[k].constants[0] for k in own])
        at = int(np.argmin(np.abs(grid - course.constants[0])))
        first, last = grid[max(at - _REACH, 0)], grid[min(at + _REACH, len(grid) - 1)]
        every = gaps(course.driver, scene.network.channels)
        every = every[(every >= first) & (every <= last)]
        if len(every) <= np.sum((grid >= first) & (grid <= last)):
            return None
        return tests.about((_of_steps(family, (g, own[0], s), every),)).score(variance)
    return None


def _of_steps(family: Family, index: tuple[int, int, int], every: np.ndarray) -> Family:
    """Steps at given instants in place of all courses, for one group in one scope."""
    g, c, s = index
    valid = np.zeros((1, len(every), len(family.scopes)), bool)
    valid[:, :, s] = True
    return replace(
        family,
        groups=family.groups[g : g + 1],
        courses=tuple(Course(family.courses[c].driver, "step", (t,)) for t in every.tolist()),
        valid=valid,
        kinds=(family.kinds[c],) * len(every),
        asked=(family.asked[c],) * len(every),
    )


def best_instant(
    finer: Ranking, hypothesis: Hypothesis, tests: ScoreTests
) -> tuple[Hypothesis, float, np.ndarray] | None:
    """The hypothesis at the best of the finer instants: (hypothesis, drop, one-step amplitudes)."""
    (scores,) = finer.scores
    drop = np.where(scores.valid, scores.drop, -np.inf)
    if not np.isfinite(drop.max()):
        return None
    g, c, s = (int(k) for k in np.unravel_index(int(np.argmax(drop)), drop.shape))
    course = member(scores.family, (g, c, s), tests.scene).course
    return replace(hypothesis, course=course), float(drop[g, c, s]), scores.amplitude[g, c, s]


def begun_slowly(ranking: Ranking, hypothesis: Hypothesis, scene: Scene) -> Hypothesis | None:
    """What settles from the moment of a step on, in the same terms at the same place, if asked.

    It contains the step, but the grid of its two constants is too coarse to show it.
    """
    course, time = hypothesis.course, np.asarray(scene.network.channels.epoch_time)
    if course.form != "step" or len(time) < 2:
        return None
    pause = float(np.median(np.diff(time)))
    slow = Course(course.driver, "settling", (max(course.constants[0] - 0.5 * pause, 0.0), pause))
    for scores, g, own, s in where(ranking, replace(hypothesis, course=slow), scene):
        return replace(member(scores.family, (g, own[0], s), scene), course=slow)
    return None
