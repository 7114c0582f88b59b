"""Robust losses: their closed forms, and adjustments with gross errors."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import adjusted, free_points_recording, nudged
from scipy.integrate import quad

from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import standard_deviations
from jaxvm.solve.robust import CauchyLoss, HuberLoss, SquaredLoss, TukeyLoss

CLOSED_FORMS = {
    SquaredLoss: lambda e, t: 1.0,
    HuberLoss: lambda e, t: 1.0 if e <= t else t / e,
    CauchyLoss: lambda e, t: 1.0 / (1.0 + (e / t) ** 2),
    TukeyLoss: lambda e, t: (1.0 - (e / t) ** 2) ** 2 if e <= t else 0.0,
}
"""Weight of a residual of e standard deviations."""

THRESHOLDS = {HuberLoss: 2.0, CauchyLoss: 2.0, TukeyLoss: 6.0}

SIZES = np.array([0.0, 1e-3, 0.3, 0.999, 1.001, 2.0, 2.5, 5.9, 6.1, 40.0])


@pytest.mark.parametrize("kind", CLOSED_FORMS)
@pytest.mark.parametrize("threshold", [1.0, 2.5, 6.0])
def test_weight_is_its_closed_form(kind, threshold):
    loss = kind() if kind is SquaredLoss else kind(threshold)
    weight = np.asarray(loss.weight(jnp.asarray(SIZES**2)))
    expected = [CLOSED_FORMS[kind](e, threshold) for e in SIZES]
    assert np.allclose(weight, expected, rtol=1e-12)
    assert ((weight >= 0) & (weight <= 1)).all()


@pytest.mark.parametrize("kind", CLOSED_FORMS)
def test_value_is_the_integral_of_the_weight(kind):
    threshold = 2.0
    loss = kind() if kind is SquaredLoss else kind(threshold)
    for e in SIZES:
        # rho(s) = integral of the weight over the squared residual.
        pieces = [0.0, min(e, threshold), e]
        expected = sum(
            quad(lambda r: CLOSED_FORMS[kind](r, threshold) * 2 * r, a, b, epsabs=1e-12)[0]
            for a, b in zip(pieces, pieces[1:], strict=False)
        )
        assert float(loss.value(jnp.asarray(e**2))) == pytest.approx(expected, rel=1e-8, abs=1e-10)
    squares = jnp.asarray(SIZES**2)
    slope = jax.vmap(jax.grad(lambda s: loss.value(s)))(squares)
    assert np.allclose(slope, loss.weight(squares), rtol=1e-10)
    assert np.isfinite(np.asarray(slope)).all()


@pytest.fixture(scope="module")
def spoiled():
    """3 % of the marks of the network of free points are 20 px to 60 px off."""
    known = free_points_recording()
    obs = known.recording.observations
    rng = np.random.default_rng(6)
    n = len(obs.point)
    wrong = rng.choice(n, round(0.03 * n), replace=False)
    angle = rng.uniform(0, 2 * np.pi, len(wrong))
    error = rng.uniform(20, 60, len(wrong))[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    pixel = obs.pixel.copy()
    pixel[wrong] += error
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    return known, recording, wrong


def scores(known, result):
    """Errors of the free parameters in the standard deviations of clean data."""
    sd = np.asarray(standard_deviations(adjusted("points")[1]).flatten())
    true = np.asarray(known.true_scene().state.flatten())
    return ((np.asarray(result.scene.state.flatten()) - true)[sd > 0]) / sd[sd > 0]


def test_least_squares_is_spoiled(spoiled):
    known, recording, _ = spoiled
    result = adjust(nudged(known, known.true_scene(recording), 1e-3))
    assert np.abs(scores(known, result)).max() > 30
    assert result.variance_factor > 30


@pytest.mark.parametrize("kind", [HuberLoss, CauchyLoss, TukeyLoss])
def test_robust_adjustment_resists(spoiled, kind):
    known, recording, wrong = spoiled
    loss = kind(jnp.asarray(THRESHOLDS[kind]))
    # A redescending loss needs a start within its threshold, as everywhere.
    size = 1e-4 if kind is TukeyLoss else 1e-3
    result = adjust(nudged(known, known.true_scene(recording), size), loss=loss)
    assert result.converged, result.why
    clean = scores(known, adjusted("points")[1])
    robust = scores(known, result)
    assert np.abs(robust).max() < 6.0
    assert np.sqrt(np.mean(robust**2)) < 1.5 * np.sqrt(np.mean(clean**2))
    # The weights point at the marks that are wrong.
    square = np.sum(np.asarray(result.residuals().pixels[0]) ** 2, axis=1)
    weight = np.asarray(loss.weight(jnp.asarray(square)))
    rows = result.scene.tables[0]
    order = rows[np.argsort(weight)]
    assert set(order[: len(wrong)]) == set(wrong)
    assert result.cost == pytest.approx(
        0.5 * float(np.sum(np.asarray(loss.value(jnp.asarray(square))))), rel=1e-9
    )


def test_wide_threshold_is_least_squares(spoiled):
    known, _, _ = spoiled
    plain = adjusted("points")[1]
    result = adjust(known.true_scene(), loss=HuberLoss(jnp.asarray(1e6)))
    assert result.cost == pytest.approx(plain.cost, rel=1e-10)
