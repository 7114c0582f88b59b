"""Data snooping: redundancy, the w-test, and the gross errors that it finds."""

from dataclasses import replace

import numpy as np
import pytest
from networks import adjusted, free_points_recording
from scipy.stats import chi2, kstest

from jaxvm.solve.adjust import adjust
from jaxvm.solve.snooping import image_point_tests, redundancy, robust_variance, snoop

NAMES = ["board", "stereo", "points"]


@pytest.mark.parametrize("name", NAMES)
def test_redundancy_numbers(name):
    _, result = adjusted(name)
    blocks = redundancy(result)
    total = sum(float(np.trace(b, axis1=1, axis2=2).sum()) for b in blocks)
    assert total == pytest.approx(result.degrees_of_freedom, rel=1e-8)
    for block in blocks:
        assert np.allclose(block, np.swapaxes(block, 1, 2), atol=1e-9)
        eigen = np.linalg.eigvalsh(block)
        assert eigen.min() > -1e-8 and eigen.max() < 1 + 1e-8
        numbers = np.diagonal(block, axis1=1, axis2=2)
        assert (numbers > 0).all()
    for block in blocks[: len(result.scene.tables)]:
        assert (np.diagonal(block, axis1=1, axis2=2) < 1).all()


def w_values(result) -> np.ndarray:
    """Standardised residuals of all image coordinates."""
    values = []
    for block, r in zip(redundancy(result), result.residuals().pixels, strict=False):
        values.append((np.asarray(r) / np.sqrt(np.diagonal(block, axis1=1, axis2=2))).ravel())
    return np.concatenate(values)


@pytest.mark.parametrize("name", NAMES)
def test_w_of_clean_data_is_standard_normal(name):
    _, result = adjusted(name)
    w = w_values(result)
    assert kstest(w, "norm").pvalue > 0.01
    assert abs(w.mean()) < 4 / np.sqrt(len(w))
    assert np.std(w) == pytest.approx(1.0, abs=4 / np.sqrt(2 * result.degrees_of_freedom))
    tests = np.concatenate(image_point_tests(result))
    assert kstest(tests, chi2(2).cdf).pvalue > 0.01
    assert robust_variance(result) == pytest.approx(1.0, abs=0.25)


@pytest.fixture(scope="module")
def network():
    known = free_points_recording()
    return known, adjusted("points")[1]


def with_gross_error(known, row: int, component: int, sigmas: float):
    obs = known.recording.observations
    pixel = obs.pixel.copy()
    pixel[row, component] += sigmas * obs.sigma[row]
    return replace(known.recording, observations=replace(obs, pixel=pixel))


@pytest.mark.parametrize("row", [3, 31, 58, 77, 104, 149])
def test_gross_error_of_six_sigma_is_the_largest(network, row):
    known, clean = network
    component = row % 2
    # Signed as the noise is, so that noise does not hide it.
    position = int(np.flatnonzero(clean.scene.tables[0] == row)[0])
    noise = -float(np.asarray(clean.residuals().pixels[0])[position, component])
    recording = with_gross_error(known, row, component, 6.0 if noise > 0 else -6.0)
    result = adjust(known.true_scene(recording))
    w = np.abs(w_values(result)).reshape(-1, 2)
    worst = np.unravel_index(np.argmax(w), w.shape)
    assert (result.scene.tables[0][worst[0]], worst[1]) == (row, component)
    assert w.max() > 3.29
    assert np.argmax(image_point_tests(result)[0]) == position


def test_error_shows_in_its_residual_by_its_redundancy(network):
    """v changes by -r times the error: the meaning of a redundancy number."""
    known, clean = network
    position, size = 40, 3.0
    row = int(clean.scene.tables[0][position])
    result = adjust(known.true_scene(with_gross_error(known, row, 0, size)))
    before, after = (np.asarray(a.residuals().pixels[0])[position] for a in (clean, result))
    numbers = redundancy(clean)[0][position]
    assert np.allclose(after - before, -size * numbers[:, 0], atol=0.02)


def test_snooping_rejects_the_gross_errors_and_nothing_else():
    known, clean = adjusted("board")
    rows = [12, 90]
    recording = known.recording
    for row in rows:
        recording = with_gross_error(replace(known, recording=recording), row, 0, 12.0)
    result, rejected, weights = snoop(known.true_scene(recording), alpha=1e-4, scale=1.0)
    assert sorted(r.row for r in rejected) == rows
    for found in rejected:
        obs, model = recording.observations, recording.model
        target = model.targets[obs.target[found.row]]
        for word in (
            f"camera {model.cameras[obs.camera[found.row]].name},",
            f"target {target.name},",
            f"point {target.point_names[obs.point[found.row]]},",
            f"epoch {recording.epoch_ids[obs.epoch[found.row]]}",
        ):
            assert word in found.where
        assert found.test > chi2.isf(1e-4, 2)
    assert np.sum(weights[0] == 0) == len(rows)
    assert set(result.scene.tables[0][weights[0] == 0]) == set(rows)
    # Two marks with two coordinates each no longer count.
    assert result.degrees_of_freedom == clean.degrees_of_freedom - 2 * len(rows)
    assert result.variance_factor == pytest.approx(clean.variance_factor, abs=0.1)


def test_snooping_leaves_clean_data_alone(network):
    known, clean = network
    result, rejected, _ = snoop(known.true_scene(), alpha=1e-5, scale=1.0)
    assert rejected == []
    assert result.cost == pytest.approx(clean.cost, rel=1e-9)


def test_redundancies_of_rejected_observations_do_not_count(network):
    """Redundancy still adds up to the degrees of freedom when something is set aside."""
    known, _ = network
    scene = known.true_scene()
    weights = np.ones(len(scene.tables[0]))
    weights[[5, 6, 50]] = 0.0
    result = adjust(scene, weights=(weights,))
    total = sum(float(np.trace(b, axis1=1, axis2=2).sum()) for b in redundancy(result))
    assert total == pytest.approx(result.degrees_of_freedom, rel=1e-8)
