"""Residuals and tangents of a fitted scene, arranged in cells for scoring.

Observations of one epoch, camera, target and local group form a *cell*; inside a cell the course of
any effect and its scope are constant.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxvm.compiling import program
from jaxvm.network.binding import observation_driver_table, range_driver_table
from jaxvm.network.factors import PixelFactor, RangeFactor
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.arrow import Arrow, factorise
from jaxvm.solve.problem import Problem
from jaxvm.solve.reduced import half_rows, packet_of_rows


@dataclass(frozen=True)
class Cells:
    """Residuals and tangents of a fitted scene, arranged in cells.

    Rows of a cell are one component of all its observations after the other.

    Attributes:
        tangent: derivative of the whitened residuals with respect to each port.
        residual: whitened residuals.
        half: rows of J L^-T, the local part first.
        group: cells of each local group, padded with the number of cells.
        group_of: local group of each cell; the number of groups where it has none.
        epoch_of: epoch of each cell.
        n_epochs: number of epochs.
    """

    tangent: Float[np.ndarray, "ports cells rows"]
    residual: Float[np.ndarray, "cells rows"]
    half: Float[np.ndarray, "cells rows halves"]
    group: Int[np.ndarray, "groups width"]
    group_of: Int[np.ndarray, " cells"]
    epoch_of: Int[np.ndarray, " cells"]
    n_epochs: int
    n_local: int

    def projected(self, e: Float[np.ndarray, "cells rows"]) -> Float[np.ndarray, "cells rows"]:
        """M e = e - J L^-T (J L^-T)^T e: a vector without what the model explains of it."""
        d = self.n_local
        absorbed = np.tensordot(self.half[:, :, d:], self.shared_part(e), axes=1)
        if d:
            half = self.half[:, :, :d]
            own = gathered(np.einsum("nr,nrd->dn", e, half), self.group).sum(axis=2)
            back = np.concatenate([own, np.zeros((d, 1))], axis=1)[:, self.group_of]
            absorbed = absorbed + np.einsum("dn,nrd->nr", back, half)
        return e - absorbed

    def shared_part(self, e: Float[np.ndarray, "cells rows"]) -> Float[np.ndarray, " shared"]:
        """Coordinates of a vector along the shared columns of J L^-T."""
        return np.tensordot(e, self.half[:, :, self.n_local :], axes=2)


@dataclass(frozen=True)
class Arrangement:
    """Cells, and where the observations behind them are."""

    cells: Cells
    rows: np.ndarray  # [cells, width] into all observations, padded with their number
    view: np.ndarray  # of each cell
    drivers: np.ndarray  # observation-like drivers of all observations, NaN where they have none
    starts: tuple[int, ...]  # first observation of each table (pixel tables, then ranges)
    components: int

    def in_cells(
        self, values: Float[np.ndarray, "observations components"]
    ) -> Float[np.ndarray, "cells rows"]:
        """A vector over all observations in the shape of the residuals of the cells."""
        return self.by_component([values])

    def by_component(
        self, parts: list[Float[np.ndarray, "observations components ..."]]
    ) -> Float[np.ndarray, "cells rows ..."]:
        """What the tables have for each observation, in the shape of the residuals of the cells."""
        return _by_component(parts, self.rows, self.components)

    def of_cells(
        self, values: Float[np.ndarray, "n observations"]
    ) -> Float[np.ndarray, "n cells width"]:
        """One number for each observation where its cell has it; zero in the padding."""
        return gathered(values, self.rows)


def gathered(
    values: Float[np.ndarray, "... n"], index: Int[np.ndarray, "a b"]
) -> Float[np.ndarray, "... a b"]:
    """Values gathered by padded lists of positions; padding reads zero."""
    zero = np.zeros((*values.shape[:-1], 1))
    return np.concatenate([values, zero], axis=-1)[..., index]


def _whitened(problem: Problem, x):
    """Half rows, residuals and port tangents of all tables on which effects act."""
    tables = problem.linearised(x, tangent=True)
    hessian = problem.assembled(tables).hessian
    n_effect = len(problem.network.acted_on)
    acting = tables[:n_effect]
    jacobians = [table.jacobian for table in acting]
    halves = _half_rows(hessian, problem.packets[:n_effect], jacobians, problem.sizes)
    return [(half, t.value, t.tangent) for half, t in zip(halves, acting, strict=True)]


@program
def _half_rows(hessian: Arrow, packets, jacobians, sizes):
    factors = factorise(hessian)
    return [half_rows(factors, p, j, sizes) for p, j in zip(packets, jacobians, strict=True)]


def arrange(adjustment: Adjustment) -> Arrangement:
    """Arrange residuals and tangents of an adjusted scene in cells."""
    scene, problem = adjustment.scene, adjustment.problem
    whitened = _whitened(problem, adjustment.x)
    n_groups = problem.sizes[1]
    keys, views, halves, residuals, tangents, starts = [], [], [], [], [], []
    components = max(r.shape[1] for _, r, _ in whitened)
    obs = scene.recording.observations
    tables = zip(problem.network.factors(), problem.packets, whitened, strict=False)
    for number, (factor, packets, (half, r, tangent)) in enumerate(tables):
        assert isinstance(factor, PixelFactor | RangeFactor)
        n = factor.n_real
        starts.append(sum(len(k) for k in keys))
        group = _group_of_rows(problem, packets, len(r))[:n]
        if isinstance(factor, PixelFactor):
            rows = scene.tables[number]
            entity = obs.camera[rows] * len(scene.model.targets) + obs.target[rows]
        else:
            ranges = scene.recording.ranges
            assert ranges is not None
            first = len(scene.model.cameras) * len(scene.model.targets)
            entity = first + ranges.rangefinder * len(scene.model.targets) + ranges.target
        views.append(np.asarray(factor.view)[:n])
        epoch = views[-1] % len(scene.recording.time)
        # Cells of one camera lie together.
        keys.append(np.stack([entity, group, epoch], axis=1))
        for parts, own in ((residuals, r), (halves, half), (tangents, tangent)):
            parts.append(np.asarray(own)[:n])
    key = np.concatenate(keys)
    distinct, cell = np.unique(key, axis=0, return_inverse=True)
    rows = padded_lists(cell.ravel(), len(distinct), len(key))

    tangent = _by_component(tangents, rows, components)
    cells = Cells(
        # What is read of one port at a time lies together.
        tangent=np.ascontiguousarray(np.moveaxis(tangent, 2, 0)),
        residual=_by_component(residuals, rows, components),
        half=_by_component(halves, rows, components),
        group=padded_lists(distinct[:, 1], n_groups, len(distinct)),
        group_of=np.where(distinct[:, 1] < 0, n_groups, distinct[:, 1]),
        epoch_of=distinct[:, 2],
        n_epochs=len(scene.recording.time),
        n_local=problem.sizes[2],
    )
    return Arrangement(
        cells,
        rows,
        np.concatenate(views)[rows.min(axis=1)],
        driver_table(adjustment),
        tuple(starts),
        components,
    )


def driver_table(adjustment: Adjustment) -> Float[np.ndarray, "observations drivers"]:
    """Observation-like drivers of all observations on which effects act, at the fit."""
    scene, network = adjustment.scene, adjustment.problem.network
    found = []
    for factor, rows in zip(network.pixels, scene.tables, strict=True):
        table = observation_driver_table(scene, factor, rows)
        found.append(np.asarray(table)[: factor.n_real])
    if network.ranges is not None:
        table = range_driver_table(scene, network.ranges)
        found.append(np.asarray(table)[: network.ranges.n_real])
    return np.concatenate(found)


def local_rows(
    adjustment: Adjustment,
) -> tuple[Float[np.ndarray, "observations 2 local"], Int[np.ndarray, " observations"]]:
    """Of every pixel observation the local part of its rows of J L^-T, and its local group.

    Rows as in the recording; the group is -1 where an observation has none, and its rows are zero.
    """
    scene, problem = adjustment.scene, adjustment.problem
    n, d = len(scene.recording.observations.epoch), problem.sizes[2]
    halves, groups = np.zeros((n, 2, d)), np.full(n, -1)
    tables = zip(scene.tables, problem.packets, _whitened(problem, adjustment.x), strict=False)
    for rows, packets, (half, value, _) in tables:
        groups[rows] = _group_of_rows(problem, packets, len(value))[: len(rows)]
        halves[rows] = np.asarray(half)[: len(rows), :, :d]
    halves[groups < 0] = 0.0
    return halves, groups


def _group_of_rows(problem: Problem, packets, n_rows: int) -> Int[np.ndarray, " rows"]:
    """Local group of every observation of a table; -1 where it has none."""
    columns = np.asarray(packets.columns)[np.asarray(packet_of_rows(packets, n_rows))]
    local = columns - problem.sizes[0]
    inside = (local >= 0) & (columns < problem.n)
    return np.where(inside, local // max(problem.sizes[2], 1), -1).max(axis=1, initial=-1)


def _by_component(
    parts: list[np.ndarray], rows: Int[np.ndarray, "cells width"], components: int
) -> Float[np.ndarray, "cells rows ..."]:
    """Values [observations, components, ...] of tables in cells; zero where a table has fewer."""
    rest = parts[0].shape[2:]
    values = np.zeros((components, sum(map(len, parts)) + 1, *rest))
    first = 0
    for part in parts:
        here = slice(first, first + len(part))
        values[: part.shape[1], here] = np.swapaxes(part, 0, 1)
        first += len(part)
    found = np.empty((len(rows), components, rows.shape[1], *rest))
    for component, own in enumerate(values):
        found[:, component] = own[rows]
    return found.reshape(len(rows), components * rows.shape[1], *rest)


def padded_lists(label: np.ndarray, n_labels: int, filler: int) -> np.ndarray:
    """Positions of each label 0..n-1 as rows of equal length, filled up with `filler`."""
    kept = np.flatnonzero(label >= 0)
    counts = np.bincount(label[kept], minlength=n_labels)
    lists = np.full((n_labels, max(int(counts.max(initial=0)), 1)), filler)
    order = kept[np.argsort(label[kept], kind="stable")]
    first = np.concatenate([[0], np.cumsum(counts)])[:-1]
    lists[label[order], np.arange(len(order)) - first[label[order]]] = order
    return lists
