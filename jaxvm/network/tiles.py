"""Tiles: neighbouring rows of a table that share all parameters but the last.

The marks that a camera sees of a target at one epoch share its lens and all poses. Cut into tiles
of one width, a table gathers what rows share once a tile instead of once a row, and the numbers of
its rows are long vectors (`jaxvm.network.componentwise`).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxvm.physics.blocks import rounded

_WIDTHS = (4, 8, 12, 16, 24, 32, 48, 64, 96, 128)

_TILE_COST = 8
"""What a tile costs beside its rows, in rows."""

_MOST_FILLED = 1.5
"""Rows with those that fill up, over rows, beyond which tiles are not worth it."""


class Tiles(eqx.Module):
    """How the rows of a table fall into tiles.

    Attributes:
        rows: of each tile; filled up with its last row.
        place: of each row among those of all tiles.
    """

    rows: Int[Array, "tiles width"]
    place: Int[Array, " rows"]

    @classmethod
    def of(cls, shared: Int[np.ndarray, "rows slots"]) -> Tiles | None:
        """Tiles of neighbouring rows with equal slots; None where such runs are too short."""
        n = len(shared)
        start = np.flatnonzero(np.append(True, (shared[1:] != shared[:-1]).any(axis=1)))
        count = np.diff(np.append(start, n))

        def tiles(width: int) -> int:
            return int(np.sum(-(-count // width)))

        full = [width for width in _WIDTHS if tiles(width) * width <= _MOST_FILLED * n]
        if not full:
            return None
        width = min(full, key=lambda width: rounded(tiles(width)) * (width + _TILE_COST))
        pieces = -(-count // width)
        run_of = np.repeat(np.arange(len(count)), pieces)
        piece = np.arange(len(run_of)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        begin = start[run_of] + width * piece
        length = np.minimum(count[run_of] - width * piece, width)
        # The number of tiles is rounded up, so that some missing views are no other program.
        spare = rounded(len(begin)) - len(begin)
        begin = np.append(begin, np.full(spare, n - 1))
        length = np.append(length, np.ones(spare, int))
        rows = begin[:, None] + np.minimum(np.arange(width), length[:, None] - 1)
        place = np.empty(n, int)
        place[rows.ravel()] = np.arange(rows.size)
        return cls(jnp.asarray(rows), jnp.asarray(place))
