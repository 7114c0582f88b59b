"""Unknowns in levels, each coupled to its neighbours alone: a block-tridiagonal normal matrix.

The levels of a breadth-first search over what is observed together are such an order (Cuthill and
McKee 1969; George and Liu 1981, section 4.3). A chain of stations has one station in each level, a
ring two, a ladder as many as it is wide. Factorising takes levels x width^3 where a dense matrix
takes (levels x width)^3, and all of it is traced: a batch of trials stays one program.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvm.solve.arrow import NormalMatrix
from jaxvm.solve.buckets import padded
from jaxvm.solve.triangle import Places

_GAIN = 8
"""How many times fewer products than those of a dense matrix make levels worth while: small
matrices, one after the other, are slower for their size."""


class Levels(eqx.Module):
    """An order of unknowns in which each couples to its own level and the next ones alone.

    Attributes:
        unknown: at each place of each level; their number where it is filled up.
        place: of each unknown in the levels, one after the other.
        entries: which products of packets add up to the entries of a matrix in this order, first
            those within all levels, then those with the level after.
    """

    unknown: Int[Array, "levels width"]
    place: Int[Array, " n"]
    entries: Places

    @classmethod
    def of(cls, columns: list[Int[np.ndarray, "packets k"]], n: int) -> "Levels | None":
        """Levels of n unknowns, from those that each packet of each table touches (n: none).

        None where a dense matrix is as good.
        """
        sets = _search(_incidence(columns, n))
        width = max(map(len, sets), default=0)
        if _GAIN * len(sets) * width**3 > n**3:
            return None
        unknown = np.full((len(sets), width), n)
        for level, members in zip(unknown, sets, strict=True):
            level[: len(members)] = members
        place = np.full(n + 1, -1)
        place[unknown.ravel()] = np.arange(unknown.size)
        numbers, entries, end = [], [], 0
        for own in columns:
            row, column = np.broadcast_arrays(place[own][:, :, None], place[own][:, None, :])
            used = (own < n)[:, :, None] & (own < n)[:, None, :]
            ahead = row // width - column // width
            used &= (ahead == 0) | (ahead == 1)
            row, column, ahead = row[used], column[used], ahead[used]
            at = (ahead * len(sets) + column // width) * width + row % width
            entries.append(at * width + column % width)
            numbers.append(end + np.flatnonzero(used))
            end += used.size
        n_entries = 2 * len(sets) * width**2
        places = Places.of(np.concatenate(numbers), np.concatenate(entries), end, n_entries)
        return cls(jnp.asarray(unknown), jnp.asarray(place[:n]), places)

    def matrix(self, products: Float[Array, " numbers"]) -> "Tridiagonal":
        """The matrix that products of packets, of all tables in a line, add up to."""
        blocks = jnp.reshape(
            self.entries.sums(products), (2, *self.unknown.shape, self.unknown.shape[1])
        )
        return Tridiagonal(self.unknown, self.place, blocks[0], blocks[1])


class Tridiagonal(NormalMatrix):
    """A symmetric positive (semi)definite matrix of levels.

    Attributes:
        unknown, place: as those of its `Levels`.
        own: block of each level; zero where it is filled up.
        next: block with the level after, whose unknowns are its rows; zero for the last.
    """

    unknown: Int[Array, "levels width"]
    place: Int[Array, " n"]
    own: Float[Array, "levels width width"]
    next: Float[Array, "levels width width"]

    def spread(self, x: Float[Array, "n *k"]) -> Float[Array, "levels width *k"]:
        """A vector, or a block of columns, in levels."""
        return padded(x)[self.unknown]

    def gathered(self, values: Float[Array, "levels width *k"]) -> Float[Array, "n *k"]:
        """Inverse of `spread`."""
        return jnp.reshape(values, (-1, *values.shape[2:]))[self.place]

    def mv(self, vector: Float[Array, " n"]) -> Float[Array, " n"]:
        """Matrix times vector."""
        x = self.spread(vector)
        product = jnp.einsum("lij,lj->li", self.own, x)
        product = product.at[1:].add(jnp.einsum("lij,lj->li", self.next[:-1], x[:-1]))
        product = product.at[:-1].add(jnp.einsum("lij,li->lj", self.next[:-1], x[1:]))
        return self.gathered(product)

    def diagonal(self) -> Float[Array, " n"]:
        """Diagonal of the matrix."""
        return self.gathered(jnp.diagonal(self.own, axis1=1, axis2=2))

    def add_diagonal(self, values: Float[Array, " n"]) -> "Tridiagonal":
        """The matrix with a diagonal added."""
        raised = self.own + jax.vmap(jnp.diag)(self.spread(values))
        return Tridiagonal(self.unknown, self.place, raised, self.next)

    def factorised(self) -> "TridiagonalFactors":
        """Cholesky factors, level by level."""
        diagonal = jnp.diagonal(self.own, axis1=1, axis2=2)
        raised = self.own + jax.vmap(jnp.diag)(jnp.where(diagonal == 0.0, 1.0, 0.0))

        def level(taken, blocks):
            own, after = blocks
            root = jnp.linalg.cholesky(own - taken)
            half = jsl.solve_triangular(root, after.T, lower=True)
            return half.T @ half, (root, half)

        _, (root, half) = jax.lax.scan(level, jnp.zeros_like(raised[0]), (raised, self.next))
        return TridiagonalFactors(self, root, half)


class TridiagonalFactors(eqx.Module):
    """Cholesky factors: the root L of each level, and L^-1 N^T of its block N with the next."""

    matrix: Tridiagonal
    root: Float[Array, "levels width width"]
    half: Float[Array, "levels width width"]

    def solve(self, rhs: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
        """Solution for one right-hand side or a block of them."""
        flat = self.matrix.spread(rhs if rhs.ndim == 2 else rhs[:, None])

        def down(taken, level):
            root, half, right = level
            found = jsl.solve_triangular(root, right - taken, lower=True)
            return half.T @ found, found

        def up(after, level):
            root, half, right = level
            found = jsl.solve_triangular(root, right - half @ after, lower=True, trans=1)
            return found, found

        none = jnp.zeros_like(flat[0])
        _, forward = jax.lax.scan(down, none, (self.root, self.half, flat))
        _, found = jax.lax.scan(up, none, (self.root, self.half, forward), reverse=True)
        return jnp.reshape(self.matrix.gathered(found), rhs.shape)


def _incidence(columns: list[Int[np.ndarray, "packets k"]], n: int) -> Bool[np.ndarray, "sets n"]:
    """Which unknowns are observed together: a row for each set of them."""
    rows = []
    for own in columns:
        touched = np.zeros((len(own), n + 1), bool)
        touched[np.arange(len(own))[:, None], own] = True
        rows.append(np.unique(touched[:, :n], axis=0))
    return np.concatenate(rows)


def _search(touched: Bool[np.ndarray, "sets n"]) -> list[Int[np.ndarray, " members"]]:
    """Levels of a breadth-first search, from a far end of every connected part."""
    found, rest = [], np.ones(touched.shape[1], bool)
    while rest.any():
        levels = _from(touched, int(np.argmax(rest)))
        for _ in range(2):
            levels = _from(touched, int(levels[-1][0]))
        found += levels
        for level in levels:
            rest[level] = False
    return found


def _from(touched: Bool[np.ndarray, "sets n"], first: int) -> list[Int[np.ndarray, " members"]]:
    # A pose is one body: what the same sets touch starts together.
    front = (touched == touched[:, first, None]).all(axis=0)
    seen, levels = front.copy(), []
    while front.any():
        levels.append(np.flatnonzero(front))
        front = touched[touched[:, front].any(axis=1)].any(axis=0) & ~seen
        seen |= front
    return levels
