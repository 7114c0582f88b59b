"""Normal equations of few bodies and very many local unknowns: Schur complement without a scatter.

In a block of images every point is a group of unknowns that a few views see. The arrow form
(`jaxvm.solve.arrow`) couples each group densely to all shared unknowns; here only what sees it
counts. Two packets of observations of one group fall on a pair of views, and all that fall on one
pair are gathered into one product of matrices (Brown 1958; Triggs et al. 2000, section 6; Agarwal
et al. 2010).

Members are gathered and multiplied a few hundred at a time: what is gathered stays in the cache.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvm.network.residual import linearise, present
from jaxvm.solve.problem import Packets, Problem, assemble, flat_state, in_packets, whitened


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
        member = _order(owner, n)
        first = np.cumsum(count) - count
        order = _order(count, int(count.max(initial=0)) + 1)
        rows, at = [], 0
        while at < n:
            least = count[order[at]]
            most = max(int(growth * least), least, 1)
            end = int(np.searchsorted(count[order], most, "right"))
            own = order[at:end]
            width = np.arange(max(int(count[own[-1]]), 1))
            inside = width < count[own, None]
            index = np.minimum(first[own, None] + width, max(len(member) - 1, 0))
            rows.append(jnp.asarray(np.where(inside, member[index], len(owner))))
            at = end
        place = np.empty(n, int)
        place[order] = np.arange(n)
        return cls(tuple(rows), jnp.asarray(place))

    def sums(self, values: Float[Array, "members ..."]) -> Float[Array, "lists ..."]:
        """Sum of the values of each list."""
        padded = _padded(values)
        return jnp.concatenate([padded[rows].sum(axis=1) for rows in self.rows])[self.place]


def _order(numbers: Int[np.ndarray, " n"], bound: int) -> Int[np.ndarray, " n"]:
    """Places in ascending order of numbers below a bound; NumPy counts where they are short."""
    return np.argsort(numbers.astype(np.uint16) if bound <= 1 << 16 else numbers, kind="stable")


def _padded(values: Array) -> Array:
    return jnp.concatenate([values, jnp.zeros((1, *values.shape[1:]), values.dtype)])


_MEMBERS = 256
"""Members of lists that are gathered at a time."""


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
            together = max(_MEMBERS // width, 1)
            pieces = -(-count // together)
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
        padded = _padded(values)
        k = values.shape[2]

        def piece(rows):
            a, b = (jnp.reshape(padded[own], (own.shape[0], -1, k)) for own in rows)
            return jnp.einsum("lra,lrb->lab", a, b)

        parts = [
            jnp.reshape(jax.lax.map(piece, both), (-1, k, k))
            for both in zip(self.left, self.right, strict=True)
        ]
        return jnp.concatenate(parts)


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
    def is_full(self) -> bool:
        """Whether views meet as often as there are shared unknowns: nothing is left out then."""
        return self.pairs.list.size * self.pair_rows.shape[1] ** 2 > 4 * self.sizes[0] ** 2

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
    def of(cls, problem: Problem) -> "SchurPattern | None":
        """Pattern of a problem; None where a table mixes shared and local unknowns at one place."""
        s, n_groups, d = problem.sizes
        tables, group, view, columns = [], [], [], []
        n_views = 0
        for factor, packets in zip(problem.network.factors(), problem.packets, strict=True):
            at = np.asarray(packets.columns)
            local = (at >= s) & (at < s + n_groups * d)
            if not local.any():
                tables.append(packets)
                continue
            split = _split(at, local, s, d)
            if split is None:
                return None
            shared_at, local_at = split
            used = local.any(axis=1)
            rows = np.asarray(packets.rows)
            if rows.shape[1] == 1:
                # One row a packet: in the order of the table nothing has to be gathered.
                n = factor.slots.shape[0]
                order = np.full(n, len(rows))
                real = rows[:, 0] < n
                order[rows[real, 0]] = np.flatnonzero(real)
                at = np.concatenate([at, np.full((1, at.shape[1]), s + n_groups * d)])[order]
                used = np.append(used, False)[order]
                rows = np.arange(n)[:, None]
            own = np.where(at[:, shared_at] < s, at[:, shared_at], s)
            tied = _tied(own)
            own = own[:, [together[0] for together in tied]]
            # Rows with the same unknowns have the same sum of hashes.
            hashes = np.random.default_rng(0).integers(1 << 62, size=own.shape[1], dtype=np.int64)
            _, where, of_packet = np.unique(own @ hashes, return_index=True, return_inverse=True)
            distinct = own[where]
            live = np.array(packets.live)
            k = int(np.sum(live[shared_at] < factor.slots.shape[1]))
            order = np.concatenate([shared_at[:k], local_at, shared_at[k:]])
            chosen = Packets(jnp.asarray(rows), jnp.asarray(own), tuple(live[order].tolist()))
            buckets = Buckets.of(of_packet, len(distinct), 1.5)
            each = np.arange(len(of_packet))
            squares = Products.of(of_packet, len(distinct), each, each, len(each))
            held = np.append(distinct, np.full((1, distinct.shape[1]), s), axis=0)
            tables.append(
                View(
                    chosen,
                    buckets,
                    squares,
                    jnp.asarray(held[squares.list]),
                    jnp.asarray(distinct),
                    (k, k + d),
                    tied,
                )
            )
            first = np.where(used, at[:, local_at].min(axis=1, initial=s + n_groups * d), s)
            group.append(np.where(used, (first - s) // max(d, 1), n_groups))
            view.append(n_views + of_packet)
            columns.append(distinct)
            n_views += len(distinct)
        if not group:
            return None
        wide = max(own.shape[1] for own in columns)
        columns = np.concatenate(
            [np.pad(own, ((0, 0), (0, wide - own.shape[1])), constant_values=s) for own in columns]
        )
        group, view = np.concatenate(group), np.concatenate(view)
        p, q = _pairs_in_groups(group, n_groups)
        # Two packets of one view count in both orders, as two of different views do by symmetry.
        again = np.flatnonzero((view[p] == view[q]) & (p != q))
        p, q = np.append(p, q[again]), np.append(q, p[again])
        swap = view[p] > view[q]
        p, q = np.where(swap, q, p), np.where(swap, p, q)
        key = view[p] * n_views + view[q]
        met = np.bincount(key, minlength=1) > 0
        distinct, of_pair = np.flatnonzero(met), (np.cumsum(met) - 1)[key]
        pairs = Products.of(of_pair, len(distinct), p, q, len(group))
        # What fills up falls on a view without unknowns.
        columns = np.append(columns, np.full((1, wide), s), axis=0)
        a, b = np.where(pairs.list < 0, n_views, np.array(divmod(distinct, n_views))[:, pairs.list])
        return cls(
            tables=tuple(tables),
            groups=Buckets.of(group[group < n_groups], n_groups, 1.3)
            if (group < n_groups).all()
            else _of_used(group, n_groups),
            group=jnp.asarray(group),
            pairs=pairs,
            pair_rows=jnp.asarray(columns[a]),
            pair_columns=jnp.asarray(columns[b]),
            halved=jnp.asarray(np.where(a == b, 0.5, 1.0)),
            sizes=problem.sizes,
        )


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
    member = used[_order(group[used], n_groups)]
    count = np.bincount(group[used], minlength=n_groups)
    first = np.cumsum(count) - count
    left, right = [np.zeros(0, int)], [np.zeros(0, int)]
    for size in np.unique(count[count > 0]):
        start = first[count == size]
        a, b = np.triu_indices(size)
        left.append(member[(start[:, None] + a).ravel()])
        right.append(member[(start[:, None] + b).ravel()])
    return np.concatenate(left), np.concatenate(right)


@dataclass(frozen=True, eq=False)
class SchurNormal:
    """Cost, gradient and Gauss-Newton matrix at one x, in blocks.

    Attributes:
        shared: of shared unknowns among themselves.
        local: of each group.
        coupling: of each packet, the unknowns of its group with its shared ones.
    """

    pattern: SchurPattern
    cost: float
    gradient: Float[Array, " n"]
    shared: Float[Array, "s s"]
    local: Float[Array, "groups d d"]
    coupling: Float[Array, "packets d shared"]

    def at(self, problem: Problem, x: Float[Array, " n"]) -> "SchurNormal":
        """The normal equations elsewhere."""
        return schur_normal(problem, self.pattern, x)

    def rescaled(self, scale: Float[np.ndarray, " n"]) -> "SchurNormal":
        """The same for unknowns in other units: x_new = x / scale."""
        s, groups, d = self.pattern.sizes
        a, b = jnp.asarray(scale[:s]), jnp.asarray(scale[s:].reshape(groups, d))
        wide = self.coupling.shape[2]
        columns = [
            jnp.pad(own, ((0, 0), (0, wide - own.shape[1])), constant_values=s)
            for own in (view.packets.columns for view in self.pattern.views)
        ]
        by_shared = jnp.append(a, 1.0)[jnp.concatenate(columns)][:, None, :]
        by_local = _padded(b)[self.pattern.group][:, :, None]
        return replace(
            self,
            gradient=self.gradient * scale,
            shared=a[:, None] * self.shared * a,
            local=b[:, :, None] * self.local * b[:, None, :],
            coupling=by_local * self.coupling * by_shared,
        )

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """Diagonal of the matrix."""
        own = jnp.diagonal(self.local, axis1=1, axis2=2)
        return np.concatenate([np.diagonal(self.shared), np.ravel(own)])


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
    at = present(network, flat)
    effects = jnp.asarray(np.concatenate([layout.all("amplitude"), layout.all("constant")]))
    cost, tables, rest = jnp.zeros(()), [], []
    for factor, view in zip(network.factors(), pattern.tables, strict=True):
        packets = view.packets if isinstance(view, View) else view
        raw = linearise(factor, network, at, packets.live)
        (table,) = whitened(
            [raw], [(factor.weight, factor.sigma)], [(factor.slots, effects, packets.live)],
            per_parameter,
        )  # fmt: skip
        square = jnp.sum(table.value**2, axis=1)
        cost = cost + 0.5 * jnp.sum(problem.loss.value(square))
        if not isinstance(view, View):
            rest.append((table, packets, factor.slots.shape[1]))
            continue
        root = jnp.sqrt(problem.loss.weight(square))[:, None]
        left, right = in_packets(packets, table.jacobian * root[:, :, None]), table.value * root
        right = in_packets(packets, right[:, :, None])
        shared, local = view.split(left)
        # Sums over few rows: products of components, which vectorise over the packets.
        tables.append(
            (
                view,
                shared,
                jnp.sum(local[:, :, :, None] * shared[:, :, None, :], axis=1),
                jnp.sum(local[:, :, :, None] * local[:, :, None, :], axis=1),
                jnp.sum(shared * right, axis=1),
                jnp.sum(local * right, axis=1),
            )
        )
    s = problem.sizes[0]
    found = [t for t, *_ in rest], tuple(p for _, p, _ in rest), [n for *_, n in rest]
    return cost, *_joined(pattern, tables, assemble(*found, problem.loss, (s, 0, 0)))


def _joined(pattern: SchurPattern, tables, rest):
    """Sums over views and groups."""
    s = pattern.sizes[0]
    wide = pattern.pair_rows.shape[1]
    shared = jnp.zeros((s + 1, s + 1)).at[:s, :s].add(rest.hessian.shared)
    gradient = jnp.zeros(s + 1).at[:s].add(rest.gradient)
    couplings, locals_, pulls = [], [], []
    for view, own, coupling, local, by_shared, by_local in tables:
        at = view.square_columns
        shared = shared.at[at[:, :, None], at[:, None, :]].add(view.squares(own))
        gradient = gradient.at[view.columns].add(view.views.sums(by_shared))
        couplings.append(jnp.pad(coupling, ((0, 0), (0, 0), (0, wide - coupling.shape[2]))))
        locals_.append(local)
        pulls.append(by_local)
    local = pattern.groups.sums(jnp.concatenate(locals_))
    pull = pattern.groups.sums(jnp.concatenate(pulls))
    return (
        jnp.concatenate([gradient[:s], jnp.ravel(pull)]),
        shared[:s, :s],
        local,
        jnp.concatenate(couplings),
    )


class SchurFactors:
    """Cholesky factors of damped normal equations: groups eliminated first, the rest dense.

    Unknowns that no observation touches (zero diagonal) stay where they are.
    """

    bends = True

    def __init__(self, pattern: SchurPattern):
        self.pattern = pattern

    def factorise(self, normal: SchurNormal, damping: float = 0.0) -> bool:
        """Factorise the matrix with its diagonal raised by `damping` of itself; False where it is
        not definite."""
        self._lower, self._half = _eliminated(normal.local, normal.coupling, self.pattern, damping)
        self._reduced, sound = _reduced(normal.shared, self._half, self.pattern, damping)
        return bool(sound)

    def damped(self, normal: SchurNormal) -> Float[np.ndarray, " n"]:
        """What damping is relative to: the present diagonal (Marquardt 1963)."""
        return normal.diagonal()

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for one right-hand side, with the latest factors."""
        return _solved(self.pattern, self._lower, self._half, self._reduced, jnp.asarray(right))


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
def _reduced(shared, half, pattern: SchurPattern, damping):
    """Cholesky factor of the reduced matrix, scaled to a unit diagonal, and whether it is sound."""
    s = shared.shape[0]
    products = pattern.pairs(half)
    rows, columns = pattern.pair_rows[:, :, None], pattern.pair_columns[:, None, :]
    taken = jnp.zeros((s + 1, s + 1)).at[rows, columns].add(
        products * pattern.halved[:, None, None]
    )[:s, :s]  # fmt: skip
    diagonal = jnp.diagonal(shared)
    raised = shared + jnp.diag(jnp.where(diagonal > 0.0, damping * diagonal, 1.0))
    matrix = raised - taken - taken.T
    scale = 1.0 / jnp.sqrt(jnp.diagonal(matrix))
    factor = jnp.linalg.cholesky(scale[:, None] * matrix * scale)
    return (factor, scale), jnp.all(jnp.isfinite(factor))


@jax.jit
def _solved(pattern: SchurPattern, lower, half, reduced, right):
    s, n_groups, d = pattern.sizes
    a, b = right[:s], jnp.reshape(right[s:], (n_groups, d))
    forward = jnp.stack(_forward(lower, [b[:, k] for k in range(d)]), axis=1)
    taken = jnp.sum(half * _padded(forward)[pattern.group][:, :, None], axis=1)
    top = jnp.append(a, 0.0)
    for view, own in pattern.by_table(taken):
        top = top.at[view.columns].add(-view.views.sums(own[:, : view.columns.shape[1]]))
    factor, scale = reduced
    shared = scale * jsl.cho_solve((factor, True), scale * top[:s])
    seen = jnp.append(shared, 0.0)
    back = [
        jnp.sum(own[:, :, : view.columns.shape[1]] * seen[view.packets.columns][:, None, :], axis=2)
        for view, own in pattern.by_table(half)
    ]
    rest = forward - pattern.groups.sums(jnp.concatenate(back))
    local = jnp.stack(_backward(lower, [rest[:, k] for k in range(d)]), axis=1)
    return jnp.concatenate([shared, jnp.ravel(local)])
