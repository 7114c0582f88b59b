"""Score every hypothesis at once, with one tangent per port.

With whitened residual r and Jacobian J of the fitted model, M = I - J (J^T J)^-1 J^T. A hypothesis
with tangents G (one column for each amplitude) has

    score S = G^T M r,   information I = G^T M G,   drop of chi-square S^T I^-1 S,
    one-step amplitudes -I^-1 S.

M is never formed: with H = J^T J = L L^T, G^T M G = G^T G - Y^T Y, Y = (J L^-T)^T G. A tangent is a
port's derivative times a pattern over observations times a course over epochs. Observations of one
epoch, camera, target and local group form a *cell*; inside a cell the course and the scope are
constant, so all products are summed over cells once for each port and pattern, and thousands of
courses of one scope cost one matrix product over its cells.

Significance: the residuals of every epoch are multiplied by random signs, again and again; the
largest statistic over all hypotheses in each repetition gives a family-wise p-value that needs no
independence inside an epoch (wild bootstrap of the scores).
"""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from jaxtyping import Float

from jaxvm.discover.battery import Battery, Part, battery
from jaxvm.discover.cells import Arrangement, Cells, arrange
from jaxvm.discover.hypotheses import Family
from jaxvm.discover.products import (
    CELLS,
    Information,
    Tangents,
    at_cells,
    by_terms,
    drop_of,
    information_of,
)
from jaxvm.discover.ranking import Ranking, Scores, surprise
from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import OBSERVATION_DRIVERS, driven_by, patterns
from jaxvm.physics.effects import Term
from jaxvm.physics.ports import PORT_INDEX
from jaxvm.solve.adjust import Adjustment

_STACKED = 16
"""Terms whose tangents are multiplied at a time, of as many groups as have them."""


@dataclass(frozen=True)
class ScoreTests:
    """Score tests (Rao 1948) of all hypotheses of a battery at one fit.

    The information is the same whatever residuals are scored: it is computed once, and kept.

    Attributes:
        scene: the fitted scene.
        arrangement: its residuals and tangents.
        battery: the hypotheses.
    """

    scene: Scene
    arrangement: Arrangement
    battery: Battery
    _known: dict[tuple[int, int, int], Information] = field(default_factory=dict)
    _patterns: dict[tuple, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, fit: Adjustment, families: tuple[Family, ...]) -> "ScoreTests":
        """Tests of the hypotheses of some families at a fit."""
        arrangement = arrange(fit)
        return cls(fit.scene, arrangement, battery(fit.scene, arrangement, families))

    def about(self, families: tuple[Family, ...]) -> "ScoreTests":
        """Tests of other hypotheses at the same fit."""
        asked = battery(self.scene, self.arrangement, families)
        return ScoreTests(self.scene, self.arrangement, asked)

    def at(self, fit: Adjustment) -> "ScoreTests":
        """Tests of the same hypotheses at another fit of the same recording."""
        found = ScoreTests(fit.scene, arrange(fit), self.battery)
        if np.array_equal(found.arrangement.rows, self.arrangement.rows):
            old, new = self.arrangement.drivers, found.arrangement.drivers
            moved = {
                name
                for k, name in enumerate(OBSERVATION_DRIVERS)
                if not np.array_equal(old[:, k], new[:, k], equal_nan=True)
            }
            # Where the image and the marks are does not change with the fit: nor do most patterns.
            same = {key: p for key, p in self._patterns.items() if not moved & driven_by(key[0])}
            found._patterns.update(same)
        return found

    def score(
        self,
        variance: float,
        signs: Float[np.ndarray, "epochs repetitions"] | None = None,
        residual: Float[np.ndarray, "observations components"] | None = None,
    ) -> Ranking:
        """Score all hypotheses against the residuals of the fit, or against another vector.

        `variance` is that of unit weight; `signs` flip whole epochs for the null distribution;
        None where it is not wanted.

        With another vector e (whitened, like all observations) the drop is the part of what the
        model does not absorb of it that a hypothesis explains: how much it resembles e.
        """
        cells = self.arrangement.cells
        e = cells.residual if residual is None else self.arrangement.in_cells(residual)
        tested = _Tested.of(cells, e, variance, signs)
        self._evaluate_patterns()
        # NumPy lets other threads run while it multiplies.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            each = pool.map(lambda f: self._of_family(f, tested), range(len(self.battery.families)))
            scores = tuple(each)
        return Ranking(scores, np.max([s.null.max(axis=0) for s in scores], axis=0))

    def _of_family(self, number: int, tested: "_Tested") -> Scores:
        family, parts = self.battery.families[number], self.battery.parts[number]
        shape = family.valid.shape
        drop, z, seen = np.zeros(shape), np.full(shape, -np.inf), np.zeros(shape)
        sound = np.zeros(shape, bool)
        amplitude = np.zeros((*shape, family.n_terms * family.n_bases))
        null = np.full((shape[0], tested.repetitions), -np.inf)
        wanted = [
            (number, g, p)
            for p, part in enumerate(parts)
            for g in np.flatnonzero(family.valid[:, part.courses, part.scope].any(axis=1))
        ]
        # Where the information is known and no signs are flipped, products with residuals do.
        full = tested.flips or any(key not in self._known for key in wanted)
        for g, tangents in enumerate(self._tangents(family, tested.residual, full)):
            product = tangents.product
            for p, part in enumerate(parts):
                here = g, part.courses, part.scope
                if not family.valid[here].any():
                    continue
                key = number, g, p
                shared = tangents.shared(part) if tested.flips or key not in self._known else None
                if shared is not None and key not in self._known:
                    self._known[key] = information_of(tangents, part, shared, family.valid[here])
                known = self._known[key]
                seen[here], sound[here] = known.seen, known.sound
                drop[here], amplitude[here] = drop_of(known, part, product)
                if shared is not None and tested.flips and known.sound.any():
                    null[g] = np.maximum(null[g], _flipped(known, part, product, shared, tested))
        for part in parts:
            part.forget()
        z[sound] = surprise(drop[sound] / tested.variance, amplitude.shape[-1])
        return Scores(family, drop, z, amplitude, seen, null, sound, tested.variance)

    def _tangents(self, family: Family, residual: np.ndarray, full: bool) -> Iterator[Tangents]:
        """Products of the tangents of each group, some groups and some cells at a time.

        What is multiplied stays in the cache, and what all groups share is read once for some.
        """
        cells, groups = self.arrangement.cells, iter(family.groups)
        n, height = residual.shape
        by_component = n, self.arrangement.components, -1
        # Of very many terms the products would take more room than the tangents.
        wide = family.n_terms > height
        at_once = 1 if wide else max(_STACKED // family.n_terms, 1)
        while some := tuple(islice(groups, at_once)):
            terms = [(group, term) for group in some for term in group.terms]
            ends = np.cumsum([len(group.terms) for group in some])
            own = [
                (
                    cells.tangent[PORT_INDEX[term.port]].reshape(by_component),
                    self._pattern(term, group.mark)[:, None],
                )
                for group, term in terms
            ]
            product = np.empty((n, len(terms)))
            halves = np.empty((n, len(terms), cells.half.shape[2])) if full else None
            square = [] if wide else [np.empty((n, *2 * (family.n_terms,))) for _ in some]
            stack = np.empty((n if wide else CELLS, len(terms), *own[0][0].shape[1:]))
            for first in range(0, n, CELLS):
                here = slice(first, min(first + CELLS, n))
                apart = stack[here] if wide else stack[: min(CELLS, n - first)]
                for k, (tangent, pattern) in enumerate(own):
                    np.multiply(tangent[here], pattern[here], out=apart[:, k])
                piece = apart.reshape(*apart.shape[:2], height)
                product[here] = (piece @ residual[here, :, None])[:, :, 0]
                if halves is not None:
                    np.matmul(piece, cells.half[here], out=halves[here])
                    for products, end in zip(square, ends, strict=False):
                        group = piece[:, end - family.n_terms : end]
                        np.matmul(group, np.swapaxes(group, 1, 2), out=products[here])
            for g, end in enumerate(ends):
                at = slice(end - family.n_terms, end)
                half = None if halves is None else halves[:, at]
                own_stack = stack.reshape(n, family.n_terms, height) if wide else None
                products = None if wide else square[g]
                yield Tangents(cells.n_local, products, own_stack, half, product[:, at])

    def _pattern(self, term, mark: tuple[int, int] | None) -> Float[np.ndarray, "cells width"]:
        """Pattern of a term over the observations of all cells, of one mark or of all."""
        own = self._patterns[_key(term)]
        own = own if mark is None else own * self._mark_mask(mark)
        return own if term.weight == 1.0 else term.weight * own

    def _evaluate_patterns(self) -> None:
        """Those that are not known yet, all of a driver and a basis at a time."""
        alike: dict[tuple, dict[tuple, Term]] = {}
        for family in self.battery.families:
            for group in family.groups:
                for term in group.terms:
                    if _key(term) not in self._patterns:
                        alike.setdefault((term.driver, term.basis), {})[_key(term)] = term
        for terms in alike.values():
            values = np.asarray(patterns(tuple(terms.values()), self.arrangement.drivers))
            self._patterns.update(zip(terms, self.arrangement.of_cells(values.T), strict=True))

    def _mark_mask(self, mark: tuple[int, int]) -> Float[np.ndarray, "cells width"]:
        obs, arrangement = self.scene.recording.observations, self.arrangement
        own = np.zeros(len(arrangement.drivers))
        for start, rows in zip(arrangement.starts, self.scene.tables, strict=False):
            own[start : start + len(rows)] = (obs.target[rows] == mark[0]) & (
                obs.point[rows] == mark[1]
            )
        return arrangement.of_cells(own)


@dataclass(frozen=True)
class _Tested:
    """Residuals that are tested, and how."""

    residual: Float[np.ndarray, "cells rows"]  # without what the model explains
    pull: Float[np.ndarray, "epochs shared"]  # of each epoch on the shared unknowns
    n_fitted: float  # epochs with residuals
    variance: float
    signs: Float[np.ndarray, "epochs repetitions"] | None

    @classmethod
    def of(cls, cells: Cells, e: np.ndarray, variance: float, signs):
        """A vector e in cells; at the minimum the model explains nothing more of it."""
        residual = cells.projected(e)
        half = cells.half[:, :, cells.n_local :]
        of_cell = np.einsum("nr,nrs->ns", residual, half, optimize=True)
        pull = np.zeros((cells.n_epochs, half.shape[2]))
        np.add.at(pull, cells.epoch_of, of_cell)
        touched = np.bincount(cells.epoch_of, np.sum(e**2, axis=1), cells.n_epochs) > 0.0
        n_fitted = max(float(touched.sum()), 2.0)
        return cls(residual, pull, n_fitted, variance, signs)

    @property
    def flips(self) -> bool:
        """Whether the null distribution is wanted."""
        return self.signs is not None

    @property
    def repetitions(self) -> int:
        """Repetitions of the null distribution."""
        return 1 if self.signs is None else self.signs.shape[1]


def _key(term: Term) -> tuple:
    """What the pattern of a term depends on."""
    return term.driver, term.basis, term.constants


def _flipped(
    known: Information, part: Part, product: np.ndarray, shared: np.ndarray, tested: _Tested
):
    """The largest z of each repetition."""
    place, sound = part.place, known.sound
    padded = np.concatenate([at_cells(product, place.cells), np.zeros((1, product.shape[1]))])[
        place.epoch
    ]
    scores = by_terms(np.moveaxis(part.by_epoch @ padded, 0, 2), part)  # b c E
    scores = known.whitener[sound] @ (scores[sound] - shared[sound] @ tested.pull.T)
    # A fitted residual lacks what the shared unknowns take of its epoch, about 1/epochs.
    lost = max(1.0 - 1.0 / tested.n_fitted, 0.5)
    null = np.sum((scores @ tested.signs) ** 2, axis=1) / (lost * tested.variance)
    return surprise(null.max(axis=0), shared.shape[1])
