"""The tests of a fit with further effects, by what their columns take of the information without.

With the columns E of the further effects in the model, its factor L grows by a border (Golub and
Van Loan 2013, section 4.2.9):

    J L^-T  becomes  [J L^-T, M E l^-T],    l l^T = E^T M E,

so that the information G^T M G of a hypothesis loses (G^T M E l^-T)(...)^T, a product with a few
vectors where all of it would be one with every unknown. E and M are those of the fit without the
effects: that is right where the way from one fit to the other is a straight line.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxvm.discover.cells import Arrangement, driver_table
from jaxvm.discover.select import stacked
from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import OBSERVATION_DRIVERS
from jaxvm.physics.effects import Effect
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.problem import Packets, Problem
from jaxvm.solve.reduced import packet_of_rows

_CURVED, _UNSEEN = 1e-4, 1.0
"""Share of the squared change from fit to fit that may lie off the straight way, or chi-square."""

_SMALL = 1e-6
"""Part of their amplitudes at which effects are derived: none of it, but constants show."""

_MOVED = 0.02
"""Change of a driver, over its spread, from which its patterns are others."""


def bordered(
    arrangement: Arrangement, plain: Adjustment, fit: Adjustment
) -> tuple[Arrangement, frozenset[str]] | None:
    """The arrangement of a plain fit for a fit with further effects, from the fit without.

    And the observation-like drivers that have changed so much that their patterns are others.
    None where the way to it is no straight line, where other observations are fitted, or where its
    effects are not those of the plain fit and others after them.
    """
    if not _goes_on(plain, fit):
        return None
    cells = arrangement.cells
    residual = arrangement.in_cells(stacked(fit))
    columns, prior = _columns(arrangement, plain.scene, fit)
    if columns.shape[2] > cells.half.shape[2]:
        return None  # all anew costs no more
    left = np.zeros_like(columns)
    for k in range(columns.shape[2]):
        left[:, :, k] = cells.projected(columns[:, :, k])
    try:
        border = left @ _inverse_root(_products(columns, left) + prior).T
    except np.linalg.LinAlgError:
        return None  # a column is what the model has already
    change = residual - cells.residual
    off = _without(left, cells.projected(change))
    if np.sum(off**2) > max(_CURVED * np.sum(change**2), _UNSEEN):
        return None
    half = np.concatenate([cells.half, border], axis=2)
    cells = replace(cells, residual=residual, half=half)
    drivers = driver_table(fit)
    new = moved(arrangement.drivers, drivers)
    return replace(arrangement, cells=cells, drivers=drivers), new


def moved(
    old: Float[np.ndarray, "observations drivers"],
    new: Float[np.ndarray, "observations drivers"],
    least: float = _MOVED,
) -> frozenset[str]:
    """Observation-like drivers of which some value has changed, by more than `least` spreads."""
    names = list(OBSERVATION_DRIVERS)
    spread = np.std(np.where(np.isfinite(old), old, 0.0), axis=0)
    # A place within a pixel is a phase.
    spread[[names.index("pixel_u"), names.index("pixel_v")]] = 1.0
    change = np.where(np.isnan(old) & np.isnan(new), 0.0, np.abs(new - old))
    other = (change > least * spread) | np.isnan(change)
    return frozenset(name for name, own in zip(names, other.any(axis=0), strict=True) if own)


def _goes_on(plain: Adjustment, fit: Adjustment) -> bool:
    """Whether a fit has the effects of the plain one and others, about the same observations."""

    def kind(effect: Effect) -> Effect:
        return replace(effect, amplitudes=(), constants=(), shares="")

    given = plain.scene.effects
    if list(map(kind, given)) != list(map(kind, fit.scene.effects[: len(given)])):
        return False
    weights = [[factor.weight for factor in of.problem.network.acted_on] for of in (plain, fit)]
    return all(np.array_equal(a, b) for a, b in zip(*weights, strict=True))


def _products(
    a: Float[np.ndarray, "cells rows p"], b: Float[np.ndarray, "cells rows p"]
) -> Float[np.ndarray, "p p"]:
    return np.tensordot(a, b, axes=([0, 1], [0, 1]))


def _inverse_root(information: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    """l^-1 of l l^T, whatever the units; raises LinAlgError where it is singular."""
    unit = 1.0 / np.sqrt(np.maximum(np.diagonal(information), 1e-300))
    root = np.linalg.cholesky(information * unit[:, None] * unit)
    return np.linalg.inv(root) * unit


def _without(
    left: Float[np.ndarray, "cells rows p"], e: Float[np.ndarray, "cells rows"]
) -> Float[np.ndarray, "cells rows"]:
    """A vector without what some columns explain of it, whatever is known of their amounts."""
    columns = left.reshape(e.size, -1)
    size = np.linalg.norm(columns, axis=0)
    columns = columns / np.where(size > 0.0, size, 1.0)
    amounts = np.linalg.lstsq(columns.T @ columns, columns.T @ e.ravel(), rcond=1e-10)[0]
    return e - (columns @ amounts).reshape(e.shape)


def _columns(
    arrangement: Arrangement, plain: Scene, fit: Adjustment
) -> tuple[Float[np.ndarray, "cells rows p"], Float[np.ndarray, "p p"]]:
    """Derivatives by the further amplitudes and constants that a fit has, at the plain fit.

    And what is known about them beforehand (their spread).
    """
    problem, wanted = _at_plain(plain, fit)
    tables = problem.linearised(jnp.zeros(problem.n))
    number = np.full(problem.n + 1, -1)
    number[wanted] = np.arange(len(wanted))
    prior = np.zeros((len(wanted), len(wanted)))
    own, acted_on = [], len(problem.network.acted_on)
    for k, (table, packets) in enumerate(zip(tables, problem.packets, strict=True)):
        found = _of_table(np.asarray(table.jacobian), packets, number, len(wanted))
        if k < acted_on:
            own.append(found)
        else:
            prior += np.tensordot(found, found, axes=([0, 1], [0, 1]))
    real = [f.n_real for f in problem.network.acted_on]
    columns = arrangement.by_component([part[:n] for part, n in zip(own, real, strict=True)])
    acts = columns.any(axis=(0, 1))
    return columns[:, :, acts], prior[np.ix_(acts, acts)]


def _of_table(
    jacobian: Float[np.ndarray, "n components live"],
    packets: Packets,
    number: Int[np.ndarray, " unknowns"],
    p: int,
) -> Float[np.ndarray, "n components p"]:
    """Columns of the wanted unknowns: those that have a number."""
    found = np.zeros((*jacobian.shape[:2], p))
    place = number[np.asarray(packets.columns)]
    live = np.flatnonzero((place >= 0).any(axis=0))
    if len(live):
        of_row = place[np.asarray(packet_of_rows(packets, len(jacobian)))]
        for column in live:
            rows = np.flatnonzero(of_row[:, column] >= 0)
            found[rows, :, of_row[rows, column]] += jacobian[rows, :, column]
    return found


def _at_plain(plain: Scene, fit: Adjustment) -> tuple[Problem, Int[np.ndarray, " wanted"]]:
    """The problem of a fit at the plain fit, and the unknowns that it has beside."""
    scene, layout, problem = fit.scene, fit.scene.network.layout, fit.problem
    n_columns = sum(effect.n_columns for effect in plain.effects)
    n_constants = sum(len(effect.constants) for effect in plain.effects)
    amplitude = _SMALL * np.asarray(scene.state.amplitude)
    amplitude[:n_columns] = np.asarray(plain.state.amplitude)[:n_columns]
    constant = np.array(scene.state.constant)
    constant[:n_constants] = np.asarray(plain.state.constant)[:n_constants]
    state = eqx.tree_at(
        lambda s: (s.amplitude, s.constant),
        plain.state,
        (jnp.asarray(amplitude), jnp.asarray(constant)),
    )
    network = problem.network.with_patterns_of(scene.with_state(state).network)
    own = np.concatenate(
        [layout.all("amplitude")[n_columns:], layout.all("constant")[n_constants:-1]]
    )
    wanted = np.unique(scene.unknowns.column[own])
    wanted = wanted[wanted < problem.n]
    wanted = wanted[np.asarray(problem.active)[wanted]]
    return replace(problem, network=network, base=state.flatten()), wanted
