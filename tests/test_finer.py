"""Constants that no refit moves, sought between the points of the grid; instants of steps."""

from dataclasses import replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover import courses
from jaxvm.discover.constants import constants_held, jumps_of, other_instants, run_away
from jaxvm.discover.courses import Course, gaps
from jaxvm.discover.diagnose import _plain_fit
from jaxvm.discover.finer import at_finer_constants, best_of, said, scores_about
from jaxvm.discover.groups import Group
from jaxvm.discover.heldout import evaluate, split
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.search import Search
from jaxvm.discover.select import Weighing, refit, shortlist
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording.recording import Drivers
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import effect_deviations
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
    pixel = predicted(truth)
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
    leading = shortlist(ranking, plain.scene, Weighing(variance, parts.n), 12)
    step = next(item for item in leading if item[0].course.form == "step")
    finer = scores_about(tests, ranking, step[0], variance)
    assert finer is not None
    best = best_of(finer.scores[0], step[0], tests)
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
    (jump,) = jumps_of(scene)
    assert not list(other_instants(scene, jump, fitted))
    fitted[50] = False
    (later,) = other_instants(scene, jump, fitted)
    assert later.effects[0].constants[0] > instant
    fitted[49] = False
    assert len(list(other_instants(scene, jump, fitted))) == 2


def test_every_jump_has_other_sides_of_its_own(recorded):
    scene, instant = recorded
    twice = replace(
        slipped(instant), form="2 jumps", constants=(50.0, instant), amplitudes=4 * (0,)
    )
    scene = scene.with_effects((slipped(100.0), twice), (8, 4))
    assert jumps_of(scene) == [(0, 0), (1, 0), (1, 1)]
    fitted = np.arange(N_EPOCHS) != 50
    assert not list(other_instants(scene, (1, 0), fitted))
    (later,) = other_instants(scene, (1, 1), fitted)
    assert later.effects[1].constants[0] == 50.0 and later.effects[1].constants[1] > instant
    assert later.effects[0] == scene.effects[0]


def test_constants_that_run_away_are_seen(recorded):
    scene, instant = recorded
    lag = Effect(
        "it lags", (Term("sensor.focal"),), "time", "onset", (instant,), 0.0, Scope(), (0,)
    )
    before = scene.with_effects((lag,), (8, 4))
    after = scene.with_effects((replace(lag, constants=(-1.0,)),), (8, 4))
    assert run_away(before, after) and not run_away(before, before)
    assert not run_away(after, after)


def test_a_fit_to_all_epochs_keeps_a_constant_that_would_run_away(recorded):
    # A jump that is said to settle: no time constant is short enough.
    scene, instant = recorded
    settling = replace(slipped(instant), form="settling", constants=(instant, 2.0))
    scene = scene.with_effects((settling,), (8, 4))
    parts, _, _ = _plain_fit(scene.with_effects((), (8, 4)), 3)
    free = adjust(scene, weights=parts.sound, check=False)
    assert run_away(scene, free.scene)
    final = split(scene, np.zeros(N_EPOCHS, bool), parts.sound).fit(scene)
    assert final.scene.fitted_effects()[0].constants == (instant, 2.0)
    assert np.isfinite(effect_deviations(final)).all()
    # The size is fitted all the same.
    sizes = np.abs(final.scene.fitted_effects()[0].amplitudes)
    np.testing.assert_allclose(sizes, 3e-4, atol=1e-4)


def test_what_was_found_keeps_its_constants_free_beside_a_new_one(recorded):
    scene, instant = recorded
    terms = (Term("sensor.focal"),)
    lag = Effect("it lags", terms, "time", "onset", (instant,), 0.0, Scope(), (1e-4,))
    both = scene.with_effects((lag, replace(lag, name="it lags, too")), (8, 4))
    own, new = both.unknowns.column[both.network.layout.all("constant")][:2]
    assert both.unknowns.active[[own, new]].all()
    held = constants_held(both, since=1)
    assert held[own] and not held[new]
    others = np.setdiff1d(np.arange(len(held)), [new])
    assert np.array_equal(held[others], both.unknowns.active[others])
    assert not constants_held(both)[[own, new]].any()


# --- stairs and plays -----------------------------------------------------------------------------


def with_hidden(form, constants, terms, amplitudes, scope, driver="ambient_degC"):
    """A board with something hidden, that follows the logged air or nothing, not in the model.

    Its camera is so quiet that little is enough, and the model is as good as linear in it.
    """
    known = board_recording(n_epochs=N_EPOCHS)
    span = float(np.ptp(known.recording.time))
    t = np.linspace(-0.05 * span, 1.05 * span, 400)
    air = 20.0 + 6.0 * np.sin(9.0 * t / span) + 2.0 * np.sin(31.0 * t / span)
    drivers = Drivers(t, {"ambient_degC": air})
    plain = known.true_scene(replace(known.recording, drivers=drivers))
    own = Effect("it", terms, driver, form, constants, 20.0, scope, amplitudes)
    truth = plain.with_effects((own,), (8, 4))
    obs = known.recording.observations
    obs = replace(obs, sigma=0.1 * obs.sigma)
    pixel = predicted(truth)
    pixel += obs.sigma[:, None] * np.random.default_rng(5).standard_normal(pixel.shape)
    observations = replace(obs, pixel=pixel)
    return known.true_scene(replace(plain.recording, observations=observations))


@pytest.mark.parametrize(
    ("form", "constants", "terms", "amplitudes", "scope"),
    [
        (
            "hysteresis with state", (3.7, 1.9),
            (Term("target.bow_x"),), (1e-6, 3e-5), Scope(target=("board",)),
        ),
        (
            "staircase", (1.77, 0.19),
            (Term("sensor.focal"),), (4e-4,), Scope(camera=("cam",)),
        ),
    ],
)  # fmt: skip
def test_constants_are_found_between_points_of_the_grid(form, constants, terms, amplitudes, scope):
    """What fits best between the points of the grid fits better than the best on it."""
    scene = with_hidden(form, constants, terms, amplitudes, scope)
    parts, plain, _ = _plain_fit(scene, 3)
    tests = ScoreTests.of(plain, enumerate_hypotheses(plain.scene))
    ranking = tests.score(robust_variance(plain))
    weigh = Weighing.at(plain, ranking, parts.n)
    leading = shortlist(ranking, plain.scene, weigh, 12)
    own = next(
        item for item in leading
        if (item[0].course.form, item[0].group.terms, item[0].scope) == (form, terms, scope)
    )  # fmt: skip
    finer, about = at_finer_constants(leading, tests, ranking, weigh)
    best = next(item for item in finer if item[0].group.terms == terms and item[0].scope == scope)
    assert best[0].course.form == form
    assert best[1] > own[1] + 5.0
    assert best[0].course.constants[0] == pytest.approx(constants[0], rel=0.05)
    assert said(best[0]) in about


def test_seams_of_a_sensor_are_found_between_those_of_the_grid():
    """Three fields, the outer two shifted by a tenth of a pixel against the middle one."""
    seams, shifts = (-0.09, 0.17), (0.1, -0.05, -0.12, 0.08)
    terms = tuple(
        Term(f"detect.{axis}", "column", "step", (at,)) for at in seams for axis in "uv"
    )  # fmt: skip
    scene = with_hidden("constant", (), terms, shifts, Scope(camera=("cam",)), "constant")
    parts, plain, _ = _plain_fit(scene, 3)
    search = Search(parts, *parts.proven(plain), 0)
    search.run(3, lambda line: None)
    (found,) = search.findings
    assert found.hypothesis.entries[0].id == "sensor-stitched"
    nearest = sorted({*(term.constants[0] for term in found.hypothesis.group.terms)})
    assert np.abs(np.array(nearest) - seams).max() < 0.0151
    np.testing.assert_allclose(found.effect.amplitudes, shifts, atol=0.03)


@pytest.mark.parametrize("flat_at, form", [(21.27, "linear"), (0.0, "affine")])
def test_what_follows_the_air_from_a_reference_of_its_own_is_one_effect(flat_at, form):
    """The mean over the recording, 21.27 degrees, is but a guess of where nothing was bent."""
    scope, slope = Scope(target=("board",)), 1e-5
    amplitudes = (-slope * flat_at, slope)
    scene = with_hidden("affine", (), (Term("target.bow_x"),), amplitudes, scope)
    parts, plain, _ = _plain_fit(scene, 3)
    plain, heldout = parts.proven(plain)
    search = Search(parts, plain, heldout, 0)
    search.run(3, lambda line: None)
    (found,) = search.findings
    assert found.hypothesis.entries[0].id == "target-bends"
    assert (found.hypothesis.course.driver, found.hypothesis.course.form) == ("ambient_degC", form)


# --- large steps ----------------------------------------------------------------------------------


@pytest.mark.parametrize("off", [-3, -1, 2])
def test_a_step_is_refitted_beyond_epochs_that_fit_badly(off):
    """A first instant that is some epochs off costs no second jump."""
    known = board_recording(n_epochs=N_EPOCHS)
    plain = known.true_scene()
    middles = gaps("time", plain.network.channels)
    bent = Hypothesis(
        Group((Term("target.bow_x"),), "target"),
        Course("time", "step", (float(middles[40]),)),
        Scope(target=("board",)),
        (),
    )
    obs = known.recording.observations
    truth = plain.with_effects((bent.effect((3e-3,)),), (8, 4))
    pixel = predicted(truth)
    pixel += obs.sigma[:, None] * np.random.default_rng(5).standard_normal(pixel.shape)
    scene = known.true_scene(replace(known.recording, observations=replace(obs, pixel=pixel)))
    parts, fitted, _ = _plain_fit(scene, 3)
    other = replace(bent, course=replace(bent.course, constants=(float(middles[40 + off]),)))
    found = refit(fitted, other, np.zeros(1), parts)
    assert found is not None
    # The fitted epochs leave open on which side of the step a held-out one lies.
    (instant,) = found.effect.constants
    at = np.asarray(scene.network.channels.epoch_time)[~parts.held]
    assert np.sum(at > instant) == np.sum(at > middles[40])
    np.testing.assert_allclose(found.effect.amplitudes, (3e-3,), rtol=0.02)
