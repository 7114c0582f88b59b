"""Observations shared out to devices, of one process or of many: each sums up its own.

Normal equations are sums over observations. Every device has whole packets of them, computes their
residuals, derivatives and products, and the small sums are added over all devices; what is unknown
is the same everywhere. The mesh is JAX's own (`jax.sharding.Mesh`).
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from jaxvm.network.factors import Factor
from jaxvm.solve.problem import Normal, Packets, Problem

AXIS = "observations"
"""Name of the mesh axis over which observations are shared out."""

_SINGLE = ("ranges", "links", "edges", "closures", "priors")


class SharedProblem(eqx.Module):
    """The normal equations of a problem whose observations lie on several devices.

    Attributes:
        tables: pixels, ranges, links, edges, closures, priors and their packets, [devices, ...].
        rest: the problem without them.
        mesh: of one axis, `observations`.
    """

    tables: Any
    rest: Problem
    mesh: Mesh = eqx.field(static=True)

    @classmethod
    def of(cls, problem: Problem, mesh: Mesh) -> "SharedProblem":
        """Share the observations of a problem out to a mesh.

        In more than one process (`jax.distributed`) all call this with the same problem.

        Raises:
            ValueError: a mesh with other axes.
        """
        if mesh.axis_names != (AXIS,):
            raise ValueError(f'a mesh of one axis "{AXIS}" is due, not {mesh.axis_names}')
        cut = [
            _cut(factor, packets, mesh.size)
            for factor, packets in zip(problem.network.factors(), problem.packets, strict=True)
        ]
        each = iter([factor for factor, _ in cut])
        network = problem.network
        tables: dict[str, Any] = {"pixels": tuple(next(each) for _ in network.pixels)}
        for name in _SINGLE:
            tables[name] = None if getattr(network, name) is None else next(each)
        own = NamedSharding(mesh, PartitionSpec(AXIS))
        placed = jax.tree.map(
            lambda leaf: jax.make_array_from_callback(leaf.shape, own, lambda at: leaf[at]),
            (tables, tuple(packets for _, packets in cut)),
        )
        bare = _with_tables(problem, {"pixels": (), **dict.fromkeys(_SINGLE)}, ())
        return cls(placed, bare, mesh)

    def normal(self, x: Float[Array, " n"]) -> Normal:
        """Cost, gradient and Gauss-Newton matrix at one x, in every process."""
        found = _summed(self.tables, self.rest, np.asarray(x), self.mesh)
        return jax.tree.map(np.asarray, found)


def _with_tables(problem: Problem, tables: dict[str, Any], packets) -> Problem:
    return replace(problem, network=replace(problem.network, **tables), packets=packets)


def _cut(factor: Factor, packets: Packets, devices: int) -> tuple[Factor, Packets]:
    """A table and its packets with an axis of devices in front; rows in the order of packets."""
    height, width = packets.rows.shape
    own = -(-height // devices)
    spare = own * devices - height
    n = factor.slots.shape[0]
    rows = np.pad(np.asarray(packets.rows), ((0, spare), (0, 0)), constant_values=n)
    columns = np.pad(np.asarray(packets.columns), ((0, spare), (0, 0)), mode="edge")
    index = np.minimum(rows, n - 1).reshape(devices, own * width)

    def taken(leaf):
        leaf = np.asarray(leaf)
        return leaf[index] if leaf.ndim else np.broadcast_to(leaf, (devices,))

    table = jax.tree.map(taken, factor.untiled())
    weight = np.where(rows.reshape(devices, -1) < n, table.weight, 0.0)
    table = eqx.tree_at(lambda f: f.weight, table, weight)
    local = np.broadcast_to(np.arange(own * width).reshape(own, width), (devices, own, width))
    return table, Packets(local, columns.reshape(devices, own, -1), packets.live)  # pyright: ignore


@eqx.filter_jit
def _summed(tables, rest: Problem, x, mesh: Mesh) -> Normal:
    arrays, static = eqx.partition(rest, eqx.is_array)

    def one(tables, arrays, x):
        own = jax.tree.map(lambda leaf: leaf[0], tables)
        problem = _with_tables(eqx.combine(arrays, static), *own)
        return jax.lax.psum(problem.normal(x), AXIS)

    own, whole = PartitionSpec(AXIS), PartitionSpec()
    shared = jax.shard_map(
        one, mesh=mesh, in_specs=(own, whole, whole), out_specs=whole, check_vma=False
    )
    return shared(tables, arrays, x)
