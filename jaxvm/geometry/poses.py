"""Poses SE(3). A pose says what it maps: `a_from_b` takes coordinates in b to coordinates in a.

As numbers a pose is a 6-vector (turn, shift): a rotation vector (rad) and a translation (m).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxvm.geometry.rotations import (
    cross,
    hat,
    se3_coupling,
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

    def settled(self) -> "Pose":
        """The pose as a rotation and a shift alone."""
        return self

    def inverse(self) -> "Pose":
        """b_from_a of a_from_b."""
        return Pose(self.rotation.T, -(self.rotation.T @ self.shift))

    def rotate(self, vector: Float[Array, "3"]) -> Float[Array, "3"]:
        """A direction in the other frame."""
        return self.rotation @ vector

    def apply(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Coordinates (m) of a point in the other frame."""
        return self.rotate(point) + self.shift

    def unrotate(self, vector: Float[Array, "3"]) -> Float[Array, "3"]:
        """A direction back in this frame."""
        return self.rotation.T @ vector

    def unapply(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Coordinates (m) back in this frame, as `inverse().apply` gives them."""
        return self.unrotate(point - self.shift)

    @classmethod
    def identity(cls) -> "Pose":
        """The pose that maps every point to itself."""
        return cls(jnp.eye(3), jnp.zeros(3))


class TurnedPose(Pose):
    """A pose with a small turn behind it, exp(turn) rotation to first order.

    What derivatives by a pose cost is what it does to a point: a cross product, not nine numbers.
    """

    turn: Float[Array, "3"]

    def settled(self) -> Pose:
        return Pose(self.rotation + hat(self.turn) @ self.rotation, self.shift)

    def __matmul__(self, other: Pose) -> Pose:
        return self.settled() @ other

    def __rmatmul__(self, other: Pose) -> Pose:
        return other @ self.settled()

    def inverse(self) -> Pose:
        return self.settled().inverse()

    def rotate(self, vector: Float[Array, "3"]) -> Float[Array, "3"]:
        still = self.rotation @ vector
        return still + cross(self.turn, still)

    def unrotate(self, vector: Float[Array, "3"]) -> Float[Array, "3"]:
        return self.rotation.T @ (vector - cross(self.turn, vector))


def pose_from_vector(vector: Float[Array, "6"] | Pose) -> Pose:
    """Pose of (turn, shift): rotation exp(turn), translation shift (not the SE(3) exponential).

    What is a pose already stays as it is.
    """
    return vector if isinstance(vector, Pose) else Pose(so3_exp(vector[:3]), vector[3:])


def vector_from_pose(pose: Pose) -> Float[Array, "6"]:
    """(turn, shift) of a pose; the turn has length at most pi."""
    return jnp.concatenate([so3_log(pose.rotation), pose.shift])


def se3_exp(twist: Float[Array, "6"]) -> Pose:
    """Exponential of a twist (omega, rho): exp(omega), J(omega) rho."""
    return Pose(so3_exp(twist[:3]), so3_left_jacobian(twist[:3]) @ twist[3:])


@jax.custom_jvp
def se3_log(pose: Pose) -> Float[Array, "6"]:
    """Twist (omega, rho) of a pose: the full SE(3) logarithm."""
    omega = so3_log(pose.rotation)
    return jnp.concatenate([omega, so3_left_jacobian_inverse(omega) @ pose.shift])


@se3_log.defjvp
def _(primals, tangents):
    """log(T exp(d)) = log(T) + J^-1(-log T) d, for changes that keep T a pose.

    J^-1 [omega; rho] = [A omega; A (rho - Q A omega)] with A that of SO(3) (Barfoot 2017, 7.86).
    """
    (pose,), (change,) = primals, tangents
    twist = se3_log(pose)
    skew, along = pose.rotation.T @ change.rotation, pose.rotation.T @ change.shift
    turn = 0.5 * jnp.stack(
        [skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]
    )
    inner = so3_left_jacobian_inverse(-twist[:3])
    turned = inner @ turn
    moved = inner @ (along - se3_coupling(-twist) @ turned)
    return twist, jnp.concatenate([turned, moved])


def se3_adjoint(pose: Pose) -> Float[Array, "6 6"]:
    """Adjoint: pose exp(xi) pose^-1 = exp(Ad xi), for twists (omega, rho)."""
    r = pose.rotation
    return jnp.block([[r, jnp.zeros((3, 3))], [hat(pose.shift) @ r, r]])
