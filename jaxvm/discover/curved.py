"""Physics that no tangent foretells, because nearly all of it hides in what the model knows.

A dome whose middle is beside the pupil turns rays by tens of pixels, and principal point, pose and
distortion take up nearly all of that. What they leave is of the second order in the offset: at no
offset its derivative is next to nothing, while a fit finds it from there at once.
"""

from collections.abc import Sequence

import numpy as np

from jaxvm.discover.finer import Leading
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.ranking import Ranking
from jaxvm.discover.space import member
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Scope

_CURVED = frozenset({"medium.dome_x", "medium.dome_y", "medium.dome_z"})
"""Ports of what is fitted whatever its tangent foretells."""

_FOREMOST = 4
"""Leading hypotheses of which one must say that a camera errs always."""


def with_curved(
    leading: Leading, ranking: Ranking, scene: Scene, known: Sequence[Hypothesis] = ()
) -> Leading:
    """The leading ones, and before one that says that a camera errs always what may be behind it.

    It counts as foretold as well as that one, whose name it may turn out to be. Where something
    that never changes was found at the camera (`known`) it had its turn: beside a window and a map
    of the image a dome takes any place, and fits creep.
    """
    seen = {other.scope for other in known if other.course.form == "constant"}
    for k, (hypothesis, foretold, _) in enumerate(leading[:_FOREMOST]):
        scope = hypothesis.scope
        if hypothesis.course.form != "constant" or not scope.camera or scope in seen:
            continue
        for found, amplitudes in _at(ranking, scope, scene):
            if not any(h.same(found) for h, *_ in leading):
                return [*leading[:k], (found, foretold, amplitudes), *leading[k:]]
    return leading


def _at(ranking: Ranking, scope: Scope, scene: Scene):
    """Hypotheses about curved ports in a scope, and amplitudes to begin with.

    Those, too, of which the scores say that the model takes up everything.
    """
    for scores in ranking.scores:
        family = scores.family
        for g, group in enumerate(family.groups):
            if {term.port for term in group.terms} == _CURVED:
                for c, s in np.argwhere(family.valid[g]):
                    if family.scopes[s] == scope:
                        index = (g, int(c), int(s))
                        yield member(family, index, scene), np.zeros(len(group.terms))
