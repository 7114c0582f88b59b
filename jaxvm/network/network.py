"""What a network is apart from its state, and what its residuals are called."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxvm.network.factors import (
    ClosureFactor,
    EdgeFactor,
    Factor,
    LinkFactor,
    PixelFactor,
    PriorFactor,
    RangeFactor,
)
from jaxvm.network.state import Layout
from jaxvm.physics.effects import Channels, EffectTable


class Network(eqx.Module):
    """Everything but the state: tables of observations, effects, channels.

    Attributes:
        pixels: one table for each family of lenses.
        ranges, links, edges, closures, priors: the other observations; tables may be empty.
        effects: the physics beyond the plain chain, as a table.
        channels: time-like drivers.
        layout: how the state is laid out.
    """

    pixels: tuple[PixelFactor, ...]
    ranges: RangeFactor | None
    links: LinkFactor | None
    edges: EdgeFactor | None
    closures: ClosureFactor | None
    priors: PriorFactor | None
    effects: EffectTable
    channels: Channels
    layout: Layout = eqx.field(static=True)

    def factors(self) -> tuple[Factor, ...]:
        """All tables that hold observations, in the order of `Residuals`."""
        others = (self.ranges, self.links, self.edges, self.closures, self.priors)
        return (*self.pixels, *(factor for factor in others if factor is not None))

    @property
    def acted_on(self) -> tuple[PixelFactor | RangeFactor, ...]:
        """Tables on which effects act: the first ones of `factors`."""
        return (*self.pixels, *(() if self.ranges is None else (self.ranges,)))

    def with_patterns_of(self, other: "Network") -> "Network":
        """The same network with the patterns of its effects as they are in another one."""

        def patterns(network: Network):
            return [factor.pattern for factor in network.acted_on]

        return eqx.tree_at(patterns, self, patterns(other))

    def residuals(self, blocks: Sequence) -> "Residuals":
        """Blocks of all tables, in the order of `factors`, by their names."""
        n = len(self.pixels)
        left = iter(blocks[n:])
        others = (self.ranges, self.links, self.edges, self.closures, self.priors)
        rest = (None if factor is None else next(left) for factor in others)
        return Residuals(tuple(blocks[:n]), *rest)

    def unpadded(self, residuals: "Residuals") -> "Residuals":
        """Blocks of all tables without the padding at their ends, as NumPy's."""
        blocks = (*residuals.pixels, *(block for block in residuals[1:] if block is not None))
        tables = zip(blocks, self.factors(), strict=True)
        # Cut on the host: to cut on a device is a program for every number of observations.
        return self.residuals([np.asarray(block)[: factor.n_real] for block, factor in tables])


class Residuals(NamedTuple):
    """Whitened residuals, (predicted - measured) / sigma, block by block."""

    pixels: tuple[Float[Array, "observations 2"], ...]
    ranges: Float[Array, "observations 1"] | None
    links: Float[Array, "observations 6"] | None
    edges: Float[Array, "observations 6"] | None
    closures: Float[Array, "observations 6"] | None
    priors: Float[Array, "observations 1"] | None
