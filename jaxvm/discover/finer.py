"""Leading hypotheses at constants that no refit moves, sought on a finer grid; and slow beginnings.

The grid of all hypotheses is coarse. A step in a gap beside the true one is wrong in all the epochs
between, and what settles slowly from there on would then fit better than the step itself. Stairs
with one edge in a wrong place lose to those of another thermometer. Where the fields of a sensor
join a little beside the seam of the grid, the strip between is wrong in all images.
"""

from dataclasses import replace
from itertools import product

import numpy as np

from jaxvm.discover.courses import ENDS, Course, gaps
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Family, Hypothesis
from jaxvm.discover.ranking import Ranking, Scores, where
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import SOUGHT, Weighing
from jaxvm.discover.space import member
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Channels

Leading = list[tuple[Hypothesis, float, np.ndarray]]
"""Hypotheses with their evidence and one-step amplitudes."""

_BEGINNINGS = 4
"""Leading hypotheses among which a step is tried as a slow beginning, too."""

_REACH = 2
"""Points of the grid on either side of the best between which the instant is sought."""

_HEIGHTS_OF_STAIRS, _PHASES = 80, 64
"""Heights and phases of stairs that are tried, all over the grid."""

_SHIFTS = tuple(round(0.01 * k, 2) for k in range(-3, 4))
"""Places beside a seam on the grid that are tried, in image widths."""

_HALVES, _CONTACTS = 33, 9
"""Half plays between the neighbours of the best on the grid, and first contacts."""


def at_finer_constants(
    leading: Leading, tests: ScoreTests, ranking: Ranking, weigh: Weighing
) -> tuple[Leading, dict[tuple, Ranking]]:
    """The leading ones, with steps and stairs where they fit best on a finer grid.

    And the scores of that grid, by what such a hypothesis says (`said`).
    """
    found, finer = [], {}
    for hypothesis, own, amplitudes in leading:
        about = scores_about(tests, ranking, hypothesis, weigh.variance)
        best = None if about is None else best_of(about.scores[0], hypothesis, tests)
        better = -np.inf if best is None else weigh(*best)
        # What is equal stays for its scores: they tell how wide the best one is.
        if best is not None and better >= own:
            (hypothesis, _, amplitudes), own = best, better
            finer[said(hypothesis)] = about
        hypothesis, own, amplitudes = _at_finer_seams(
            (hypothesis, own, amplitudes), tests, ranking, weigh
        )
        found.append((hypothesis, own, amplitudes))
    return sorted(found, key=lambda item: -item[1]), finer


def _at_finer_seams(
    item: tuple[Hypothesis, float, np.ndarray], tests: ScoreTests, ranking: Ranking, weigh: Weighing
) -> tuple[Hypothesis, float, np.ndarray]:
    """A hypothesis with seams where they fit best, its evidence and amplitudes; or as it was."""
    hypothesis, own, _ = item
    groups = _with_seams_moved(hypothesis.group)
    for scores, g, places, s in where(ranking, hypothesis, tests.scene) if groups else ():
        family = of_courses(scores.family, (g, places[0], s), (hypothesis.course,))
        valid = np.repeat(family.valid, len(groups), axis=0)
        moved = replace(family, groups=groups, valid=valid)
        for about in tests.about((moved,)).score(weigh.variance).scores:
            drop = np.where(about.valid, about.drop, -np.inf)[:, 0, s]
            best = int(np.argmax(drop))
            better = replace(hypothesis, group=groups[best])
            amplitudes = about.amplitude[best, 0, s]
            evidence = weigh(better, float(drop[best]), amplitudes)
            if evidence > own:
                return better, evidence, amplitudes
    return item


def _with_seams_moved(group: Group) -> tuple[Group, ...]:
    """The group with each seam at several places beside its own; none where it has no seams."""
    if any(term.basis != "step" or term.driver not in ("column", "row") for term in group.terms):
        return ()
    seams = [term.constants for term in group.terms]
    each = sorted({*seams})
    ways = product(*([(round(at + by, 2),) for by in _SHIFTS] for (at,) in each))
    moved = [dict(zip(each, way, strict=True)) for way in ways if list(way) == sorted({*way})]
    return tuple(
        replace(group, terms=tuple(replace(t, constants=places[t.constants]) for t in group.terms))
        for places in moved
    )


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


def scores_about(
    tests: ScoreTests, ranking: Ranking, hypothesis: Hypothesis, variance: float
) -> Ranking | None:
    """Scores of a step or stairs on a finer grid; None for another form, or where none is new.

    The terms and the place are those of the hypothesis.
    """
    course, scene = hypothesis.course, tests.scene
    if course.form not in _FINER:
        return None
    for scores, g, own, s in where(ranking, hypothesis, scene):
        family = scores.family
        grid = np.array([family.courses[k].constants for k in own])
        finer = _FINER[course.form](course, grid, scene.network.channels)
        if not finer:
            return None
        return tests.about((of_courses(family, (g, own[0], s), finer),)).score(variance)
    return None


def _every_gap(course: Course, grid: np.ndarray, channels: Channels) -> tuple[Course, ...]:
    """Steps in all gaps between epochs about the best; none where they are on the grid already."""
    instants = np.unique(grid[:, 0])
    first, last = _neighbours(instants, course.constants[0], _REACH)
    every = gaps(course.driver, channels)
    every = every[(every >= first) & (every <= last)]
    if len(every) <= np.sum((instants >= first) & (instants <= last)):
        return ()
    return tuple(Course(course.driver, "step", (t,)) for t in every.tolist())


def _stairs(course: Course, grid: np.ndarray, channels: Channels) -> tuple[Course, ...]:
    """Stairs of all heights and phases: their fit has many maxima, so the best leads nowhere."""
    first, *_, last = np.unique(grid[:, 0])
    return tuple(
        replace(course, constants=(h, p))
        for h in np.geomspace(first, last, _HEIGHTS_OF_STAIRS).tolist()
        for p in np.linspace(0.0, 1.0, _PHASES + 1)[1:].tolist()
    )


def _plays(course: Course, grid: np.ndarray, channels: Channels) -> tuple[Course, ...]:
    """Plays between the neighbours of the best, with the contact anywhere at first."""
    halves = np.geomspace(*_neighbours(np.unique(grid[:, 0]), course.constants[0], 1), _HALVES)
    first = [np.linspace(*ENDS, _CONTACTS).tolist()] * (grid.shape[1] - 1)
    return tuple(replace(course, constants=own) for own in product(halves.tolist(), *first))


_FINER = dict(zip(SOUGHT, (_every_gap, _stairs, _plays, _plays), strict=True))
"""Courses on a finer grid about one, by its form."""


def _neighbours(grid: np.ndarray, value: float, reach: int) -> tuple[float, float]:
    """The points of an ascending grid so many places before and after a value."""
    at = int(np.argmin(np.abs(grid - value)))
    return float(grid[max(at - reach, 0)]), float(grid[min(at + reach, len(grid) - 1)])


def of_courses(family: Family, index: tuple[int, int, int], courses: tuple[Course, ...]) -> Family:
    """Given courses in place of all others, for one group in one scope."""
    g, c, s = index
    valid = np.zeros((1, len(courses), len(family.scopes)), bool)
    valid[:, :, s] = True
    return replace(
        family,
        groups=family.groups[g : g + 1],
        courses=courses,
        valid=valid,
        kinds=(family.kinds[c],) * len(courses),
        asked=(family.asked[c],) * len(courses),
    )


def best_of(
    scores: Scores, hypothesis: Hypothesis, tests: ScoreTests
) -> tuple[Hypothesis, float, np.ndarray] | None:
    """A hypothesis with the best of some courses: (hypothesis, drop, one-step amplitudes)."""
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
