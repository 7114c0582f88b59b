"""The state: everything that can be estimated, as one PyTree of arrays, and how it is laid out.

Poses are 6-vectors (turn, shift): a rotation vector (rad) and a translation (m) that map the second
frame of their name into the first. Static bodies have one row, moving ones a row for each epoch.
Where bodies move, spare rows follow, and so they do after the points: recordings of similar size
are the same program.
"""

import math
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from jaxvm.compiling import program

N_DISTORTION = 14
"""Columns of the distortion table; a lens with fewer coefficients leaves the rest at zero."""


class State(eqx.Module):
    """Values of all parameters, free or held. Poses come first: pose k begins at 6 k."""

    station_from_camera: Float[Array, "cameras 6"]
    world_from_station: Float[Array, "station_rows 6"]
    carrier_from_target: Float[Array, "target_rows 6"]  # carrier: its station, else the world
    station_from_rangefinder: Float[Array, "rangefinders 6"]
    link: Float[Array, "closed_links 6"]  # relative poses that take part in loop closures
    identity: Float[Array, "1 6"]  # pose of the world, and of a node that is its own carrier
    focal: Float[Array, "cameras 2"]  # px
    centre: Float[Array, "cameras 2"]  # px
    distortion: Float[Array, "cameras 14"]  # OpenCV's order
    point: Float[Array, "points 3"]  # target coordinates, m
    amplitude: Float[Array, " columns"]  # of effects
    constant: Float[Array, " constants"]  # of effects; the last is always 1

    def flatten(self) -> Float[Array, " n"]:
        """All values as one vector, in the order of the fields."""
        return _flattened(self)


@dataclass(frozen=True)
class Layout:
    """Where each field of a state lies in its flat vector."""

    fields: tuple[tuple[str, tuple[int, ...]], ...]

    @classmethod
    def of(cls, state: State) -> "Layout":
        """Layout of a state."""
        return cls(tuple((name, getattr(state, name).shape) for name in state.__dataclass_fields__))

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each field."""
        return dict(self.fields)

    def offset(self, name: str) -> int:
        """First position of a field."""
        total = 0
        for other, shape in self.fields:
            if other == name:
                return total
            total += math.prod(shape)
        raise KeyError(name)

    @property
    def n_poses(self) -> int:
        """Number of poses; they come first."""
        return self.offset("focal") // 6

    @property
    def size(self) -> int:
        """Length of the flat vector."""
        return sum(math.prod(shape) for _, shape in self.fields)

    def slots(self, name: str, rows: Int[np.ndarray, " n"], width: int | None = None) -> np.ndarray:
        """Positions [n, width] of the given rows of a table; `width` cuts the last columns off."""
        columns = self.shapes[name][1]
        own = np.arange(columns if width is None else width)
        return self.offset(name) + np.asarray(rows)[:, None] * columns + own

    def all(self, name: str) -> np.ndarray:
        """Positions of a whole field."""
        start = self.offset(name)
        return np.arange(start, start + math.prod(self.shapes[name]))

    def restore(self, flat: Float[Array, " n"]) -> State:
        """State of a flat vector (also under jit)."""
        return _restored(self, flat)


@program
def _flattened(state: State):
    return ravel_pytree(state)[0]


@program
def _restored(layout: Layout, flat) -> State:
    fields = {}
    for name, shape in layout.fields:
        start = layout.offset(name)
        fields[name] = jnp.reshape(flat[start : start + math.prod(shape)], shape)
    return State(**fields)
