"""Sums over lists of unequal length without a scatter: gathered, in a few full tables.

XLA adds scattered values one by one on a processor; values that are gathered list by list are added
and multiplied as long vectors. Lists of like length are filled up alike.
"""

import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.sparse import coo_array


class Buckets(eqx.Module):
    """Lists of unequal length as a few full tables: lists of like length are filled up alike.

    Attributes:
        rows: for each bucket the members of its lists; what is filled up points past the end.
        place: where list k stands in the buckets, one after the other.
    """

    rows: tuple[Int[Array, "lists width"], ...]
    place: Int[Array, " lists"]

    @classmethod
    def of(cls, owner: Int[np.ndarray, " members"], n: int, growth: float) -> "Buckets":
        """Lists 0 to n - 1 of the members that they own, in their order; longest over shortest
        list of a bucket is at most `growth`."""
        count = np.bincount(owner, minlength=n)
        member = in_order(owner, n)
        first = np.cumsum(count) - count
        order = in_order(count, int(count.max(initial=0)) + 1)
        rows, at = [], 0
        while at < n:
            least = count[order[at]]
            most = max(int(growth * least), least, 1)
            end = int(np.searchsorted(count[order], most, "right"))
            width = np.arange(max(int(count[order[end - 1]]), 1))
            # In their own order: neighbouring lists often share members.
            order[at:end] = np.sort(order[at:end])
            own = order[at:end]
            inside = width < count[own, None]
            index = np.minimum(first[own, None] + width, max(len(member) - 1, 0))
            rows.append(jnp.asarray(np.where(inside, member[index], len(owner))))
            at = end
        place = np.empty(n, int)
        place[order] = np.arange(n)
        return cls(tuple(rows), jnp.asarray(place))

    def sums(self, values: Float[Array, "members ..."]) -> Float[Array, "lists ..."]:
        """Sum of the values of each list."""
        parts = [filled(values, rows).sum(axis=1) for rows in self.rows]
        return taken(jnp.concatenate(parts), self.place)


def in_order(numbers: Int[np.ndarray, " n"], bound: int) -> Int[np.ndarray, " n"]:
    """Places in ascending order of numbers below a bound, equal ones in their own order.

    NumPy counts where numbers are short; for others SciPy does, which lists a matrix row by row.
    """
    n = len(numbers)
    if bound <= 1 << 16:
        return np.argsort(numbers.astype(np.uint16), kind="stable")
    if max(n, bound) > np.iinfo(np.int32).max:
        return np.argsort(numbers, kind="stable")
    place = numbers.astype(np.int32), np.arange(n, dtype=np.int32)
    listed = coo_array((np.ones(n, np.int8), place), shape=(bound, n)).tocsr()
    return listed.indices.astype(int)


def padded(values: Float[Array, "members ..."]) -> Float[Array, "members_and_1 ..."]:
    """Values with a zero behind them, for what fills lists up."""
    return jnp.concatenate([values, jnp.zeros((1, *values.shape[1:]), values.dtype)])


CORES = os.cpu_count() or 1
"""Shares that are computed side by side."""


def taken(values: Float[Array, "members ..."], rows: Int[Array, "..."]) -> Float[Array, "..."]:
    """Values at rows that are known to exist: nothing checks them."""
    return values.at[rows].get(mode="promise_in_bounds", wrap_negative_indices=False)


def filled(values: Float[Array, "members ..."], rows: Int[Array, "..."]) -> Float[Array, "..."]:
    """Values at rows, zero where they point past the end."""
    return values.at[rows].get(mode="fill", fill_value=0.0, wrap_negative_indices=False)


_MEMBERS = 2048
"""Members of lists that are gathered at a time, so that what is gathered stays in the cache."""


class Products(eqx.Module):
    """Sums of products of matrices over lists of unequal length, list by list.

    Attributes:
        left, right: members of each list, a few lists together: [pieces, lists, width] for each
            bucket. What fills up points past the end.
        list: which list each product belongs to, one after the other; -1 for what fills up.
    """

    left: tuple[Int[Array, "pieces lists width"], ...]
    right: tuple[Int[Array, "pieces lists width"], ...]
    list: Int[np.ndarray, " products"]

    @classmethod
    def of(cls, owner: Int[np.ndarray, " members"], n: int, left, right, end: int) -> "Products":
        """Lists 0 to n - 1; member k of its list multiplies row left[k] with row right[k].

        Args:
            end: number of rows; a row of zeros stands behind them.
        """
        buckets = Buckets.of(owner, n, 1.25)
        left, right = np.append(left, end), np.append(right, end)
        order = np.argsort(np.asarray(buckets.place))
        found, first = ([], [], []), 0
        for rows in map(np.asarray, buckets.rows):
            count, width = rows.shape
            # A list that is longer than a piece is one on its own.
            pieces = min(-(-count * width // _MEMBERS), count)
            together = -(-count // pieces)
            spare = pieces * together - count
            rows = np.pad(rows, ((0, spare), (0, 0)), constant_values=len(owner))
            rows = rows.reshape(pieces, together, width)
            found[0].append(jnp.asarray(left[rows]))
            found[1].append(jnp.asarray(right[rows]))
            found[2].append(np.pad(order[first : first + count], (0, spare), constant_values=-1))
            first += count
        return cls(tuple(found[0]), tuple(found[1]), np.concatenate(found[2]))

    def __call__(self, values: Float[Array, "rows d k"]) -> Float[Array, "products k k"]:
        """Sum of values[left]^T values[right] over the members of each list."""
        k = values.shape[2]

        def piece(rows):
            left, right = rows
            # What fills up is zero on one side; nothing is copied for it.
            a = filled(values, left)
            b = values.at[right].get(mode="clip", wrap_negative_indices=False)
            a, b = (jnp.reshape(own, (own.shape[0], -1, k)) for own in (a, b))
            return jnp.einsum("lra,lrb->lab", a, b)

        parts = [
            jnp.reshape(jax.lax.map(piece, both), (-1, k, k))
            for both in zip(self.left, self.right, strict=True)
        ]
        return jnp.concatenate(parts)
