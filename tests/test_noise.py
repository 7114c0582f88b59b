"""The memory of noise against AR(1) series, and random multipliers against their covariance."""

import numpy as np
import pytest
from long_series import N_EPOCHS, autoregressive, long_board, of_marks

from jaxvm.discover.noise import LONGEST, REMEMBERED, memory, multipliers


@pytest.fixture(scope="module")
def scene():
    return long_board()


def test_white_residuals_do_not_remember(scene):
    n = len(scene.recording.observations.epoch)
    found = [
        memory(scene, np.random.default_rng(seed).standard_normal((n, 2))) for seed in range(30)
    ]
    # Three standard deviations, twice: one in several hundred is beyond by chance.
    assert found.count(1) >= 29


@pytest.mark.parametrize("phi", [0.3, 0.6])
def test_memory_ends_where_the_correlation_does(scene, phi):
    """But for two epochs: where it ends is where an estimate falls below a threshold."""
    expected = int(np.ceil(np.log(REMEMBERED) / np.log(phi)))
    for seed in range(5):
        courses = autoregressive(np.random.default_rng(seed), phi, (N_EPOCHS, 30, 2))
        assert abs(memory(scene, of_marks(scene, courses)) - expected) <= 2


def test_memory_grows_with_the_correlation_up_to_a_share_of_the_recording(scene):
    found = []
    for phi in (0.0, 0.3, 0.6, 0.8, 0.95):
        courses = autoregressive(np.random.default_rng(7), phi, (N_EPOCHS, 30, 2))
        found.append(memory(scene, of_marks(scene, courses)))
    assert found[0] == 1
    assert found == sorted(found) and len(set(found[:4])) == 4
    assert max(found) <= LONGEST * N_EPOCHS


def test_what_a_whole_view_remembers_counts_too(scene):
    """Each mark alone is white but for 4 % of its variance; the mean of the view tells."""
    rng = np.random.default_rng(3)
    white = rng.standard_normal((N_EPOCHS, 30, 2))
    common = 0.2 * autoregressive(rng, 0.8, (N_EPOCHS, 1, 2))
    assert memory(scene, of_marks(scene, white)) == 1
    assert memory(scene, of_marks(scene, white + common)) > 1


def test_a_constant_offset_of_a_mark_is_no_memory(scene):
    rng = np.random.default_rng(4)
    white = rng.standard_normal((N_EPOCHS, 30, 2))
    assert memory(scene, of_marks(scene, white + 50.0 * rng.standard_normal((1, 30, 2)))) == 1


def test_epochs_that_were_not_fitted_are_left_out(scene):
    courses = autoregressive(np.random.default_rng(5), 0.6, (N_EPOCHS, 30, 2))
    residual = of_marks(scene, courses)
    held = scene.recording.observations.epoch % 3 == 2
    residual[held] = np.nan
    assert 4 <= memory(scene, residual) <= 8
    assert memory(scene, np.full_like(residual, np.nan)) == 1


def test_independent_multipliers_are_signs():
    for window in (0, 1):
        signs = multipliers(12, window, 20_000, 0)
        assert signs.shape == (12, 20_000)
        assert set(np.unique(signs)) == {-1.0, 1.0}
        assert np.abs(signs @ signs.T / 20_000 - np.eye(12)).max() < 5 / np.sqrt(20_000)


@pytest.mark.parametrize("window", [2, 4, 9])
def test_multipliers_have_a_triangular_covariance(window):
    n, repetitions = 14, 40_000
    values = multipliers(n, window, repetitions, 1)
    assert values.shape == (n, repetitions)
    apart = np.abs(np.arange(n)[:, None] - np.arange(n))
    triangle = np.maximum(1.0 - apart / window, 0.0)
    # A sampled covariance of Gaussians has the variance (1 + rho^2) / n.
    assert np.abs(values.mean(axis=1)).max() < 5 / np.sqrt(repetitions)
    assert np.abs(values @ values.T / repetitions - triangle).max() < 5 * np.sqrt(2 / repetitions)


@pytest.mark.parametrize("window", [1, 5])
def test_the_seed_gives_the_multipliers(window):
    first, again, other = (multipliers(30, window, 8, seed) for seed in (3, 3, 4))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
