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
    (n,) = {len(leaf) for leaf in leaves if leaf.ndim}
    size = size or (_SMALL if n <= _SMALL else BLOCK)
    only = None if only is None or len(only) == n else only
    wanted = n if only is None else len(only)
    found = []
    # Without any row the shape of the result is that of a block.
    for start in range(0, max(wanted, 1), size):
        rows = _rows(start, size, n, only)
        block = [_cut(leaf, rows) if leaf.ndim else leaf for leaf in leaves]
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


def _rows(start: int, size: int, n: int, only: np.ndarray | None) -> slice | np.ndarray:
    """Rows of a block; the last row again where the table ends."""
    if only is None and start + size <= n:
        return slice(start, start + size)
    rows = np.arange(n) if only is None or not len(only) else only
    return rows[np.minimum(np.arange(start, start + size), len(rows) - 1)]


def _cut(leaf: np.ndarray, rows: slice | np.ndarray) -> np.ndarray:
    return leaf[rows] if isinstance(rows, slice) else leaf.take(rows, axis=0)


def rounded(n: int) -> int:
    """The next number of the form m * 2^k with m in 4..8: sizes of tables, at most a quarter more.

    Few sizes mean few compiled programs.
    """
    step = 1 << max(int(n - 1).bit_length() - 3, 0)
    return -(-n // step) * step


def roomy(values, axis: int = 0, least: int = 64) -> Any:
    """An array filled up with its last value along an axis, to a power of two, `least` or more."""
    spare = _spare(values, axis, least)
    if not spare:
        return values
    values = np.asarray(values)
    last = values.take([-1], axis=axis)
    return np.concatenate([values, np.repeat(last, spare, axis=axis)], axis=axis)


def continued(series):
    """Series (last axis) that go on in a straight line, as long as a power of two.

    Where a series ends, neither its values nor its central differences change.
    """
    n = series.shape[-1]
    spare = _spare(series, -1, 64) if n > 1 else 0
    if not spare:
        return series
    series = np.asarray(series)
    if spare >= n:
        widths = [(0, 0)] * (series.ndim - 1) + [(0, spare)]
        return np.pad(series, widths, mode="reflect", reflect_type="odd")
    mirrored = series[..., n - 1 - spare : n - 1][..., ::-1]
    return np.concatenate([series, 2.0 * series[..., -1:] - mirrored], axis=-1)


def _spare(values, axis: int, least: int) -> int:
    """How many are missing along an axis to a power of two, `least` or more; none on the device."""
    n = values.shape[axis]
    if whole(values) or n == 0:
        return 0
    return max(least, 1 << (n - 1).bit_length()) - n
