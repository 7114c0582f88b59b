"""Bind the effects of a scene to its tables: patterns, scopes, and priors of amplitudes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxvm.compiling import program
from jaxvm.network.factors import PixelFactor, PriorFactor, RangeFactor
from jaxvm.network.network import Network
from jaxvm.network.residual import parts_of
from jaxvm.network.tables import Tables
from jaxvm.physics.blocks import by_blocks, roomy
from jaxvm.physics.chain import Aim, Sight, level_axes
from jaxvm.physics.drivers import all_observation_drivers, all_range_drivers, patterns
from jaxvm.physics.effects import Effect, Scope, courses
from jaxvm.physics.ports import PORTS, PortValues

if TYPE_CHECKING:
    from jaxvm.network.scene import Scene


def bind(scene: Scene) -> Scene:
    """Compute the patterns of the effects over the tables, at the present geometry."""
    network = scene.network
    n_columns = network.effects.n_columns
    pixels = []
    for factor, rows in zip(network.pixels, scene.tables, strict=True):
        table = np.zeros((factor.slots.shape[0], n_columns))
        if scene.effects:
            drivers = observation_driver_table(scene, factor, rows)
            inside = [in_scope(scene, effect.scope, rows) for effect in scene.effects]
            _fill(table, scene.effects, drivers, inside)
        pixels.append(eqx.tree_at(lambda f: f.pattern, factor, jnp.asarray(table)))
    network = eqx.tree_at(lambda n: n.pixels, network, tuple(pixels))
    if network.ranges is not None:
        table = np.zeros((len(network.ranges.view), n_columns))
        if scene.effects:
            drivers = range_driver_table(scene, network.ranges)
            inside = [ranges_in_scope(scene, effect.scope) for effect in scene.effects]
            _fill(table, scene.effects, drivers, inside)
        network = eqx.tree_at(lambda n: n.ranges.pattern, network, jnp.asarray(table))
    return replace(scene, network=_with_amplitude_priors(scene, network))


def _fill(table: np.ndarray, effects: tuple[Effect, ...], drivers, inside) -> None:
    """Write the patterns of all terms and bases, one column each; `inside` are the real rows.

    Terms that differ in their constants alone (what every image or mark has for itself, the tiles
    of a map) are evaluated together.
    """
    first = 0
    for effect, own in zip(effects, inside, strict=True):
        columns = np.arange(first, first + effect.n_columns).reshape(len(effect.terms), -1)
        first += effect.n_columns
        alike: dict[tuple, list[int]] = {}
        for k, term in enumerate(effect.terms):
            alike.setdefault((term.driver, term.basis), []).append(k)
        for places in alike.values():
            values = np.asarray(patterns([effect.terms[k] for k in places], drivers))
            values = values[: len(own)] * own[:, None]
            table[: len(own), columns[places]] = values[:, :, None]


def _with_amplitude_priors(scene: Scene, network: Network) -> Network:
    """Priors that keep every amplitude of physical size, so that none is undetermined.

    The width is the largest plausible perturbation of the port over the largest value that the
    column takes; against any real evidence it weighs nothing.
    """
    n_columns = network.effects.n_columns
    given = Tables(scene).priors()
    if n_columns == 0:
        return replace(network, priors=given)
    reach = np.zeros(n_columns)
    for factor in network.acted_on:
        reach = np.maximum(reach, np.abs(np.asarray(factor.pattern)).max(axis=0, initial=0.0))
    own = np.asarray(courses(network.effects, scene.state.constant, network.channels))
    reach = reach * np.abs(own).max(axis=1)
    largest = np.abs(np.asarray(network.effects.ports)).T > 0
    limit = np.where(largest, np.array([port.largest for port in PORTS])[:, None], 0.0).max(axis=0)
    used = (reach > 0) & (limit > 0)
    slots = network.layout.all("amplitude")
    sigma = np.where(used, limit, 1.0) / np.where(used, reach, 1.0)
    own_spread = np.zeros(n_columns)
    for effect, (columns, _) in zip(scene.effects, scene.places(), strict=True):
        own_spread[columns] = effect.spread
    sigma = np.where(own_spread > 0.0, own_spread, sigma)
    own_priors = PriorFactor(
        slots=jnp.asarray(slots[:, None]),
        sigma=jnp.asarray(sigma[:, None]),
        weight=jnp.asarray(used, float),
        expected=jnp.zeros(n_columns),
    )
    if given is None:
        return replace(network, priors=own_priors)
    both = jax.tree.map(lambda a, b: jnp.asarray(np.concatenate([a, b])), given, own_priors)
    return replace(network, priors=both)


def observation_driver_table(scene: Scene, factor: PixelFactor, rows: np.ndarray):
    """Observation-like drivers of a pixel table at the scene's present state."""
    sizes = np.array([c.image_size for c in scene.model.cameras], float)
    padded = np.append(rows, np.full(factor.slots.shape[0] - len(rows), rows[-1]))
    size = sizes[scene.recording.observations.camera[padded]]
    level = jnp.asarray(level_axes(scene.model.up))
    return by_blocks(_driver_table, (factor.untiled(), size), roomy(scene.state.flatten()), level)


@program
def _driver_table(table: tuple[PixelFactor, Array], flat, level):
    factor, size = table
    own = parts_of(factor, flat)
    plain = jax.vmap(lambda o, at: factor.local(o, at, PortValues()) + at.pixel)
    predicted = plain(own, factor.circumstances)
    return all_observation_drivers(Sight(*own), factor.circumstances, predicted, size, level)


def range_driver_table(scene: Scene, factor: RangeFactor):
    """Observation-like drivers of the distances at the scene's present state."""
    return by_blocks(_range_driver_table, factor, roomy(scene.state.flatten()))


@program
def _range_driver_table(factor: RangeFactor, flat):
    own = parts_of(factor, flat)
    return all_range_drivers(Aim(*own), factor.circumstances, factor.to_plane)


def in_scope(scene: Scene, scope: Scope, rows: np.ndarray) -> np.ndarray:
    """1.0 for the observations (rows of the recording) that a scope touches."""
    obs, model = scene.recording.observations, scene.model
    if scope.rangefinder:
        return np.zeros(len(rows))
    camera_ok = np.array(
        [
            (not scope.camera or c.name in scope.camera)
            and (not scope.station or c.station in scope.station)
            for c in model.cameras
        ]
    )
    target_ok = np.array([not scope.target or t.name in scope.target for t in model.targets])
    inside = camera_ok[obs.camera[rows]] & target_ok[obs.target[rows]]
    if scope.point:
        names = np.concatenate([np.array(t.point_names, object) for t in model.targets])
        mine = np.isin(names.astype(str), scope.point)
        inside &= mine[scene.first_point[obs.target[rows]] + obs.point[rows]]
    return inside.astype(float)


def ranges_in_scope(scene: Scene, scope: Scope) -> np.ndarray:
    """1.0 for the ranges that a scope touches."""
    ranges, model = scene.recording.ranges, scene.model
    if ranges is None or scope.camera or scope.point:
        return np.zeros(0 if ranges is None else len(ranges.epoch))
    finder_ok = np.array(
        [
            (not scope.rangefinder or r.name in scope.rangefinder)
            and (not scope.station or r.station in scope.station)
            for r in model.rangefinders
        ]
    )
    target_ok = np.array([not scope.target or t.name in scope.target for t in model.targets])
    return (finder_ok[ranges.rangefinder] & target_ok[ranges.target]).astype(float)
