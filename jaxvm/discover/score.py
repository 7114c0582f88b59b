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

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxvm.discover.cells import Arrangement, Cells
from jaxvm.discover.hypotheses import Family, Hypothesis, member
from jaxvm.network.binding import in_scope, ranges_in_scope
from jaxvm.network.factors import rounded
from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import pattern
from jaxvm.physics.effects import Scope
from jaxvm.physics.forms import BASIS_INDEX, FORMS, evaluate_basis
from jaxvm.physics.ports import PORT_INDEX

FEWEST_EPOCHS = 3.0
"""A hypothesis that fewer epochs carry than this can't be told from a few bad images."""


@dataclass(frozen=True)
class Scores:
    """Scores of one family: arrays [groups, courses, scopes].

    Attributes:
        family: the hypotheses.
        drop: predicted drop of chi-square (of residuals with unit variance).
        z: the same as a surprise, about -2 ln p, comparable whatever the number of columns.
        amplitude: one-step amplitudes [groups, courses, scopes, columns].
        seen: share of the effect that the model does not absorb.
        valid: hypotheses that were scored.
    """

    family: Family
    drop: np.ndarray
    z: np.ndarray
    amplitude: np.ndarray
    seen: np.ndarray
    valid: np.ndarray
    variance: float

    @property
    def n(self) -> int:
        """Number of hypotheses scored."""
        return int(self.valid.sum())


@dataclass(frozen=True)
class Ranking:
    """All families' scores, and the distribution of the largest z under noise."""

    scores: tuple[Scores, ...]
    null: np.ndarray

    @property
    def n(self) -> int:
        """Number of hypotheses scored."""
        return sum(s.n for s in self.scores)

    def best_z(self) -> float:
        """Largest statistic."""
        return max((float(s.z[s.valid].max()) for s in self.scores if s.n), default=-np.inf)

    def p_value(self, z: float) -> float:
        """Probability that noise alone gives a statistic this large anywhere (family-wise)."""
        return float((1 + np.sum(self.null >= z)) / (1 + len(self.null)))


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
        weights.append(course[:, :, arrangement.epoch][c] * inside[s][:, None])
    return Battery(families, tuple(weights), tuple(used))


def score_residuals(
    scene: Scene,
    arrangement: Arrangement,
    battery: Battery,
    variance: float,
    signs: np.ndarray,
    residual: np.ndarray | None = None,
) -> Ranking:
    """Score all hypotheses against the arranged residuals, or against another vector.

    `variance` is that of unit weight; `signs` [epochs, repetitions] flip whole epochs for the null
    distribution (`jaxvm.discover.noise.multipliers`); all zero where it is not wanted.

    With another vector e (whitened, like all observations, and orthogonal to the model's
    tangents) the drop is the part of |e|^2 that a hypothesis explains: how much it resembles e.
    """
    cells = arrangement.cells
    if residual is not None:
        padded = np.concatenate([residual, np.zeros((1, arrangement.components))])
        own = padded[arrangement.rows].reshape(cells.residual.shape)
        cells = eqx.tree_at(lambda c: c.residual, cells, jnp.asarray(own))
    results, null = [], np.full(signs.shape[1], -np.inf)
    for family, weights, used in zip(battery.families, battery.weights, battery.used, strict=True):
        ports, patterns = _group_arrays(scene, arrangement, family)
        valid = family.valid.reshape(len(family.groups), -1)[:, used]
        n_groups, n_pairs = valid.shape
        # Rounded sizes: a driver more or a mark less is no other program.
        more, wider = rounded(n_groups) - n_groups, rounded(n_pairs) - n_pairs
        ports, patterns, valid = (_grown(a, more) for a in (ports, patterns, valid))
        valid = np.pad(valid, [(0, 0), (0, wider)])
        drop, z, amplitude, seen, sound, largest = _kernel(
            cells,
            jnp.asarray(ports),
            jnp.asarray(patterns),
            jnp.asarray(_grown(weights, wider)),
            jnp.asarray(valid),
            jnp.asarray(signs),
            jnp.asarray(variance),
        )
        null = np.maximum(null, np.asarray(largest))
        drop, z, amplitude, seen, sound = (
            _spread(np.asarray(values)[:n_groups, :n_pairs], used, family.valid.shape, fill)
            for values, fill in (
                (drop, 0.0), (z, -np.inf), (amplitude, 0.0), (seen, 0.0), (sound, False),
            )
        )  # fmt: skip
        results.append(Scores(family, drop, z, amplitude, seen, sound, variance))
    return Ranking(tuple(results), null)


def _grown(values: np.ndarray, more: int) -> np.ndarray:
    """An array with some rows of zeros behind."""
    return np.concatenate([values, np.zeros((more, *values.shape[1:]), values.dtype)])


def _spread(values: np.ndarray, used: np.ndarray, shape: tuple[int, ...], fill) -> np.ndarray:
    """Values of the used pairs of course and scope, put among all pairs."""
    full = np.full((shape[0], shape[1] * shape[2], *values.shape[2:]), fill, values.dtype)
    full[:, used] = values
    return full.reshape(*shape, *values.shape[2:])


def _group_arrays(scene: Scene, arrangement: Arrangement, family: Family):
    """Port numbers [groups, terms] and patterns [groups, terms, cells, rows] of a family."""
    ports = np.array([[PORT_INDEX[t.port] for t in g.terms] for g in family.groups])
    drivers = jnp.asarray(arrangement.drivers)
    known: dict[tuple, np.ndarray] = {}
    shape = (len(family.groups), family.n_terms, *arrangement.rows.shape)
    patterns = np.zeros(shape)
    for g, group in enumerate(family.groups):
        for k, term in enumerate(group.terms):
            key = (term.driver, term.basis, term.constants)
            if key not in known:
                values = np.append(np.asarray(pattern(term, drivers)), 0.0)
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
    """Courses [courses, bases, epochs] of each family, at the epochs."""
    channels = scene.network.channels
    place: dict[tuple, int] = {}
    x, basis, constants, index = [], [], [], []
    for family in families:
        own = []
        for course in family.courses:
            form = FORMS[course.form]
            reference = course.reference if form.centred else 0.0
            for name in form.bases:
                key = (course.driver, reference, name, course.constants)
                if key not in place:
                    place[key] = len(x)
                    x.append(np.asarray(channels.values[channels.index(course.driver)]) - reference)
                    basis.append(BASIS_INDEX[name])
                    constants.append((*course.constants, 1.0, 1.0)[:2])
                own.append(place[key])
        index.append(np.array(own).reshape(len(family.courses), family.n_bases))
    more = rounded(len(x)) - len(x)
    rows = (_grown(np.array(v), more) for v in (basis, x, constants))
    table = np.asarray(_evaluate(channels, *map(jnp.asarray, rows)))
    return [table[own] for own in index]


@eqx.filter_jit
def _evaluate(channels, basis, x, constants):
    on_grid = jax.lax.map(
        lambda v: evaluate_basis(v[0], v[1], channels.time, v[2]),
        (basis, x, constants),
        batch_size=64,
    )
    return channels.at_epochs(on_grid)


@eqx.filter_jit
def _kernel(
    cells: Cells,
    ports: Int[Array, "groups terms"],
    patterns: Float[Array, "groups terms cells observations"],
    weights: Float[Array, "b bases cells"],
    valid: Bool[Array, "groups b"],
    signs: Float[Array, "epochs repetitions"],
    variance: Float[Array, ""],
):
    """Drop, z, amplitudes, visible share, soundness [groups, b, ...], largest z per repetition."""
    d = cells.n_local
    b, n_bases, _ = weights.shape
    columns = ports.shape[1] * n_bases
    by_group = cells.by(cells.group, weights)  # b i G w
    by_epoch = cells.by(cells.epoch, weights)  # b i E w
    zero = jnp.zeros((1, *cells.half.shape[1:]))
    padded_half = jnp.concatenate([cells.half[:, :, d:], zero[:, :, d:]])
    residual = _without_local(cells)
    padded_residual = jnp.concatenate([residual, jnp.zeros((1, residual.shape[1]))])
    touched = jnp.sum(cells.by(cells.epoch, jnp.sum(cells.residual**2, axis=1)), axis=1) > 0.0
    n_fitted = jnp.maximum(jnp.sum(touched), 2.0)
    asked = jnp.any(signs != 0.0)  # all zero: the null distribution is not wanted
    # What each epoch contributes to the gradient of the shared unknowns.
    pull = jnp.einsum("ewr,ewrs->es", padded_residual[cells.epoch], padded_half[cells.epoch])

    def one(inputs):
        port, own_pattern, own_valid = inputs
        components = cells.residual.shape[1] // own_pattern.shape[2]
        tangent = cells.tangent[port] * jnp.repeat(own_pattern, components, axis=2)  # k n r
        square = jnp.einsum("knr,lnr->nkl", tangent, tangent)
        product = jnp.einsum("knr,nr->kn", tangent, residual)
        halves = jnp.einsum("knr,nrs->nks", tangent, cells.half)
        scaled_weights = jnp.einsum("bin,nkl->bkiln", weights, square)
        gram = jnp.einsum("bkiln,bjn->bkilj", scaled_weights, weights)
        gram = jnp.reshape(gram, (b, columns, columns))
        shared = jnp.einsum("bin,nks->bkis", weights, halves[:, :, d:])
        shared = jnp.reshape(shared, (b, columns, -1))
        absorbed = jnp.einsum("bcs,bds->bcd", shared, shared)
        if d:
            local_halves = jnp.moveaxis(halves[:, :, :d], 0, -1)  # k s n
            of_group = cells.by(cells.group, local_halves)  # k s G w
            local = jnp.einsum("bigw,ksgw->gbkis", by_group, of_group)
            local = jnp.reshape(local, (local.shape[0], b, columns, d))
            absorbed = absorbed + jnp.einsum("gbcs,gbds->bcd", local, local)
        information = gram - absorbed
        of_epoch = cells.by(cells.epoch, product)  # k E w
        parts = jnp.einsum("biew,kew->bkie", by_epoch, of_epoch)
        parts = jnp.reshape(parts, (b, columns, -1)) - jnp.einsum("bcs,es->bce", shared, pull)

        # Directions that the model absorbs to eight digits carry no information.
        size = jnp.diagonal(gram, axis1=1, axis2=2)
        unit = 1.0 / jnp.sqrt(jnp.where(size > 0.0, size, 1.0))
        scaled = information * unit[:, :, None] * unit[:, None, :]
        root = jnp.linalg.cholesky(scaled + 1e-8 * jnp.eye(columns))
        whiten = jax.vmap(lambda m, v: jax.scipy.linalg.solve_triangular(m, v, lower=True))
        part_w = whiten(root, parts * unit[:, :, None])  # b c e
        score_w = jnp.sum(part_w, axis=2)
        drop = jnp.sum(score_w**2, axis=1)
        back = jax.vmap(lambda m, v: jax.scipy.linalg.solve_triangular(m, v, lower=True, trans=1))(
            root, score_w
        )
        amplitude = -back * unit
        # A fitted residual lacks what the shared unknowns take of its epoch, about 1/epochs.
        lost = jnp.maximum(1.0 - 1.0 / n_fitted, 0.5)
        flipped = jax.lax.cond(
            asked,
            lambda: jnp.einsum("bce,er->bcr", part_w, signs) / jnp.sqrt(lost),
            lambda: jnp.zeros((b, columns, signs.shape[1])),
        )
        null_drop = jnp.sum(flipped**2, axis=1)

        seen = jnp.max(jnp.diagonal(scaled, axis1=1, axis2=2), axis=1)
        of_epoch_square = cells.by(cells.epoch, jnp.einsum("nkk->n", square))  # E w
        weight_square = jnp.einsum("biew,ew->be", by_epoch**2, of_epoch_square)
        total = jnp.sum(weight_square, axis=1)
        carried = total**2 / jnp.maximum(jnp.sum(weight_square**2, axis=1), 1e-300)
        fewest = min(FEWEST_EPOCHS, 0.5 * cells.epoch.shape[0])
        sound = own_valid & (seen > 1e-6) & (total > 0.0) & (carried >= fewest)
        z = surprise(drop / variance, columns)
        null_z = surprise(null_drop / variance, columns)
        largest = jnp.max(jnp.where(sound[:, None], null_z, -jnp.inf), axis=0, initial=-jnp.inf)
        return drop, jnp.where(sound, z, -jnp.inf), amplitude, seen, sound, largest

    drop, z, amplitude, seen, sound, largest = jax.lax.map(one, (ports, patterns, valid))
    return drop, z, amplitude, seen, sound, jnp.max(largest, axis=0)


def _without_local(cells: Cells) -> Float[Array, "cells rows"]:
    """Residuals without the part that the local unknowns explain.

    At the minimum there is none; another vector may have one. The local columns of the half rows
    are orthonormal within a group.
    """
    d = cells.n_local
    if not d:
        return cells.residual
    own = jnp.einsum("nr,nrd->dn", cells.residual, cells.half[:, :, :d])
    of_group = jnp.sum(cells.by(cells.group, own), axis=2)  # d G
    back = jnp.concatenate([of_group, jnp.zeros((d, 1))], axis=1)[:, cells.group_of]
    return cells.residual - jnp.einsum("dn,nrd->nr", back, cells.half[:, :, :d])


def surprise(chi_square: Float[Array, "..."], columns: int) -> Float[Array, "..."]:
    """About -2 ln p of a chi-square statistic: comparable whatever the number of columns.

    The leading term of the upper tail, p ~ x^(s-1) e^-x / Gamma(s) with s = columns/2, x = half the
    statistic; below the mean, where it does not hold, the statistic is taken at the mean.
    """
    x = 0.5 * jnp.maximum(chi_square, columns)
    return 2.0 * (x - (0.5 * columns - 1.0) * jnp.log(x) + math.lgamma(0.5 * columns))


def top(ranking: Ranking, scene: Scene, count: int) -> list[tuple[Hypothesis, float, np.ndarray]]:
    """The leading hypotheses by z: (hypothesis, drop, one-step amplitudes).

    Courses that differ only in their constants (instants, lags, periods) count as one: the best.
    """
    entries = []
    for scores in ranking.scores:
        z = np.where(scores.valid, scores.z, -np.inf)
        kinds: dict[tuple[str, str], list[int]] = {}
        for place, course in enumerate(scores.family.courses):
            kinds.setdefault((course.driver, course.form), []).append(place)
        for places in kinds.values():
            own = z[:, places]
            best = np.argmax(own, axis=1)
            value = np.max(own, axis=1)
            for g, s in np.argwhere(np.isfinite(value)):
                entries.append((value[g, s], scores, (g, places[best[g, s]], s)))
    entries.sort(key=lambda entry: -entry[0])
    return [
        (member(s.family, index, scene), float(s.drop[index]), s.amplitude[index])
        for _, s, index in entries[:count]
    ]
