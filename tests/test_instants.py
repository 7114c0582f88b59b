"""Instants of steps: sought in every gap, and open on the side of a held-out epoch."""

from dataclasses import replace

import numpy as np
import pytest
from networks import board_recording

from jaxvm.discover import courses
from jaxvm.discover.constants import other_instants, run_away
from jaxvm.discover.courses import gaps
from jaxvm.discover.diagnose import _plain_fit
from jaxvm.discover.heldout import evaluate
from jaxvm.discover.instants import best_instant, step_at_every_gap
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import shortlist
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.network.residual import predict_pixels
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.solve.snooping import robust_variance

N_EPOCHS = 80
MARK = Scope(target=("board",), point=("1/1",))


def slipped(instant):
    """A mark that slips by 0.4 mm."""
    terms = (Term("target.point_x"), Term("target.point_y"))
    return Effect("it slips", terms, "time", "step", (instant,), 0.0, MARK, (3e-4, -3e-4))


@pytest.fixture(scope="module")
def recorded():
    """Recording, its truth, and the gap in which the mark slips; epoch 50 is held out."""
    known = board_recording(n_epochs=N_EPOCHS)
    plain = known.true_scene()
    middles = gaps("time", plain.network.channels)
    instant = float(middles[47])  # between epochs 49 and 50: two gaps are left out at the start
    truth = plain.with_effects((slipped(instant),), (8, 4))
    obs = known.recording.observations
    pixel = np.zeros(obs.pixel.shape)
    for rows, own in zip(truth.tables, predict_pixels(truth.state, truth.network), strict=True):
        pixel[rows] = np.asarray(own)[: len(rows)]
    pixel += obs.sigma[:, None] * np.random.default_rng(5).standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    return known.true_scene(recording), instant


def test_the_gap_is_found_between_points_of_the_grid(recorded, monkeypatch):
    monkeypatch.setattr(courses, "_MOST_INSTANTS", 8)
    scene, instant = recorded
    parts, plain, _ = _plain_fit(scene, 3)
    tests = ScoreTests.of(plain, enumerate_hypotheses(plain.scene))
    variance = robust_variance(plain)
    ranking = tests.score(variance)
    leading = shortlist(ranking, plain.scene, variance, parts.n, 12)
    step = next(item for item in leading if item[0].course.form == "step")
    finer = step_at_every_gap(tests, ranking, step[0], variance)
    assert finer is not None
    best = best_instant(finer, step[0], tests)
    assert best is not None
    hypothesis, drop, amplitudes = best
    pause = np.median(np.diff(gaps("time", scene.network.channels)))
    on_grid = max(
        float(s.drop[g, c, k])
        for s in ranking.scores
        for g, c, k in np.argwhere(s.valid)
        if s.family.courses[c].form == "step" and s.family.groups[g] == step[0].group
    )
    # The fitted epochs leave open on which side epoch 50 lies.
    assert abs(step[0].course.constants[0] - instant) > 1.5 * pause
    assert abs(hypothesis.course.constants[0] - instant) < 1.5 * pause
    assert drop > on_grid + 20.0
    np.testing.assert_allclose(amplitudes, (3e-4, -3e-4), atol=6e-5)


def test_a_held_out_epoch_takes_its_own_side(recorded):
    scene, instant = recorded
    parts, _, _ = _plain_fit(scene, 3)
    assert parts.held[50] and not parts.held[[49, 51]].any()
    pause = float(np.median(np.diff(gaps("time", scene.network.channels))))
    shown = {}
    for late in (-1, 0, 1, 2):
        other = scene.with_effects((slipped(instant + late * pause),), (8, 4))
        shown[late] = evaluate(other, parts.held, parts.sound).total
    # Fitted epochs lie on both sides of epoch 50 alone.
    assert shown[1] == pytest.approx(shown[0], rel=1e-6)
    assert min(shown[-1], shown[2]) > shown[0] - 1e-6 * shown[0]


def test_other_instants_cross_epochs_that_were_not_fitted(recorded):
    scene, instant = recorded
    scene = scene.with_effects((slipped(instant),), (8, 4))
    fitted = np.ones(N_EPOCHS, bool)
    assert not list(other_instants(scene, fitted))
    fitted[50] = False
    (later,) = other_instants(scene, fitted)
    assert later.effects[0].constants[0] > instant
    fitted[49] = False
    assert len(list(other_instants(scene, fitted))) == 2


def test_constants_that_run_away_are_seen(recorded):
    scene, instant = recorded
    lag = Effect(
        "it lags", (Term("sensor.focal"),), "time", "onset", (instant,), 0.0, Scope(), (0,)
    )
    before = scene.with_effects((lag,), (8, 4))
    after = scene.with_effects((replace(lag, constants=(-1.0,)),), (8, 4))
    assert run_away(before, after) and not run_away(before, before)
    assert not run_away(after, after)
