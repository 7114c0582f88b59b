"""Rotations against scipy, power series and finite differences, at 0 and at pi too."""

import hypothesis.extra.numpy as hnp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxvm.geometry import (
    hat,
    quaternion_from_rotation,
    rotation_from_quaternion,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)

exp_all = jax.jit(jax.vmap(so3_exp))
log_all = jax.jit(jax.vmap(so3_log))
jacobian_all = jax.jit(jax.vmap(so3_left_jacobian))
jacobian_inverse_all = jax.jit(jax.vmap(so3_left_jacobian_inverse))
exp_forward = jax.jit(jax.vmap(jax.jacfwd(so3_exp)))
exp_reverse = jax.jit(jax.vmap(jax.jacrev(so3_exp)))
there_and_back = jax.jit(lambda turn: so3_log(so3_exp(turn)))
to_quaternion = jax.jit(jax.vmap(quaternion_from_rotation))
from_quaternion = jax.jit(jax.vmap(rotation_from_quaternion))

AXES = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [1, 1, 0], [0, -1, 1], [1, -2, 3], [-3, 1e-3, 2]],
    float,
)
AXES /= np.linalg.norm(AXES, axis=1)[:, None]
# Zero, the smallest numbers, both sides of the change from series to closed form (0.1 rad in the
# exponential, about 0.02 rad in the logarithm), and both sides of pi.
ANGLES = np.array(
    [0.0, 1e-160, 1e-20, 1e-8, 1e-4, 0.0199, 0.0201, 0.0999999, 0.1000001, 0.7, 1.5707963, 2.5]
    + [3.0, np.pi - 1e-5, np.pi - 1e-9]
)
TURNS = (ANGLES[:, None, None] * AXES).reshape(-1, 3)

component = st.floats(-10.0, 10.0, allow_subnormal=False)
turns = hnp.arrays(float, 3, elements=component)
relaxed = settings(
    deadline=None,
    derandomize=True,
    max_examples=150,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)


def power_series(matrix, divide):
    """Sum of matrix^k / divide(k)! in extended precision, for angles up to about pi."""
    matrix = matrix.astype(np.longdouble)
    total, power, factorial = np.zeros((3, 3), np.longdouble), np.eye(3, dtype=np.longdouble), 1
    for k in range(60):
        total += power / np.longdouble(factorial * (k + 1 if divide else 1))
        power, factorial = power @ matrix, factorial * (k + 1)
    return total.astype(float)


def skew(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def test_hat_is_the_cross_product():
    rng = np.random.default_rng(0)
    w, x = rng.normal(size=(2, 3))
    np.testing.assert_allclose(hat(w) @ x, np.cross(w, x), rtol=1e-15)


def test_exp_equals_the_power_series_and_scipy():
    got = np.asarray(exp_all(TURNS))
    np.testing.assert_allclose(got, [power_series(skew(t), False) for t in TURNS], atol=2e-15)
    np.testing.assert_allclose(got, Rotation.from_rotvec(TURNS).as_matrix(), atol=2e-15)


@given(turns)
@relaxed
def test_exp_is_a_rotation_for_any_turn(turn):
    rotation = np.asarray(exp_all(turn[None])[0])
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(turn).as_matrix(), atol=1e-14)


@given(turns)
@relaxed
def test_log_undoes_exp_below_pi_and_is_shortest_above(turn):
    got = np.asarray(there_and_back(turn))
    angle = np.linalg.norm(turn)
    assert np.linalg.norm(got) <= np.pi + 1e-14
    if angle < np.pi - 1e-9:
        np.testing.assert_allclose(got, turn, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(exp_all(got[None]), exp_all(turn[None]), atol=1e-14)


def test_log_is_as_exact_near_pi_as_elsewhere():
    got = np.asarray(log_all(exp_all(TURNS)))
    np.testing.assert_allclose(got, TURNS, rtol=1e-15, atol=4e-15)
    np.testing.assert_allclose(
        got, Rotation.from_matrix(np.array(exp_all(TURNS))).as_rotvec(), atol=1e-14
    )


def test_log_at_pi_is_one_of_the_two_opposite_turns():
    half_turns = np.array([2.0 * np.outer(a, a) - np.eye(3) for a in AXES])
    got = np.asarray(log_all(half_turns))
    signs = np.sign(np.sum(got * AXES, axis=1))
    np.testing.assert_allclose(signs[:, None] * got, np.pi * AXES, atol=1e-14)


def test_derivative_of_exp_is_the_series_of_the_derivative():
    """By finite differences of scipy; at 0 it is the three generators exactly."""
    forward, reverse = exp_forward(TURNS), exp_reverse(TURNS)
    assert np.all(np.isfinite(forward))
    np.testing.assert_allclose(forward, reverse, atol=1e-14)
    step = 1e-5
    for j, e in enumerate(np.eye(3)):
        up = Rotation.from_rotvec(TURNS + step * e).as_matrix()
        down = Rotation.from_rotvec(TURNS - step * e).as_matrix()
        np.testing.assert_allclose(forward[..., j], (up - down) / (2 * step), atol=2e-10)
        assert np.array_equal(forward[0][..., j], skew(e))


def test_second_derivative_of_exp_at_zero():
    """d2 exp / di dj = (Gi Gj + Gj Gi) / 2; a series that is cut too early loses it."""
    g = np.array([skew(e) for e in np.eye(3)])
    expected = 0.5 * (np.einsum("iab,jbc->acij", g, g) + np.einsum("jab,ibc->acij", g, g))
    got = jax.jit(jax.jacfwd(jax.jacrev(so3_exp)))(jnp.zeros(3))
    np.testing.assert_allclose(got, expected, atol=1e-15)


def test_derivative_of_log_is_the_inverse_left_jacobian_also_at_pi():
    """d log(exp(d) R) / dd at d = 0, forward and reverse, against differences of scipy."""

    def disturbed(d, rotation):
        return so3_log(so3_exp(d) @ rotation)

    at = np.concatenate([TURNS, np.pi * AXES])
    rotations = np.asarray(exp_all(at))
    zero = jnp.zeros(3)
    forward = jax.jit(jax.vmap(lambda r: jax.jacfwd(disturbed)(zero, r)))(rotations)
    reverse = jax.jit(jax.vmap(lambda r: jax.jacrev(disturbed)(zero, r)))(rotations)
    assert np.all(np.isfinite(forward))
    np.testing.assert_allclose(forward, reverse, atol=1e-13)
    # At pi the logarithm may have taken the opposite turn, whose Jacobian it then has.
    taken = log_all(rotations)
    np.testing.assert_allclose(forward, jacobian_inverse_all(taken), atol=1e-13)
    step = 1e-5
    away = np.linalg.norm(at, axis=1) < np.pi - 1e-4  # differences must not jump to the far side
    for j, e in enumerate(np.eye(3)):
        ends = [
            (Rotation.from_rotvec(s * step * e) * Rotation.from_rotvec(at[away])).as_rotvec()
            for s in (1, -1)
        ]
        np.testing.assert_allclose(
            forward[away][..., j], (ends[0] - ends[1]) / (2 * step), atol=1e-8
        )


def test_log_after_exp_has_the_identity_as_derivative():
    turned = jax.jit(jax.vmap(jax.jacrev(lambda t: so3_log(so3_exp(t)))))(TURNS)
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-13)


def test_left_jacobian_equals_the_power_series():
    np.testing.assert_allclose(
        jacobian_all(TURNS), [power_series(skew(t), True) for t in TURNS], atol=3e-15
    )


def test_left_jacobian_by_finite_differences():
    """exp(turn + d) exp(turn)^-1 is the turn J d, here of scipy's rotations."""
    at = TURNS[np.linalg.norm(TURNS, axis=1) > 1e-9]
    got, step = jacobian_all(at), 1e-5
    for j, e in enumerate(np.eye(3)):
        back = Rotation.from_rotvec(at).inv()
        ends = [(Rotation.from_rotvec(at + s * step * e) * back).as_rotvec() for s in (1, -1)]
        np.testing.assert_allclose(got[..., j], (ends[0] - ends[1]) / (2 * step), atol=1e-9)


def test_inverse_left_jacobian_inverts_it_even_beyond_pi():
    at = np.concatenate([TURNS, 4.0 * AXES, 5.5 * AXES])
    product = np.asarray(jacobian_inverse_all(at)) @ np.asarray(jacobian_all(at))
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-13)


def test_jacobians_can_be_differentiated_at_zero():
    """dJ/dw = hat/2 and dJ^-1/dw = -hat/2 at zero."""
    generators = np.stack([skew(e) for e in np.eye(3)], axis=-1)
    for function, sign in ((so3_left_jacobian, 0.5), (so3_left_jacobian_inverse, -0.5)):
        np.testing.assert_allclose(
            jax.jit(jax.jacrev(function))(jnp.zeros(3)), sign * generators, atol=1e-15
        )


def test_quaternions_equal_scipys_and_have_no_negative_w():
    random = Rotation.random(300, rng=np.random.default_rng(1)).as_matrix()
    rotations = np.concatenate([random, exp_all(TURNS), exp_all(np.pi * AXES)])
    got = np.asarray(to_quaternion(rotations))
    expected = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    same_side = np.sign(np.sum(got * expected, axis=1))[:, None]
    np.testing.assert_allclose(got, same_side * expected, atol=1e-14)
    assert np.all(got[:, 0] >= 0.0)
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(from_quaternion(got), rotations, atol=1e-14)


def test_a_quaternion_of_any_length_gives_scipys_rotation():
    q = np.random.default_rng(2).normal(size=(200, 4)) * np.geomspace(1e-3, 1e3, 200)[:, None]
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    np.testing.assert_allclose(from_quaternion(q), expected, atol=2e-15)
