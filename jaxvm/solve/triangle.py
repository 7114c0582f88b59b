"""The reduced matrix of a Schur complement: where its entries come from, and its factors.

Both a dense and a sparse matrix are a list of entries of the lower triangle, each the sum of a few
numbers that were computed elsewhere. Nearly all have one such number, so they are gathered; only
what adds to another one is scattered.
"""

from typing import Any, Protocol

import cvxopt
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from cvxopt import cholmod  # pyright: ignore[reportAttributeAccessIssue]
from jaxtyping import Array, Float, Int

from jaxvm.solve.buckets import taken


class Places(eqx.Module):
    """Which numbers add up to each entry.

    Attributes:
        first: of each entry; the number of numbers where there is none.
        further: numbers that are added to an entry that has one already.
        entry: that entry.
    """

    first: Int[Array, " entries"]
    further: Int[Array, " more"]
    entry: Int[Array, " more"]

    @classmethod
    def of(
        cls, number: Int[np.ndarray, " k"], entry: Int[np.ndarray, " k"], end: int, n: int
    ) -> "Places":
        """Number k goes to its entry, one of n; `end` is how many numbers there are."""
        first, chosen = np.full(n, end), np.full(n, -1)
        first[entry] = number
        chosen[entry] = np.arange(len(number))
        rest = np.flatnonzero(chosen[entry] != np.arange(len(number)))
        return cls(jnp.asarray(first), jnp.asarray(number[rest]), jnp.asarray(entry[rest]))

    def sums(self, numbers: Float[Array, " numbers"]) -> Float[Array, " entries"]:
        """The entries."""
        found = taken(jnp.append(numbers, 0.0), self.first)
        return found.at[self.entry].add(taken(numbers, self.further))


class Triangle(eqx.Module):
    """The lower triangle of a symmetric matrix as a list of entries.

    Dense: all entries of the matrix, row by row, those above the diagonal zero. Sparse: those that
    may differ from zero, column by column.

    Attributes:
        row, column: of each entry.
        diagonal: place of each diagonal entry in the list.
        dense: whether the list is the matrix.
    """

    row: Int[Array, " entries"]
    column: Int[Array, " entries"]
    diagonal: Int[Array, " n"]
    dense: bool = eqx.field(static=True)

    @property
    def n(self) -> int:
        """Rows of the matrix."""
        return len(self.diagonal)

    @classmethod
    def of(cls, key: Int[np.ndarray, " k"], n: int, dense: bool) -> "Triangle":
        """Of the entries that occur, each as column n + row; the diagonal is always there."""
        if dense:
            row, column = np.divmod(np.arange(n * n), n)
            return cls(jnp.asarray(row), jnp.asarray(column), jnp.arange(n) * (n + 1), True)
        every = np.sort(np.concatenate([key, np.arange(n) * (n + 1)]))
        every = every[np.append(True, every[1:] > every[:-1])]
        diagonal = np.searchsorted(every, np.arange(n) * (n + 1))
        row, column = jnp.asarray(every % n), jnp.asarray(every // n)
        return cls(row, column, jnp.asarray(diagonal), False)

    def place(self, key: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        """Where entries, each as column n + row, stand in the list."""
        n = self.n
        if self.dense:
            return (key % n) * n + key // n
        return np.searchsorted(np.asarray(self.column) * n + np.asarray(self.row), key)


class Solver(Protocol):
    """Factors of a reduced matrix."""

    def factorise(self, entries: Float[Array, " entries"]) -> bool: ...
    def solve(self, right: Float[Array, " n"]) -> Any: ...


def solver(triangle: Triangle) -> Solver:
    """A place for the factors of a matrix."""
    if triangle.dense:
        return Dense(triangle.n)
    return Sparse(triangle.row, triangle.column, triangle.n)


class Dense:
    """Cholesky factors of a dense matrix, scaled to a unit diagonal."""

    def __init__(self, n: int):
        self._n = n

    def factorise(self, entries: Float[Array, " entries"]) -> bool:
        """Factorise; False where the matrix is not definite."""
        self._factor, sound = _factorised(entries, self._n)
        return bool(sound)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for one right-hand side."""
        return _solution(self._factor, right)


@jax.jit(static_argnums=1)
def _factorised(entries, n: int):
    matrix = jnp.reshape(entries, (n, n))
    scale = 1.0 / jnp.sqrt(jnp.diagonal(matrix))
    scaled = scale[:, None] * matrix * scale
    factor = jax.lax.linalg.cholesky(scaled, symmetrize_input=False)
    return (factor, scale), jnp.all(jnp.isfinite(factor))


@jax.jit
def _solution(factors, right):
    factor, scale = factors
    return scale * jsl.cho_solve((factor, True), scale * right)


class Sparse:
    """Cholesky factors of a sparse matrix, given as entries of its lower triangle, by CHOLMOD:
    analysed once."""

    def __init__(self, row, column, n: int):
        self._matrix = cvxopt.spmatrix(
            1.0, cvxopt.matrix(np.asarray(row)), cvxopt.matrix(np.asarray(column)), (n, n)
        )
        self._symbolic = cholmod.symbolic(self._matrix)

    def factorise(self, entries: Float[np.ndarray | Array, " entries"]) -> bool:
        """Factorise; False where the matrix is not definite."""
        values = np.asarray(entries)
        if not np.isfinite(values).all():
            return False
        self._matrix.V = cvxopt.matrix(values)
        try:
            cholmod.numeric(self._matrix, self._symbolic)
        except ArithmeticError:
            return False
        return True

    def solve(self, right: Float[np.ndarray | Array, "n *k"]) -> Float[np.ndarray, "n *k"]:
        """Solution for one right-hand side or a block of them."""
        columns = cvxopt.matrix(np.reshape(np.asarray(right), (len(right), -1)))
        cholmod.solve(self._symbolic, columns)
        return np.reshape(np.array(columns), np.shape(right))
