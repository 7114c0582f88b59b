"""The one residual function of a network, and its block Jacobian from the same local functions.

Simulation, adjustment, covariance, Monte Carlo and diagnosis all call what stands here.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
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
from jaxvm.network.state import Layout, State
from jaxvm.physics.blocks import by_blocks, roomy
from jaxvm.physics.effects import Channels, EffectTable, courses
from jaxvm.physics.ports import N_PORTS, PortValues


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


class Residuals(NamedTuple):
    """Whitened residuals, (predicted - measured) / sigma, block by block."""

    pixels: tuple[Float[Array, "observations 2"], ...]
    ranges: Float[Array, "observations 1"] | None
    links: Float[Array, "observations 6"] | None
    edges: Float[Array, "observations 6"] | None
    closures: Float[Array, "observations 6"] | None
    priors: Float[Array, "observations 1"] | None


def residual(state: State, network: Network) -> Residuals:
    """Whitened residuals of all observations: the one function of the project.

    Pure and differentiable in every field of `state`; `jax.vmap` and `jax.jit` apply. Called
    outside of them it is computed in compiled blocks (`jaxvm.physics.blocks`).
    """
    flat = state.flatten()
    values = courses(network.effects, state.constant, network.channels)

    def block(factor: Factor | None):
        if factor is None:
            return None
        return rows(factor, network, flat, values) * whitening(factor)

    return Residuals(
        tuple(rows(f, network, flat, values) * whitening(f) for f in network.pixels),
        block(network.ranges),
        block(network.links),
        block(network.edges),
        block(network.closures),
        block(network.priors),
    )


def whitening(factor: Factor) -> Float[Array, "observations components"]:
    """Factor from a residual in its unit to a whitened one: weight / sigma."""
    return factor.weight[:, None] / factor.sigma


def rows(
    factor: Factor,
    network: Network,
    flat: Float[Array, " n"],
    values: Float[Array, "columns epochs"],
) -> Float[Array, "observations components"]:
    """Predicted minus measured of one table, in its unit."""
    amplitude = flat[jnp.asarray(network.layout.all("amplitude"))]
    acting = Acting(amplitude, network.effects.ports, values)
    return by_blocks(_rows, factor, roomy(flat), acting.roomy())


class Acting(NamedTuple):
    """What all observations share of the effects."""

    amplitude: Float[Array, " columns"]
    ports: Float[Array, "columns ports"]
    value: Float[Array, "columns epochs"]

    def roomy(self) -> "Acting":
        """With spare epochs, so that a recording of another length is no other program."""
        return self._replace(value=roomy(self.value, axis=1))


def parts_of(factor: Factor, flat: Float[Array, " n"]) -> tuple[Float[Array, "n part"], ...]:
    """Values at the slots of a table, one array for each parameter."""
    ends = np.cumsum(factor.widths)
    pieces = zip(ends - np.array(factor.widths), ends, strict=True)
    return tuple(flat[factor.slots[:, a:b]] for a, b in pieces)


@eqx.filter_jit
def _rows(factor: Factor, flat, acting: Acting) -> Float[Array, "observations components"]:
    local = jax.vmap(lambda own, data, ports: factor.local(own, data, PortValues(ports)))
    return local(parts_of(factor, flat), factor.data(), _ports(factor, acting))


def _ports(factor: Factor, acting: Acting) -> Float[Array, "observations ports"] | None:
    """Port values of each observation: what all effects together do to it; None without effects."""
    if not (isinstance(factor, PixelFactor | RangeFactor) and len(acting.amplitude)):
        return None
    course = acting.amplitude * acting.value.T[factor.epoch] * factor.pattern
    return course @ acting.ports


class Linearised(NamedTuple):
    """A table at one state, in its unit."""

    value: Float[Array, "observations components"]  # predicted minus measured
    jacobian: Float[Array, "observations components live"]
    tangent: Float[Array, "observations components ports"]  # by every port: tangents of all effects


def linearise(
    factor: Factor,
    network: Network,
    flat: Float[Array, " n"],
    values: Float[Array, "columns epochs"],
    slopes: Float[Array, "columns epochs 2"],
    live: tuple[int, ...],
    tangent: bool = False,
) -> Linearised:
    """Each row with its derivatives: by its live slots, and by the ports.

    `live` are the positions along [own slots, amplitudes, constants] that are wanted. Reverse mode:
    a row has one to six components and many slots. Whatever the number of effects, they enter
    through the ports: one derivative by the ports serves all amplitudes and constants. Without any
    the tangent is computed when it is asked for, else it is empty.
    """
    layout = network.layout
    amplitude = flat[jnp.asarray(layout.all("amplitude"))]
    acting = Acting(amplitude, network.effects.ports, values).roomy()
    n_constants = len(layout.all("constant"))
    owner = jax.nn.one_hot(network.effects.constant_index, n_constants, dtype=float)
    common = (roomy(flat), acting, roomy(slopes, axis=1), owner)
    return by_blocks(partial(_linearise, live=live, tangent=tangent), factor, *common)


@eqx.filter_jit
def _linearise(factor: Factor, flat, acting: Acting, slopes, owner, live, tangent) -> Linearised:
    n_own = factor.slots.shape[1]
    own = [at for at in live if at < n_own]
    of_effects = jnp.asarray([at - n_own for at in live if at >= n_own], int)
    ports = _ports(factor, acting)
    affected = ports is not None
    if tangent and not affected and isinstance(factor, PixelFactor | RangeFactor):
        ports = jnp.zeros((factor.slots.shape[0], N_PORTS))
    value, by_own, by_ports = _derivatives(factor, parts_of(factor, flat), ports, own)
    if not affected or not of_effects.size:
        nothing = jnp.zeros((*value.shape, of_effects.size))
        return Linearised(value, jnp.concatenate([by_own, nothing], axis=2), by_ports)
    entering = (by_ports @ acting.ports.T) * factor.pattern[:, None, :]
    slope = jnp.moveaxis(slopes, 1, 0)[factor.epoch]
    moved = (entering * acting.amplitude)[..., None] * slope[:, None]
    n_constants = owner.shape[2]
    by_constants = jnp.reshape(moved, (*value.shape, -1)) @ jnp.reshape(owner, (-1, n_constants))
    by_amplitudes = entering * acting.value.T[factor.epoch][:, None, :]
    every = jnp.concatenate([by_amplitudes, by_constants], axis=2)[:, :, of_effects]
    return Linearised(value, jnp.concatenate([by_own, every], axis=2), by_ports)


def _derivatives(factor: Factor, parts, ports, live: list[int]):
    """Values of the rows, and their derivatives by live slots of their own and by all ports."""
    ends = np.cumsum([part.shape[1] for part in parts])
    first = np.concatenate([[0], ends])[:-1]
    # Only parameters with a wanted slot are differentiated; the others are constants.
    moving = [k for k in range(len(ends)) if any(first[k] <= at < ends[k] for at in live)]
    within = np.concatenate([np.arange(first[k], ends[k]) for k in moving] or [[]])
    wanted = jnp.asarray(np.searchsorted(within, np.asarray(live, int)), int)

    def local(free, ports, parts, data):
        own = list(parts)
        for k, value in zip(moving, free, strict=True):
            own[k] = value
        value = factor.local(own, data, PortValues(ports))
        return value, value

    free = [parts[k] for k in moving]
    derivative = jax.vmap(jax.jacrev(local, argnums=(0, 1), has_aux=True))
    (blocks, by_ports), value = derivative(free, ports, parts, factor.data())
    none = jnp.zeros((*value.shape, 0))
    by_own = jnp.concatenate([none, *blocks], axis=2)[:, :, wanted]
    return value, by_own, none if by_ports is None else by_ports


def predict_pixels(state: State, network: Network) -> tuple[Float[Array, "observations 2"], ...]:
    """Predicted pixels (px) of every table: what a simulation adds its noise to."""
    flat = state.flatten()
    values = courses(network.effects, state.constant, network.channels)
    return tuple(rows(f, network, flat, values) + f.circumstances.pixel for f in network.pixels)
