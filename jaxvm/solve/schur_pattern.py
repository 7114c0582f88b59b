"""Which observations meet in which local unknowns: the index tables of the Schur complement.

They depend on the network and on what is free, not on values: made once, by NumPy.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvm.solve.buckets import Buckets, Products, in_order
from jaxvm.solve.problem import Packets, Problem


class View(eqx.Module):
    """A table of observations, its packets sorted into views.

    Attributes:
        packets: rows of each packet; `live` are its own shared positions, the local ones, effects.
        views: packets of each view, that is of each combination of shared unknowns.
        squares: of the packets of each view, in `square_columns`.
        columns: shared unknowns of each view; their number where there is none.
        local: which of the live positions are local: from and to.
        tied: shared positions that are one unknown in all views, together.
    """

    packets: Packets
    views: Buckets
    squares: Products
    square_columns: Int[Array, "products shared"]
    columns: Int[Array, "views shared"]
    local: tuple[int, int] = eqx.field(static=True)
    tied: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def split(self, values: Float[Array, "... live"]) -> tuple[Array, Array]:
        """Shared and local columns."""
        a, b = self.local
        shared = jnp.concatenate([values[..., :a], values[..., b:]], axis=-1)
        if len(self.tied) < shared.shape[-1]:
            shared = jnp.stack([sum(shared[..., k] for k in own) for own in self.tied], axis=-1)
        return shared, values[..., a:b]


class SchurPattern(eqx.Module):
    """Which packets meet in which groups and views.

    Packets of all tables with local unknowns are numbered one after the other, and so are views.

    Attributes:
        tables: views of those with local unknowns, packets of the others.
        groups: packets of each group.
        group: of each packet; the number of groups where it fills up.
        pairs: packets of one group by the pair of views that they fall on.
        pair_rows, pair_columns: shared unknowns of both views of each pair.
        halved: factor on each pair: 1/2 for a view with itself, because pairs count both ways.
        sizes: shared unknowns, groups, unknowns of a group.
    """

    tables: tuple[View | Packets, ...]
    groups: Buckets
    group: Int[Array, " packets"]
    pairs: Products
    pair_rows: Int[Array, "pairs shared"]
    pair_columns: Int[Array, "pairs shared"]
    halved: Float[Array, " pairs"]
    sizes: tuple[int, int, int] = eqx.field(static=True)

    @property
    def views(self) -> list[View]:
        """Tables with local unknowns."""
        return [table for table in self.tables if isinstance(table, View)]

    @property
    def n(self) -> int:
        """Number of unknowns."""
        s, groups, d = self.sizes
        return s + groups * d

    def by_table(self, values: Array) -> list[tuple[View, Array]]:
        """Tables with local unknowns, each with the values of its own packets."""
        found, first = [], 0
        for view in self.views:
            n = len(view.packets.rows)
            found.append((view, values[first : first + n]))
            first += n
        return found

    @classmethod
    def of(cls, problem: Problem, share: float = 0.25) -> "SchurPattern | None":
        """Pattern of a problem.

        None where a table mixes shared and local unknowns at one place, and where the products of
        pairs are more than this share of those of the dense arrow: little would be left out.
        """
        s, n_groups, _ = problem.sizes
        sorted_ = [
            _sorted(packets, factor.slots.shape[0], problem.sizes)
            for factor, packets in zip(problem.network.factors(), problem.packets, strict=True)
        ]
        found = [table for table in sorted_ if isinstance(table, _Sorted)]
        if None in sorted_ or not found:
            return None
        group = np.concatenate([table.group for table in found])
        count = np.bincount(group[group < n_groups], minlength=n_groups)
        wide = max(table.columns.shape[1] for table in found)
        if np.sum(count * (count + 1) / 2) * wide**2 > share * n_groups * s**2:
            return None
        tables, view, columns, n_views = [], [], [], 0
        for table, factor in zip(sorted_, problem.network.factors(), strict=True):
            if not isinstance(table, _Sorted):
                tables.append(table)
                continue
            own, of_packet = _view(table, factor.slots.shape[1], s)
            tables.append(own)
            view.append(n_views + of_packet)
            columns.append(np.asarray(own.columns))
            n_views += len(own.columns)
        # One view without unknowns stands for what fills up.
        columns = [*columns, np.full((1, 0), s)]
        columns = np.concatenate(
            [np.pad(own, ((0, 0), (0, wide - own.shape[1])), constant_values=s) for own in columns]
        )
        p, q, distinct, of_pair = _pairs(group, np.concatenate(view), n_groups, n_views)
        pairs = Products.of(of_pair, len(distinct), p, q, len(group))
        a, b = np.where(pairs.list < 0, n_views, np.array(divmod(distinct, n_views))[:, pairs.list])
        return cls(
            tables=tuple(tables),
            groups=_of_used(group, n_groups),
            group=jnp.asarray(group),
            pairs=pairs,
            pair_rows=jnp.asarray(columns[a]),
            pair_columns=jnp.asarray(columns[b]),
            halved=jnp.asarray(np.where(a == b, 0.5, 1.0)),
            sizes=problem.sizes,
        )


@dataclass(frozen=True, eq=False)
class _Sorted:
    """Packets of a table with local unknowns: rows, shared unknowns (one past the last where there
    is none), group, live positions, which of them are shared and local, and which are tied."""

    rows: Int[np.ndarray, "packets width"]
    columns: Int[np.ndarray, "packets shared"]
    group: Int[np.ndarray, " packets"]
    live: Int[np.ndarray, " live"]
    shared_at: Int[np.ndarray, " shared"]
    local_at: Int[np.ndarray, " d"]
    tied: tuple[tuple[int, ...], ...]


def _sorted(packets: Packets, n: int, sizes: tuple[int, int, int]) -> _Sorted | Packets | None:
    """Shared and local unknowns of a table of n rows apart; the packets themselves if none is
    local, None where both stand at one place."""
    s, n_groups, d = sizes
    held = s + n_groups * d
    at, rows = np.asarray(packets.columns), np.asarray(packets.rows)
    local = (at >= s) & (at < held)
    if not local.any():
        return packets
    split = _split(at, local, s, d)
    if split is None:
        return None
    shared_at, local_at = split
    used = local.any(axis=1)
    if rows.shape[1] == 1:
        # One row a packet: in the order of the table nothing has to be gathered.
        order = np.full(n, len(rows))
        real = rows[:, 0] < n
        order[rows[real, 0]] = np.flatnonzero(real)
        at = np.concatenate([at, np.full((1, at.shape[1]), held)])[order]
        used = np.append(used, False)[order]
        rows = np.arange(n)[:, None]
    columns = np.minimum(at[:, shared_at], s)
    tied = _tied(columns)
    group = np.where(used, (at[:, local_at].min(axis=1, initial=held) - s) // d, n_groups)
    live = np.array(packets.live)
    columns = columns[:, [together[0] for together in tied]]
    return _Sorted(rows, columns, group, live, shared_at, local_at, tied)


def _view(table: _Sorted, n_own: int, s: int) -> tuple[View, Int[np.ndarray, " packets"]]:
    """The views of a table, and the view of each of its packets."""
    # Rows with the same unknowns have the same sum of hashes.
    hashes = np.random.default_rng(0).integers(1 << 62, size=table.columns.shape[1], dtype=np.int64)
    _, where, view = np.unique(table.columns @ hashes, return_index=True, return_inverse=True)
    columns = table.columns[where]
    # Derivatives come with the table's own positions first, then effects.
    k = int(np.sum(table.live[table.shared_at] < n_own))
    order = np.concatenate([table.shared_at[:k], table.local_at, table.shared_at[k:]])
    live = tuple(table.live[order].tolist())
    each = np.arange(len(view))
    squares = Products.of(view, len(columns), each, each, len(each))
    with_none = np.append(columns, np.full((1, columns.shape[1]), s), axis=0)
    found = View(
        packets=Packets(jnp.asarray(table.rows), jnp.asarray(table.columns), live),
        views=Buckets.of(view, len(columns), 1.5),
        squares=squares,
        square_columns=jnp.asarray(with_none[squares.list]),
        columns=jnp.asarray(columns),
        local=(k, k + len(table.local_at)),
        tied=table.tied,
    )
    return found, view


def _pairs(group, view, n_groups: int, n_views: int):
    """Pairs of packets of one group, (p, q) with the view of p before that of q; the pairs of views
    that occur, as one number each; and the pair of views of each pair of packets."""
    p, q = _pairs_in_groups(group, n_groups)
    # Two packets of one view count in both orders, as two of different views do by symmetry.
    again = np.flatnonzero((view[p] == view[q]) & (p != q))
    p, q = np.append(p, q[again]), np.append(q, p[again])
    swap = view[p] > view[q]
    p, q = np.where(swap, q, p), np.where(swap, p, q)
    key = view[p] * n_views + view[q]
    met = np.bincount(key, minlength=1) > 0
    return p, q, np.flatnonzero(met), (np.cumsum(met) - 1)[key]


def _of_used(group: Int[np.ndarray, " packets"], n_groups: int) -> Buckets:
    """Packets of each group, without those that fill up."""
    used = np.append(np.flatnonzero(group < n_groups), len(group))
    buckets = Buckets.of(group[group < n_groups], n_groups, 1.3)
    return replace(buckets, rows=tuple(jnp.asarray(used[np.asarray(r)]) for r in buckets.rows))


def _tied(columns: Int[np.ndarray, "packets shared"]) -> tuple[tuple[int, ...], ...]:
    """Positions that hold the same unknown in every packet, together."""
    together: dict[bytes, list[int]] = {}
    for k, own in enumerate(columns.T):
        together.setdefault(own.tobytes(), []).append(k)
    return tuple(map(tuple, together.values()))


def _split(at, local, s: int, d: int):
    """Positions with shared and with local unknowns; None where they are not apart."""
    used = local.any(axis=1)
    is_local, is_shared = local.any(axis=0), (at < s).any(axis=0)
    if (is_local & is_shared).any() or is_local.sum() != d:
        return None
    members = at[used][:, is_local] - s
    if not (local[used][:, is_local].all() and (members % d == np.arange(d)).all()):
        return None
    return np.flatnonzero(is_shared), np.flatnonzero(is_local)


def _pairs_in_groups(group, n_groups: int):
    """All pairs of packets of one group: each with itself, and each two once."""
    used = np.flatnonzero(group < n_groups)
    member = used[in_order(group[used], n_groups)]
    count = np.bincount(group[used], minlength=n_groups)
    first = np.cumsum(count) - count
    left, right = [np.zeros(0, int)], [np.zeros(0, int)]
    for size in np.unique(count[count > 0]):
        start = first[count == size]
        a, b = np.triu_indices(size)
        left.append(member[(start[:, None] + a).ravel()])
        right.append(member[(start[:, None] + b).ravel()])
    return np.concatenate(left), np.concatenate(right)
