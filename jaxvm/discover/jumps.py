"""What jumps several times: a loose lens that is knocked, a tripod that is touched again and again.

One step explains a part of it, and something that runs smoothly may then explain more. So where a
named step explains a good part of what the leading hypothesis does, it is given a second instant, a
third and a fourth, each where it explains most beside the others. Four jumps follow much that does
not jump: what they claim is that all stands still between them, and a curve must not do better, at
that place or another: what is random from image to image at one camera follows four jumps of its
station, too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from jaxvm.discover.courses import gaps
from jaxvm.discover.finer import Leading, best_of, of_courses
from jaxvm.discover.hypotheses import FREE, Family, Hypothesis
from jaxvm.discover.ranking import Ranking
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import Weighing
from jaxvm.discover.space import member
from jaxvm.network.scene import Scene
from jaxvm.physics.forms import JUMPS, N_KNOTS

_LEAST = 0.15
"""Share of the leading drop that a single step must explain: the largest of four explains more."""

_MOST = 8
"""Terms and places that are tried, those whose single step explains most first."""

Instants = tuple[float, ...]


@dataclass(frozen=True)
class _Place:
    """A named step: where it stands in a family [group, course, scope], and what it explains."""

    family: Family
    index: tuple[int, int, int]
    hypothesis: Hypothesis
    drop: float

    def jumping(self, instants: list[Instants]) -> Family:
        """The same terms at the same place with jumps at each of some sets of instants."""
        course, form = self.hypothesis.course, JUMPS[len(instants[0])]
        courses = (replace(course, form=form, constants=own) for own in instants)
        return of_courses(self.family, self.index, tuple(courses))


def with_jumps(leading: Leading, tests: ScoreTests, ranking: Ranking, weigh: Weighing) -> Leading:
    """The leading hypotheses, and what jumps several times among them.

    `ranking` are the scores of `tests`, and `weigh` is for these.
    """
    variance = weigh.variance
    least = _LEAST * leading[0][1] * variance if leading else np.inf
    places = sorted(_steps(ranking, tests.scene, least), key=lambda place: -place.drop)[:_MOST]
    if not places:
        return leading
    instants = [place.hypothesis.course.constants for place in places]
    channels = tests.scene.network.channels
    every = [gaps(place.hypothesis.course.driver, channels).tolist() for place in places]
    smooth = [_by_a_curve(ranking, place.hypothesis.course.driver) for place in places]
    best: dict[int, tuple[Hypothesis, float, np.ndarray]] = {}
    for count in range(2, 1 + min(max(JUMPS), *map(len, every))):
        instants, found = _with_one_more(tests, variance, places, instants, every)
        for k, (hypothesis, drop, amplitudes) in enumerate(found):
            own = weigh(hypothesis, drop, amplitudes)
            beyond_noise = drop / variance - len(amplitudes) - count
            if beyond_noise > smooth[k] and (k not in best or own > best[k][1]):
                best[k] = hypothesis, own, amplitudes
    return sorted([*leading, *best.values()], key=lambda item: -item[1])


def _by_a_curve(ranking: Ranking, driver: str) -> float:
    """What the best free-form curve of a driver explains, wherever it acts.

    On the scale of chi-square, less the one that noise gives it on average for each knot.
    """
    most = -np.inf
    for scores in ranking.scores:
        drop = np.where(scores.valid, scores.drop, -np.inf) / scores.variance
        for (other, form), own in scores.family.by_driver_and_form().items():
            if form in N_KNOTS and other == driver:
                most = max(most, float(drop[:, own].max()) - scores.amplitude.shape[-1])
    return most


def _steps(ranking: Ranking, scene: Scene, least: float) -> Iterator[_Place]:
    """Named steps that explain at least so much, each at its best instant."""
    for scores in ranking.scores:
        family = scores.family
        if family.n_terms > FREE:
            continue
        drop = np.where(scores.valid, scores.drop, -np.inf)
        for (_, form), own in family.by_driver_and_form().items():
            if form != "step":
                continue
            for g, s in np.argwhere(drop[:, own].max(axis=1) >= least):
                index = int(g), own[int(np.argmax(drop[g, own, s]))], int(s)
                hypothesis = member(family, index, scene)
                if family.groups[g].mark is None and hypothesis.entries:
                    yield _Place(family, index, hypothesis, float(drop[index]))


def _with_one_more(
    tests: ScoreTests,
    variance: float,
    places: list[_Place],
    instants: list[Instants],
    every: list[list[float]],
):
    """Instants with one more of `every`, and the hypotheses with their drop and amplitudes."""
    found = []
    # First the new one beside the others, then each of these beside it.
    for k in reversed(range(len(instants[0]) + 1)):
        asked = [
            _varied(own if found else (*own, own[-1]), k, at)
            for own, at in zip(instants, every, strict=True)
        ]
        families = tuple(p.jumping(own) for p, own in zip(places, asked, strict=True))
        scores = tests.about(families).score(variance).scores
        pairs = zip(scores, places, strict=True)
        found = [best_of(own, place.hypothesis, tests) for own, place in pairs]
        found = [
            # Where so many can't be told apart, any will do for the next ones.
            best or (replace(place.hypothesis, course=f.courses[0]), -np.inf, np.zeros(0))
            for best, place, f in zip(found, places, families, strict=True)
        ]
        instants = [hypothesis.course.constants for hypothesis, _, _ in found]
    return instants, found


def _varied(instants: Instants, k: int, every: list[float]) -> list[Instants]:
    """Sets of instants in which one stands at every place where no other does."""
    others = instants[:k], instants[k + 1 :]
    taken = {*others[0], *others[1]}
    return [(*others[0], at, *others[1]) for at in every if at not in taken]
