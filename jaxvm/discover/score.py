"""Score every hypothesis at once, with one tangent per port.

With whitened residual r and Jacobian J of the fitted model, M = I - J (J^T J)^-1 J^T. A hypothesis
with tangents G (one column for each amplitude) has

    score S = G^T M r,   information I = G^T M G,   drop of chi-square S^T I^-1 S,
    one-step amplitudes -I^-1 S.

M is never formed: with H = J^T J = L L^T, G^T M G = G^T G - Y^T Y, Y = (J L^-T)^T G. A tangent is a
port's derivative times a pattern over observations times a course over epochs. Observations of one
epoch, camera, target and local group form a *cell*; inside a cell the course and the scope are
constant, so all products are summed over cells once for each port and pattern, and thousands of
courses and scopes cost one matrix product.

Significance: the residuals of every epoch are multiplied by random signs, again and again; the
largest statistic over all hypotheses in each repetition gives a family-wise p-value that needs no
independence inside an epoch (wild bootstrap of the scores).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxvm.discover.cells import Arrangement, Cells
from jaxvm.discover.hypotheses import Family
from jaxvm.discover.ranking import Ranking, Scores, surprise
from jaxvm.network.binding import in_scope, ranges_in_scope
from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import pattern
from jaxvm.physics.effects import Scope, evaluate
from jaxvm.physics.forms import BASIS_INDEX, FORMS
from jaxvm.physics.ports import PORT_INDEX

_ABSORBED = 1e-8
"""Relative information below which a direction counts as absorbed by the model."""

_MOST_PRODUCTS = 6_000_000
"""Numbers that products of the weights within groups may take: 48 MB."""

FEWEST_EPOCHS = 3.0
"""A hypothesis that fewer epochs carry than this can't be told from a few bad images."""


@dataclass(frozen=True)
class Battery:
    """Families of hypotheses with what does not change from one fit to the next.

    Attributes:
        families: hypotheses.
        weights: for each family [pairs of course and scope, bases, cells]: the course at the
            epoch of a cell that is in scope.
        used: the pairs that some group of the family uses; only these are in `weights`.
    """

    families: tuple[Family, ...]
    weights: tuple[np.ndarray, ...]
    used: tuple[np.ndarray, ...]


def battery(scene: Scene, arrangement: Arrangement, families: tuple[Family, ...]) -> Battery:
    """Families with their courses and scopes over the cells of a scene."""
    weights, used = [], []
    inside = _inside(scene, arrangement, families[0].scopes)
    for family, course in zip(families, course_tables(scene, families), strict=True):
        used.append(np.flatnonzero(family.valid.any(axis=0).ravel()))
        c, s = np.divmod(used[-1], len(family.scopes))
        weights.append(course[:, :, arrangement.view][c] * inside[s][:, None])
    return Battery(families, tuple(weights), tuple(used))


def score_residuals(
    scene: Scene,
    arrangement: Arrangement,
    battery: Battery,
    variance: float,
    signs: np.ndarray,
    residual: np.ndarray | None = None,
    studentised: bool = False,
) -> Ranking:
    """Score all hypotheses against the arranged residuals, or against another vector.

    `variance` is that of unit weight; `signs` [epochs, repetitions] flip whole epochs for the null
    distribution (`jaxvm.discover.noise.multipliers`); all zero where it is not wanted.

    Noise with a memory makes smooth hypotheses look good and hardly touches the others. With
    `studentised` each statistic is compared with its own distribution under the multipliers:
    every hypothesis is judged by the noise that it meets.

    With another vector e (whitened, like all observations, and orthogonal to the model's
    tangents) the drop is the part of |e|^2 that a hypothesis explains: how much it resembles e.
    """
    cells = arrangement.cells
    if residual is not None:
        padded = np.concatenate([residual, np.zeros((1, arrangement.components))])
        own = padded[arrangement.rows].reshape(cells.residual.shape)
        cells = replace(cells, residual=own)
    common = _common(cells)
    results, null = [], np.full(signs.shape[1], -np.inf)
    for family, weights, used in zip(battery.families, battery.weights, battery.used, strict=True):
        ports, patterns = _group_arrays(scene, arrangement, family)
        valid = family.valid.reshape(len(family.groups), -1)[:, used]
        pairs = _Pairs.of(weights, cells)
        scored, largest = [], np.full((len(family.groups), signs.shape[1]), -np.inf)
        for g, own in enumerate(zip(ports, patterns, valid, strict=True)):
            *found, largest[g] = _score_group(
                common, *own[:2], pairs, own[2], signs, variance, studentised
            )
            scored.append(found)
        null = np.maximum(null, largest.max(axis=0))
        drop, z, amplitude, seen, inflation, freedom, sound = (
            _spread(np.stack(values), used, family.valid.shape, fill)
            for values, fill in zip(
                zip(*scored, strict=True), (0.0, -np.inf, 0.0, 0.0, 1.0, 1.0, False), strict=True
            )
        )
        found = drop, z, amplitude, seen, inflation, freedom, largest, sound
        results.append(Scores(family, *found, variance))
    return Ranking(tuple(results), null)


def _spread(values: np.ndarray, used: np.ndarray, shape: tuple[int, ...], fill) -> np.ndarray:
    """Values of the used pairs of course and scope, put among all pairs."""
    full = np.full((shape[0], shape[1] * shape[2], *values.shape[2:]), fill, values.dtype)
    full[:, used] = values
    return full.reshape(*shape, *values.shape[2:])


def _group_arrays(scene: Scene, arrangement: Arrangement, family: Family):
    """Port numbers [groups, terms] and patterns [groups, terms, cells, rows] of a family."""
    ports = np.array([[PORT_INDEX[t.port] for t in g.terms] for g in family.groups])
    known: dict[tuple, np.ndarray] = {}
    shape = (len(family.groups), family.n_terms, *arrangement.rows.shape)
    patterns = np.zeros(shape)
    for g, group in enumerate(family.groups):
        for k, term in enumerate(group.terms):
            key = (term.driver, term.basis, term.constants)
            if key not in known:
                values = np.append(np.asarray(pattern(term, arrangement.drivers)), 0.0)
                known[key] = values[arrangement.rows]
            own = known[key]
            if group.mark is not None:
                own = own * _mark_mask(scene, arrangement, group.mark)
            patterns[g, k] = own * term.weight
    return ports, patterns


def _mark_mask(scene: Scene, arrangement: Arrangement, mark: tuple[int, int]) -> np.ndarray:
    obs = scene.recording.observations
    own = np.zeros(len(arrangement.drivers) + 1)
    for start, rows in zip(arrangement.starts, scene.tables, strict=False):
        own[start : start + len(rows)] = (obs.target[rows] == mark[0]) & (
            obs.point[rows] == mark[1]
        )
    return own[arrangement.rows]


def _inside(scene: Scene, arrangement: Arrangement, scopes: tuple[Scope, ...]) -> np.ndarray:
    """1 where a cell is in a scope [scopes, cells]."""
    found = []
    for scope in scopes:
        own = [in_scope(scene, scope, rows) for rows in scene.tables]
        if scene.network.ranges is not None:
            own.append(ranges_in_scope(scene, scope))
        found.append(np.concatenate(own))
    inside = np.stack(found)
    first = arrangement.rows.min(axis=1)  # any observation speaks for its cell
    return inside[:, np.where(first < inside.shape[1], first, 0)]


def course_tables(scene: Scene, families: tuple[Family, ...]) -> list[np.ndarray]:
    """Courses [courses, bases, views] of each family."""
    channels = scene.network.channels
    place: dict[tuple, int] = {}
    columns, index = [], []
    for family in families:
        of_family = []
        for course in family.courses:
            form = FORMS[course.form]
            reference = course.reference if form.centred else 0.0
            for name in form.bases:
                key = (course.driver, reference, name, course.constants)
                if key not in place:
                    place[key] = len(columns)
                    own = (*course.constants, 1.0, 1.0)[:2]
                    channel = channels.index(course.driver)
                    columns.append((BASIS_INDEX[name], channel, reference, own))
                of_family.append(place[key])
        index.append(np.array(of_family).reshape(len(family.courses), family.n_bases))
    basis, channel, reference, constants = map(np.array, zip(*columns, strict=True))
    table = evaluate(basis, channel, reference, constants, channels)
    return [np.asarray(table)[own] for own in index]


@dataclass(frozen=True)
class _Common:
    """What all families share of one fit."""

    cells: Cells
    residual: Float[np.ndarray, "cells rows"]  # without what the local unknowns explain
    pull: Float[np.ndarray, "epochs shared"]  # of each epoch on the shared unknowns
    n_fitted: float  # epochs with residuals


def _common(cells: Cells) -> _Common:
    residual = _without_local(cells)
    half = cells.half[:, :, cells.n_local :]
    by_cell = np.einsum("nr,nrs->sn", residual, half, optimize=True)
    touched = cells.by(cells.epoch, np.sum(cells.residual**2, axis=1)).sum(axis=1) > 0.0
    pull = cells.by(cells.epoch, by_cell).sum(axis=2).T
    return _Common(cells, residual, pull, max(float(touched.sum()), 2.0))


@dataclass(frozen=True)
class _Pairs:
    """Courses and scopes of a family over the cells: their weights, as the products need them."""

    weights: Float[np.ndarray, "b bases cells"]
    by_group: Float[np.ndarray, "groups b_bases width"]
    by_epoch: Float[np.ndarray, "epochs b_bases wide"]
    within: Float[np.ndarray, "b bases bases groups_width_width"] | None
    """Products of the weights of two cells of one group; None where they would be too many."""

    @classmethod
    def of(cls, weights: np.ndarray, cells: Cells) -> "_Pairs":
        """Gathered by group and by epoch."""
        flat = weights.reshape(-1, weights.shape[2])
        by_group = cells.by(cells.group, flat)  # (b i) G w
        by_epoch = np.moveaxis(cells.by(cells.epoch, flat), 1, 0)
        within = None
        b, n_bases, _ = weights.shape
        if b * n_bases**2 * cells.group.size * cells.group.shape[1] <= _MOST_PRODUCTS:
            own = by_group.reshape(b, n_bases, *cells.group.shape)
            within = np.einsum("bigv,bjgw->bijgvw", own, own).reshape(b, n_bases, n_bases, -1)
        return cls(weights, np.moveaxis(by_group, 1, 0), by_epoch, within)


def _score_group(
    common: _Common,
    ports: Int[np.ndarray, " terms"],
    patterns: Float[np.ndarray, "terms cells observations"],
    pairs: _Pairs,
    valid: Bool[np.ndarray, " b"],
    signs: Float[np.ndarray, "epochs repetitions"],
    variance: float,
    studentised: bool,
):
    """Drop, z, amplitudes, visible share, inflation, freedom, soundness [b, ...]; the largest z.

    Few large matrix products, in NumPy: a compiled program for every shape of a family would take
    longer to make than to run.
    """
    cells, weights = common.cells, pairs.weights
    d = cells.n_local
    b, n_bases, n = weights.shape
    k = len(ports)
    columns = k * n_bases
    components = cells.residual.shape[1] // patterns.shape[2]
    tangent = cells.tangent[ports] * np.repeat(patterns, components, axis=2)  # k n r
    tangent = np.ascontiguousarray(np.moveaxis(tangent, 1, 0))  # n k r
    square = tangent @ np.swapaxes(tangent, 1, 2)  # n k k
    product = (tangent @ common.residual[:, :, None])[:, :, 0]  # n k
    halves = tangent @ cells.half  # n k s
    of_bases = weights.reshape(b * n_bases, n)

    def by_terms(values: np.ndarray) -> np.ndarray:
        """[b bases, terms, ...] with one axis of columns, term by term."""
        split = values.reshape(b, n_bases, k, *values.shape[2:])
        return np.swapaxes(split, 1, 2).reshape(b, columns, *values.shape[2:])

    if n_bases == 1:
        gram = ((of_bases**2) @ square.reshape(n, k * k)).reshape(b, k, k)
    else:
        gram = np.empty((b, k, n_bases, k, n_bases))
        for i in range(k):
            for j in range(k):
                gram[:, i, :, j] = (weights * square[:, i, j]) @ np.swapaxes(weights, 1, 2)
        gram = gram.reshape(b, columns, columns)
    of_shared = halves[:, :, d:]
    shared = by_terms((of_bases @ of_shared.reshape(n, -1)).reshape(-1, *of_shared.shape[1:]))
    information = gram - shared @ np.swapaxes(shared, 1, 2)
    padded = np.concatenate([halves[:, :, :d], np.zeros((1, k, d))])[cells.group]
    if d and pairs.within is not None:
        alike = np.einsum("gvkd,gwld->gvwkl", padded, padded, optimize=True)
        taken = pairs.within @ alike.reshape(-1, k * k)
        taken = taken.reshape(b, n_bases, n_bases, k, k).transpose(0, 3, 1, 4, 2)
        information -= taken.reshape(b, columns, columns)
    elif d:
        local = pairs.by_group @ padded.reshape(*cells.group.shape, k * d)  # G (b i) (k d)
        local = np.moveaxis(local, 0, 1).reshape(b * n_bases, -1, k, d)
        local = by_terms(np.swapaxes(local, 1, 2)).reshape(b, columns, -1)
        information -= local @ np.swapaxes(local, 1, 2)
    padded = np.concatenate([product, np.zeros((1, k))])[cells.epoch]  # E w k
    parts = by_terms(np.moveaxis(pairs.by_epoch @ padded, 0, 2))  # b c E
    parts = parts - shared @ common.pull.T

    # Directions that the model absorbs to eight digits carry no information.
    size = np.diagonal(gram, axis1=1, axis2=2)
    unit = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    scaled = information * unit[:, :, None] * unit[:, None, :]
    root = np.linalg.cholesky(scaled + _ABSORBED * np.eye(columns))
    inverse = np.linalg.inv(root)
    part_w = inverse @ (parts * unit[:, :, None])  # b c E
    score_w = part_w.sum(axis=2)
    drop = np.sum(score_w**2, axis=1)
    amplitude = -np.einsum("bdc,bd->bc", inverse, score_w) * unit
    seen = np.diagonal(scaled, axis1=1, axis2=2).max(axis=1)
    of_epoch_square = cells.by(cells.epoch, np.einsum("nkk->n", square))  # E w
    weight_square = np.einsum("ebw,ew->be", pairs.by_epoch**2, of_epoch_square, optimize=True)
    weight_square = weight_square.reshape(b, n_bases, -1).sum(axis=1)
    total = weight_square.sum(axis=1)
    carried = total**2 / np.maximum(np.sum(weight_square**2, axis=1), 1e-300)
    fewest = min(FEWEST_EPOCHS, 0.5 * len(cells.epoch))
    sound = valid & (seen > 1e-6) & (total > 0.0) & (carried >= fewest)
    inflation, freedom = np.ones(b), np.full(b, float(columns))
    largest = np.full(signs.shape[1], -np.inf)
    if signs.any() and sound.any():  # all zero: the null distribution is not wanted
        # A fitted residual lacks what the shared unknowns take of its epoch, about 1/epochs.
        lost = max(1.0 - 1.0 / common.n_fitted, 0.5)
        null = np.sum((part_w[sound] @ signs) ** 2, axis=1) / (lost * variance)
        if studentised:
            mean, spread = null.mean(axis=1), null.var(axis=1)
            inflation[sound] = np.maximum(0.5 * spread / mean, 1.0)
            freedom[sound] = np.clip(2.0 * mean**2 / spread, 1.0, columns)
            of = inflation[sound, None], freedom[sound, None]
            largest = surprise(null / of[0], of[1]).max(axis=0)
        else:
            largest = surprise(null.max(axis=0), columns)
    z = np.where(sound, surprise(drop / variance / inflation, freedom), -np.inf)
    return drop, z, amplitude, seen, inflation, freedom, sound, largest


def _without_local(cells: Cells) -> Float[np.ndarray, "cells rows"]:
    """Residuals without the part that the local unknowns explain.

    At the minimum there is none; another vector may have one. The local columns of the half rows
    are orthonormal within a group.
    """
    d = cells.n_local
    if not d:
        return cells.residual
    half = cells.half[:, :, :d]
    own = np.einsum("nr,nrd->dn", cells.residual, half)
    of_group = cells.by(cells.group, own).sum(axis=2)  # d G
    back = np.concatenate([of_group, np.zeros((d, 1))], axis=1)[:, cells.group_of]
    return cells.residual - np.einsum("dn,nrd->nr", back, half)
