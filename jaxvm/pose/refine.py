"""Maximum-likelihood pose from one image: Levenberg-Marquardt, many poses at once.

The unknowns are a small turn w and shift d of the target as the camera sees it, X -> X + w x X + d.
With x = X/Z, y = Y/Z the ideal image moves by

    dx = dx/Z - x dz/Z - x y wx + (1 + x^2) wy - y wz,
    dy = dy/Z - y dz/Z - (1 + y^2) wx + x y wy + x wz.

All numbers are arrays with the poses last, so that one instruction works on several of them, and
the six normal equations are written out: for systems this small, that is what limits the speed.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxvm.geometry import so3_exp, so3_log
from jaxvm.pose.sighting import Sighting

_MOST = 30
_BLOCK = 512
"""Poses that are worked on together: their numbers stay in the cache of a processor."""


class Refined(eqx.Module):
    """A maximum-likelihood pose.

    Attributes:
        observer_from_target: (turn, shift) in rad and m; the observer is a camera, or a station.
        cost: chi-square, the sum of squared whitened residuals.
        covariance: of a turn and a shift of the target as the observer sees it,
            X -> exp(w) X + d about the observer's origin (rad, m).
        iterations: steps until it stood still.
    """

    observer_from_target: Float[Array, "*b 6"]
    cost: Float[Array, "*b"]
    covariance: Float[Array, "*b 6 6"]
    iterations: Int[Array, "*b"]


def refine(sighting: Sighting, start: Float[Array, "6"]) -> Refined:
    """Maximum-likelihood pose from a start.

    Args:
        sighting: marks, ideal image points, their whitening.
        start: camera_from_target as (turn, shift).
    """
    with_lanes = jax.tree.map(lambda leaf: leaf[..., None], sighting)
    rotation = so3_exp(start[:3])[..., None]
    found = _minimised(with_lanes, rotation, start[3:, None])
    return _result(jax.tree.map(lambda leaf: leaf[..., 0], found))


@eqx.filter_jit
def refine_many(sightings: Sighting, starts: Float[Array, "b 6"]) -> Refined:
    """Maximum-likelihood poses of many sightings, in blocks that stay in cache.

    Args:
        sightings: with the poses first: points [b, n, 3] or [n, 3], image [b, n, 2], whitener
            [b, n, 2, 2] or [n, 2, 2].
        starts: camera_from_target as (turn, shift).
    """
    count = len(starts)
    block = min(_BLOCK, count)
    n_blocks = -(-count // block)
    fill = n_blocks * block - count

    def blocks(values):
        padded = jnp.concatenate([values, jnp.repeat(values[-1:], fill, axis=0)])
        return jnp.moveaxis(padded.reshape(n_blocks, block, *values.shape[1:]), 1, -1)

    rotation = jax.vmap(so3_exp)(starts[:, :3])
    shared = [leaf.ndim == k for leaf, k in zip(_leaves(sightings), (2, 2, 3), strict=True)]
    own = [None if s else blocks(leaf) for leaf, s in zip(_leaves(sightings), shared, strict=True)]

    def solve(args):
        given, rotation, shift = args
        leaves = [
            leaf[..., None] if one is None else one
            for leaf, one in zip(_leaves(sightings), given, strict=True)
        ]
        return _minimised(Sighting(*leaves), rotation, shift)

    found = jax.lax.map(solve, (own, blocks(rotation), blocks(starts[:, 3:])))
    found = jax.tree.map(
        lambda leaf: jnp.moveaxis(leaf, -1, 1).reshape(-1, *leaf.shape[1:-1])[:count], found
    )
    return jax.vmap(_result)(found)


def _leaves(sighting: Sighting) -> tuple[Array, Array, Array]:
    return sighting.points, sighting.image, sighting.whitener


class _State(eqx.Module):
    """Where the poses stand; lanes last."""

    rotation: Float[Array, "3 3 b"]
    shift: Float[Array, "3 b"]
    cost: Float[Array, " b"]
    pull: Float[Array, "6 b"]
    hessian: Float[Array, "6 6 b"]
    damping: Float[Array, " b"]
    done: Array
    iterations: Array


def _result(state: _State) -> Refined:
    vector = jnp.concatenate([so3_log(state.rotation), state.shift])
    return Refined(vector, state.cost, jnp.linalg.inv(state.hessian), state.iterations)


def _minimised(sighting: Sighting, rotation, shift) -> _State:
    cost, pull, hessian = _system(sighting, rotation, shift)
    state = _State(
        rotation, shift, cost, pull, hessian,
        damping=jnp.full_like(cost, 1e-6),
        done=~jnp.isfinite(cost),
        iterations=jnp.zeros_like(cost, dtype=int),
    )  # fmt: skip
    return jax.lax.while_loop(
        lambda s: ~jnp.all(s.done) & (jnp.max(s.iterations) < _MOST),
        lambda s: _step(sighting, s),
        state,
    )


def _step(sighting: Sighting, s: _State) -> _State:
    """One step of all poses; those that are done stay."""
    change = _solved(s.hessian, -s.pull, s.damping)
    turn = _small_rotation(change[:3])
    rotation = _product(turn, s.rotation)
    shift = _applied(turn, s.shift) + change[3:]
    cost, pull, hessian = _system(sighting, rotation, shift)
    better = cost <= s.cost
    # What the next step could still gain: pull^T H^-1 pull, to first order.
    gain = -jnp.sum(change * s.pull, axis=0)
    still = (gain <= 1e-14 * s.cost + 1e-20) | ~jnp.isfinite(gain)
    go, stop = better & ~s.done, s.done | still
    return _State(
        rotation=jnp.where(go, rotation, s.rotation),
        shift=jnp.where(go, shift, s.shift),
        cost=jnp.where(go, cost, s.cost),
        pull=jnp.where(go, pull, s.pull),
        hessian=jnp.where(go, hessian, s.hessian),
        damping=jnp.where(better, 0.1 * s.damping, jnp.maximum(10.0 * s.damping, 1e-3)),
        done=stop,
        iterations=s.iterations + ~s.done,
    )


def _system(sighting: Sighting, rotation, shift):
    """Chi-square, its half gradient and its Gauss-Newton matrix, over (turn, shift)."""
    p, w = sighting.points, sighting.whitener
    x, y, z = (
        rotation[k, 0] * p[:, 0] + rotation[k, 1] * p[:, 1] + rotation[k, 2] * p[:, 2] + shift[k]
        for k in range(3)
    )
    z = jnp.where(jnp.any(w != 0.0, axis=(1, 2)), z, 1.0)  # where it was seen
    per_depth = 1.0 / z
    x, y = x * per_depth, y * per_depth
    dx, dy = x - sighting.image[:, 0], y - sighting.image[:, 1]
    xy, zero = x * y, jnp.zeros_like(x)
    of_x = (-xy, 1.0 + x * x, -y, per_depth, zero, -x * per_depth)
    of_y = (-1.0 - y * y, xy, x, zero, per_depth, -y * per_depth)
    first = [w[:, 0, 0] * a + w[:, 0, 1] * b for a, b in zip(of_x, of_y, strict=True)]
    second = [w[:, 1, 0] * a + w[:, 1, 1] * b for a, b in zip(of_x, of_y, strict=True)]
    e, f = w[:, 0, 0] * dx + w[:, 0, 1] * dy, w[:, 1, 0] * dx + w[:, 1, 1] * dy
    # A mark behind the camera is no picture of anything.
    cost = jnp.where(jnp.all(z > 0.0, axis=0), jnp.sum(e * e + f * f, axis=0), jnp.inf)
    pull = jnp.stack([jnp.sum(a * e + b * f, axis=0) for a, b in zip(first, second, strict=True)])
    rows = {}
    for i in range(6):
        for j in range(i + 1):
            rows[i, j] = jnp.sum(first[i] * first[j] + second[i] * second[j], axis=0)
    hessian = jnp.stack(
        [jnp.stack([rows[max(i, j), min(i, j)] for j in range(6)]) for i in range(6)]
    )
    return cost, pull, hessian


def _solved(hessian, right, damping):
    """Solution of the damped normal equations by Cholesky, written out."""
    h = [[hessian[i, j] for j in range(i + 1)] for i in range(6)]
    root = [[right[0]] * 6 for _ in range(6)]
    inverse = []
    for j in range(6):
        pivot = h[j][j] * (1.0 + damping)
        for k in range(j):
            pivot = pivot - root[j][k] * root[j][k]
        inverse.append(jax.lax.rsqrt(jnp.maximum(pivot, 1e-300)))
        for i in range(j + 1, 6):
            value = h[i][j]
            for k in range(j):
                value = value - root[i][k] * root[j][k]
            root[i][j] = value * inverse[j]
    half = []
    for i in range(6):
        value = right[i]
        for k in range(i):
            value = value - root[i][k] * half[k]
        half.append(value * inverse[i])
    solution = [half[0]] * 6
    for i in reversed(range(6)):
        value = half[i]
        for k in range(i + 1, 6):
            value = value - root[k][i] * solution[k]
        solution[i] = value * inverse[i]
    return jnp.stack(solution)


def _small_rotation(turn):
    """Rotation matrix of a turn by the Cayley transform: exact rotation, equal to third order."""
    a, b, c = 0.5 * turn[0], 0.5 * turn[1], 0.5 * turn[2]
    scale = 2.0 / (1.0 + a * a + b * b + c * c)
    return jnp.stack(
        [
            jnp.stack([1 - scale * (b * b + c * c), scale * (a * b - c), scale * (a * c + b)]),
            jnp.stack([scale * (a * b + c), 1 - scale * (a * a + c * c), scale * (b * c - a)]),
            jnp.stack([scale * (a * c - b), scale * (b * c + a), 1 - scale * (a * a + b * b)]),
        ]
    )


def _product(a, b):
    """Products of 3 x 3 matrices, lanes last."""
    return jnp.stack(
        [jnp.stack([sum(a[i, k] * b[k, j] for k in range(3)) for j in range(3)]) for i in range(3)]
    )


def _applied(a, v):
    return jnp.stack([sum(a[i, k] * v[k] for k in range(3)) for i in range(3)])
