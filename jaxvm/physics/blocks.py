"""Tables evaluated in blocks of a fixed number of rows: programs fit recordings of any size.

Compiling the chain and its derivatives takes seconds, running it milliseconds. A program for a
block of rows is compiled once and serves every recording with such cameras; a program for a whole
table would serve recordings of that very size alone. Under a transformation of JAX (`jit`, `vmap`,
`grad`) and on an accelerator the whole table is one program, as usual.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from jaxvm.compiling import program

BLOCK = 1024
"""Rows of a block."""

_SMALL = 64
"""Rows of a block of a small table."""


def whole(*values) -> bool:
    """Whether tables are one program: under a transformation of JAX, and on an accelerator."""
    leaves = jax.tree.leaves(values)
    return jax.default_backend() != "cpu" or any(isinstance(leaf, Tracer) for leaf in leaves)


def hosted(*arrays) -> Any:
    """Arrays as NumPy's unless tables are one program: indexing them compiles nothing."""
    return arrays if whole(arrays) else tuple(np.asarray(array) for array in arrays)


def by_blocks(
    function: Callable, table, *common, size: int | None = None, only: np.ndarray | None = None
) -> Any:
    """`function(table, *common)`, computed block by block of the table's rows.

    Args:
        function: compiled; every leaf of its result leads with the rows of its first argument.
        table: PyTree whose leaves lead with the rows; scalars go along unchanged.
        common: what all rows share.
        size: rows of a block; by default `BLOCK`, less for a small table.
        only: rows that are wanted, in order; the others are zero where blocks are computed.
    """
    if whole(table, common):
        return function(table, *common)
    named = {}
    while isinstance(function, partial) and not function.args:
        named = function.keywords | named
        function = function.func
    # All blocks have one structure: to put each together and take it apart again takes as long as
    # to run many a program.
    leaves, structure = jax.tree.flatten(((table, *common), named))
    n_leaves = jax.tree.structure(table).num_leaves
    leaves, others = [np.asarray(leaf) for leaf in leaves[:n_leaves]], leaves[n_leaves:]
    n = max(len(leaf) for leaf in leaves if leaf.ndim)
    size = size or (_SMALL if n <= _SMALL else BLOCK)
    only = None if only is None or len(only) == n else only
    wanted = n if only is None else len(only)
    found = []
    # Without any row the shape of the result is that of a block.
    for start in range(0, max(wanted, 1), size):
        block = [_cut(leaf, start, size, only) if leaf.ndim else leaf for leaf in leaves]
        if isinstance(function, program):
            found.append(function.of_leaves([*block, *others], structure))
        else:
            args, kwargs = jax.tree.unflatten(structure, [*block, *others])
            found.append(function(*args, **kwargs))

    def joined(*parts):
        values = np.concatenate(parts)[:wanted]
        if only is None:
            return values
        everywhere = np.zeros((n, *values.shape[1:]), values.dtype)
        everywhere[only] = values
        return everywhere

    return jax.tree.map(joined, *found)


def _cut(leaf: np.ndarray, start: int, size: int, only: np.ndarray | None) -> np.ndarray:
    """Rows of a block; the last row again where the table ends."""
    if only is None and start + size <= len(leaf):
        return leaf[start : start + size]
    rows = np.arange(len(leaf)) if only is None or not len(only) else only
    return leaf[rows[np.minimum(np.arange(start, start + size), len(rows) - 1)]]


def rounded(n: int) -> int:
    """The next number of the form m * 2^k with m in 4..8: sizes of tables, at most a quarter more.

    Few sizes mean few compiled programs.
    """
    step = 1 << max(int(n - 1).bit_length() - 3, 0)
    return -(-n // step) * step


def roomy(values, axis: int = 0, least: int = 64) -> Any:
    """An array filled up with its last value along an axis, to a power of two, `least` or more."""
    return _grown(values, axis, least, mode="edge")


def continued(series):
    """Series (last axis) that go on in a straight line, as long as a power of two.

    Where a series ends, neither its values nor its central differences change.
    """
    if series.shape[-1] < 2:
        return series
    return _grown(series, -1, 64, mode="reflect", reflect_type="odd")


def _grown(values, axis: int, least: int, **how):
    n = values.shape[axis]
    size = max(least, 1 << max(n - 1, 0).bit_length())
    if whole(values) or n in (0, size):
        return values
    widths = [(0, 0)] * np.ndim(values)
    widths[axis] = (0, size - n)
    return np.pad(np.asarray(values), widths, **how)
