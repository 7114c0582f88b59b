"""What a recording could have shown, the least that would be found, and what it can't show."""

from collections.abc import Iterator

import numpy as np
from scipy.special import ndtri

from jaxvm.discover.ranking import Ranking, Scores
from jaxvm.discover.space import member
from jaxvm.network.scene import Scene
from jaxvm.physics.catalogue import entries_of
from jaxvm.physics.ports import PORTS


def smallest_visible(
    ranking: Ranking, variance: float, scene: Scene
) -> dict[str, tuple[float, str]]:
    """Smallest amplitude that would be found at family-wise 5 % with power 80 %, by entry.

    sqrt(lambda0 / I) with I the information of one column (MATHEMATICS 1.8); lambda0 from the
    number of hypotheses. Hypotheses of one column, constant or linear in a driver; the most
    favourable place counts.
    """
    level = -ndtri(0.025 / max(ranking.n, 1)) - ndtri(0.2)
    unit = {port.name: port.unit for port in PORTS}
    smallest: dict[str, tuple[float, str]] = {}
    for scores in ranking.scores:
        if scores.amplitude.shape[-1] != 1:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            # One-step amplitude a = S / I and drop S^2 / I give the information drop / a^2.
            information = scores.drop / scores.amplitude[..., 0] ** 2
            detectable = level * np.sqrt(variance / information)
        detectable = np.where(scores.valid & np.isfinite(detectable), detectable, np.inf)
        for g in range(len(scores.family.groups)):
            for c, course in enumerate(scores.family.courses):
                s = int(np.argmin(detectable[g, c]))
                known = course.form in ("constant", "linear")
                if not known or not np.isfinite(detectable[g, c, s]):
                    continue
                hypothesis = member(scores.family, (g, c, s), scene)
                for entry in hypothesis.entries:
                    key = (
                        f"{entry.id} ({course.driver})" if course.driver != "constant" else entry.id
                    )
                    value = float(detectable[g, c, s])
                    if key not in smallest or value < smallest[key][0]:
                        smallest[key] = (value, unit[hypothesis.group.terms[0].port])
    return smallest


def absorbed(ranking: Ranking, scene: Scene) -> tuple[str, ...]:
    """Entries of the catalogue that a recording can't show: the model's unknowns take them over.

    They were asked, of some body and along some course, and no hypothesis of theirs leaves more
    than rounding (or is carried by enough epochs) beside the unknowns. Whether they are there is
    another recording's question.

    Args:
        ranking: scores at the fit of the plain model; findings would take over their doubles.
        scene: of that fit.
    """
    # Most hypotheses show: only the names of those that don't are looked for among the others.
    lost: set[str] = set()
    for scores, places, asked, shown in _kinds(ranking):
        for g, s in np.argwhere(asked & ~shown):
            lost |= _names(scores, g, places, s, scene)
    for scores, places, _, shown in _kinds(ranking) if lost else ():
        for g, group in enumerate(scores.family.groups):
            if lost & {entry.id for entry in entries_of(group.terms, group.entity)}:
                for s in np.flatnonzero(shown[g]).tolist():
                    lost -= _names(scores, g, places, s, scene)
    return tuple(sorted(lost))


def _kinds(ranking: Ranking) -> Iterator[tuple[Scores, list[int], np.ndarray, np.ndarray]]:
    """Courses that differ in their constants alone; which [groups, scopes] were asked, and show."""
    for scores in ranking.scores:
        for places in scores.family.by_driver_and_form().values():
            asked = np.asarray(scores.family.valid[:, places].any(axis=1))
            yield scores, places, asked, np.asarray(scores.valid[:, places].any(axis=1))


def _names(scores: Scores, g: int, places: list[int], s: int, scene: Scene) -> set[str]:
    index = int(g), places[0], int(s)
    return {entry.id for entry in member(scores.family, index, scene).entries}
