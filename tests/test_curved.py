"""A dome beside the pupil, of which the tangent foretells little, is tried where it may be."""

import numpy as np
import pytest
from networks import board_recording

from jaxvm.discover.courses import Course
from jaxvm.discover.curved import with_curved
from jaxvm.discover.diagnose import _plain_fit
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.physics.effects import Scope, Term
from jaxvm.solve.snooping import robust_variance

AT = Scope(camera=("cam",))
DOME = tuple(Term(f"medium.dome_{axis}") for axis in "xyz")

SKEW = Hypothesis(Group((Term("sensor.skew"),), "camera"), Course("constant", "constant"), AT, ())
CREEP = Hypothesis(Group((Term("mount.turn_x"),), "camera"), Course("time", "linear"), AT, ())


@pytest.fixture(scope="module")
def board():
    """The plain fit to a board before one camera, and the scores of all hypotheses."""
    scene = board_recording().true_scene().with_effects((), (16, 8))
    _, plain, _ = _plain_fit(scene, 3)
    tests = ScoreTests.of(plain, enumerate_hypotheses(plain.scene))
    return plain, tests.score(robust_variance(plain))


def test_a_camera_that_errs_always_may_stand_behind_a_dome(board):
    plain, ranking = board
    leading = [(CREEP, 60.0, np.zeros(1)), (SKEW, 50.0, np.zeros(1)), (CREEP, 40.0, np.zeros(1))]
    first, (dome, foretold, amplitudes), own, last = with_curved(leading, ranking, plain.scene)
    assert [first, own, last] == leading
    assert (dome.group.terms, dome.scope, foretold) == (DOME, AT, 50.0)
    assert "window-off-centre" in {entry.id for entry in dome.entries}
    np.testing.assert_array_equal(amplitudes, np.zeros(3))


def test_where_an_error_that_never_changes_was_found_no_dome_is_tried(board):
    plain, ranking = board
    leading = [(SKEW, 50.0, np.zeros(1))]
    assert with_curved(leading, ranking, plain.scene, [SKEW]) == leading
    assert len(with_curved(leading, ranking, plain.scene, [CREEP])) == 2


def test_what_changes_or_is_tried_already_brings_no_dome(board):
    plain, ranking = board
    moving = [(CREEP, 50.0, np.zeros(1))]
    assert with_curved(moving, ranking, plain.scene) == moving
    again = with_curved([(SKEW, 50.0, np.zeros(1))], ranking, plain.scene)
    assert with_curved(again, ranking, plain.scene) == again
    assert with_curved([], ranking, plain.scene) == []
