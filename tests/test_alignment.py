"""Absolute orientation against known transforms, scipy and a brute-force minimum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxvm.geometry import align

align_scaled = jax.jit(lambda a, b, w: align(a, b, w, with_scale=True))
align_rigid = jax.jit(align)


def situation(seed, n=12, flat=False):
    """Points, a rotation, a shift, a scale, and weights."""
    rng = np.random.default_rng(seed)
    b = rng.normal(size=(n, 3)) * [2.0, 1.0, 0.0 if flat else 0.5] + [5.0, -3.0, 10.0]
    rotation = Rotation.random(rng=rng).as_matrix()
    return rng, b, rotation, rng.normal(size=3) * 4.0, rng.uniform(0.5, 2.0), rng.uniform(0.1, 3, n)


@pytest.mark.parametrize("flat", [False, True], ids=["solid", "flat"])
@pytest.mark.parametrize("seed", range(5))
def test_recovers_a_known_similarity(seed, flat):
    """Also from points in a plane, where a reflection would fit just as well."""
    _, b, rotation, shift, scale, weights = situation(seed, flat=flat)
    pose, got_scale = align_scaled(scale * b @ rotation.T + shift, b, weights)
    np.testing.assert_allclose(pose.rotation, rotation, atol=1e-13)
    np.testing.assert_allclose(pose.shift, shift, atol=1e-12)
    assert got_scale == pytest.approx(scale, rel=1e-13)


@pytest.mark.parametrize("seed", range(3))
def test_recovers_a_known_rigid_transform_from_three_points(seed):
    _, b, rotation, shift, *_ = situation(seed, n=3)
    pose, scale = align_rigid(b @ rotation.T + shift, b)
    np.testing.assert_allclose(pose.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(pose.shift, shift, atol=1e-12)
    assert scale == 1.0


@pytest.mark.parametrize("seed", range(5))
def test_noisy_points_get_the_rotation_of_scipy(seed):
    rng, b, rotation, shift, _, weights = situation(seed)
    a = b @ rotation.T + shift + 0.2 * rng.normal(size=b.shape)
    pose, _ = align_rigid(a, b, weights)
    mean_a, mean_b = np.average(a, 0, weights), np.average(b, 0, weights)
    expected, _ = Rotation.align_vectors(a - mean_a, b - mean_b, weights=weights)
    np.testing.assert_allclose(pose.rotation, expected.as_matrix(), atol=1e-13)
    np.testing.assert_allclose(pose.shift, mean_a - expected.apply(mean_b), atol=1e-12)


def test_the_sum_of_squares_is_a_minimum_in_all_seven_unknowns():
    rng, b, rotation, shift, scale, weights = situation(11)
    a = scale * b @ rotation.T + shift + 0.3 * rng.normal(size=b.shape)

    def sum_of_squares(p):
        turned = Rotation.from_rotvec(p[:3]).as_matrix()
        return np.sum(weights[:, None] * (a - (p[6] * b @ turned.T + p[3:6])) ** 2)

    pose, got = align_scaled(a, b, weights)
    turn = Rotation.from_matrix(np.array(pose.rotation)).as_rotvec()
    found = np.concatenate([turn, pose.shift, [got]])
    best = minimize(sum_of_squares, found + 0.01, method="BFGS", options={"gtol": 1e-7})
    assert sum_of_squares(found) <= best.fun + 1e-9
    np.testing.assert_allclose(found, best.x, atol=1e-4)


def test_mirrored_points_still_give_a_proper_rotation():
    """A mirror image has no rotation that fits; the best one has det +1, as scipy's."""
    _, b, rotation, *_ = situation(4)
    a = b @ np.diag([1.0, 1.0, -1.0]) @ rotation.T
    pose, _ = align_rigid(a, b)
    assert np.linalg.det(pose.rotation) == pytest.approx(1.0)
    expected, _ = Rotation.align_vectors(a - a.mean(0), b - b.mean(0))
    np.testing.assert_allclose(pose.rotation, expected.as_matrix(), atol=1e-12)


def test_points_of_weight_zero_do_not_count():
    _, b, rotation, shift, scale, _ = situation(6)
    a = scale * b @ rotation.T + shift
    a[:2] += 100.0
    weights = np.ones(len(b))
    weights[:2] = 0.0
    pose, got = align_scaled(a, b, weights)
    np.testing.assert_allclose(pose.rotation, rotation, atol=1e-12)
    assert got == pytest.approx(scale, rel=1e-12)


def test_derivative_of_the_shift_by_finite_differences():
    rng, b, rotation, shift, *_ = situation(8)
    a = b @ rotation.T + shift + 0.1 * rng.normal(size=b.shape)
    slope = jax.jit(jax.jacrev(lambda a: align(a, jnp.asarray(b))[0].shift))(a)
    step = np.zeros_like(a)
    step[3, 1] = 1e-5
    difference = align_rigid(a + step, b)[0].shift - align_rigid(a - step, b)[0].shift
    np.testing.assert_allclose(slope[:, 3, 1], difference / 2e-5, atol=1e-8)
