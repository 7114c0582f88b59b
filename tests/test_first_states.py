"""Lags that did not start in equilibrium: the constants of the last fit are right all the same."""

from dataclasses import replace

import numpy as np
from networks import board_recording

from jaxvm.discover.first_states import first_states, with_first_states
from jaxvm.network.residual import predict_pixels
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording import Drivers
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import effect_deviations

SHARE, SIZE, N_EPOCHS = 0.12, 1.5e-3, 30
BOARD = Scope(target=("board",))


def recorded(seed: int, state: float):
    """True scene of a board that bends with a lag, from `state` metres off equilibrium."""
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
    pixel = np.zeros(obs.pixel.shape)
    for rows, own in zip(truth.tables, predict_pixels(truth.state, truth.network), strict=True):
        pixel[rows] = np.asarray(own)[: len(rows)]
    pixel += obs.sigma[:, None] * np.random.default_rng(seed).standard_normal(pixel.shape)
    recording = replace(recording, observations=replace(obs, pixel=pixel))
    settled = replace(bent, form="lag", amplitudes=(SIZE,))
    return known.true_scene(recording).with_effects((settled,), (8, 4)), bent


def off(fitted, true: Effect) -> tuple[float, float]:
    """How many standard deviations size and time constant are off."""
    effect, stds = fitted.scene.fitted_effects()[0], effect_deviations(fitted)[0]
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
