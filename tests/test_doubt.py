"""Doubts about a course: what is left at its ports, and what else was needed at its place."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from jaxvm.discover.courses import Course
from jaxvm.discover.doubt import DOUBT, doubted
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Family
from jaxvm.discover.ranking import Ranking, Scores
from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.effects import Effect, Scope, Term

LEFT, RIGHT = Scope(camera=("left",)), Scope(camera=("right",))
SWAYS = Effect(
    "sways", (Term("mount.turn_x"),), "time", "periodic", (100.0,), 0.0, LEFT, (1e-4, 0.0)
)
WARMS = replace(SWAYS, terms=(Term("sensor.focal"),), driver="air_degC", form="linear")
WARMS = replace(WARMS, constants=(), amplitudes=(1e-5,))
JUMPS = Effect(
    "jumps",
    each("epoch", "sensor.cx", numbers=range(12)),
    "constant",
    "constant",
    (),
    0.0,
    LEFT,
    (0.1,) * 12,
)


@dataclass(frozen=True)
class Claim:
    effect: Effect
    drop: float = 100.0
    weight: float = 1.0
    rivals: tuple = ()


@dataclass(frozen=True)
class Left:
    """What the last scores leave."""

    at: float = 1.0
    harmonics: float = 1.0

    def left_at(self, ports, scope):
        return self.at

    def left_in_harmonics(self, effect):
        return self.harmonics


def weights(*effects, left=None, significant=False, drops=None):
    claims = [Claim(e, d) for e, d in zip(effects, drops or [100.0] * len(effects), strict=True)]
    return [claim.weight for claim in doubted(claims, left or Left(), significant)]


def test_a_course_of_which_nothing_is_left_is_sure():
    assert weights(SWAYS) == [1.0]
    assert weights(SWAYS, WARMS) == [1.0, 1.0]


@pytest.mark.parametrize(
    "doubt", [{"significant": True}, {"left": Left(at=0.01)}, {"left": Left(harmonics=0.01)}]
)
def test_what_is_left_speaks_against_it(doubt):
    assert weights(SWAYS, **doubt) == [1.0 - DOUBT]


@pytest.mark.parametrize(
    "other",
    [
        replace(SWAYS, driver="air_degC", form="linear", constants=()),  # the same port
        replace(WARMS, driver="time"),  # the same driver
        JUMPS,  # every image
    ],
)
def test_another_at_the_same_place_may_be_the_rest_of_it(other):
    # The free form comes after, and explains less.
    drops = [100.0, 10.0]
    assert weights(SWAYS, other, drops=drops)[0] == 1.0 - DOUBT
    assert weights(SWAYS, replace(other, scope=RIGHT), drops=drops)[0] == 1.0


def test_two_that_never_change_are_not_one_course():
    still = replace(SWAYS, driver="constant", form="constant", constants=(), amplitudes=(1e-4,))
    other = replace(still, terms=(Term("sensor.focal"),))
    assert weights(still, other) == [1.0, 1.0]


def test_a_free_form_that_explains_more_leaves_no_name_sure():
    assert weights(WARMS, replace(JUMPS, scope=RIGHT), drops=[10.0, 100.0])[0] == 1.0 - DOUBT


def test_what_is_left_at_many_ports_is_one_family():
    """Two hundred repetitions, forty groups: what none of them gives is as rare as one in 200."""
    n_groups, repetitions = 40, 199
    groups = tuple(
        Group((Term("sensor.focal", f"pattern {k}"),), "camera") for k in range(n_groups)
    )
    family = Family(
        groups=groups,
        courses=(Course("constant", "constant"),),
        scopes=(LEFT, RIGHT),
        valid=np.ones((n_groups, 1, 2), bool),
        kinds=("constant",),
        asked=(1,),
        named={},
    )
    null = np.random.default_rng(0).chisquare(1, (n_groups, repetitions))
    z = np.full((n_groups, 1, 2), 1.0)
    shape = (n_groups, 1, 2)

    def left(largest: float, scope: Scope = LEFT) -> float:
        own = z.copy()
        own[7, 0, 0] = largest
        scores = Scores(family, own, own, own[..., None], own, null, np.ones(shape, bool), 1.0)
        return Ranking((scores,), null.max(axis=0)).left_at({"sensor.focal"}, scope)

    assert left(1e3) == 1.0 / (repetitions + 1)
    # The largest of forty, half of the time.
    assert left(float(np.median(null.max(axis=0)))) == pytest.approx(0.5, abs=0.02)
    assert left(1e3, RIGHT) > 0.9
    assert left(1e3, Scope(camera=("none",))) == 1.0
