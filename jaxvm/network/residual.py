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
    course = _course(factor, network, flat, values, None)
    return jax.vmap(lambda row, at, data: _local(factor, network, row, at, data))(
        _gather(factor, network, flat), course, factor.data()
    )


def _course(factor, network, flat, values, slopes):
    """Effects at the epochs of a table; None for tables on which effects do not act."""
    if not isinstance(factor, PixelFactor | RangeFactor) or network.effects.n_columns == 0:
        return None
    constant = flat[jnp.asarray(network.layout.all("constant"))]
    n = factor.epoch.shape[0]
    return Course(
        factor.pattern,
        values.T[factor.epoch],
        None if slopes is None else jnp.moveaxis(slopes, 1, 0)[factor.epoch],
        jnp.broadcast_to(constant, (n, constant.shape[0])),
    )


def parts_of(factor: Factor, flat: Float[Array, " n"]) -> tuple[Float[Array, "n part"], ...]:
    """Values at the slots of a table, one array for each parameter."""
    ends = np.cumsum(factor.widths)
    pieces = zip(ends - np.array(factor.widths), ends, strict=True)
    return tuple(flat[factor.slots[:, a:b]] for a, b in pieces)


def _gather(factor: Factor, network: Network, flat) -> Row:
    n = factor.slots.shape[0]

    def repeat(name):
        values = flat[jnp.asarray(network.layout.all(name))]
        return jnp.broadcast_to(values, (n, values.shape[0]))

    return Row(parts_of(factor, flat), repeat("amplitude"), repeat("constant"))


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
    """Derivative of each row with respect to its slots, own slots, amplitudes, constants.

    `live` are the positions along [own, amplitude, constant] that are wanted. Reverse mode: a row
    has one to six components and many slots. The courses of the effects are linearised in their
    constants, so that the derivative stays local.
    """
    row = _gather(factor, network, flat)
    values, structure = jax.tree.flatten(row)
    if not live:
        return jnp.zeros((factor.slots.shape[0], factor.sigma.shape[1], 0))
    ends = np.cumsum([value.shape[1] for value in values])
    first = np.concatenate([[0], ends])[:-1]
    # Only parameters with a wanted slot are differentiated; the others are constants.
    moving = [k for k in range(len(values)) if any(first[k] <= at < ends[k] for at in live)]
    within = np.concatenate([np.arange(first[k], ends[k]) for k in moving] or [[]])
    wanted = jnp.asarray(np.searchsorted(within, np.asarray(live, int)), int)
    course = None
    if isinstance(factor, PixelFactor | RangeFactor) and network.effects.n_columns:
        constant = flat[jnp.asarray(network.layout.all("constant"))]

        def of_constants(c):
            return courses(network.effects, c, network.channels)

        course = _course(
            factor, network, flat, of_constants(constant), jax.jacfwd(of_constants)(constant)
        )

    def local(free, everything, at, data):
        full = list(everything)
        for k, value in zip(moving, free, strict=True):
            full[k] = value
        return _local(factor, network, jax.tree.unflatten(structure, full), at, data)

    free = [values[k] for k in moving]
    blocks = jax.vmap(jax.jacrev(local))(free, values, course, factor.data())
    return jnp.concatenate(blocks, axis=2)[:, :, wanted]


def port_jacobian(
    factor: PixelFactor | RangeFactor, network: Network, state: State
) -> Float[Array, "observations components ports"]:
    """Derivative of each row with respect to every port, in its unit: the tangents of all effects.

    One reverse pass for each component gives all ports at once.
    """
    flat = state.flatten()
    course = _course(
        factor, network, flat, courses(network.effects, state.constant, network.channels), None
    )

    def local(disturbance, row, at, data):
        return _local(factor, network, row, at, data, disturbance)

    return jax.vmap(jax.jacrev(local), in_axes=(None, 0, 0, 0))(
        jnp.zeros(N_PORTS), _gather(factor, network, flat), course, factor.data()
    )


def predict_pixels(state: State, network: Network) -> tuple[Float[Array, "observations 2"], ...]:
    """Predicted pixels (px) of every table: what a simulation adds its noise to."""
    flat = state.flatten()
    values = courses(network.effects, state.constant, network.channels)
    return tuple(rows(f, network, flat, values) + f.circumstances.pixel for f in network.pixels)
