"""A gain whose course may follow its quantity in several forms: intervals that hold the truth."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.averaged import with_forms
from jaxvm.discover.diagnose import _spreads
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording import Drivers
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import effect_deviations

GAIN, N_EPOCHS = 1.5e-3, 24


@dataclass(frozen=True)
class Told:
    """Of a finding, what the average needs."""

    final_effect: Effect
    final_stds: tuple[float, ...]
    noise: float = 1.0
    stds: tuple[float, ...] = ()


def bent(form: str, late: tuple[float, ...], gain: float) -> Effect:
    terms, board = (Term("target.bow_x"),), Scope(target=("board",))
    return Effect("it bends", terms, "ambient_degC", form, late, 20.0, board, (gain,))


def averaged(seed: int, chosen: str, swings: tuple[float, ...], gain: float = GAIN):
    """Errors of a lag's gain over its standard deviation without other forms, and with them.

    The air swings so many times in the recording.
    """
    known = board_recording(seed, n_epochs=N_EPOCHS)
    span = np.ptp(known.recording.time)
    log = np.linspace(-1.0 * span, 1.1 * span, 120)
    air = 20.0 + 3.0 * sum(np.sin(2.0 * np.pi * n * log / span) for n in swings)
    late = (0.1 * span,)
    recording = replace(known.recording, drivers=Drivers(log, {"ambient_degC": air}))
    real = known.true_scene(recording).with_effects((bent("lag", late, gain),), (8, 4))
    obs, rng = recording.observations, np.random.default_rng(seed)
    pixel = predicted(real)
    pixel += obs.sigma[:, None] * rng.standard_normal(pixel.shape)
    recording = replace(recording, observations=replace(obs, pixel=pixel))
    start = bent(chosen, late, gain)
    scene = known.true_scene(recording).with_effects((start,), (8, 4))
    weights = tuple(np.ones(len(rows)) for rows in scene.tables)
    final = adjust(scene, weights=weights, rtol=1e-8, check=False)
    (effect,), (stds,) = final.scene.fitted_effects(), effect_deviations(final)
    found = with_forms(final, Told(effect, stds), 0, weights)
    error = effect.amplitudes[0] - gain
    return error / stds[0], error / found.final_stds[0]


def test_a_dead_time_that_may_as_well_be_a_lag():
    """Of a single sine both make a later one; the lag makes it smaller, too, by another gain."""
    z = np.array([averaged(seed, "delay", (1.1,), 0.2 * GAIN) for seed in range(12)])
    alone, both = np.abs(z).T
    assert np.all(alone > 3.0), alone
    assert np.all(both < 2.5), both


def test_where_the_recording_tells_the_form_nothing_is_widened():
    for seed in range(3):
        alone, both = averaged(seed, "lag", (1.1, 3.7), 5.0 * GAIN)
        assert both == pytest.approx(alone, rel=1e-6)
        assert abs(both) < 3.5


def test_what_has_no_gain_is_left_alone():
    effect = bent("rate", (), GAIN)
    found = Told(effect, (1e-5,))
    assert with_forms(None, found, 0, ()) is found  # type: ignore[arg-type]


def test_amplitudes_beside_a_constant_that_was_held_are_no_better_known():
    """A mark that settles for ever is a ramp: its whole way and its time constant go together."""
    effect = Effect("it settles", (Term("target.bow_x"),), "time", "settling", (60.0, 9e4))
    found = Told(effect, (), stds=(2e-3, 15.0, 8e5))
    held = _spreads(found, effect, np.array([4e-5, 0.0, 0.0]), np.full(3, 4.0), np.zeros(3))
    assert held == (2e-3, 15.0, 8e5)
    free = _spreads(found, effect, np.array([4e-5, 3.0, 2e2]), np.full(3, 4.0), np.zeros(3))
    np.testing.assert_allclose(free, (8e-5, 6.0, 4e2))
    # An instant of a jump is never refined: the size of the jump is its own.
    jump = Effect("it jumps", (Term("target.bow_x"),), "time", "step", (60.0,))
    found = Told(jump, (), stds=(9e-5, 15.0))
    assert _spreads(found, jump, np.array([4e-5, 0.0]), np.ones(2), np.zeros(2)) == (4e-5, 15.0)
