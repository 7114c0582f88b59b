"""Poses against 4x4 matrices and scipy's matrix exponential."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxvm.geometry import (
    Pose,
    pose_from_vector,
    se3_adjoint,
    se3_exp,
    se3_log,
    so3_left_jacobian,
    vector_from_pose,
)

RNG = np.random.default_rng(3)
N = 60


def random_vectors(n=N):
    """Turns of every angle from 1e-9 to almost pi, about every axis, and shifts of some metres."""
    axis = RNG.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    angle = np.concatenate([np.geomspace(1e-9, 1.0, n // 2), np.linspace(1.0, 3.14, n - n // 2)])
    return np.hstack([angle[:, None] * axis, RNG.normal(0.0, 3.0, (n, 3))])


def batched(function):
    """Of many at once, compiled."""
    return jax.jit(jax.vmap(function))


poses_from_vectors = batched(pose_from_vector)
exp_all = batched(se3_exp)
exp_then_log = batched(lambda t: se3_log(se3_exp(t)))
A = poses_from_vectors(random_vectors())
B = poses_from_vectors(RNG.permutation(random_vectors()))  # small turns meet large ones


def with_no_turn(twists):
    """The same number of twists, the first two of them at rest and without turn."""
    twists[:2] = [[0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 2, 3]]
    return twists


def matrices(poses: Pose) -> np.ndarray:
    """Homogeneous 4x4 matrices of a batch of poses."""
    out = np.tile(np.eye(4), (len(poses.shift), 1, 1))
    out[:, :3, :3], out[:, :3, 3] = poses.rotation, poses.shift
    return out


def twist_matrices(twists: np.ndarray) -> np.ndarray:
    """4x4 matrices of twists (omega, rho)."""
    out = np.zeros((len(twists), 4, 4))
    for m, (x, y, z, *rho) in zip(out, twists, strict=True):
        m[:3] = [[0, -z, y, rho[0]], [z, 0, -x, rho[1]], [-y, x, 0, rho[2]]]
    return out


def test_composition_inverse_and_application_are_those_of_4x4_matrices():
    ab = batched(lambda a, b: a @ b)(A, B)
    np.testing.assert_allclose(matrices(ab), matrices(A) @ matrices(B), atol=1e-14)
    inverse = batched(Pose.inverse)(A)
    np.testing.assert_allclose(matrices(inverse), np.linalg.inv(matrices(A)), atol=1e-13)
    points = RNG.normal(size=(N, 3))
    expected = np.einsum("nij,nj->ni", matrices(A), np.hstack([points, np.ones((N, 1))]))[:, :3]
    np.testing.assert_allclose(batched(Pose.apply)(A, points), expected, atol=1e-14)


def test_identity_maps_every_point_to_itself():
    point = jnp.array([1.0, -2.0, 3.0])
    assert np.array_equal(Pose.identity().apply(point), point)
    composed = Pose.identity() @ jax.tree.map(lambda x: x[7], A)
    assert np.array_equal(composed.rotation, A.rotation[7])


def test_names_compose_from_right_to_left():
    """a_from_c = a_from_b @ b_from_c: a point goes through c -> b first."""
    quarter = pose_from_vector(jnp.array([0.0, 0.0, np.pi / 2, 0.0, 0.0, 0.0]))
    move = pose_from_vector(jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    origin = jnp.zeros(3)
    np.testing.assert_allclose((quarter @ move).apply(origin), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose((move @ quarter).apply(origin), [1, 0, 0], atol=1e-15)


def test_vector_and_pose_round_trip():
    vectors = random_vectors()
    poses = poses_from_vectors(vectors)
    np.testing.assert_allclose(
        poses.rotation, Rotation.from_rotvec(vectors[:, :3]).as_matrix(), atol=1e-14
    )
    # The translation is taken as it is and is not turned.
    assert np.array_equal(poses.shift, vectors[:, 3:])
    np.testing.assert_allclose(batched(vector_from_pose)(poses), vectors, rtol=1e-13, atol=1e-14)


def test_se3_exp_equals_the_matrix_exponential():
    twists = with_no_turn(random_vectors())
    expected = np.array([expm(m) for m in twist_matrices(twists)])
    np.testing.assert_allclose(matrices(exp_all(twists)), expected, atol=1e-13)


def test_se3_log_undoes_exp():
    twists = with_no_turn(random_vectors())
    got = exp_then_log(twists)
    np.testing.assert_allclose(got, twists, rtol=1e-12, atol=1e-13)


def test_derivatives_at_the_identity():
    """exp has the unit twists as derivative at 0, and log after exp the identity."""

    def both(twist):
        pose = se3_exp(twist)
        return pose.shift, se3_log(pose)

    of_shift, there_and_back = jax.jit(jax.jacrev(both))(jnp.zeros(6))
    np.testing.assert_allclose(of_shift, np.eye(3, 6, 3), atol=1e-15)
    np.testing.assert_allclose(there_and_back, np.eye(6), atol=1e-15)


def test_adjoint_moves_a_twist_through_a_pose():
    """pose exp(xi) pose^-1 = exp(Ad xi), and Ad of a product is the product."""
    xi = 0.4 * RNG.normal(size=(N, 6))
    left = batched(lambda p, x: p @ se3_exp(x) @ p.inverse())(A, xi)
    adjoint = batched(se3_adjoint)(A)
    right = exp_all(jnp.einsum("nij,nj->ni", adjoint, xi))
    np.testing.assert_allclose(matrices(left), matrices(right), atol=1e-12)
    of_product, of_b = batched(lambda a, b: (se3_adjoint(a @ b), se3_adjoint(b)))(A, B)
    np.testing.assert_allclose(of_product, adjoint @ of_b, atol=1e-12)


def test_shift_of_a_twist_is_the_left_jacobian_times_rho():
    """A screw of constant velocity, integrated in 2000 midpoint steps, ends where exp says."""
    omega, rho = np.array([0.3, -1.1, 0.7]), np.array([1.0, 0.5, -2.0])
    middle = (np.arange(2000) + 0.5) / 2000
    path = Rotation.from_rotvec(middle[:, None] * omega).apply(rho).mean(axis=0)
    np.testing.assert_allclose(so3_left_jacobian(jnp.asarray(omega)) @ rho, path, atol=1e-6)
