"""Lags from a log that is not all: what was before it, and errors of its samples."""

from dataclasses import replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.first_states import first_states, with_first_states
from jaxvm.discover.inputs import sample_error, variances_by_inputs
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording import Drivers
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import effect_deviations

SHARE, SIZE, N_EPOCHS = 0.12, 1.5e-3, 30
BOARD = Scope(target=("board",))


def recorded(seed: int, state: float, log_error: float = 0.0):
    """True scene of a board that bends with a lag, from `state` metres off equilibrium.

    The samples of the log err by `log_error` kelvin.
    """
    known = board_recording(seed, n_epochs=N_EPOCHS)
    time = known.recording.time
    span = np.ptp(time)
    log = np.linspace(-0.1 * span, 1.1 * span, 60)
    air = 20.0 + 3.0 * np.sin(2.0 * np.pi * log / (0.8 * span))
    recording = replace(known.recording, drivers=Drivers(log, {"ambient_degC": air}))
    bent = Effect(
        "it bends",
        (Term("target.bow_x"),),
        "ambient_degC",
        "lag with state",
        (SHARE * span,),
        20.0,
        BOARD,
        (SIZE, state),
    )
    truth = known.true_scene(recording).with_effects((bent,), (8, 4))
    obs = recording.observations
    pixel = predicted(truth)
    pixel += obs.sigma[:, None] * np.random.default_rng(seed).standard_normal(pixel.shape)
    read = air + log_error * np.random.default_rng([seed, 1]).standard_normal(len(air))
    recording = replace(
        known.recording,
        observations=replace(obs, pixel=pixel),
        drivers=Drivers(log, {"ambient_degC": read}),
    )
    settled = replace(bent, form="lag", amplitudes=(SIZE,))
    return known.true_scene(recording).with_effects((settled,), (8, 4)), bent


def off(fitted, true: Effect, more: float | np.ndarray = 0.0) -> tuple[float, float]:
    """How many standard deviations size and time constant are off; `more` are further variances."""
    effect = fitted.scene.fitted_effects()[0]
    stds = np.sqrt(np.square(effect_deviations(fitted)[0]) + more)
    found = np.array([effect.amplitudes[0], effect.constants[0]])
    errors = (found - [true.amplitudes[0], true.constants[0]]) / stds
    return float(errors[0]), float(errors[1])


def test_an_uncertain_first_state_mends_the_constants():
    assumed, allowed = [], []
    for seed in range(6):
        scene, true = recorded(seed, state=4e-3)
        settled = adjust(scene, rtol=1e-8)
        assumed.append(off(settled, true))
        allowed.append(off(adjust(with_first_states(settled.scene), rtol=1e-8), true))
    # Equilibrium at first, which was not so, costs the time constant many standard deviations.
    assert np.abs(np.array(assumed)[:, 1]).min() > 4.0
    assert np.abs(allowed).max() < 3.5
    assert np.sqrt(np.mean(np.square(allowed))) < 1.6


def test_an_uncertain_first_state_of_a_settled_lag_changes_nothing_but_the_spread():
    scene, true = recorded(3, state=0.0)
    settled = adjust(scene, rtol=1e-8)
    allowed = adjust(with_first_states(settled.scene), rtol=1e-8)
    assert np.abs(off(settled, true)).max() < 3.5
    assert np.abs(off(allowed, true)).max() < 3.5
    assert effect_deviations(allowed)[0][1] > effect_deviations(settled)[0][1]


def test_the_spread_is_what_the_driver_did():
    scene, true = recorded(0, state=0.0)
    (state,) = first_states(scene.effects[0], scene.network.channels)
    channels = scene.network.channels
    values = np.asarray(channels.values)[channels.index("ambient_degC")]
    np.testing.assert_allclose(state.spread, SIZE * np.ptp(values))
    assert state.shares == true.name


def test_errors_of_a_log_widen_what_follows_it():
    alone, both = [], []
    for seed in range(10):
        scene, true = recorded(seed, state=0.0, log_error=0.25)
        fitted = adjust(scene, rtol=1e-8)
        alone.append(off(fitted, true))
        both.append(off(fitted, true, variances_by_inputs(fitted)[0]))
    assert np.sqrt(np.mean(np.square(alone))) > 2.0
    assert 0.5 < np.sqrt(np.mean(np.square(both))) < 1.5


def test_a_log_without_errors_widens_nothing():
    scene, _ = recorded(1, state=0.0)
    fitted = adjust(scene, rtol=1e-8)
    own = np.square(effect_deviations(fitted)[0])
    assert (variances_by_inputs(fitted)[0] < 0.01 * own).all()


@pytest.mark.parametrize("error", [0.003, 0.02, 0.3])
def test_error_of_samples_beside_a_smooth_course(error):
    time = np.arange(200.0)
    smooth = 20.0 + 3.0 * np.sin(2.0 * np.pi * time / 80.0)
    read = smooth + error * np.random.default_rng(4).standard_normal(200)
    np.testing.assert_allclose(sample_error(read), error, rtol=0.25)
    steps = np.round(smooth / (4.0 * error)) * 4.0 * error
    np.testing.assert_allclose(sample_error(steps), 4.0 * error / np.sqrt(12.0), rtol=0.6)
