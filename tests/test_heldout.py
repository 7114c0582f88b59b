"""The held-out epochs' word: the odds of two forecasts, each with its own uncertainty."""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import board_recording, predicted, stereo_recording

from jaxvm.discover.accept import STRONG, _is_foretold, accept, is_determined
from jaxvm.discover.courses import Course
from jaxvm.discover.diagnose import _plain_fit, diagnose
from jaxvm.discover.groups import Group
from jaxvm.discover.heldout import HeldOut, gain, hold_out, split, weights_of
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.select import refit
from jaxvm.physics.catalogue import entries_for
from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.report.words import summary
from jaxvm.solve.covariance import effect_deviations
from jaxvm.solve.problem import scene_problem

FOCAL = (Term("sensor.focal"),)
CAMERA = Scope(camera=("cam",))
MARKS = each("mark", "target.point_z", numbers=range(30))
BOARD = Scope(target=("board",))
ROOM = 64, 8
FAINT = 6.9e-4
"""Drift of a focal length (1/s) that all epochs show and two thirds do not."""


def named(terms, kind: str, driver: str, form: str, scope: Scope) -> Hypothesis:
    """Terms in a course of a driver, with their names."""
    names = entries_for(terms, kind, (driver,), form)
    return Hypothesis(Group(terms, kind), Course(driver, form), scope, names)


AGES = named(FOCAL, "camera", "time", "linear", CAMERA)
DEPTHS = named(MARKS, "target", "constant", "constant", BOARD)


@pytest.fixture(scope="module")
def known():
    return board_recording(n_epochs=24)


def drawn(known, per_second: float, seed: int):
    """The split, the plain fit and that with the drift, of a camera whose focal length drifts."""
    drift = Effect("drift", FOCAL, "time", "linear", (), 0.0, CAMERA, (per_second,))
    return refitted(known, drift, AGES, seed)


def raised(known, metres: float, seed: int):
    """The same of a board whose marks stand at depths of their own, up to a few times so many."""
    depths = metres * np.random.default_rng(100 + seed).standard_normal(len(MARKS))
    true = Effect("depths", MARKS, "constant", "constant", (), 0.0, BOARD, tuple(depths))
    return refitted(known, true, DEPTHS, seed)


def refitted(known, true: Effect, hypothesis: Hypothesis, seed: int):
    """The split, the plain fit, that with the hypothesis, and the candidate that it is of."""
    truth = known.true_scene().with_effects((true,), ROOM)
    obs = known.recording.observations
    pixel = predicted(truth)
    pixel += obs.sigma[:, None] * np.random.default_rng(seed).standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    scene = known.true_scene(recording).with_effects((), ROOM)
    parts, before, _ = _plain_fit(scene, 3)
    before, _ = parts.proven(before)
    found = refit(before, hypothesis, np.zeros(hypothesis.n_columns), parts)
    assert found is not None
    after, _ = parts.proven(found.adjustment)
    return parts, before, after, found


def odds(parts, before, after) -> float:
    return parts.odds(before, parts.undivided(before.scene).fit(before.scene), after)


def stacked(problem, x):
    """All whitened residuals in one vector, pixels first."""
    return jnp.concatenate([jnp.ravel(block) for block in jax.tree.leaves(problem.residual(x))])


def log_density(scene, parts, variance: float) -> float:
    """2 ln p(held-out epochs | fitted ones), but for what all models have in common.

    By dense matrices: what the fitted epochs leave open of the unknowns widens the forecast; the
    poses of the held-out epochs are unknown.
    """
    problem = scene_problem(scene)
    at = np.zeros(problem.n)
    residual = np.asarray(stacked(problem, at))
    jacobian = np.asarray(jax.jacfwd(lambda x: stacked(problem, x))(at))
    held = np.zeros(len(residual), bool)
    begin = 0
    aside = weights_of(scene, parts.held, parts.sound)
    used = np.ones(len(residual), bool)
    for factor, weight in zip(scene.network.pixels, aside, strict=True):
        n = 2 * len(np.asarray(factor.weight))
        own = slice(begin, begin + 2 * len(weight))
        held[own] = np.repeat(weight > 0, 2)
        used[own] = np.repeat(np.concatenate(parts.sound) > 0, 2)
        begin += n
    fitted = used & ~held
    ours = ~np.any(jacobian[fitted] != 0.0, axis=0)
    theirs = ~ours & np.any(jacobian != 0.0, axis=0)
    ours &= np.any(jacobian[held] != 0.0, axis=0)
    known = jacobian[fitted][:, theirs]
    spread = np.linalg.inv(known.T @ known)
    # The fit is at its minimum: what is expected of the held-out residuals is what they are there.
    open_ = jacobian[held][:, theirs]
    total = variance * (np.eye(held.sum()) + open_ @ spread @ open_.T)
    free = jacobian[held][:, ours]
    weight = np.linalg.inv(total)
    normal = free.T @ weight @ free
    left = residual[held] - free @ np.linalg.solve(normal, free.T @ weight @ residual[held])
    determinants = np.linalg.slogdet(total)[1] + np.linalg.slogdet(normal)[1]
    return float(-left @ weight @ left - determinants)


@pytest.mark.parametrize("per_second", [0.0, 3e-4, 1e-3])
def test_the_odds_are_those_of_the_two_forecasts(known, per_second):
    parts, before, after, _ = drawn(known, per_second, seed=4)
    dense = [log_density(fit.scene, parts, after.variance_factor) for fit in (after, before)]
    assert odds(parts, before, after) == pytest.approx(dense[0] - dense[1], abs=0.05)


def test_noise_gets_odds_against_it_and_an_effect_odds_for_it(known):
    noise, effect = ([drawn_odds(known, size, k) for k in range(12)] for size in (0.0, 1e-3))
    assert np.mean(noise) < 0.0 and np.max(noise) < 6.0
    assert np.mean(effect) > 10.0 and np.mean(np.array(effect) > 0.0) > 0.9


def test_depths_of_marks_get_odds_for_them_where_there_are_any(known):
    """A forecast of thirty amounts is vague, but their spread is known."""
    both = [[raised(known, size, k) for k in range(8)] for size in (0.0, 1e-4)]
    noise, effect = ([odds(*fits) for *fits, _ in some] for some in both)
    assert np.max(noise) < 0.0 and np.min(effect) > 0.0
    *_, found = both[1][0]
    unnamed = replace(found, hypothesis=replace(found.hypothesis, entries=()))
    assert not _is_foretold(unnamed)


def test_odds_prove_depths_of_marks(known, monkeypatch):
    monkeypatch.setattr("jaxvm.discover.heldout.CONFIRMED", 1.1)
    parts, before, _, found = raised(known, 1e-4, 0)
    heldout = parts.evaluate(before.scene)
    leading = [(DEPTHS, found.evidence, found.amplitudes)]
    assert isinstance(accept(before, leading, parts, heldout, 0, set()), str)
    accepted = accept(before, leading, parts, heldout, 0, set(), ask_odds=True)
    assert not isinstance(accepted, str) and accepted.gain.odds > 0.0


@pytest.mark.parametrize("seed", [14, 18])
def test_odds_prove_what_errors_alone_can_not(known, seed, monkeypatch):
    parts, before, after, found = drawn(known, 8e-4, seed)
    heldout = parts.evaluate(before.scene)
    errors = gain(heldout, parts.evaluate(after.scene))
    assert not errors.proven and found.evidence > STRONG
    leading = [(AGES, found.evidence, found.amplitudes)]
    assert isinstance(accept(before, leading, parts, heldout, 0, set()), str)
    accepted = accept(before, leading, parts, heldout, 0, set(), ask_odds=True)
    assert not isinstance(accepted, str) and accepted.gain.odds > 0.0
    assert accepted.gain.probability == errors.probability
    monkeypatch.setattr("jaxvm.discover.accept.STRONG", 2.0 * found.evidence)
    assert isinstance(accept(before, leading, parts, heldout, 0, set(), ask_odds=True), str)


def test_who_promised_more_than_the_leading_one_kept_comes_before_it(known):
    """A step that was foretold as ten times what it is stands in for a trend no longer."""
    parts, before, _, found = drawn(known, 6e-3, seed=1)
    heldout, middle = parts.evaluate(before.scene), float(np.median(known.recording.time)) + 1e-3
    step = replace(AGES, course=Course("time", "step", (middle,)))
    candidate = refit(before, step, np.zeros(1), parts)
    assert candidate is not None and STRONG < candidate.evidence < 0.9 * found.evidence
    leading = [(step, 10.0 * found.evidence, np.zeros(1)), (AGES, found.evidence, np.zeros(1))]
    accepted = accept(before, leading, parts, heldout, 0, set())
    assert not isinstance(accepted, str) and accepted.chosen.hypothesis.same(AGES)
    alone = accept(before, leading[:1], parts, heldout, 0, set())
    assert not isinstance(alone, str) and alone.chosen.hypothesis.same(step)


def test_what_no_epoch_shows_has_no_size(known):
    parts, before, _, found = drawn(known, 8e-4, seed=14)
    late = Effect("late", FOCAL, "time", "step", (1e4,), 0.0, CAMERA, (0.0,))
    unseen = parts.fit(before.scene.with_effects((late,), (16, 8)))
    for candidate, determined in ((found, True), (replace(found, adjustment=unseen), False)):
        shown = parts.evaluate(candidate.adjustment.scene)
        assert is_determined(candidate, shown) is determined


def test_an_image_that_was_never_taken_needs_no_amount():
    known = stereo_recording()
    obs, cameras = known.recording.observations, known.recording.model.cameras
    left = next(k for k, camera in enumerate(cameras) if camera.name == "left")
    seen = ~((obs.camera == left) & (obs.epoch == 3))
    obs = replace(obs, **{f.name: getattr(obs, f.name)[seen] for f in fields(obs)})
    scene = known.true_scene(replace(known.recording, observations=obs))
    parts, plain, _ = _plain_fit(scene, 3)
    assert not parts.held[3]
    terms = each("epoch", "sensor.cx", "sensor.cy", numbers=range(6))
    camera, course = Scope(camera=("left",)), Course("constant", "constant")
    hypothesis = Hypothesis(Group(terms, "camera"), course, camera, ())
    candidate = refit(plain, hypothesis, np.zeros(len(terms)), parts)
    assert candidate is not None
    shown = parts.evaluate(candidate.adjustment.scene)
    completed = replace(candidate.adjustment, scene=shown.scene)
    sized = np.isfinite(effect_deviations(completed)[-1])
    assert sized.sum() == len(terms) - 2
    assert is_determined(candidate, shown)


def drawn_odds(known, per_second, seed):
    parts, before, after, _ = drawn(known, per_second, seed)
    return odds(parts, before, after)


def test_where_nothing_was_held_out_nothing_is_proven(known):
    nothing = np.zeros(0)
    before = HeldOut(0.0, nothing, nothing, 0.0, known.true_scene())
    found = gain(before, replace(before, range_square=-1.0))
    assert not found.proven and found.probability == 0.0 and found.share == 0.0


def test_with_nothing_set_aside_each_third_is_foretold_from_the_others(known):
    parts, *_ = drawn(known, 0.0, 0)
    scene = known.true_scene()
    whole = parts.undivided(scene)
    fitted = whole.fit(scene)
    crossed = whole.evaluate(fitted.scene)
    assert whole.judged.all() and np.array_equal(parts.judged, parts.held)
    for k in range(3):
        held = hold_out(scene, offset=k)
        assert np.array_equal(np.flatnonzero(held), np.arange(k, len(held), 3))
        part = split(scene, held, parts.sound)
        alone = part.evaluate(part.fit(scene).scene)
        np.testing.assert_allclose(crossed.square[held], alone.square, rtol=1e-4)
        assert np.array_equal(crossed.count[held], alone.count)
    # An error of a forecast is more than that of a fit.
    inside = sum(float(np.sum(np.asarray(b) ** 2)) for b in fitted.residuals().pixels)
    assert crossed.total > inside


def test_a_second_look_finds_what_two_thirds_do_not_show(known):
    """A focal length that drifts: chi-square is expected to drop by 37 in all epochs."""
    drift = Effect("drift", FOCAL, "time", "linear", (), 0.0, CAMERA, (FAINT,))
    obs = known.recording.observations
    still, moving = (
        predicted(known.true_scene().with_effects(effects, ROOM)) for effects in ((), (drift,))
    )
    noise = obs.sigma[:, None] * np.random.default_rng(5).standard_normal(still.shape)
    nothing, found = (
        diagnose(replace(known.recording, observations=replace(obs, pixel=pixel + noise)))
        for pixel in (still, moving)
    )
    assert nothing.verdict == "consistent" and not nothing.second_look
    assert np.array_equal(nothing.held, hold_out(nothing.scene))
    assert found.second_look and found.held.all()
    (finding,) = found.findings
    assert (finding.effect.terms, finding.effect.scope) == (FOCAL, CAMERA)
    assert finding.p_value <= 0.005 and finding.gain.proven
    assert "at a second look, with all of them" in summary(found)
