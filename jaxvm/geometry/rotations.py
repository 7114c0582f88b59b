"""Rotations SO(3): exponential and logarithm, exact and differentiable everywhere they are defined.

A *turn* is a rotation vector (axis times angle, rad). Below a small angle the closed forms are
replaced by their series, with inputs made safe first, so that no derivative is lost to 0/0.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SERIES = 1e-2
"""Squared angle (rad^2) below which four terms of the series are exact in double precision."""


def hat(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Skew-symmetric matrix of a vector: hat(w) x = w cross x."""
    zero = jnp.zeros_like(w[0])
    return jnp.stack(
        [
            jnp.stack([zero, -w[2], w[1]]),
            jnp.stack([w[2], zero, -w[0]]),
            jnp.stack([-w[1], w[0], zero]),
        ]
    )


def _sine_coefficients(square: Float[Array, ""]) -> tuple[Float[Array, ""], ...]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the squared angle t^2."""
    small = square < _SERIES
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    sine = jnp.sin(angle)
    half = jnp.sin(0.5 * angle)
    a = jnp.where(small, _series(square, (1.0, 6.0, 20.0, 42.0, 72.0)), sine / angle)
    b = jnp.where(small, _series(square, (2.0, 12.0, 30.0, 56.0, 90.0)), 2.0 * half**2 / safe)
    c = jnp.where(
        small, _series(square, (6.0, 20.0, 42.0, 72.0, 110.0)), (angle - sine) / (safe * angle)
    )
    return a, b, c


def _series(square, divisors):
    """1/d0 (1 - s/d1 (1 - s/d2 (...)))."""
    total = jnp.ones_like(square)
    for divisor in divisors[:0:-1]:
        total = 1.0 - square / divisor * total
    return total / divisors[0]


@jax.custom_jvp
def so3_exp(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a turn (Rodrigues 1840)."""
    square = turn @ turn
    a, b, _ = _sine_coefficients(square)
    outer = turn[:, None] * turn[None, :]
    return jnp.eye(3) * (1.0 - b * square) + a * hat(turn) + b * outer


@so3_exp.defjvp
def _(primals, tangents):
    """exp(w + d) = exp(J(w) d) exp(w): a tenth of the operations of Rodrigues' derivative."""
    (turn,), (change,) = primals, tangents
    rotation = so3_exp(turn)
    return rotation, hat(so3_left_jacobian(turn) @ change) @ rotation


def rotate(turn: Float[Array, "3"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """so3_exp(turn) @ vector without the matrix: v + a w x v + b w x (w x v)."""
    a, b, _ = _sine_coefficients(turn @ turn)
    once = cross(turn, vector)
    return vector + a * once + b * cross(turn, once)


def cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    """a x b, by components."""
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def quaternion_from_rotation(rotation: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Unit quaternion (w, x, y, z) of a rotation, w >= 0, from its largest component.

    Exact for every angle (Shepperd 1978): the component that is divided by is at least 1/2.
    """
    r = rotation
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    squares = jnp.stack(
        [
            1.0 + trace,
            1.0 + 2.0 * r[0, 0] - trace,
            1.0 + 2.0 * r[1, 1] - trace,
            1.0 + 2.0 * r[2, 2] - trace,
        ]
    )
    d0, d1, d2 = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    s01, s02, s12 = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    rows = jnp.stack(
        [
            jnp.stack([squares[0], d0, d1, d2]),
            jnp.stack([d0, squares[1], s01, s02]),
            jnp.stack([d1, s01, squares[2], s12]),
            jnp.stack([d2, s02, s12, squares[3]]),
        ]
    )
    largest = jnp.argmax(squares)
    row = rows[largest]
    q = row / jnp.sqrt(row @ row)
    return jnp.where(q[0] < 0.0, -q, q)


def rotation_from_quaternion(quaternion: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a quaternion (w, x, y, z), which need not have unit length."""
    w, v = quaternion[0], quaternion[1:]
    outer = v[:, None] * v[None, :]
    square = quaternion @ quaternion
    return (jnp.eye(3) * (w**2 - v @ v) + 2.0 * outer + 2.0 * w * hat(v)) / square


@jax.custom_jvp
def so3_log(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Turn of a rotation, of length at most pi.

    Through the quaternion, so that it is as exact near pi as elsewhere; at pi itself, where two
    opposite turns are the same rotation, one of them is returned.
    """
    q = quaternion_from_rotation(rotation)
    w, v = q[0], q[1:]
    square = v @ v
    small = square < 1e-4
    safe = jnp.where(small, 1.0, square)
    sine = jnp.sqrt(safe)
    # 2 arcsin(s) / s = 2 (1 + s^2/6 + 3 s^4/40 + 15 s^6/336 + 105 s^8/3456)
    series = 2.0 * (
        1.0
        + square / 6.0
        + 3.0 * square**2 / 40.0
        + 15.0 * square**3 / 336.0
        + 105.0 * square**4 / 3456.0
    )
    return jnp.where(small, series, 2.0 * jnp.arctan2(sine, w) / sine) * v


@so3_log.defjvp
def _(primals, tangents):
    """log(exp(d) R) = log(R) + J^-1(log R) d, for changes that keep R a rotation."""
    (rotation,), (change,) = primals, tangents
    turn = so3_log(rotation)
    skew = change @ rotation.T
    small = 0.5 * jnp.stack(
        [skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]
    )
    return turn, so3_left_jacobian_inverse(turn) @ small


def so3_left_jacobian(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Left Jacobian: exp(turn + d) = exp(J d) exp(turn) to first order in d."""
    square = turn @ turn
    a, b, c = _sine_coefficients(square)
    return jnp.eye(3) * a + b * hat(turn) + c * turn[:, None] * turn[None, :]


def so3_left_jacobian_inverse(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Inverse of the left Jacobian; singular at a full turn."""
    square = turn @ turn
    a, b, _ = _sine_coefficients(square)
    small = square < _SERIES
    safe = jnp.where(small, 1.0, square)
    series = 1.0 / 12.0 + square / 720.0 + square**2 / 30240.0 + square**3 / 1209600.0
    d = jnp.where(small, series, (1.0 - 0.5 * a / b) / safe)
    skew = hat(turn)
    return jnp.eye(3) - 0.5 * skew + d * (skew @ skew)


def se3_coupling(twist: Float[Array, "6"]) -> Float[Array, "3 3"]:
    """Q of a twist (omega, rho): the left Jacobian of SE(3) is [J, 0; Q, J] (Barfoot 2017, 7.86).

    With W = hat(omega), P = hat(rho) its products of three and four are vectors' own: W P + P W =
    omega rho^T + rho omega^T - 2 k, W P W = -k W, and so on, k = omega . rho.
    """
    omega, rho = twist[:3], twist[3:]
    square, k = omega @ omega, omega @ rho
    _, b, c = _sine_coefficients(square)
    small = square < _SERIES
    safe = jnp.where(small, 1.0, square)
    d = jnp.where(small, _series(square, (24.0, 30.0, 56.0, 90.0)), (0.5 - b) / safe)
    e = jnp.where(
        small,
        1.0 / 120.0 - square / 2520.0 + square**2 / 120960.0 - square**3 / 9979200.0,
        0.5 * (3.0 * c - b) / safe,
    )
    mixed = omega[:, None] * rho[None, :]
    own = omega[:, None] * omega[None, :]
    skew = (0.5 - d * square) * hat(rho) + k * (2.0 * d - c) * hat(omega)
    return skew + c * (mixed + mixed.T) - 2.0 * k * (e * own + (c - e * square) * jnp.eye(3))
