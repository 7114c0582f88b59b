"""The least-squares problem of a scene: cost, gradient and normal equations as functions of x.

The unknowns x are scaled increments of the free parameters about the scene's state (`Unknowns`).
Observations that touch the same unknowns form a *packet*: their products are one batched matrix
product, and only the small packet blocks are scattered into the arrow.
"""

from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvm.compiling import program
from jaxvm.network.factors import Factor
from jaxvm.network.network import Network, Residuals
from jaxvm.network.residual import Linearised, linearise, present, residual
from jaxvm.network.scene import Scene
from jaxvm.network.state import Layout, State
from jaxvm.network.unknowns import Unknowns
from jaxvm.physics.blocks import rounded
from jaxvm.solve.arrow import Arrow, NormalMatrix
from jaxvm.solve.buckets import in_order
from jaxvm.solve.levels import Levels, Tridiagonal
from jaxvm.solve.robust import Loss, SquaredLoss


class Packets(eqx.Module):
    """How the rows of one table fall into packets.

    `live` are the positions along [own slots, amplitudes, constants] that are free somewhere;
    `rows` lists the observations of each packet, filled up with the number of observations.
    """

    rows: Int[Array, "packets width"]
    columns: Int[Array, "packets live"]
    live: tuple[int, ...] = eqx.field(static=True)

    @property
    def n_observations(self) -> int:
        """Number of packets times their width."""
        return self.rows.shape[0] * self.rows.shape[1]


_AT_ONCE = 8192
"""Rows of a table that are looked through at a time."""


def pack(factor: Factor, layout: Layout, unknowns: Unknowns) -> Packets:
    """Group the observations of a table by the unknowns that they touch.

    A packet with very many observations is cut into several, so that little is filled up.
    """
    own = np.asarray(factor.slots)[: factor.n_real]
    effects = np.concatenate([layout.all("amplitude"), layout.all("constant")])
    common, free = unknowns.column[effects], unknowns.column < unknowns.n
    # Some rows at a time, of which most touch little that is free: all would take much room.
    somewhere = np.zeros(own.shape[1], bool)
    for first in range(0, len(own), _AT_ONCE):
        somewhere |= free[own[first : first + _AT_ONCE]].any(axis=0)
    of_own, of_effects = np.flatnonzero(somewhere), np.flatnonzero(common < unknowns.n)
    live = (*of_own, *(own.shape[1] + of_effects))
    columns = unknowns.column[own[:, of_own]]
    # Rows that touch the same unknowns have the same sum of hashes.
    hashes = np.random.default_rng(0).integers(1 << 62, size=columns.shape[1], dtype=np.int64)
    _, first, packet = np.unique(columns @ hashes, return_index=True, return_inverse=True)
    packet = packet.ravel()
    counts = np.bincount(packet, minlength=len(first))
    order = in_order(packet, len(first))
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1]
    rank = np.arange(len(packet)) - starts[packet[order]]
    width = _best_width(counts)
    pieces = np.concatenate([[0], np.cumsum(-(-counts // width))])
    # The number of packets is rounded up, so that some missing views are no other program.
    height = rounded(int(pieces[-1]))
    rows = np.full((height, width), factor.slots.shape[0])
    rows[pieces[packet[order]] + rank // width, rank % width] = order
    found = np.full((height, len(live)), unknowns.n)
    here = found[: pieces[-1]]
    here[:, : len(of_own)] = columns[np.repeat(first, np.diff(pieces))]
    here[:, len(of_own) :] = common[of_effects]
    return Packets(jnp.asarray(rows), jnp.asarray(found), tuple(int(k) for k in live))


_SHORT = 0.1
"""Part of a step along which residuals are differentiated twice."""

_PACKET_COST = 16
"""What the scatter of a packet costs, in rows of a packet product."""


def _best_width(counts: Int[np.ndarray, " packets"]) -> int:
    """Power of two at which rows, filled-up ones too, and packets cost least together."""
    widths = [1 << k for k in range(int(counts.max(initial=1)).bit_length() + 1)]
    return min(widths, key=lambda width: np.sum(-(-counts // width)) * (width + _PACKET_COST))


Matrix = TypeVar("Matrix", bound=NormalMatrix, covariant=True)


class Normal(eqx.Module, Generic[Matrix]):
    """Cost, gradient and Gauss-Newton matrix at one x."""

    cost: Float[Array, ""]
    gradient: Float[Array, " n"]
    hessian: Matrix


class Problem(eqx.Module):
    """A scene as a function of its unknowns.

    Attributes:
        network: tables and effects.
        base: flat state at x = 0.
        column: unknown of each position of the flat state; `n` where held.
        factor: change of the parameter for a unit change of its unknown.
        active: unknowns that may move; the others stay at zero.
        loss: robust loss of whitened residuals.
        levels: order of the unknowns in which the matrix is block-tridiagonal; None for an arrow.
    """

    network: Network
    packets: tuple[Packets, ...]
    base: Float[Array, " parameters"]
    column: Int[Array, " parameters"]
    factor: Float[Array, " parameters"]
    active: Bool[Array, " n"]
    loss: Loss
    sizes: tuple[int, int, int] = eqx.field(static=True)  # shared, groups, group size
    levels: Levels | None = None

    @property
    def n(self) -> int:
        """Length of x."""
        s, groups, d = self.sizes
        return s + groups * d

    def flat(self, x: Float[Array, " n"]) -> Float[Array, " parameters"]:
        """Flat state at x."""
        return flat_state(self, x)[0]

    def state(self, x: Float[Array, " n"]) -> State:
        """State at x."""
        return self.network.layout.restore(self.flat(x))

    def residual(self, x: Float[Array, " n"]) -> Residuals:
        """Whitened residuals at x, through the one residual function."""
        return residual(self.state(x), self.network)

    def cost(self, x: Float[Array, " n"]) -> Float[Array, ""]:
        """Half the sum of the losses."""
        blocks = jax.tree.leaves(self.residual(x))
        squares = [jnp.sum(self.loss.value(jnp.sum(block**2, axis=1))) for block in blocks]
        return 0.5 * jnp.sum(jnp.stack(squares))

    def linearised(self, x: Float[Array, " n"], tangent: bool = False) -> list[Linearised]:
        """Every table at x, whitened, with derivatives by the unknowns of its live slots.

        With `tangent` also by every port, where ports act on the table.
        """
        raw, whiten, steps = [], [], []
        flat, per_parameter = flat_state(self, x)
        network, layout = self.network, self.network.layout
        at = present(network, flat, slopes=self._constants_move())
        effects = np.concatenate([layout.all("amplitude"), layout.all("constant")])
        for factor, packets in zip(network.factors(), self.packets, strict=True):
            raw.append(linearise(factor, network, at, packets.live, tangent))
            whiten.append((factor.weight, factor.sigma))
            steps.append((factor.slots, jnp.asarray(effects), packets.live))
        return whitened(raw, whiten, steps, per_parameter)

    def _constants_move(self) -> bool:
        """Whether any table is derived by constants of effects."""
        tables = zip(self.network.factors(), self.packets, strict=True)
        amplitudes = len(self.network.layout.all("amplitude"))
        return any(p.live and p.live[-1] >= f.slots.shape[1] + amplitudes for f, p in tables)

    def normal(self, x: Float[Array, " n"]) -> Normal:
        """Cost, gradient and Gauss-Newton matrix, with the weights of the robust loss."""
        return self.assembled(self.linearised(x))

    def bend(
        self, tables: list[Linearised], x: Float[Array, " n"], step: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """J^T r'' of the tables at x, with r'' the second derivative of the residuals along a step.

        By central differences: a tenth of the step leaves a hundredth of its fourth derivative. The
        weights of the robust loss are those at x.
        """
        part = _SHORT * step
        ahead, behind = self.residual(x + part), self.residual(x - part)
        return bent(tables, ahead, behind, self.packets, self.loss, self.n)

    def assembled(self, tables: list[Linearised]) -> Normal:
        """The same of tables that are linearised already."""
        own = [factor.slots.shape[1] for factor in self.network.factors()]
        if self.levels is not None:
            return assemble_levels(tables, self.packets, self.loss, self.levels)
        return assemble(tables, self.packets, own, self.loss, self.sizes)


def flat_state(problem: Problem, x: Float[Array, " n"]) -> tuple[Array, Array]:
    """Flat state at x, and the change of every parameter for a unit change of its unknown."""
    return _flat(problem.base, problem.factor, problem.column, problem.active, x)


@program
def _flat(base, factor, column, active, x):
    moved = jnp.concatenate([jnp.where(active, x, 0.0), jnp.zeros(1)])
    moving = jnp.concatenate([active, jnp.zeros(1, bool)])[column]
    return base + factor * moved[column], jnp.where(moving, factor, 0.0)


@program
def whitened(raw: list[Linearised], whiten, steps, per_parameter) -> list[Linearised]:
    """Tables in units of their standard deviations, with derivatives by unknowns.

    Args:
        raw: in their own units.
        whiten: weight and sigma of each table.
        steps: slots, positions of all effects, and live positions of each table.
        per_parameter: change of every parameter for a unit change of its unknown.
    """
    result = []
    for table, (weight, sigma), (slots, effects, live) in zip(raw, whiten, steps, strict=True):
        # What is set aside counts nothing, even where it can't be predicted at all.
        used = (weight > 0.0)[:, None]
        scale = weight[:, None] / sigma
        value, jacobian, tangent = (
            jnp.where(used if part.ndim == 2 else used[:, :, None], part, 0.0) for part in table
        )
        n = slots.shape[0]
        every = jnp.concatenate([slots, jnp.broadcast_to(effects, (n, len(effects)))], axis=1)
        step = per_parameter[every[:, jnp.asarray(live, int)]]
        jacobian = jacobian * scale[:, :, None] * step[:, None, :]
        result.append(Linearised(value * scale, jacobian, tangent * scale[:, :, None]))
    return result


@program
def assemble(
    tables: list[Linearised],
    packets_of: tuple[Packets, ...],
    own_slots: list[int],
    loss: Loss,
    sizes: tuple[int, int, int],
) -> Normal:
    """Cost, gradient and Gauss-Newton matrix of linearised tables."""
    s, groups, d = sizes
    n = s + groups * d
    cost = jnp.zeros(())
    gradient = jnp.zeros(n + 1)
    shared = jnp.zeros((s + 1, s + 1))
    coupling = jnp.zeros((groups + 1, d + 1, s + 1))
    local = jnp.zeros((groups + 1, d + 1, d + 1))
    for table, packets, n_own in zip(tables, packets_of, own_slots, strict=True):
        r = table.value
        square = jnp.sum(r**2, axis=1)
        cost = cost + 0.5 * jnp.sum(loss.value(square))
        root = jnp.sqrt(loss.weight(square))[:, None]
        place, group, member = split_columns(packets.columns, sizes)
        # What a packet has to itself is scattered; what all have in common (effects) is one product
        # of matrices, for it is most of a wide model.
        k = sum(at < n_own for at in packets.live)
        common = place[0, k:]
        place, member = place[:, :k], member[:, :k]
        jacobian, value = table.jacobian * root[:, :, None], r * root
        beside = jnp.reshape(jacobian[:, :, k:], (r.size, common.shape[0]))
        apart, product = packet_products(packets, jacobian[:, :, :k], jacobian, value)
        own, cross = apart[:, :, :k], apart[:, :, k:]
        gradient = gradient.at[packets.columns[:, :k]].add(product)
        gradient = gradient.at[packets.columns[0, k:]].add(jnp.ravel(value) @ beside)
        mixed = jnp.zeros((s + 1, common.shape[0])).at[place].add(cross)
        shared = shared.at[place[:, :, None], place[:, None, :]].add(own)
        shared = shared.at[:, common].add(mixed).at[common].add(mixed.T)
        shared = shared.at[common[:, None], common].add(beside.T @ beside)
        if groups:
            where = group[:, None, None]
            coupling = coupling.at[where, member[:, :, None], place[:, None, :]].add(own)
            apart = jnp.zeros((groups + 1, d + 1, common.shape[0]))
            apart = apart.at[group[:, None], member].add(cross)
            coupling = coupling.at[:, :, common].add(apart)
            local = local.at[where, member[:, :, None], member[:, None, :]].add(own)
    arrow = Arrow(shared[:s, :s], coupling[:groups, :d, :s], local[:groups, :d, :d])
    return Normal(cost, gradient[:n], arrow)


@program
def bent(
    tables: list[Linearised],
    ahead: Residuals,
    behind: Residuals,
    packets_of: tuple[Packets, ...],
    loss: Loss,
    n: int,
) -> Float[Array, " n"]:
    """J^T r'' of tables at x, by their residuals a short part of the step ahead and behind."""
    gradient = jnp.zeros(n + 1)
    sides = zip(jax.tree.leaves(ahead), jax.tree.leaves(behind), strict=True)
    for table, (one, other), packets in zip(tables, sides, packets_of, strict=True):
        weight = loss.weight(jnp.sum(table.value**2, axis=1))[:, None]
        second = weight * (one + other - 2.0 * table.value) / _SHORT**2
        _, product = packet_products(packets, table.jacobian, table.jacobian[:, :, :0], second)
        gradient = gradient.at[packets.columns].add(product)
    return gradient[:n]


def assemble_levels(
    tables: list[Linearised], packets_of: tuple[Packets, ...], loss: Loss, levels: Levels
) -> Normal[Tridiagonal]:
    """The same as `assemble`, of unknowns in levels."""
    cost, gradient, products = jnp.zeros(()), jnp.zeros(len(levels.place) + 1), []
    for table, packets in zip(tables, packets_of, strict=True):
        square = jnp.sum(table.value**2, axis=1)
        cost = cost + 0.5 * jnp.sum(loss.value(square))
        root = jnp.sqrt(loss.weight(square))[:, None]
        jacobian = table.jacobian * root[:, :, None]
        own, product = packet_products(packets, jacobian, jacobian, table.value * root)
        gradient = gradient.at[packets.columns].add(product)
        products.append(jnp.ravel(own))
    return Normal(cost, gradient[:-1], levels.matrix(jnp.concatenate(products)))


def in_levels(problem: Problem) -> Problem:
    """The problem with its unknowns in levels, where that is faster than an arrow.

    Groups and effects, which all observations share, are left to the arrow.
    """
    s, groups, _ = problem.sizes
    own = [factor.slots.shape[1] for factor in problem.network.factors()]
    shared = any(at >= n for p, n in zip(problem.packets, own, strict=True) for at in p.live)
    if groups or shared or not s:
        return problem
    levels = Levels.of([np.asarray(packets.columns) for packets in problem.packets], s)
    return eqx.tree_at(lambda p: p.levels, problem, levels, is_leaf=lambda leaf: leaf is None)


def specialised(problem: Problem) -> Problem:
    """The problem for a program of its own, which is worth compiling where it runs many times."""
    effects = problem.network.effects.specialised()
    return eqx.tree_at(lambda p: p.network.effects, in_levels(problem), effects)


def packet_products(
    packets: Packets,
    left: Float[Array, "obs comps own"],
    right: Float[Array, "obs comps live"],
    values: Float[Array, "obs comps"],
) -> tuple[Float[Array, "packets own live"], Float[Array, "packets own"]]:
    """Products left^T right and left^T values of every packet."""
    own, other, v = (in_packets(packets.rows, part) for part in (left, right, values[:, :, None]))
    return jnp.einsum("prk,prl->pkl", own, other), jnp.einsum("prk,prm->pkm", own, v)[:, :, 0]


def in_packets(
    rows: Int[Array, "packets width"], values: Float[Array, "obs comps k"]
) -> Float[Array, "packets rows k"]:
    """Rows of a table gathered packet by packet, filled up with zeros."""
    padded = jnp.concatenate([values, jnp.zeros((1, *values.shape[1:]))])
    gathered = padded[rows]
    p, width, components, k = gathered.shape
    return jnp.reshape(gathered, (p, width * components, k))


def split_columns(columns: Int[Array, "packets live"], sizes: tuple[int, int, int]):
    """Shared index, group of the packet, and member index of each live slot.

    A slot that is not shared has the shared index s, one that is not local the member index d.
    """
    s, groups, d = sizes
    is_local = (columns >= s) & (columns < s + groups * d)
    offset = jnp.where(is_local, columns - s, 0)
    place = jnp.where(columns < s, columns, s)
    member = jnp.where(is_local, offset % max(d, 1), d)
    group = jnp.max(jnp.where(is_local, offset // max(d, 1), -1), axis=1, initial=-1)
    return place, jnp.where(group < 0, groups, group), member


def scene_problem(scene: Scene, loss: Loss | None = None) -> Problem:
    """The least-squares problem of a scene, unscaled: x are plain increments."""
    unknowns = scene.unknowns
    layout = scene.network.layout
    return Problem(
        network=scene.network,
        packets=tuple(pack(f, layout, unknowns) for f in scene.network.factors()),
        base=scene.state.flatten(),
        column=jnp.asarray(unknowns.column),
        factor=jnp.asarray(unknowns.factor, float),
        active=jnp.asarray(unknowns.active),
        loss=SquaredLoss() if loss is None else loss,
        sizes=(unknowns.n_shared, unknowns.n_groups, unknowns.group_size),
    )


def normal_at(problem: Problem, x: Float[Array, " n"]) -> Normal:
    """Cost, gradient and normal matrix of a problem at x."""
    return problem.normal(x)


def scaled(problem: Problem, normal: Normal) -> tuple[Problem, Normal]:
    """The problem with unknowns scaled to a unit diagonal, and its normal equations at x = 0."""
    problem, scale = to_unit_diagonal(problem, np.asarray(normal.hessian.diagonal()))
    return problem, _rescale(normal, jnp.asarray(scale))


def to_unit_diagonal(
    problem: Problem, diagonal: Float[np.ndarray, " n"]
) -> tuple[Problem, Float[np.ndarray, " n"]]:
    """The problem with unknowns scaled so that this diagonal is one, and the scales."""
    scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 1.0)
    per_parameter = np.append(scale, 1.0)[np.asarray(problem.column)]
    return eqx.tree_at(lambda p: p.factor, problem, problem.factor * per_parameter), scale


@program
def _rescale(normal: Normal, scale: Float[Array, " n"]) -> Normal:
    a, b = normal.hessian.split(scale)
    arrow = Arrow(
        a[:, None] * normal.hessian.shared * a,
        b[:, :, None] * normal.hessian.coupling * a,
        b[:, :, None] * normal.hessian.local * b[:, None, :],
    )
    return Normal(normal.cost, normal.gradient * scale, arrow)
