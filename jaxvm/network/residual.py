"""The one residual function of a network, and its block Jacobian from the same local functions.

Simulation, adjustment, covariance, Monte Carlo and diagnosis all call what stands here.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxvm.network.factors import (
    ClosureFactor,
    Course,
    EdgeFactor,
    Factor,
    LinkFactor,
    PixelFactor,
    PriorFactor,
    RangeFactor,
    Row,
    port_values,
)
from jaxvm.network.state import Layout, State
from jaxvm.physics.effects import Channels, EffectTable, course_slopes, courses
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


@eqx.filter_jit
def residual(state: State, network: Network) -> Residuals:
    """Whitened residuals of all observations: the one function of the project.

    Pure and differentiable in every field of `state`; `jax.vmap` and `jax.jit` apply.
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
    course = _course(factor, network, values)
    return jax.vmap(lambda row, at, data: _local(factor, network, row, at, data))(
        _gather(factor, network, flat), course, factor.data()
    )


def _affected(factor: Factor, network: Network) -> bool:
    """Whether effects act on a table."""
    return isinstance(factor, PixelFactor | RangeFactor) and network.effects.n_columns > 0


def _course(factor, network, values) -> Course | None:
    """Effects at the epochs of a table; None for tables on which they do not act."""
    if not _affected(factor, network):
        return None
    return Course(factor.pattern, values.T[factor.epoch])


def parts_of(factor: Factor, flat: Float[Array, " n"]) -> tuple[Float[Array, "n part"], ...]:
    """Values at the slots of a table, one array for each parameter."""
    ends = np.cumsum(factor.widths)
    pieces = zip(ends - np.array(factor.widths), ends, strict=True)
    return tuple(flat[factor.slots[:, a:b]] for a, b in pieces)


def _gather(factor: Factor, network: Network, flat) -> Row:
    n = factor.slots.shape[0]
    amplitude = flat[jnp.asarray(network.layout.all("amplitude"))]
    return Row(parts_of(factor, flat), jnp.broadcast_to(amplitude, (n, amplitude.shape[0])))


def _local(factor, network, row: Row, course: Course | None, data, disturbance=None):
    ports = disturbance
    if course is not None:
        acting = port_values(row, course, network.effects.ports)
        ports = acting if ports is None else acting + ports
    return factor.local(row.own, data, PortValues(ports))


@eqx.filter_jit
def block_jacobian(
    factor: Factor, network: Network, flat: Float[Array, " n"], live: tuple[int, ...]
) -> Float[Array, "observations components slots"]:
    """Derivative of each row with respect to its slots: own slots, amplitudes, constants.

    `live` are the positions along [own, amplitude, constant] that are wanted. Reverse mode: a row
    has one to six components and many slots. Whatever the number of effects, they enter through the
    ports: one derivative with respect to the ports serves all amplitudes and constants.
    """
    n, components = factor.slots.shape[0], factor.sigma.shape[1]
    n_own = factor.slots.shape[1]
    of_effects = [at for at in live if at >= n_own]
    acting = _affected(factor, network) and bool(of_effects)
    own, ports = _derivatives(factor, network, flat, [at for at in live if at < n_own], acting)
    if not of_effects:
        return own
    if not (acting and isinstance(factor, PixelFactor | RangeFactor)):
        return jnp.concatenate([own, jnp.zeros((n, components, len(of_effects)))], axis=2)
    effects, layout = network.effects, network.layout
    constant = flat[jnp.asarray(layout.all("constant"))]
    amplitude = flat[jnp.asarray(layout.all("amplitude"))]
    values = courses(effects, constant, network.channels).T[factor.epoch]
    slopes = jnp.moveaxis(course_slopes(effects, constant, network.channels), 1, 0)[factor.epoch]
    entering = (ports @ effects.ports.T) * factor.pattern[:, None, :]
    moved = (entering * amplitude)[..., None] * slopes[:, None]
    owner = jax.nn.one_hot(effects.constant_index, constant.shape[0], dtype=moved.dtype)
    by_constants = jnp.reshape(moved, (n, components, -1)) @ jnp.reshape(
        owner, (-1, constant.shape[0])
    )
    every = jnp.concatenate([entering * values[:, None, :], by_constants], axis=2)
    return jnp.concatenate([own, every[:, :, jnp.asarray(of_effects) - n_own]], axis=2)


def _derivatives(factor, network, flat, live: list[int], with_ports: bool):
    """Derivatives of each row [n, components, ...]: by live slots of its own, and by all ports.

    Without ports their part is empty.
    """
    row = _gather(factor, network, flat)
    constant = flat[jnp.asarray(network.layout.all("constant"))]
    course = None
    if _affected(factor, network):
        course = _course(factor, network, courses(network.effects, constant, network.channels))
    ends = np.cumsum([part.shape[1] for part in row.own])
    first = np.concatenate([[0], ends])[:-1]
    # Only parameters with a wanted slot are differentiated; the others are constants.
    moving = [k for k in range(len(ends)) if any(first[k] <= at < ends[k] for at in live)]
    within = np.concatenate([np.arange(first[k], ends[k]) for k in moving] or [[]])
    wanted = jnp.asarray(np.searchsorted(within, np.asarray(live, int)), int)

    def local(free, disturbance, row, at, data):
        own = list(row.own)
        for k, value in zip(moving, free, strict=True):
            own[k] = value
        return _local(factor, network, Row(tuple(own), row.amplitude), at, data, disturbance)

    none = jnp.zeros((factor.slots.shape[0], factor.sigma.shape[1], 0))
    free = [row.own[k] for k in moving]
    ports = none
    if with_ports:
        blocks, ports = jax.vmap(jax.jacrev(local, argnums=(0, 1)), in_axes=(0, None, 0, 0, 0))(
            free, jnp.zeros(N_PORTS), row, course, factor.data()
        )
    elif not moving:
        return none, none
    else:
        blocks = jax.vmap(jax.jacrev(lambda own, *rest: local(own, None, *rest)))(
            free, row, course, factor.data()
        )
    return jnp.concatenate([none, *blocks], axis=2)[:, :, wanted], ports


def port_jacobian(
    factor: PixelFactor | RangeFactor, network: Network, state: State
) -> Float[Array, "observations components ports"]:
    """Derivative of each row with respect to every port, in its unit: the tangents of all effects.

    One reverse pass for each component gives all ports at once.
    """
    return _derivatives(factor, network, state.flatten(), [], True)[1]


@eqx.filter_jit
def predict_pixels(state: State, network: Network) -> tuple[Float[Array, "observations 2"], ...]:
    """Predicted pixels (px) of every table: what a simulation adds its noise to."""
    flat = state.flatten()
    values = courses(network.effects, state.constant, network.channels)
    return tuple(rows(f, network, flat, values) + f.circumstances.pixel for f in network.pixels)
