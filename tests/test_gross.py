"""Single wrong marks are set aside, all of them and no others; physics is not."""

import importlib
from dataclasses import dataclass, replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.diagnose import _laid_bare, _searched
from jaxvm.discover.gross import without_gross_errors
from jaxvm.discover.heldout import Split, hold_out, split
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.solve.adjust import Adjustment

N_EPOCHS = 30


@pytest.fixture(scope="module")
def known():
    """A board of 30 marks in 30 epochs."""
    return board_recording(n_epochs=N_EPOCHS)


def cleaned(known, pixel: np.ndarray):
    """The fit of the recording with these pixels, before and after, and its splits."""
    obs = known.recording.observations
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    scene = known.true_scene(recording)
    sound = tuple(np.ones(len(rows)) for rows in scene.tables)
    parts = split(scene, hold_out(scene), sound)
    fitted = parts.fit(scene)
    return (fitted, parts), without_gross_errors(fitted, parts)


def set_aside(fitted, parts) -> np.ndarray:
    """Rows of the recording that are set aside."""
    tables = zip(fitted.scene.tables, parts.sound, strict=True)
    return np.sort(np.concatenate([rows[own == 0] for rows, own in tables]))


def test_exactly_the_wrong_marks_are_set_aside(known):
    """0.5 % of the marks 5 px to 50 px off, in fitted and in held-out epochs, two in one image."""
    obs = known.recording.observations
    rng = np.random.default_rng(2)
    n = len(obs.epoch)
    wrong = rng.choice(n, round(0.005 * n), replace=False)
    neighbours = np.flatnonzero((obs.epoch == obs.epoch[wrong[0]]) & (obs.point < 4))
    wrong = np.unique(np.append(wrong, neighbours[0]))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(wrong))
    size = np.geomspace(5.0, 50.0, len(wrong))
    pixel = obs.pixel.copy()
    pixel[wrong] += size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    (spoiled, all_parts), (fitted, parts, count) = cleaned(known, pixel)
    assert len(set(obs.epoch[wrong] % 3 == 2)) == 2
    assert spoiled.variance_factor > 5.0
    assert count == len(wrong)
    assert np.array_equal(set_aside(fitted, parts), wrong)
    assert fitted.converged, fitted.why
    dof = fitted.degrees_of_freedom
    assert abs(fitted.variance_factor - 1.0) < 4.0 * np.sqrt(2.0 / dof)
    # What is fitted are the sound marks of the same epochs as before.
    assert np.array_equal(parts.held, all_parts.held)
    assert parts.n == all_parts.n - 2 * int(np.sum(obs.epoch[wrong] % 3 != 2))
    # And the wrong ones in the held-out epochs don't spoil the proof.
    proof = parts.evaluate(fitted.scene)
    assert proof.square.sum() / proof.count.sum() < 1.5


def test_a_mark_that_is_displaced_in_all_epochs_stays(known):
    """A mark that stands elsewhere on the board is physics."""
    obs = known.recording.observations
    pixel = obs.pixel + np.where(obs.point == 17, 1.0, 0.0)[:, None] * [6.0, -4.0]
    (first, _), (fitted, parts, count) = cleaned(known, pixel)
    assert count == 0 and len(set_aside(fitted, parts)) == 0
    assert first.variance_factor > 3.0
    assert fitted.variance_factor == pytest.approx(first.variance_factor, rel=1e-6)


def test_a_wrong_mark_beside_a_displaced_one_goes_alone(known):
    obs = known.recording.observations
    pixel = obs.pixel + np.where(obs.point == 17, 1.0, 0.0)[:, None] * [6.0, -4.0]
    wrong = np.flatnonzero((obs.epoch == 4) & (obs.point == 3))
    pixel[wrong] += [-30.0, 20.0]
    _, (fitted, parts, count) = cleaned(known, pixel)
    assert count == 1 and np.array_equal(set_aside(fitted, parts), wrong)


def test_sound_marks_all_stay(known):
    (first, all_parts), (fitted, parts, count) = cleaned(known, known.recording.observations.pixel)
    assert count == 0
    assert fitted is first and parts is all_parts
    assert abs(fitted.variance_factor - 1.0) < 4.0 * np.sqrt(2.0 / fitted.degrees_of_freedom)


def test_errors_that_are_set_aside_are_not_laid_bare_again(known):
    pixel = known.recording.observations.pixel.copy()
    pixel[[100, 500]] += 20.0
    _, (fitted, parts, count) = cleaned(known, pixel)
    assert count == 2

    @dataclass
    class Found:
        current: Adjustment
        parts: Split
        findings: tuple = ("one",)

    same, new = _laid_bare(Found(fitted, parts))  # pyright: ignore[reportArgumentType]
    assert new == 0 and same is parts


@pytest.mark.parametrize("beginnings", [2, 1])
def test_what_an_effect_conceals_is_set_aside_when_it_is_found(known, beginnings, monkeypatch):
    """By beginning again without it, or where the search stands if it may not begin again."""
    module = importlib.import_module("jaxvm.discover.diagnose")
    monkeypatch.setattr(module, "_BEGINNINGS", beginnings)
    obs, rng = known.recording.observations, np.random.default_rng(7)
    bent = Effect(
        "bent", (Term("target.bow_x"),), "constant", "constant", (), 0.0,
        Scope(target=("board",)), (6e-3,),
    )  # fmt: skip
    pixel = predicted(known.true_scene().with_effects((bent,), (8, 4)))
    pixel += obs.sigma[:, None] * rng.standard_normal(pixel.shape)
    wrong = np.sort(rng.choice(len(pixel), 8, replace=False))
    pixel[wrong] += rng.choice([-4.0, 4.0], (8, 2))
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    scene = known.true_scene(recording).with_effects((), (16, 8))
    told: list[str] = []
    found, plain, _, count = _searched(scene, 3, 0.01, 0, 8, told.append)
    assert np.array_equal(set_aside(plain, found.parts), wrong) and count == len(wrong)
    assert sum("beginning again" in line for line in told) == beginnings - 1
    (finding,) = found.findings
    assert finding.hypothesis.entries[0].id == "target-bow"
    assert abs(finding.effect.amplitudes[0] - 6e-3) < 5.0 * finding.stds[0]
    assert abs(found.current.variance_factor - 1.0) < 0.15
