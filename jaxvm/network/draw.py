"""Measurements drawn about a state: the same prediction as everywhere, plus noise."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxvm.geometry.poses import pose_from_vector, se3_exp, vector_from_pose
from jaxvm.network.factors import Factor, LinkFactor, link_pose
from jaxvm.network.network import Network
from jaxvm.network.residual import parts_of, present, rows
from jaxvm.network.state import State

Noise = Callable[[PRNGKeyArray, tuple[int, ...]], Float[Array, "..."]]
"""Numbers of zero mean and unit variance, of a key and a shape."""


def drawn(
    network: Network,
    state: State,
    key: PRNGKeyArray,
    scale: float = 1.0,
    noise: Noise = jax.random.normal,
) -> Network:
    """The network with measurements drawn anew about a state.

    Every table gets its prediction at the state plus independent noise of its own sigmas (or
    covariances) times `scale`, normal by default; loop closures stay what they are. Pure: `jax.jit`
    and `jax.vmap` apply.
    """
    flat = state.flatten()
    at = present(network, flat)
    keys = iter(jax.random.split(key, len(network.pixels) + 4))

    def off(factor: Factor) -> Float[Array, "observations components"]:
        """Predicted minus measured, plus noise."""
        white = noise(next(keys), factor.sigma.shape)
        return rows(factor, network, at) + scale * factor.sigma * white

    pixels = tuple(
        eqx.tree_at(
            lambda f: f.circumstances.pixel, factor, factor.circumstances.pixel + off(factor)
        )
        for factor in network.pixels
    )
    network = replace(network, pixels=pixels)
    if network.ranges is not None:
        measured = network.ranges.measured + off(network.ranges)[:, 0]
        network = eqx.tree_at(lambda n: n.ranges.measured, network, measured)
    if network.priors is not None:
        expected = network.priors.expected + off(network.priors)[:, 0]
        network = eqx.tree_at(lambda n: n.priors.expected, network, expected)
    if network.links is not None:
        own = _true_links(network.links, flat)
        measured = _measured(own, network.links.root, scale * noise(next(keys), own.shape))
        network = eqx.tree_at(lambda n: n.links.measured, network, measured)
    if network.edges is not None:
        measured = _measured(
            state.link, network.edges.root, scale * noise(next(keys), state.link.shape)
        )
        network = eqx.tree_at(lambda n: n.edges.measured, network, measured)
    return network


def with_measurements(network: Network, other: Network) -> Network:
    """The network with what another one of the same tables has measured; priors stay its own."""
    pixels = tuple(
        eqx.tree_at(lambda f: f.circumstances.pixel, own, its.circumstances.pixel)
        for own, its in zip(network.pixels, other.pixels, strict=True)
    )
    network = replace(network, pixels=pixels)
    for name in ("ranges", "links", "edges"):
        own, its = getattr(network, name), getattr(other, name)
        if own is not None:
            measured = eqx.tree_at(lambda f: f.measured, own, its.measured)
            network = replace(network, **{name: measured})
    return network


def _true_links(factor: LinkFactor, flat) -> Float[Array, "links 6"]:
    def one(*own):
        return vector_from_pose(link_pose([pose_from_vector(vector) for vector in own]))

    return jax.vmap(one)(*parts_of(factor, flat))


def _measured(true, root, white) -> Float[Array, "links 6"]:
    """Measured poses whose twist log(measured^-1 . true) has the covariance (root^T root)^-1."""

    def one(true, root, white):
        twist = jnp.linalg.solve(root, white)
        return vector_from_pose(pose_from_vector(true) @ se3_exp(-twist))

    return jax.vmap(one)(true, root, white)
