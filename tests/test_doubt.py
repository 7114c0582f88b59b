"""Doubts about a course: what is left at its ports, and what else was needed at its place."""

from dataclasses import dataclass, replace

import pytest

from jaxvm.discover.doubt import DOUBT, doubted
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
