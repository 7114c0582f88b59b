"""Selected inverse: the entries of H^-1 where H has its own, which is all that precision needs.

Takahashi, Fagan & Chin 1973, by fronts (Campbell & Davis 1995): blocks of unknowns are eliminated
one after the other, each with the dense front of the blocks it meets; on the way back every front
of the inverse is a part of its parent's. No other entries are ever formed.
"""

from dataclasses import dataclass

import cvxopt
import numpy as np
from cvxopt import amd  # pyright: ignore[reportAttributeAccessIssue]
from jaxtyping import Array, Float, Int

from jaxvm.solve.problem import Problem
from jaxvm.solve.sparse import Pattern, SparseNormal, sparse_normal


@dataclass(frozen=True, eq=False)
class SelectedInverse:
    """The inverse of a normal matrix at the non-zeros of its pattern."""

    pattern: Pattern
    values: Float[np.ndarray, " nonzeros"]

    @classmethod
    def of(cls, problem: Problem, x: Float[Array, " n"]) -> "SelectedInverse":
        """That of a problem's normal equations at x."""
        pattern = Pattern.of(problem)
        return cls(pattern, selected_inverse(sparse_normal(problem, pattern, x)))

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """Variances of all unknowns."""
        return self.values[self.pattern.diagonal]

    def blocks(self, columns: Int[np.ndarray, "m k"]) -> Float[np.ndarray, "m k k"]:
        """Blocks of unknowns that meet in an observation; zero for those that are held (>= n)."""
        n = self.pattern.n
        a = np.maximum(columns[:, :, None], columns[:, None, :])
        b = np.minimum(columns[:, :, None], columns[:, None, :])
        key = self.pattern.column * n + self.pattern.row
        wanted = np.where(a < n, b * n + a, 0)
        place = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where((a < n) & (key[place] == wanted), self.values[place], 0.0)


def selected_inverse(normal: SparseNormal) -> Float[np.ndarray, " nonzeros"]:
    """Entries of the inverse of a normal matrix, in the order of the non-zeros of its pattern.

    Unknowns that no observation touches (zero diagonal) have no variance: zero.

    Raises:
        numpy.linalg.LinAlgError: the matrix is not positive definite.
    """
    pattern = normal.pattern
    first = _blocks(pattern)
    tree = _Tree(pattern, first)
    values = normal.values.copy()
    untouched = values[pattern.diagonal] == 0.0
    values[pattern.diagonal[untouched]] = 1.0
    lower, across = _eliminate(pattern, values, first, tree)
    found = _returned(pattern, first, tree, lower, across)
    dead = untouched[pattern.row] | untouched[pattern.column]
    return np.where(dead, 0.0, found)


def _blocks(pattern: Pattern) -> Int[np.ndarray, " blocks+1"]:
    """First unknown of each block: runs of unknowns with the same column below them."""
    n = pattern.n
    counts = np.bincount(pattern.column, minlength=n)
    # Sums of hashed rows tell columns apart; k and k + 1 go together where they differ by k alone.
    hashed = np.random.default_rng(0).integers(1 << 40, size=n)
    total = np.bincount(pattern.column, hashed[pattern.row].astype(float), n)
    same = (counts[:-1] == counts[1:] + 1) & (total[:-1] == total[1:] + hashed[:-1])
    return np.concatenate([[0], np.flatnonzero(~same) + 1, [n]])


class _Tree:
    """Elimination tree of the blocks.

    Attributes:
        order: blocks in the order of their elimination.
        below: for each step, the steps that the block of that step still meets, ascending.
        children: for each step, the steps that hang below it.
    """

    def __init__(self, pattern: Pattern, first: np.ndarray):
        block = np.repeat(np.arange(len(first) - 1), np.diff(first))
        a, b = block[pattern.row], block[pattern.column]
        pairs = np.unique(np.stack([a, b], axis=1), axis=0)
        m = len(first) - 1
        ones = cvxopt.matrix(1.0, (len(pairs), 1))
        graph = cvxopt.spmatrix(
            ones, cvxopt.matrix(pairs[:, 0]), cvxopt.matrix(pairs[:, 1]), (m, m)
        )
        self.order = np.array(amd.order(graph)).ravel()
        self.step = np.empty(m, int)
        self.step[self.order] = np.arange(m)
        ends = self.step[pairs[pairs[:, 0] != pairs[:, 1]]]
        later, sooner = ends.max(axis=1), ends.min(axis=1)
        by_sooner = np.argsort(sooner, kind="stable")
        own = np.split(later[by_sooner], np.cumsum(np.bincount(sooner, minlength=m))[:-1])
        self.below: list[np.ndarray] = []
        self.children: list[list[int]] = [[] for _ in range(m)]
        for k in range(m):
            met = [own[k], *(self.below[child] for child in self.children[k])]
            rows = np.unique(np.concatenate(met))
            rows = rows[rows > k]
            self.below.append(rows)
            if len(rows):
                self.children[rows[0]].append(k)


def _unknowns(first, order, steps) -> np.ndarray:
    """Unknowns of the blocks that are eliminated at some steps."""
    blocks = order[steps]
    sizes = first[blocks + 1] - first[blocks]
    starts = np.repeat(first[blocks] - np.concatenate([[0], np.cumsum(sizes)[:-1]]), sizes)
    return np.arange(int(sizes.sum())) + starts


def _columns_of(pattern: Pattern, values, first, tree: _Tree):
    """For each step, the given entries of the matrix in its block's columns: row, column, value."""
    block = np.repeat(np.arange(len(first) - 1), np.diff(first))
    a, b = tree.step[block[pattern.row]], tree.step[block[pattern.column]]
    # An entry belongs to the block that is eliminated first; inside a block, both triangles.
    swap = a < b
    row = np.where(swap, pattern.column, pattern.row)
    column = np.where(swap, pattern.row, pattern.column)
    owner = np.minimum(a, b)
    order = np.argsort(owner, kind="stable")
    cuts = np.searchsorted(owner[order], np.arange(len(first) - 1))[1:]
    where = np.arange(len(order))
    return list(zip(*(np.split(x[order], cuts) for x in (row, column, values, where)), strict=True))


def _eliminate(pattern: Pattern, values, first, tree: _Tree):
    """Cholesky factors of all diagonal blocks, and L_below L_own^-1 of all fronts."""
    place = np.zeros(pattern.n, int)
    given = _columns_of(pattern, values, first, tree)
    updates: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    lower, across = [], []
    for k, rows in enumerate(tree.below):
        unknowns = _unknowns(first, tree.order, np.concatenate([[k], rows]))
        d = first[tree.order[k] + 1] - first[tree.order[k]]
        place[unknowns] = np.arange(len(unknowns))
        front = np.zeros((len(unknowns), len(unknowns)))
        row, column, value, _ = given[k]
        front[place[row], place[column]] = value
        inside = place[row] < d
        front[place[column[inside]], place[row[inside]]] = value[inside]
        for child in tree.children[k]:
            own, update = updates.pop(child)
            at = place[own]
            front[np.ix_(at, at)] += update
        root = np.linalg.cholesky(front[:d, :d])
        half = np.linalg.solve(root, front[d:, :d].T)  # L_below^T
        lower.append(root)
        across.append(np.linalg.solve(root.T, half).T)
        if len(rows):
            updates[k] = unknowns[d:], front[d:, d:] - half.T @ half
    return lower, across


def _returned(pattern: Pattern, first, tree: _Tree, lower, across):
    """Entries of the inverse at the non-zeros of the pattern, from the last block to the first."""
    found = np.zeros(len(pattern.row))
    given = _columns_of(pattern, found, first, tree)
    place = np.zeros(pattern.n, int)
    fronts: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    waiting = [len(children) for children in tree.children]
    for k in range(len(tree.below) - 1, -1, -1):
        rows = tree.below[k]
        unknowns = _unknowns(first, tree.order, np.concatenate([[k], rows]))
        d = first[tree.order[k] + 1] - first[tree.order[k]]
        inverse = np.linalg.inv(lower[k])
        own = inverse.T @ inverse
        front = np.empty((len(unknowns), len(unknowns)))
        if len(rows):
            parent = int(rows[0])
            above, entries = fronts[parent]
            place[above] = np.arange(len(above))
            at = place[unknowns[d:]]
            rest = entries[np.ix_(at, at)]
            beside = -rest @ across[k]
            front[d:, d:], front[d:, :d], front[:d, d:] = rest, beside, beside.T
            own = own - across[k].T @ beside
            waiting[parent] -= 1
            if waiting[parent] == 0:
                del fronts[parent]
        front[:d, :d] = own
        place[unknowns] = np.arange(len(unknowns))
        row, column, _, where = given[k]
        found[where] = front[place[row], place[column]]
        if waiting[k]:
            fronts[k] = unknowns, front
    return found
