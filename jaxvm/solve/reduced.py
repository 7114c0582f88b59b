"""Rows of the Jacobian in the metric of the normal equations, local unknowns eliminated.

With H = L L^T, the rows J L^-T have inner products J H^-1 J^T: the hat matrix, and with it the
redundancy of observations and the projector M = I - J H^-1 J^T of hypothesis tests.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxvm.compiling import program
from jaxvm.solve.arrow import ArrowFactors
from jaxvm.solve.problem import Packets, split_columns


@program
def packet_of_rows(packets: Packets, n: int) -> Int[Array, " observations"]:
    """Packet of each row of a table; padding rows get packet 0."""
    number = jnp.arange(packets.rows.shape[0])[:, None]
    everywhere = jnp.broadcast_to(number, packets.rows.shape)
    return jnp.zeros(n + 1, int).at[packets.rows].set(everywhere)[:n]


def half_rows(
    factors: ArrowFactors,
    packets: Packets,
    jacobian: Float[Array, "obs comps live"],
    sizes: tuple[int, int, int],
) -> Float[Array, "obs comps d_plus_s"]:
    """Rows of J L^-T with H = L L^T: their inner products are those of J H^-1 J^T.

    Only the group of the observation and the shared unknowns are non-zero, so d + s columns do.
    """
    s, groups, d = sizes
    place, group, member = split_columns(packets.columns, sizes)
    packet_of = packet_of_rows(packets, jacobian.shape[0])
    shared = _spread(jacobian, place[packet_of], s)
    if not groups:
        return _through(factors.reduced, shared)
    local = _spread(jacobian, member[packet_of], d)
    own = jnp.minimum(group[packet_of], groups - 1)
    local = jnp.where((group[packet_of] < groups)[:, None, None], local, 0.0)
    solved = jax.vmap(lambda f, rows: jax.scipy.linalg.solve_triangular(f, rows.T, lower=True).T)(
        factors.local[own], local
    )
    rest = shared - jnp.einsum("nad,nds->nas", solved, factors.coupled[own])
    return jnp.concatenate([solved, _through(factors.reduced, rest)], axis=2)


def _through(root, rows):
    """Rows times the inverse transposed of a lower triangle; untouched where nothing is shared."""
    if not rows.shape[2]:
        return rows
    flat = rows.reshape(-1, rows.shape[2])
    return jax.scipy.linalg.solve_triangular(root, flat.T, lower=True).T.reshape(rows.shape)


def _spread(jacobian, places, width):
    """Live slots added into dense columns; the column `width` collects what does not belong."""
    n, components, _ = jacobian.shape
    dense = jnp.zeros((n, width + 1, components))
    rows = jnp.arange(n)[:, None]
    dense = dense.at[rows, places].add(jnp.swapaxes(jacobian, 1, 2))
    return jnp.swapaxes(dense[:, :width], 1, 2)
