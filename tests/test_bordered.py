"""Scores beside further effects, by what these take of what is known, against all of it anew."""

from dataclasses import replace

import numpy as np
import pytest
from networks import stereo_recording

from jaxvm.discover import score
from jaxvm.discover.curves import curve_constants
from jaxvm.discover.noise import random_signs
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.network.residual import residual
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording.recording import Drivers
from jaxvm.solve.adjust import adjust

AIR, LEFT = "ambient_degC", Scope(camera=("left",))
CENTRE = (Term("sensor.cx"), Term("sensor.cy"))
WALK = Effect("walk", CENTRE, AIR, "linear", (), 20.0, LEFT, (0.08, -0.06))
LAG = Effect("lag", CENTRE, AIR, "lag", (300.0,), 20.0, LEFT, (0.2, -0.15))
FOCAL = Effect("focal", (Term("sensor.focal"),), "time", "linear", (), 0.0, amplitudes=(1e-7,))
KNOTS = curve_constants(18.0, 23.0)
CURVE = Effect(
    "curve", (Term("sensor.focal"),), AIR, "curve", KNOTS, 0.0, LEFT, (0.0,) * 6 + (6e-4,) * 6
)


@pytest.fixture(scope="module")
def known():
    """A stereo pair at its truth: its scene, over forty minutes in which the air changes."""
    known = stereo_recording()
    time = 480.0 * np.arange(len(known.recording.time))
    air = 20.0 + np.array([0.0, 2.0, 3.0, -1.0, -2.0, 1.5])
    recording = replace(known.recording, time=time, drivers=Drivers(time, {AIR: air}))
    return known, recording


@pytest.fixture(scope="module")
def families(known):
    """Every third family of hypotheses: all kinds of groups and courses are among them."""
    return enumerate_hypotheses(adjusted(known).scene)[::3]


def adjusted(known, *effects):
    """The fit without any effect to what is measured where there are some."""
    truth, recording = known
    scene = truth.true_scene(recording)
    there = scene.with_effects(effects)
    observations = recording.observations
    pixel, sigma = observations.pixel.copy(), observations.sigma[:, None]
    blocks = [residual(s.state, s.network).pixels for s in (there, scene)]
    for rows, new, old in zip(scene.tables, *blocks, strict=True):
        pixel[rows] += (np.asarray(new) - np.asarray(old))[: len(rows)] * sigma[rows]
    changed = replace(recording, observations=replace(observations, pixel=pixel))
    return adjust(truth.true_scene(changed))


def fitted(plain, *effects):
    return adjust(plain.scene.with_effects(effects, (16, 8)), rtol=1e-10)


@pytest.mark.parametrize(
    "effects",
    [(WALK,), (LAG,), (FOCAL, WALK), (replace(CURVE, spread=2e-4),)],
    ids=["two columns", "a constant", "two effects", "prior"],
)
def test_a_border_says_what_all_anew_says(known, families, effects):
    """Drops, sizes, validity, and the null distribution."""
    plain = adjusted(known, *effects)
    tests, fit = ScoreTests.of(plain, families), fitted(plain, *effects)
    signs = random_signs(len(fit.scene.recording.time), 19, 0)
    tests.score(1.0, signs)
    beside, anew = tests.at(fit), ScoreTests.of(fit, families)
    assert beside.plain is tests
    one, other = beside.score(1.0, signs), anew.score(1.0, signs)
    np.testing.assert_allclose(one.null, other.null, rtol=0.05)
    compared = 0
    for a, b in zip(one.scores, other.scores, strict=True):
        assert np.mean(a.valid != b.valid) < 0.01
        # What is nearly absorbed is what the curvature of the model leaves of it. Of many columns
        # some always are.
        both = a.valid & b.valid & (b.seen > 1e-2)
        few = a.amplitude.shape[-1] < 5
        np.testing.assert_allclose(a.drop[both], b.drop[both], rtol=0.03 if few else 0.3, atol=0.1)
        np.testing.assert_allclose(a.seen[both], b.seen[both], rtol=0.02)
        compared += both.sum()
    assert compared > 1000
    # It is not that nothing has changed.
    before = tests.score(1.0)
    assert before.best_z() > 2.0 * one.best_z()


def test_nothing_kept_gives_the_same(known, families, monkeypatch):
    """Where there are too many unknowns to keep what they see of each course."""
    plain = adjusted(known, WALK)
    fit, signs = fitted(plain, WALK), random_signs(6, 19, 0)
    firsts, found = [], []
    for most in (score._MOST_KEPT, 0):
        monkeypatch.setattr(score, "_MOST_KEPT", most)
        tests = ScoreTests.of(plain, families)
        firsts.append(tests.score(1.0, signs))
        found.append(tests.at(fit).score(1.0, signs))
    for a, b in zip(firsts[0].scores, firsts[1].scores, strict=True):
        # What little is left of what the shared unknowns take nearly all of counts, too.
        np.testing.assert_allclose(a.null, b.null, rtol=1e-5)
    np.testing.assert_allclose(found[0].null, found[1].null, rtol=1e-4)
    for a, b in zip(found[0].scores, found[1].scores, strict=True):
        np.testing.assert_allclose(a.z[a.valid], b.z[a.valid], rtol=1e-9)


def test_it_is_all_anew_where_it_must(known, families):
    """A way that is not straight, other effects, other weights; and again from the first fit."""
    large = replace(WALK, amplitudes=(25.0, -20.0))
    plain = adjusted(known, large)
    tests = ScoreTests.of(plain, families)
    curved = tests.at(fitted(plain, large))
    assert curved.plain is None and curved.first is tests

    straight = adjusted(known, WALK, FOCAL)
    tests = ScoreTests.of(straight, families)
    assert tests.at(straight) is tests
    with_walk = ScoreTests.of(fitted(straight, WALK), families)
    assert with_walk.at(fitted(straight, FOCAL)).plain is None
    assert with_walk.at(fitted(straight, WALK, FOCAL)).plain is with_walk
    # One observation less, which lies where it is foretold.
    weights = tuple(np.ones(len(rows)) for rows in straight.scene.tables)
    block = np.asarray(straight.residuals().pixels[0])
    weights[0][np.argmin(np.linalg.norm(block, axis=1))] = 0.0
    some = adjust(straight.scene.with_effects((WALK,)), weights=weights)
    assert tests.at(some).plain is None
    # The search may have begun anew at a fit whose effects are not those of the next one.
    later = replace(with_walk, first=tests)
    assert later.at(fitted(straight, FOCAL)).plain is tests


def test_patterns_of_the_phase_within_a_pixel_are_those_of_the_fit(known):
    """The image moves by a third of a pixel with what was found, and every phase with it."""
    every = enumerate_hypotheses(adjusted(known).scene)
    phases = {"pixel_u", "pixel_v"}
    locked = tuple(
        replace(f, groups=tuple(f.groups[g] for g in own), valid=f.valid[own])
        for f in every
        if (
            own := [
                g for g, group in enumerate(f.groups) if phases & {t.driver for t in group.terms}
            ]
        )
    )
    assert locked
    plain = adjusted(known, WALK)
    tests, fit = ScoreTests.of(plain, locked), fitted(plain, WALK)
    before = tests.score(1.0).scores
    beside, anew = tests.at(fit), ScoreTests.of(fit, locked)
    assert beside.plain is tests and phases <= beside.new
    held = 0.0
    for a, b, old in zip(beside.score(1.0).scores, anew.score(1.0).scores, before, strict=True):
        both = a.valid & b.valid & old.valid & (b.seen > 1e-2)
        np.testing.assert_allclose(a.drop[both], b.drop[both], rtol=0.02, atol=0.05)
        held = max(held, float(np.abs(old.seen[both] - b.seen[both]).max(initial=0.0)))
    # With the phases of the plain fit they would be others.
    assert held > 1e-3
