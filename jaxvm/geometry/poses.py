"""Poses SE(3). A pose says what it maps: `a_from_b` takes coordinates in b to coordinates in a.

As numbers a pose is a 6-vector (turn, shift): a rotation vector (rad) and a translation (m).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry.rotations import (
    hat,
    so3_exp,
    so3_left_jacobian,
    so3_left_jacobian_inverse,
    so3_log,
)


class Pose(eqx.Module):
    """A rigid transform x -> rotation x + shift."""

    rotation: Float[Array, "3 3"]
    shift: Float[Array, "3"]

    def __matmul__(self, other: "Pose") -> "Pose":
        """a_from_c = a_from_b @ b_from_c."""
        return Pose(self.rotation @ other.rotation, self.rotation @ other.shift + self.shift)

    def inverse(self) -> "Pose":
        """b_from_a of a_from_b."""
        return Pose(self.rotation.T, -(self.rotation.T @ self.shift))

    def apply(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Coordinates (m) of a point in the other frame."""
        return self.rotation @ point + self.shift

    @classmethod
    def identity(cls) -> "Pose":
        """The pose that maps every point to itself."""
        return cls(jnp.eye(3), jnp.zeros(3))


def pose_from_vector(vector: Float[Array, "6"]) -> Pose:
    """Pose of (turn, shift): rotation exp(turn), translation shift (not the SE(3) exponential)."""
    return Pose(so3_exp(vector[:3]), vector[3:])


def vector_from_pose(pose: Pose) -> Float[Array, "6"]:
    """(turn, shift) of a pose; the turn has length at most pi."""
    return jnp.concatenate([so3_log(pose.rotation), pose.shift])


def se3_exp(twist: Float[Array, "6"]) -> Pose:
    """Exponential of a twist (omega, rho): exp(omega), J(omega) rho."""
    return Pose(so3_exp(twist[:3]), so3_left_jacobian(twist[:3]) @ twist[3:])


def se3_log(pose: Pose) -> Float[Array, "6"]:
    """Twist (omega, rho) of a pose: the full SE(3) logarithm."""
    omega = so3_log(pose.rotation)
    return jnp.concatenate([omega, so3_left_jacobian_inverse(omega) @ pose.shift])


def se3_adjoint(pose: Pose) -> Float[Array, "6 6"]:
    """Adjoint: pose exp(xi) pose^-1 = exp(Ad xi), for twists (omega, rho)."""
    r = pose.rotation
    return jnp.block([[r, jnp.zeros((3, 3))], [hat(pose.shift) @ r, r]])
