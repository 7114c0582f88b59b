"""Maximum-likelihood pose from one image: Levenberg-Marquardt, many poses at once.

The unknowns are a small turn w and shift d of the target as the camera sees it, X -> X + w x X + d.
All numbers are arrays with the poses last, so that one instruction works on several of them, and
the six normal equations are written out: for systems this small, that is what limits the speed.
"""

import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxvm.geometry import so3_exp, so3_log
from jaxvm.pose.sighting import Sighting

_MOST = 30
_BLOCK = 256
"""Poses that are worked on together: their numbers stay in the cache of a processor."""

_LEFT = 1e-12
"""Chi-square that the step after the last one might still gain."""


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
    found = _result(_minimised(with_lanes, rotation, start[3:, None]))
    return jax.tree.map(lambda leaf: leaf[..., 0], found)


def refine_many(sightings: Sighting, starts: Float[Array, "b 6"]) -> Refined:
    """Maximum-likelihood poses of many sightings, in blocks that stay in cache.

    Outside of `jax.jit` each core works on its own share.

    Args:
        sightings: with the poses first: points [b, n, 3] or [n, 3], image [b, n, 2], whitener
            [b, n, 2, 2] or [n, 2, 2].
        starts: camera_from_target as (turn, shift).
    """
    count, cores = len(starts), os.cpu_count() or 1
    leaves = _leaves(sightings)
    if isinstance(starts, Tracer) or any(isinstance(leaf, Tracer) for leaf in leaves):
        return _in_blocks(sightings, starts)
    # Equal shares are one compiled program; the last one may overlap the one before.
    size = min(-(-count // (cores * _BLOCK)) * _BLOCK, count)
    firsts = [min(first, count - size) for first in range(0, count, size)]
    if len(firsts) == 1:
        return _in_blocks(sightings, starts)
    with ThreadPoolExecutor(cores) as pool:
        parts = pool.map(
            lambda first: jax.block_until_ready(_share(sightings, starts, first, size)), firsts
        )
        found = list(parts)
    fresh = firsts[-1] - firsts[-2]
    found[-1] = jax.tree.map(lambda leaf: leaf[size - fresh :], found[-1])
    return jax.tree.map(lambda *each: jnp.concatenate(each), *found)


@eqx.filter_jit
def _share(sightings: Sighting, starts: Float[Array, "b 6"], first, size: int) -> Refined:
    """The poses from `first` on, as many as `size`."""
    leaves = [
        leaf if leaf.ndim == k else jax.lax.dynamic_slice_in_dim(leaf, first, size)
        for leaf, k in zip(_leaves(sightings), (2, 2, 3), strict=True)
    ]
    return _in_blocks(Sighting(*leaves), jax.lax.dynamic_slice_in_dim(starts, first, size))


@eqx.filter_jit
def _in_blocks(sightings: Sighting, starts: Float[Array, "b 6"]) -> Refined:
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
        return _result(_minimised(Sighting(*leaves), rotation, shift))

    found = jax.lax.map(solve, (own, blocks(rotation), blocks(starts[:, 3:])))
    return jax.tree.map(
        lambda leaf: jnp.moveaxis(leaf, -1, 1).reshape(-1, *leaf.shape[1:-1])[:count], found
    )


def _leaves(sighting: Sighting) -> tuple[Array, Array, Array]:
    return sighting.points, sighting.image, sighting.whitener


class _Marks(eqx.Module):
    """Marks, their ideal images, and the weights W^T W = [[a, b], [b, c]] of these; lanes last."""

    points: Float[Array, "n 3 b"]
    image: Float[Array, "n 2 b"]
    weight: tuple[Array, Array, Array]


def _marks(sighting: Sighting) -> _Marks:
    w = sighting.whitener
    a = w[:, 0, 0] ** 2 + w[:, 1, 0] ** 2
    b = w[:, 0, 0] * w[:, 0, 1] + w[:, 1, 0] * w[:, 1, 1]
    c = w[:, 0, 1] ** 2 + w[:, 1, 1] ** 2
    return _Marks(sighting.points, sighting.image, (a, b, c))


class _State(eqx.Module):
    """Where the poses stand, the system there, and the next step; lanes last."""

    rotation: Float[Array, "3 3 b"]
    shift: Float[Array, "3 b"]
    cost: Float[Array, " b"]
    pull: Float[Array, "6 b"]
    hessian: Float[Array, "6 6 b"]
    damping: Float[Array, " b"]
    change: Float[Array, "6 b"]
    gain: Float[Array, " b"]
    done: Array
    iterations: Array


def _result(state: _State) -> Refined:
    """Poses and covariances, lanes last."""
    turn = jax.vmap(so3_log, in_axes=-1, out_axes=-1)(state.rotation)
    vector = jnp.concatenate([turn, state.shift])
    unit = jnp.eye(6)[:, :, None] + 0.0 * state.cost
    columns = [_solved(state.hessian, unit[k], 0.0) for k in range(6)]
    return Refined(vector, state.cost, jnp.stack(columns), state.iterations)


def _minimised(sighting: Sighting, rotation, shift) -> _State:
    marks = _marks(sighting)
    cost, pull, hessian = _system(marks, rotation, shift)
    state = _planned(
        _State(
            rotation, shift, cost, pull, hessian,
            damping=jnp.full_like(cost, 1e-6),
            change=jnp.zeros_like(pull),
            gain=jnp.ones_like(cost),
            done=~jnp.isfinite(cost),
            iterations=jnp.zeros_like(cost, dtype=int),
        )
    )  # fmt: skip
    return jax.lax.while_loop(
        lambda s: ~jnp.all(s.done) & (jnp.max(s.iterations) < _MOST),
        lambda s: _planned(_step(marks, s)),
        state,
    )


def _step(marks: _Marks, s: _State) -> _State:
    """One step of all poses that are not done, taken where it makes the cost smaller."""
    rotation, shift = _moved(s)
    cost, pull, hessian = _system(marks, rotation, shift)
    better = cost <= s.cost
    go = better & ~s.done
    return _State(
        rotation=jnp.where(go, rotation, s.rotation),
        shift=jnp.where(go, shift, s.shift),
        cost=jnp.where(go, cost, s.cost),
        pull=jnp.where(go, pull, s.pull),
        hessian=jnp.where(go, hessian, s.hessian),
        damping=jnp.where(better, 0.1 * s.damping, jnp.maximum(10.0 * s.damping, 1e-3)),
        change=s.change,
        gain=s.gain,
        done=s.done,
        iterations=s.iterations + ~s.done,
    )


def _planned(s: _State) -> _State:
    """The next step of all poses; the last one is taken without a look at where it leads.

    Steps that gain g after g0 leave about g^2 / g0: Gauss and Newton's converge at a constant rate.
    """
    change = _solved(s.hessian, -s.pull, s.damping)
    gain = -jnp.sum(change * s.pull, axis=0)
    sound = jnp.isfinite(gain)
    last = ((gain * gain <= _LEFT * s.gain) & (gain <= s.gain) | ~sound) & ~s.done
    planned = eqx.tree_at(lambda s: (s.change, s.gain), s, (change, gain))
    rotation, shift = _moved(planned)
    go = last & sound
    return eqx.tree_at(
        lambda s: (s.rotation, s.shift, s.cost, s.done),
        planned,
        (
            jnp.where(go, rotation, s.rotation),
            jnp.where(go, shift, s.shift),
            jnp.where(go, s.cost - gain, s.cost),
            s.done | last,
        ),
    )


def _moved(s: _State):
    """Rotation and shift after the next step."""
    turn = _small_rotation(s.change[:3])
    return _product(turn, s.rotation), _applied(turn, s.shift) + s.change[3:]


def _system(marks: _Marks, rotation, shift):
    """Chi-square, its half gradient and its Gauss-Newton matrix, over (turn, shift).

    With X = (x, y, 1) and J = [I, -(x, y)], a shift moves the ideal image by J d / Z and a turn by
    J (w x X). So with M = J^T W^T W J the blocks of the matrix are M / Z^2, X x M / Z, and that
    crossed with X once more.
    """
    p = marks.points
    x, y, z = (
        rotation[k, 0] * p[:, 0] + rotation[k, 1] * p[:, 1] + rotation[k, 2] * p[:, 2] + shift[k]
        for k in range(3)
    )
    a, b, c = marks.weight
    z = jnp.where((a > 0.0) | (c > 0.0), z, 1.0)  # where it was seen
    r = 1.0 / z
    # 28 sums read these: they are computed once.
    x, y, r = jax.lax.optimization_barrier((x * r, y * r, r))
    dx, dy = x - marks.image[:, 0], y - marks.image[:, 1]
    q, s = a * dx + b * dy, b * dx + c * dy
    # A mark behind the camera is no picture of anything.
    cost = jnp.where(jnp.all(r > 0.0, axis=0), jnp.sum(dx * q + dy * s, axis=0), jnp.inf)

    def cross(v):
        """(x, y, 1) x v."""
        return y * v[2] - v[1], v[0] - x * v[2], x * v[1] - y * v[0]

    def total(value):
        return jnp.sum(value, axis=0)

    g, h = a * x + b * y, b * x + c * y
    columns = (a, b, -g), (b, c, -h), (-g, -h, x * g + y * h)
    force = q, s, -(x * q + y * s)
    pull = [*map(total, cross(force)), *(total(r * f) for f in force)]
    crossed = [cross(column) for column in columns]  # [shift][turn]
    rows = [[pull[0]] * 6 for _ in range(6)]
    for i in range(3):
        of_turn = cross([crossed[k][i] for k in range(3)])
        for j in range(3):
            if j >= i:
                rows[i][j] = rows[j][i] = total(of_turn[j])
                shift_shift = total(r * r * columns[i][j])
                rows[3 + i][3 + j] = rows[3 + j][3 + i] = shift_shift
            rows[i][3 + j] = rows[3 + j][i] = total(r * crossed[j][i])
    return cost, jnp.stack(pull), jnp.stack([jnp.stack(row) for row in rows])


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
