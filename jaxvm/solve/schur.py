"""Normal equations of few bodies and very many local unknowns: Schur complement without a scatter.

In a block of images every point is a group of unknowns that a few views see. The arrow form
(`jaxvm.solve.arrow`) couples each group densely to all shared unknowns; here only what sees it
counts. Two packets of observations of one group fall on a pair of views, and all that fall on one
pair are gathered into one product of matrices (Brown 1958; Triggs et al. 2000, section 6; Agarwal
et al. 2010).

Gathering and multiplying are compiled apart: in one program XLA's layout for the products makes the
gathers four times as slow on a processor.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float, Int

from jaxvm.network.residual import linearise
from jaxvm.physics.effects import course_slopes, courses
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
        member = np.argsort(owner, kind="stable")
        first = np.cumsum(count) - count
        order = np.argsort(count, kind="stable")
        rows, at = [], 0
        while at < n:
            least = count[order[at]]
            most = max(int(growth * least), least, 1)
            end = int(np.searchsorted(count[order], most, "right"))
            own = order[at:end]
            width = np.arange(max(count[own[-1]], 1))
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


def _padded(values: Array) -> Array:
    return jnp.concatenate([values, jnp.zeros((1, *values.shape[1:]), values.dtype)])


class View(eqx.Module):
    """A table of observations, its packets sorted into views.

    Attributes:
        packets: rows of each packet; `live` are its own shared positions, the local ones, effects.
        views: packets of each view, that is of each combination of shared unknowns.
        columns: shared unknowns of each view; their number where there is none.
        local: which of the live positions are local: from and to.
    """

    packets: Packets
    views: Buckets
    columns: Int[Array, "views shared"]
    local: tuple[int, int] = eqx.field(static=True)

    def split(self, values: Float[Array, "... live"]) -> tuple[Array, Array]:
        """Shared and local columns."""
        a, b = self.local
        shared = jnp.concatenate([values[..., :a], values[..., b:]], axis=-1)
        return shared, values[..., a:b]


class SchurPattern(eqx.Module):
    """Which packets meet in which groups and views.

    Packets of all tables with local unknowns are numbered one after the other, and so are views.

    Attributes:
        tables: those with local unknowns; None for others.
        others: packets of tables without local unknowns; None for those with.
        groups: packets of each group.
        group: of each packet; the number of groups where it fills up.
        pairs: packets p <= q of one group by the pair of views they fall on, as (p, q).
        pair_rows, pair_columns: shared unknowns of both views of each pair.
        halved: factor on each pair: 1/2 for a view with itself, because pairs count both ways.
        sizes: shared unknowns, groups, unknowns of a group.
    """

    tables: tuple[View | None, ...]
    others: tuple[Packets | None, ...]
    groups: Buckets
    group: Int[Array, " packets"]
    pairs: tuple[tuple[Int[Array, "pairs width"], Int[Array, "pairs width"]], ...]
    pair_rows: Int[Array, "pairs shared"]
    pair_columns: Int[Array, "pairs shared"]
    halved: Float[Array, " pairs"]
    sizes: tuple[int, int, int] = eqx.field(static=True)

    @classmethod
    def of(cls, problem: Problem) -> "SchurPattern | None":
        """Pattern of a problem; None where a table mixes shared and local unknowns at one place."""
        s, n_groups, d = problem.sizes
        tables, others, group, view, columns = [], [], [], [], []
        n_views = 0
        for factor, packets in zip(problem.network.factors(), problem.packets, strict=True):
            at = np.asarray(packets.columns)
            local = (at >= s) & (at < s + n_groups * d)
            if not local.any():
                tables.append(None)
                others.append(packets)
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
            distinct, of_packet = np.unique(own, axis=0, return_inverse=True)
            of_packet = of_packet.ravel()
            live = np.array(packets.live)
            k = int(np.sum(live[shared_at] < factor.slots.shape[1]))
            order = np.concatenate([shared_at[:k], local_at, shared_at[k:]])
            chosen = Packets(jnp.asarray(rows), jnp.asarray(own), tuple(live[order].tolist()))
            buckets = Buckets.of(of_packet, len(distinct), 1.5)
            tables.append(View(chosen, buckets, jnp.asarray(distinct), (k, k + d)))
            others.append(None)
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
        distinct, of_pair = np.unique(key, return_inverse=True)
        buckets = Buckets.of(of_pair.ravel(), len(distinct), 1.25)
        place = np.argsort(np.asarray(buckets.place))
        p, q = (np.append(index, len(group)) for index in (p, q))
        a, b = distinct[place] // n_views, distinct[place] % n_views
        return cls(
            tables=tuple(tables),
            others=tuple(others),
            groups=Buckets.of(group[group < n_groups], n_groups, 1.3)
            if (group < n_groups).all()
            else _of_used(group, n_groups),
            group=jnp.asarray(group),
            pairs=tuple(
                (jnp.asarray(p[np.asarray(r)]), jnp.asarray(q[np.asarray(r)])) for r in buckets.rows
            ),
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
    member = used[np.argsort(group[used], kind="stable")]
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
        coupling: of each packet, its shared unknowns with those of its group.
    """

    pattern: SchurPattern
    cost: float
    gradient: Float[Array, " n"]
    shared: Float[Array, "s s"]
    local: Float[Array, "groups d d"]
    coupling: Float[Array, "packets shared d"]

    def diagonal(self) -> Float[np.ndarray, " n"]:
        """Diagonal of the matrix."""
        own = jnp.diagonal(self.local, axis1=1, axis2=2)
        return np.concatenate([np.diagonal(self.shared), np.ravel(own)])


def schur_normal(problem: Problem, pattern: SchurPattern, x: Float[Array, " n"]) -> SchurNormal:
    """Normal equations of a problem at x, with the weights of its robust loss."""
    bare = eqx.tree_at(lambda p: p.packets, problem, ())
    cost, tables, rest = _linearised(bare, pattern, jnp.asarray(x))
    blocks = [
        (view, _multiplied(_gathered(view.views, left)), *own)
        for view, (left, *own) in zip((v for v in pattern.tables if v), tables, strict=True)
    ]
    return SchurNormal(pattern, cost, *_joined(pattern, blocks, rest))


@eqx.filter_jit
def _linearised(problem: Problem, pattern: SchurPattern, x):
    """Cost; of each table with groups what its packets have, of all others the normal equations."""
    network, layout = problem.network, problem.network.layout
    flat, per_parameter = flat_state(problem, x)
    constant = flat[layout.offset("constant") : layout.offset("identity")]
    values = courses(network.effects, constant, network.channels)
    slopes = course_slopes(network.effects, constant, network.channels)
    effects = jnp.asarray(np.concatenate([layout.all("amplitude"), layout.all("constant")]))
    cost, tables, rest = jnp.zeros(()), [], []
    for factor, view, other in zip(network.factors(), pattern.tables, pattern.others, strict=True):
        packets = other if view is None else view.packets
        raw = linearise(factor, network, flat, values, slopes, packets.live)
        (table,) = whitened(
            [raw], [(factor.weight, factor.sigma)], [(factor.slots, effects, packets.live)],
            per_parameter,
        )  # fmt: skip
        square = jnp.sum(table.value**2, axis=1)
        cost = cost + 0.5 * jnp.sum(problem.loss.value(square))
        if view is None:
            rest.append((table, packets, factor.slots.shape[1]))
            continue
        root = jnp.sqrt(problem.loss.weight(square))[:, None]
        left, right = in_packets(packets, table.jacobian * root[:, :, None]), table.value * root
        right = in_packets(packets, right[:, :, None])
        shared, local = view.split(left)
        # Sums over few rows: products of components, which vectorise over the packets.
        tables.append(
            (
                shared,
                jnp.sum(shared[:, :, :, None] * local[:, :, None, :], axis=1),
                jnp.sum(local[:, :, :, None] * local[:, :, None, :], axis=1),
                jnp.sum(shared * right, axis=1),
                jnp.sum(local * right, axis=1),
            )
        )
    s = problem.sizes[0]
    found = [t for t, *_ in rest], [p for _, p, _ in rest], [n for *_, n in rest]
    return cost, tables, assemble(*found, problem.loss, (s, 0, 0))


@eqx.filter_jit
def _gathered(buckets: Buckets, values):
    """Members of each list side by side: [lists, all rows, columns]."""
    padded = _padded(values)
    return [
        jnp.reshape(padded[rows], (rows.shape[0], -1, values.shape[2])) for rows in buckets.rows
    ], buckets.place


@jax.jit
def _multiplied(gathered):
    """left^T left of every list."""
    lists, place = gathered
    return jnp.concatenate([jnp.einsum("kra,krb->kab", own, own) for own in lists])[place]


@eqx.filter_jit
def _joined(pattern: SchurPattern, blocks, rest):
    """Gradient, shared and local blocks, and couplings of all packets."""
    s, n_groups, d = pattern.sizes
    wide = pattern.pair_rows.shape[1]
    shared = jnp.zeros((s + 1, s + 1)).at[:s, :s].add(rest.hessian.shared)
    gradient = jnp.zeros(s + 1).at[:s].add(rest.gradient)
    couplings, locals_, pulls = [], [], []
    for view, own, coupling, local, by_shared, by_local in blocks:
        shared = shared.at[view.columns[:, :, None], view.columns[:, None, :]].add(own)
        gradient = gradient.at[view.columns].add(view.views.sums(by_shared))
        couplings.append(jnp.pad(coupling, ((0, 0), (0, wide - coupling.shape[1]), (0, 0))))
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

    def __init__(self, pattern: SchurPattern):
        self.pattern = pattern

    def factorise(self, normal: SchurNormal, damping: float = 0.0) -> bool:
        """Factorise the matrix with its diagonal raised by `damping` of itself; False where it is
        not definite."""
        self._lower, self._half, across = _eliminated(
            normal.local, normal.coupling, self.pattern, damping
        )
        products = _crossed(_paired(self.pattern.pairs, across))
        self._reduced, sound = _reduced(normal.shared, products, self.pattern, damping)
        return bool(sound)

    def solve(self, right: Float[Array, " n"]) -> Float[Array, " n"]:
        """Solution for one right-hand side, with the latest factors."""
        return _solved(self.pattern, self._lower, self._half, self._reduced, jnp.asarray(right))


@jax.jit
def _eliminated(local, coupling, pattern: SchurPattern, damping):
    """Factors L of each group, and (L^-1 W)^T of each packet, also with the members leading."""
    d = local.shape[1]
    diagonal = jnp.diagonal(local, axis1=1, axis2=2)
    raised = local + jnp.where(diagonal > 0.0, damping * diagonal, 1.0)[:, :, None] * jnp.eye(d)
    lower = _cholesky([[raised[:, i, j] for j in range(i + 1)] for i in range(d)])
    of_packet = [[jnp.append(one, 1.0)[pattern.group] for one in row] for row in lower]
    half = jnp.stack(_forward(of_packet, [coupling[:, :, k] for k in range(d)]), axis=2)
    return lower, half, jnp.swapaxes(half, 1, 2)


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
    d = len(right)
    found = [None] * d
    for i in reversed(range(d)):
        own = right[i] - sum(lower[k][i] * found[k] for k in range(i + 1, d))
        found[i] = own / lower[i][i]
    return found


def _along(vector, values):
    return jnp.reshape(vector, (-1,) + (1,) * (values.ndim - 1))


@jax.jit
def _paired(pairs, across):
    """Both members of all pairs side by side: [pairs of views, all members, columns]."""
    padded = _padded(across)
    return [
        tuple(jnp.reshape(padded[rows], (rows.shape[0], -1, across.shape[2])) for rows in both)
        for both in pairs
    ]


@jax.jit
def _crossed(paired):
    """left^T right of every pair of views."""
    return jnp.concatenate([jnp.einsum("kra,krb->kab", a, b) for a, b in paired])


@jax.jit
def _reduced(shared, products, pattern: SchurPattern, damping):
    """Cholesky factor of the reduced matrix, scaled to a unit diagonal, and whether it is sound."""
    s = shared.shape[0]
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
    own = _padded(forward)[pattern.group]
    taken = jnp.sum(half * own[:, None, :], axis=2)
    top, first = jnp.append(a, 0.0), 0
    for view in pattern.tables:
        if view is None:
            continue
        n = len(view.packets.rows)
        part = view.views.sums(taken[first : first + n, : view.columns.shape[1]])
        top = top.at[view.columns].add(-part)
        first += n
    factor, scale = reduced
    shared = scale * jsl.cho_solve((factor, True), scale * top[:s])
    seen, parts, first = jnp.append(shared, 0.0), [], 0
    for view in pattern.tables:
        if view is None:
            continue
        n = len(view.packets.rows)
        at = seen[view.packets.columns]
        parts.append(jnp.sum(half[first : first + n, : view.columns.shape[1]] * at[:, :, None], axis=1))
        first += n
    rest = forward - pattern.groups.sums(jnp.concatenate(parts))
    local = jnp.stack(_backward(lower, [rest[:, k] for k in range(d)]), axis=1)
    return jnp.concatenate([shared, jnp.ravel(local)])
