"""The instant of a step: on the grid of all hypotheses it is coarse, here every gap between epochs.

A step in a gap beside the true one is wrong in all the epochs between. What settles slowly from
there on would then fit better than the step itself.
"""

from dataclasses import replace

import numpy as np

from jaxvm.discover.courses import Course, gaps
from jaxvm.discover.hypotheses import Family, Hypothesis
from jaxvm.discover.ranking import Ranking, where
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.space import member

_REACH = 2
"""Points of the grid on either side of the best between which the instant is sought."""


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
