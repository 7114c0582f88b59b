"""Which observations meet in which local unknowns: the index tables of the Schur complement.

They depend on the network and on what is free, not on values: made once, by NumPy.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvm.network.componentwise import Numbers, total
from jaxvm.network.factors import Factor, PixelFactor
from jaxvm.solve.buckets import CORES, Buckets, Products, in_order
from jaxvm.solve.problem import Packets, Problem
from jaxvm.solve.triangle import Places, Triangle


class View(eqx.Module):
    """A table of observations, its packets sorted into views.

    Packets stand in runs with the same shared unknowns: in tiles of the table, or one by one.

    Attributes:
        rows: observations of each packet.
        own: 1 for packets, 0 for what fills up runs.
        columns: shared unknowns of each run; their number where there is none.
        views: runs of each view, that is of each combination of shared unknowns.
        view_columns: shared unknowns of each view.
        live: positions with derivatives: its own shared ones, the local ones, effects.
        local: which of the live positions are local: from and to.
        tied: shared positions that are one unknown in all views, together.
        slots, local_slots: of tiles of the table, those with derivatives (local ones of each row).
        tiled: whether runs are the table's tiles.
    """

    rows: Int[Array, "packets width"]
    own: Float[Array, "runs length"]
    columns: Int[Array, "runs shared"]
    views: Buckets
    view_columns: Int[Array, "views shared"]
    slots: Int[Array, "runs 1 live"]
    local_slots: Int[Array, "runs length d"]
    live: tuple[int, ...] = eqx.field(static=True)
    local: tuple[int, int] = eqx.field(static=True)
    tied: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    tiled: bool = eqx.field(static=True)

    @property
    def n_shared(self) -> int:
        """Shared unknowns of a packet."""
        return self.columns.shape[1]

    def split(self, values: Numbers) -> tuple[Numbers, Numbers]:
        """Shared and local columns of derivatives, [rows, live]."""
        a, b = self.local
        shared = np.concatenate([values[:, :a], values[:, b:]], axis=1)
        columns = np.empty((len(shared), len(self.tied)), object)
        for k, together in enumerate(self.tied):
            for row, own in enumerate(shared[:, list(together)]):
                columns[row, k] = total(own)
        return columns, values[:, a:b]

    def in_runs(self, values: Float[Array, "packets ..."]) -> Float[Array, "runs length ..."]:
        """Values of packets, run by run."""
        return jnp.reshape(values, (*self.own.shape, *values.shape[1:]))


class SchurPattern(eqx.Module):
    """Which packets meet in which groups and views.

    Packets of all tables with local unknowns are numbered one after the other, and so are views.

    Attributes:
        tables: views of those with local unknowns, packets of the others.
        groups: packets of each group.
        group: of each packet; the number of groups where it fills up.
        pairs: packets of one group by the pair of views that they fall on, in shares for the cores.
        triangle: entries of the reduced matrix.
        of_pairs, of_views: which products of pairs, and of views of each table, add up to them.
        wide: most shared unknowns of a packet.
        sizes: shared unknowns, groups, unknowns of a group.
    """

    tables: tuple[View | Packets, ...]
    groups: Buckets
    group: Int[Array, " packets"]
    pairs: tuple[Products, ...]
    triangle: Triangle
    of_pairs: Places
    of_views: tuple[Places, ...]
    wide: int = eqx.field(static=True)
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
            n = view.own.size
            found.append((view, values[first : first + n]))
            first += n
        return found

    @classmethod
    def of(cls, problem: Problem, share: float = 0.25, dense: bool = True) -> "SchurPattern | None":
        """Pattern of a problem; whether its reduced matrix is dense.

        None where a table mixes shared and local unknowns at one place, and where the products of
        pairs are more than this share of those of the dense arrow: little would be left out.
        """
        s, n_groups, _ = problem.sizes
        plain = not len(problem.network.layout.all("amplitude"))
        sorted_ = [
            _sorted(packets, factor, problem.sizes, plain)
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
            own, of_packet = _view(table, factor)
            tables.append(own)
            view.append(n_views + of_packet)
            columns.append(np.asarray(own.view_columns))
            n_views += len(own.view_columns)
        # One view without unknowns stands for what fills up.
        columns = [*columns, np.full((1, 0), s)]
        columns = np.concatenate(
            [np.pad(own, ((0, 0), (0, wide - own.shape[1])), constant_values=s) for own in columns]
        )
        p, q, distinct, of_pair = _pairs(group, np.concatenate(view), n_groups, n_views)
        pairs, list_ = _shared_out(of_pair, len(distinct), p, q, len(group))
        a, b = np.where(list_ < 0, n_views, np.array(divmod(distinct, n_views))[:, list_])
        number, key = _products(columns[a], columns[b], a == b, s)
        own = [np.asarray(table.view_columns) for table in tables if isinstance(table, View)]
        of_views = [_products(each, each, np.ones(len(each), bool), s) for each in own]
        triangle = Triangle.of(np.concatenate([key, *(key for _, key in of_views)]), s, dense)
        n = len(triangle.row)
        return cls(
            tables=tuple(tables),
            groups=_of_used(group, n_groups),
            group=jnp.asarray(group),
            pairs=pairs,
            triangle=triangle,
            of_pairs=Places.of(number, triangle.place(key), a.size * wide**2, n),
            of_views=tuple(
                Places.of(number, triangle.place(key), each.size * each.shape[1], n)
                for each, (number, key) in zip(own, of_views, strict=True)
            ),
            wide=wide,
            sizes=problem.sizes,
        )


_SHARE = 150_000
"""Pairs of packets of a share, at least: threads cost something, too."""


def _shared_out(of_pair, n: int, p, q, end: int):
    """Products of pairs in shares of about as many members, and the pair of each product."""
    before = np.cumsum(np.bincount(of_pair, minlength=n))
    n_shares = min(max(len(of_pair) // _SHARE, 1), CORES)
    share = np.minimum(before * n_shares // max(len(of_pair), 1), n_shares - 1)
    shares, lists = [], []
    for k in range(n_shares):
        own, pairs = np.flatnonzero(share[of_pair] == k), np.flatnonzero(share == k)
        if not len(pairs):
            continue
        number = np.full(n, -1)
        number[pairs] = np.arange(len(pairs))
        found = Products.of(number[of_pair[own]], len(pairs), p[own], q[own], end)
        shares.append(found)
        lists.append(np.where(found.list < 0, -1, pairs[found.list]))
    return tuple(shares), np.concatenate(lists)


def _products(rows, columns, same, s: int):
    """The numbers of products of matrices that count, and the entry of the lower triangle that each
    belongs to, as column s + row.

    Args:
        rows, columns: shared unknowns of both views of each product, [products, k].
        same: products of a view with itself: of those, half counts.
    """
    row, column = np.broadcast_arrays(rows[:, :, None], columns[:, None, :])
    used = (row < s) & (column < s) & ((row >= column) | ~same[:, None, None])
    number = np.flatnonzero(used)
    row, column = row[used], column[used]
    # An unknown that both views have meets itself both ways.
    again = (row == column) & ~np.repeat(same, rows.shape[1] * columns.shape[1])[number]
    key = np.minimum(row, column) * s + np.maximum(row, column)
    return np.append(number, number[again]), np.append(key, key[again])


@dataclass(frozen=True, eq=False)
class _Sorted:
    """Packets of a table with local unknowns: rows, runs, shared unknowns of a run (one past the
    last where there is none), group, live positions, which are shared and local, which are tied."""

    rows: Int[np.ndarray, "packets width"]
    own: Float[np.ndarray, "runs length"]
    columns: Int[np.ndarray, "runs shared"]
    group: Int[np.ndarray, " packets"]
    live: Int[np.ndarray, " live"]
    shared_at: Int[np.ndarray, " shared"]
    local_at: Int[np.ndarray, " d"]
    tied: tuple[tuple[int, ...], ...]
    tiled: bool


def _sorted(packets: Packets, factor: Factor, sizes, plain: bool) -> _Sorted | Packets | None:
    """Shared and local unknowns of a table apart; the packets themselves if none is local, None
    where both stand at one place. `plain` says that no effects act."""
    s, n_groups, d = sizes
    n = factor.slots.shape[0]
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
    own = np.ones((len(rows), 1))
    tiles = factor.tiles if isinstance(factor, PixelFactor) else None
    tiled = rows.shape[1] == 1 and plain and tiles is not None
    if rows.shape[1] == 1:
        # One row a packet: in the order of the table, or of its tiles, nothing has to be gathered.
        order = np.full(n, len(rows))
        real = rows[:, 0] < n
        order[rows[real, 0]] = np.flatnonzero(real)
        rows = np.arange(n)[:, None]
        own = np.ones((n, 1))
        if tiles is not None and tiled:
            whole, place = np.asarray(tiles.rows), np.asarray(tiles.place)
            rows = whole.reshape(-1, 1)
            own = place[whole] == np.arange(whole.size).reshape(whole.shape)
            order = order[rows[:, 0]]
        at = np.concatenate([at, np.full((1, at.shape[1]), held)])[order]
        used = np.append(used, False)[order] & own.ravel().astype(bool)
    columns = np.minimum(at[:: own.shape[1]][:, shared_at], s)
    tied = _tied(columns)
    group = np.where(used, (at[:, local_at].min(axis=1, initial=held) - s) // d, n_groups)
    columns = columns[:, [together[0] for together in tied]]
    live = np.array(packets.live)
    return _Sorted(rows, own.astype(float), columns, group, live, shared_at, local_at, tied, tiled)


def _view(table: _Sorted, factor: Factor) -> tuple[View, Int[np.ndarray, " packets"]]:
    """The views of a table, and the view of each of its packets."""
    # Runs with the same unknowns have the same sum of hashes.
    hashes = np.random.default_rng(0).integers(1 << 62, size=table.columns.shape[1], dtype=np.int64)
    _, where, view = np.unique(table.columns @ hashes, return_index=True, return_inverse=True)
    # Derivatives come with the table's own positions first, then effects.
    k = int(np.sum(table.live[table.shared_at] < factor.slots.shape[1]))
    order = np.concatenate([table.shared_at[:k], table.local_at, table.shared_at[k:]])
    live, local = table.live[order], table.live[table.local_at]
    own = table.rows.reshape((*table.own.shape, -1))[..., 0]
    slots = np.asarray(factor.slots) if table.tiled else np.zeros((1, 1 + live.max()), int)
    own = own if table.tiled else np.zeros((1, 1), int)
    found = View(
        rows=jnp.asarray(table.rows),
        own=jnp.asarray(table.own),
        columns=jnp.asarray(table.columns),
        views=Buckets.of(view, len(where), 1.5),
        view_columns=jnp.asarray(table.columns[where]),
        slots=jnp.asarray(slots[own[:, :1]][..., live]),
        local_slots=jnp.asarray(slots[own][..., local]),
        live=tuple(live.tolist()),
        local=(k, k + len(table.local_at)),
        tied=table.tied,
        tiled=table.tiled,
    )
    return found, np.repeat(view, table.own.shape[1])


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
    for size in map(int, np.flatnonzero(np.bincount(count[count > 0]))):
        start = first[count == size]
        a, b = np.triu_indices(size)
        left.append(member[(start[:, None] + a).ravel()])
        right.append(member[(start[:, None] + b).ravel()])
    return np.concatenate(left), np.concatenate(right)
