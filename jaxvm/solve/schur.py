"""Normal equations of few bodies and very many local unknowns: Schur complement without a scatter.

In a block of images every point is a group of unknowns that a few views see. The arrow form
(`jaxvm.solve.arrow`) couples each group densely to all shared unknowns; here only what sees it
counts. Two packets of observations of one group fall on a pair of views, and all that fall on one
pair are gathered into one product of matrices (Brown 1958; Triggs et al. 2000, section 6; Agarwal
et al. 2010).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.network.componentwise import Numbers, apart, each, is_known, joined, matmul, total
from jaxvm.network.residual import Linearised, linearise, linearise_tiles, present
from jaxvm.solve.buckets import CORES, Products, padded
from jaxvm.solve.problem import Problem, assemble, flat_state, in_packets, whitened
from jaxvm.solve.schur_pattern import SchurPattern, View
from jaxvm.solve.triangle import solver


@dataclass(frozen=True, eq=False)
class SchurNormal:
    """Cost, gradient and Gauss-Newton matrix at one x, in blocks.

    Attributes:
        shared: of shared unknowns among themselves, in the entries of the pattern's triangle.
        local: of each group.
        coupling: of each packet, the unknowns of its group with its shared ones.
    """

    pattern: SchurPattern
    cost: float
    gradient: Float[Array, " n"]
    shared: Float[Array, " entries"]
    local: Float[Array, "groups d d"]
    coupling: Float[Array, "packets d shared"]

    def at(self, problem: Problem, x: Float[Array, " n"]) -> "SchurNormal":
        """The normal equations elsewhere."""
        return schur_normal(problem, self.pattern, x)

    def rescaled(self, scale: Float[np.ndarray, " n"]) -> "SchurNormal":
        """The same for unknowns in other units: x_new = x / scale."""
        blocks = self.gradient, self.shared, self.local, self.coupling
        gradient, shared, local, coupling = _rescaled(self.pattern, blocks, jnp.asarray(scale))
        return replace(self, gradient=gradient, shared=shared, local=local, coupling=coupling)

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """Diagonal of the matrix."""
        own = jnp.diagonal(self.local, axis1=1, axis2=2)
        return np.concatenate([self.shared[self.pattern.triangle.diagonal], np.ravel(own)])


@jax.jit
def _rescaled(pattern: SchurPattern, blocks, scale):
    gradient, shared, local, coupling = blocks
    s, groups, d = pattern.sizes
    a, b = scale[:s], jnp.reshape(scale[s:], (groups, d))
    of_group = padded(b)[pattern.group][:, :, None] * coupling
    of_shared, wide = jnp.append(a, 1.0), coupling.shape[2]
    found = [
        view.in_runs(own) * of_shared[_wider(view.columns, wide, s)][:, None, None, :]
        for view, own in pattern.by_table(of_group)
    ]
    return (
        gradient * scale,
        shared * a[pattern.triangle.row] * a[pattern.triangle.column],
        b[:, :, None] * local * b[:, None, :],
        jnp.concatenate([jnp.reshape(own, (-1, d, wide)) for own in found]),
    )


def schur_normal(problem: Problem, pattern: SchurPattern, x: Float[Array, " n"]) -> SchurNormal:
    """Normal equations of a problem at x, with the weights of its robust loss."""
    bare = eqx.tree_at(lambda p: p.packets, problem, ())
    cost, *blocks = _linearised(bare, pattern, jnp.asarray(x))
    return SchurNormal(pattern, float(cost), *blocks)


@eqx.filter_jit
def _linearised(problem: Problem, pattern: SchurPattern, x):
    """Cost, gradient, shared and local blocks, and couplings of all packets."""
    network, layout = problem.network, problem.network.layout
    flat, per_parameter = flat_state(problem, x)
    at = present(network, flat, slopes=True)
    effects = jnp.asarray(np.concatenate([layout.all("amplitude"), layout.all("constant")]))
    cost, products, rest = jnp.zeros(()), [], []
    for factor, view in zip(network.factors(), pattern.tables, strict=True):
        if isinstance(view, View) and view.tiled:
            own, *found = _by_pieces(problem, factor, view, at, per_parameter)
            products.append((view, *found))
        else:
            raw = linearise(factor, network, at, view.live)
            steps = factor.slots, effects, view.live
            (table,) = whitened([raw], [(factor.weight, factor.sigma)], [steps], per_parameter)
            square = jnp.sum(table.value**2, axis=1)
            if isinstance(view, View):
                numbers = _of_packets(problem, table, view, square)
                products.append((view, *_products(view, *numbers)))
            else:
                rest.append((table, view, factor.slots.shape[1]))
            own = 0.5 * jnp.sum(problem.loss.value(square))
        cost = cost + own
    s = problem.sizes[0]
    found = [t for t, *_ in rest], tuple(p for _, p, _ in rest), [n for *_, n in rest]
    others = assemble(*found, problem.loss, (s, 0, 0)) if rest else None
    return cost, *_joined(pattern, products, others)


_PIECE = 4096
"""Packets of a piece, at least: what is computed on the way stays in the processor's cache."""


def _by_pieces(problem: Problem, factor, view: View, at, per_parameter):
    """Cost and products of a table in tiles, some tiles at a time."""
    tables = factor.tiles.rows, view.own, view.slots, view.local_slots
    pieces, (count, width) = 1, view.own.shape
    while count % (2 * pieces) == 0 and count * width >= 2 * pieces * _PIECE:
        pieces *= 2

    def piece(some):
        rows, *parts = some
        own = eqx.tree_at(lambda f: f.tiles.rows, factor, rows)
        part = eqx.tree_at(lambda v: (v.own, v.slots, v.local_slots), view, parts)
        square, *numbers = _of_tiles(problem, own, part, at, per_parameter)
        return 0.5 * jnp.sum(problem.loss.value(square)), *_products(part, *numbers)

    cut = [jnp.reshape(t, (pieces, count // pieces, *t.shape[1:])) for t in tables]
    cost, *found = jax.lax.map(piece, cut)
    return jnp.sum(cost), *(jnp.reshape(part, (-1, *part.shape[2:])) for part in found)


def _of_tiles(problem: Problem, factor, view: View, at, per_parameter):
    """Sum of squares of each packet, and numbers of its whitened rows and derivatives by unknowns,
    with the weights of the robust loss."""
    rows = factor.tiles.rows
    value, jacobian = linearise_tiles(factor, at, view.live)
    weight = factor.weight[rows] * view.own
    scale = apart(weight[..., None] / factor.sigma[rows], 2)
    a, b = view.local
    step = apart(per_parameter[view.slots], 2)
    step[a:b] = apart(per_parameter[view.local_slots], 2)

    def used(number):
        # What is set aside counts nothing, even where it can't be predicted at all.
        return jnp.where(weight > 0.0, number, 0.0)

    value = each(lambda v, f: f * used(v), value, scale)
    square = total(v * v for v in value)
    root = jnp.sqrt(problem.loss.weight(square))

    def derivative(j, f, t):
        return j if is_known(j) and j == 0.0 else used(j) * (f * root) * t

    jacobian = each(derivative, jacobian, scale[:, None], step)
    return square, each(lambda v: v * root, value), jacobian


def _of_packets(problem: Problem, table: Linearised, view: View, square):
    """Numbers of the whitened rows and derivatives of each packet, with the weights of the loss."""
    root = jnp.sqrt(problem.loss.weight(square))[:, None]
    both = jnp.concatenate([table.jacobian, table.value[:, :, None]], axis=2) * root[:, :, None]
    numbers = apart(in_packets(view.rows, both)[:, None], 2)
    return numbers[:, -1], numbers[:, :-1]


def _products(view: View, value: Numbers, jacobian: Numbers):
    """Products of derivatives and rows: those of each run by shared unknowns, with the rows as one
    more; couplings of each packet; those of each packet by local unknowns, in a line."""
    shared, local = view.split(jacobian)
    d = local.shape[1]
    runs = view.own.shape
    coupling = joined(matmul(local.T, shared), runs, 0)
    square, pull = matmul(local.T, local), matmul(local.T, value[:, None])
    own = joined(np.append(square[np.tril_indices(d)], pull), runs, 0)
    side = jnp.moveaxis(joined(np.column_stack([shared, value]).T, runs, 2), 2, 0)
    block = jnp.einsum("tarw,tbrw->tab", side, side)
    return block, *(jnp.reshape(part, (-1, *part.shape[2:])) for part in (coupling, own))


def _joined(pattern: SchurPattern, products, rest):
    """Sums over views and groups."""
    s, _, d = pattern.sizes
    wide = pattern.wide
    shared = jnp.zeros(len(pattern.triangle.row))
    gradient = jnp.zeros(s + 1)
    if rest is not None:
        shared = (
            shared + jnp.tril(rest.hessian.shared)[pattern.triangle.row, pattern.triangle.column]
        )
        gradient = gradient.at[:s].add(rest.gradient)
    for (view, block, *_), places in zip(products, pattern.of_views, strict=True):
        whole = view.views.sums(block)
        shared = shared + places.sums(jnp.ravel(whole[:, :-1, :-1]))
        gradient = gradient.at[view.view_columns].add(whole[:, :-1, -1])
    couplings = [
        jnp.pad(own, ((0, 0), (0, 0), (0, wide - own.shape[2]))) for _, _, own, _ in products
    ]
    own = pattern.groups.sums(jnp.concatenate([own for *_, own in products]))
    place = np.zeros((d, d), int)
    place[np.tril_indices(d)] = np.arange(d * (d + 1) // 2)
    local = own[:, np.maximum(place, place.T)]
    return (
        jnp.concatenate([gradient[:s], jnp.ravel(own[:, -d:])]),
        shared,
        local,
        jnp.concatenate(couplings),
    )


def _wider(columns, wide: int, none: int):
    """Columns of a run filled up with none."""
    return jnp.pad(columns, ((0, 0), (0, wide - columns.shape[1])), constant_values=none)


class SchurFactors:
    """Cholesky factors of damped normal equations: groups eliminated first, the rest dense.

    Unknowns that no observation touches (zero diagonal) stay where they are.
    """

    bends = True

    def __init__(self, pattern: SchurPattern):
        self.pattern = pattern
        self._shared = solver(pattern.triangle)
        self._pool = ThreadPoolExecutor(CORES)

    def factorise(self, normal: SchurNormal, damping: float = 0.0) -> bool:
        """Factorise the matrix with its diagonal raised by `damping` of itself; False where it is
        not definite."""
        self._lower, self._half = _eliminated(normal.local, normal.coupling, self.pattern, damping)
        shares = self.pattern.pairs
        products = list((self._pool.map if len(shares) > 1 else map)(self._products, shares))
        return self._shared.factorise(_reduced(normal.shared, products, self.pattern, damping))

    def _products(self, pairs: Products) -> Array:
        return jax.block_until_ready(_paired(pairs, self._half))

    def damped(self, normal: SchurNormal) -> Float[np.ndarray, " n"]:
        """What damping is relative to: the present diagonal (Marquardt 1963)."""
        return normal.diagonal()

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for one right-hand side, with the latest factors."""
        factors = self.pattern, self._lower, self._half
        forward, top = _down(*factors, jnp.asarray(right))
        return _up(*factors, forward, self._shared.solve(top))


@jax.jit
def _eliminated(local, coupling, pattern: SchurPattern, damping):
    """Factors L of each group, and L^-1 W^T [d, shared] of each packet."""
    d = local.shape[1]
    diagonal = jnp.diagonal(local, axis1=1, axis2=2)
    raised = local + jnp.where(diagonal > 0.0, damping * diagonal, 1.0)[:, :, None] * jnp.eye(d)
    lower = _cholesky([[raised[:, i, j] for j in range(i + 1)] for i in range(d)])
    of_packet = [[jnp.append(one, 1.0)[pattern.group] for one in row] for row in lower]
    return lower, jnp.stack(_forward(of_packet, [coupling[:, k] for k in range(d)]), axis=1)


def _cholesky(a):
    """Cholesky factor of many small matrices, component by component: each is one long vector."""
    d = len(a)
    lower = [[a[i][j] for j in range(i + 1)] for i in range(d)]
    for j in range(d):
        pivot = lower[j][j] - sum(lower[j][k] ** 2 for k in range(j))
        lower[j][j] = jnp.sqrt(pivot)
        for i in range(j + 1, d):
            rest = lower[i][j] - sum(lower[i][k] * lower[j][k] for k in range(j))
            lower[i][j] = rest / lower[j][j]
    return lower


def _forward(lower, right):
    """L^-1 right, component by component; right may have further axes behind the first."""
    found = []
    for i, own in enumerate(right):
        for k in range(i):
            own = own - _along(lower[i][k], own) * found[k]
        found.append(own / _along(lower[i][i], own))
    return found


def _backward(lower, right):
    """L^-T right, component by component."""
    found = {}
    for i in reversed(range(len(right))):
        own = right[i] - sum(lower[k][i] * found[k] for k in found)
        found[i] = own / lower[i][i]
    return [found[i] for i in range(len(right))]


def _along(vector, values):
    return jnp.reshape(vector, (-1,) + (1,) * (values.ndim - 1))


@jax.jit
def _paired(pairs: Products, half):
    return jnp.ravel(pairs(half))


@jax.jit
def _reduced(shared, products, pattern: SchurPattern, damping):
    """Entries of the reduced matrix."""
    at = pattern.triangle.diagonal
    diagonal = shared[at]
    raised = shared.at[at].add(jnp.where(diagonal > 0.0, damping * diagonal, 1.0))
    return raised - pattern.of_pairs.sums(jnp.concatenate(products))


@jax.jit
def _down(pattern: SchurPattern, lower, half, right):
    """Right-hand sides of the groups, forward, and that of the reduced matrix."""
    s, n_groups, d = pattern.sizes
    a, b = right[:s], jnp.reshape(right[s:], (n_groups, d))
    forward = jnp.stack(_forward(lower, [b[:, k] for k in range(d)]), axis=1)
    taken = jnp.sum(half * padded(forward)[pattern.group][:, :, None], axis=1)
    top = jnp.append(a, 0.0)
    for view, own in pattern.by_table(taken):
        of_runs = jnp.sum(view.in_runs(own), axis=1)[:, : view.n_shared]
        top = top.at[view.view_columns].add(-view.views.sums(of_runs))
    return forward, top[:s]


@jax.jit
def _up(pattern: SchurPattern, lower, half, forward, shared):
    """All unknowns from the shared ones."""
    d = pattern.sizes[2]
    seen = jnp.append(shared, 0.0)
    back = [
        jnp.sum(
            view.in_runs(own)[..., : view.n_shared] * seen[view.columns][:, None, None, :], axis=3
        )
        for view, own in pattern.by_table(half)
    ]
    back = jnp.concatenate([jnp.reshape(own, (-1, d)) for own in back])
    rest = forward - pattern.groups.sums(back)
    local = jnp.stack(_backward(lower, [rest[:, k] for k in range(d)]), axis=1)
    return jnp.concatenate([shared, jnp.ravel(local)])
