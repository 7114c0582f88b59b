"""Normal equations of large networks: sparse, factorised on the host by CHOLMOD.

The arrow form (`jaxvm.solve.arrow`) keeps its shared part dense. A network of thousands of stations
shares everything with everything along its sight lines, and little else: here all unknowns go into
one sparse matrix, whose elimination order (approximate minimum degree, Amestoy, Davis & Duff 1996)
finds local unknowns by itself. Packets are linearised and multiplied in one compiled program that
keeps no Jacobian; only their small blocks reach the host.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvm.network.residual import linearise, present
from jaxvm.solve.buckets import CORES
from jaxvm.solve.problem import Packets, Problem, flat_state, whitened
from jaxvm.solve.triangle import Sparse

_ROWS_AT_A_TIME = 256
"""Rows that are linearised together: their Jacobian stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """Where the non-zeros of a normal matrix are, and which products of packets add up to each.

    Lower triangle by columns, rows ascending. The diagonal is complete.

    Attributes:
        n: number of unknowns.
        row, column: of each non-zero.
        diagonal: place of each diagonal entry among the non-zeros.
        shares: the packets of all tables in equal shares, one for each core.
        source, place: for each share and table, which entries of its flattened blocks count, and
            where.
        unknown: for each share and table, the unknown of each gradient entry of its packets.
    """

    n: int
    row: Int[np.ndarray, " nonzeros"]
    column: Int[np.ndarray, " nonzeros"]
    diagonal: Int[np.ndarray, " n"]
    shares: tuple[tuple[Packets, ...], ...]
    source: tuple[Int[np.ndarray, " entries"], ...]
    place: tuple[Int[np.ndarray, " entries"], ...]
    unknown: tuple[Int[np.ndarray, " entries"], ...]

    @classmethod
    def of(cls, problem: Problem) -> "Pattern":
        """Pattern of a problem's normal equations."""
        n = problem.n
        shares = _shares(problem.packets, n)
        every_packets = [packets for share in shares for packets in share]
        sources, keys = [], []
        for packets in every_packets:
            columns = np.asarray(packets.columns)
            k = columns.shape[1]
            rows = np.repeat(columns, k, axis=1).ravel()
            below = np.tile(columns, (1, k)).ravel()
            source = np.flatnonzero((rows >= below) & (rows < n))
            sources.append(source)
            keys.append(below[source] * n + rows[source])
        diagonal = np.arange(n) * (n + 1)
        every, place = np.unique(np.concatenate([*keys, diagonal]), return_inverse=True)
        ends = np.cumsum([len(key) for key in keys]).astype(int)
        pieces = np.split(place, ends)
        return cls(
            n=n,
            row=every % n,
            column=every // n,
            diagonal=pieces[-1],
            shares=shares,
            source=tuple(sources),
            place=tuple(pieces[:-1]),
            unknown=tuple(np.asarray(packets.columns).ravel() for packets in every_packets),
        )


def _shares(tables: tuple[Packets, ...], n: int) -> tuple[tuple[Packets, ...], ...]:
    """Packets in equal shares for all cores: a share is one compiled program.

    Tables whose packets can't be shared out evenly are filled up with empty packets.
    """

    def part(packets: Packets, k: int) -> Packets:
        height = -(-packets.rows.shape[0] // CORES)
        rows, columns = np.asarray(packets.rows), np.asarray(packets.columns)
        spare = height * CORES - len(rows)
        # An empty packet has rows past the last one, and unknowns, too.
        rows = np.pad(rows, ((0, spare), (0, 0)), constant_values=np.iinfo(np.int64).max)
        columns = np.pad(columns, ((0, spare), (0, 0)), constant_values=n)
        own = slice(k * height, (k + 1) * height)
        return Packets(jnp.asarray(rows[own]), jnp.asarray(columns[own]), packets.live)

    return tuple(tuple(part(packets, k) for packets in tables) for k in range(CORES))


@dataclass(frozen=True, eq=False)
class SparseNormal:
    """Cost, gradient and Gauss-Newton matrix (the values of its pattern) at one x."""

    pattern: Pattern
    cost: float
    gradient: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " nonzeros"]

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """Diagonal of the matrix."""
        return self.values[self.pattern.diagonal]

    def at(self, problem: Problem, x: Float[Array, " n"]) -> "SparseNormal":
        """The normal equations elsewhere."""
        return sparse_normal(problem, self.pattern, x)

    def rescaled(self, scale: Float[np.ndarray, " n"]) -> "SparseNormal":
        """The same for unknowns in other units: x_new = x / scale."""
        both = scale[self.pattern.row] * scale[self.pattern.column]
        return replace(self, gradient=self.gradient * scale, values=self.values * both)

    def mv(self, x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Matrix times vector."""
        row, column, n = self.pattern.row, self.pattern.column, self.pattern.n
        off = row != column
        lower = np.bincount(row, self.values * x[column], n)
        return lower + np.bincount(column[off], self.values[off] * x[row[off]], n)


def sparse_normal(problem: Problem, pattern: Pattern, x: Float[Array, " n"]) -> SparseNormal:
    """Normal equations of a problem at x, with the weights of its robust loss."""
    x = jnp.asarray(x)
    bare = eqx.tree_at(lambda p: p.packets, problem, ())
    with ThreadPoolExecutor(len(pattern.shares)) as pool:
        parts = list(
            pool.map(lambda share: jax.block_until_ready(_products(bare, share, x)), pattern.shares)
        )
    blocks = [block for _, found, _ in parts for block in found]
    products = [product for *_, found in parts for product in found]
    values = np.zeros(len(pattern.row))
    gradient = np.zeros(pattern.n + 1)
    tables = zip(pattern.source, pattern.place, pattern.unknown, blocks, products, strict=True)
    for source, place, unknown, block, product in tables:
        values += np.bincount(place, np.ravel(block)[source], len(values))
        gradient += np.bincount(unknown, np.ravel(product), len(gradient))
    return SparseNormal(pattern, sum(float(cost) for cost, *_ in parts), gradient[:-1], values)


def total_cost(problem: Problem, x: Float[Array, " n"]) -> float:
    """Half the sum of the losses at x."""
    return float(_cost(eqx.tree_at(lambda p: p.packets, problem, ()), x))


@eqx.filter_jit
def _cost(problem: Problem, x):
    return problem.cost(x)


@eqx.filter_jit
def _products(problem: Problem, packets_of: tuple[Packets, ...], x):
    """Cost, and J^T J and J^T r of some packets of every table."""
    network, layout = problem.network, problem.network.layout
    flat, per_parameter = flat_state(problem, x)
    now = present(network, flat, slopes=True)
    effects = jnp.asarray(np.concatenate([layout.all("amplitude"), layout.all("constant")]))

    def of_packet(rows, factor, packets: Packets):
        n = factor.slots.shape[0]
        at = jnp.minimum(rows, n - 1)
        own = jax.tree.map(lambda leaf: leaf[at] if leaf.ndim else leaf, factor.untiled())
        weight = jnp.where(rows < n, own.weight, 0.0)
        raw = linearise(own, network, now, packets.live)
        (table,) = whitened(
            [raw], [(weight, own.sigma)], [(own.slots, effects, packets.live)], per_parameter
        )
        square = jnp.sum(table.value**2, axis=1)
        root = jnp.sqrt(problem.loss.weight(square))[:, None]
        left = jnp.reshape(table.jacobian * root[:, :, None], (-1, len(packets.live)))
        cost = 0.5 * jnp.sum(problem.loss.value(square))
        return cost, left.T @ left, left.T @ jnp.ravel(table.value * root)

    cost, blocks, products = jnp.zeros(()), [], []
    for factor, packets in zip(network.factors(), packets_of, strict=True):
        width = packets.rows.shape[1]
        found = jax.lax.map(
            lambda rows, f=factor, p=packets: of_packet(rows, f, p),
            packets.rows,
            batch_size=max(_ROWS_AT_A_TIME // width, 1),
        )
        cost = cost + jnp.sum(found[0])
        blocks.append(found[1])
        products.append(found[2])
    return cost, blocks, products


class SparseFactors:
    """Cholesky factors of sparse normal matrices of one pattern: analysed once.

    Unknowns that no observation touches (zero diagonal) stay where they are.
    """

    bends = False

    def __init__(self, pattern: Pattern):
        self.pattern = pattern
        self._factors = Sparse(pattern.row, pattern.column, pattern.n)

    def factorise(self, normal: SparseNormal, damping: float = 0.0) -> bool:
        """Factorise the matrix plus `damping` on its diagonal; False where it is not definite."""
        values = normal.values.copy()
        diagonal = values[self.pattern.diagonal]
        values[self.pattern.diagonal] = np.where(diagonal > 0.0, diagonal + damping, 1.0)
        return self._factors.factorise(values)

    def damped(self, normal: SparseNormal) -> Float[np.ndarray, " n"]:
        """What damping is relative to: the unit diagonal of a scaled problem."""
        return np.ones(self.pattern.n)

    def solve(self, right: Float[np.ndarray, "n *k"]) -> Float[np.ndarray, "n *k"]:
        """Solution for one right-hand side or a block of them, with the latest factors."""
        return self._factors.solve(right)
