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

A fit with further effects takes a little of the information that is known without them
(`jaxvm.discover.bordered`).

Significance: the residuals of every epoch are multiplied by random signs, again and again; the
largest statistic over all hypotheses in each repetition gives a family-wise p-value that needs no
independence inside an epoch (wild bootstrap of the scores).
"""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32

from jaxvm.discover.battery import Battery, Part, battery
from jaxvm.discover.bordered import bordered, moved
from jaxvm.discover.cells import Arrangement, Cells, arrange
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Family
from jaxvm.discover.once import once
from jaxvm.discover.products import (
    CELLS,
    MANY_TERMS_CELLS,
    Information,
    Tangents,
    at_cells,
    by_terms,
    drop_of,
    information_of,
    summed,
)
from jaxvm.discover.ranking import Ranking, Scores, surprise
from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import driven_by, patterns
from jaxvm.physics.effects import Term
from jaxvm.physics.ports import PORT_INDEX
from jaxvm.solve.adjust import Adjustment

_STACKED = 32
"""Terms whose tangents are multiplied at a time, of as many groups as have them."""

_MOST_KEPT = 30_000_000
"""Numbers that are kept of what shared unknowns see of all hypotheses: 120 MB."""


@dataclass(frozen=True)
class ScoreTests:
    """Score tests (Rao 1948) of all hypotheses of a battery at one fit.

    The information is the same whatever residuals are scored: it is computed once, and kept.

    Attributes:
        fit: the adjusted scene.
        arrangement: its residuals and tangents.
        battery: the hypotheses.
        plain: tests at the fit without its last effects, whose information is known.
        first: tests at the fit that was there first; None for these.
        new: observation-like drivers that are not those of the plain fit.
    """

    fit: Adjustment
    arrangement: Arrangement
    battery: Battery
    plain: "ScoreTests | None" = None
    first: "ScoreTests | None" = None
    new: frozenset[str] = frozenset()
    _known: dict[tuple[int, int, int], Information] = field(default_factory=dict)
    _patterns: dict[tuple, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, fit: Adjustment, families: tuple[Family, ...]) -> "ScoreTests":
        """Tests of the hypotheses of some families at a fit."""
        arrangement = arrange(fit)
        return cls(fit, arrangement, battery(fit.scene, arrangement, families))

    @property
    def scene(self) -> Scene:
        """The fitted scene."""
        return self.fit.scene

    def about(self, families: tuple[Family, ...]) -> "ScoreTests":
        """Tests of other hypotheses at the same fit."""
        asked = battery(self.scene, self.arrangement, families)
        return ScoreTests(self.fit, self.arrangement, asked)

    def at(self, fit: Adjustment) -> "ScoreTests":
        """Tests of the same hypotheses at another fit of the same recording.

        With further effects in the model what they take of the information is enough, where the
        way from one fit to the other is straight.
        """
        if fit is self.fit:
            return self
        latest = self.plain or self
        first = latest.first or latest
        for known in (latest,) if latest is first else (latest, first):
            beside = bordered(known.arrangement, known.fit, fit)
            if beside is not None:
                arrangement, new = beside
                return ScoreTests(
                    fit, arrangement, self.battery, known, first, new, _patterns=known._but(new)
                )
        found = ScoreTests(fit, arrange(fit), self.battery, first=first)
        if np.array_equal(found.arrangement.rows, self.arrangement.rows):
            # Where the image and the marks are does not change with the fit: nor do most patterns.
            new = moved(self.arrangement.drivers, found.arrangement.drivers, least=0.0)
            found._patterns.update(self._but(new))
        return found

    def _but(self, new: frozenset[str]) -> dict[tuple, np.ndarray]:
        """Patterns but those that depend on some drivers."""
        return {key: p for key, p in self._patterns.items() if not new & driven_by(key[0])}

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
        scores = tuple(_unscored(f, tested) for f in self.battery.families)
        # NumPy lets other threads run while it multiplies.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            self._evaluate_patterns(pool)
            for _ in pool.map(lambda own: self._score_groups(own, tested, scores), self._batches()):
                pass
        for own in scores:
            drop = own.drop[own.valid] / tested.variance
            own.z[own.valid] = surprise(drop, own.amplitude.shape[-1])
        return Ranking(scores, np.max([own.null.max(axis=0) for own in scores], axis=0))

    def _batches(self) -> Iterator[list[tuple[int, int]]]:
        """Groups by family and number, so many that they have about `_STACKED` terms."""
        own, terms = [], 0
        for number, family in enumerate(self.battery.families):
            for g in range(len(family.groups)):
                own.append((number, g))
                terms += family.n_terms
                if terms >= _STACKED:
                    yield own
                    own, terms = [], 0
        if own:
            yield own

    def _score_groups(
        self, groups: list[tuple[int, int]], tested: "_Tested", scores: tuple[Scores, ...]
    ) -> None:
        wanted = []
        for number, g in groups:
            valid = self.battery.families[number].valid[g]
            for p, part in enumerate(self.battery.parts[number]):
                if valid[part.courses, part.scope].any():
                    wanted.append((number, g, p))
        # Where the information is known, products with residuals and with what is new do.
        full = any(self._wants_halves(key, tested) for key in wanted)
        vectors = np.concatenate([tested.residual[:, :, None], self._border], axis=2)
        tangents = self._tangents(groups, vectors, full)
        for key in wanted:
            self._score_part(key, tangents[key[:2]], tested, scores[key[0]])
        for number in {number for number, _ in groups}:
            for part in self.battery.parts[number]:
                part.forget()

    def _score_part(
        self, key: tuple[int, int, int], tangents: Tangents, tested: "_Tested", scores: Scores
    ) -> None:
        number, g, p = key
        part, product = self.battery.parts[number][p], tangents.product[:, :, 0]
        here = g, part.courses, part.scope
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = self._information(key, part, tangents)
        scores.seen[here], scores.valid[here] = known.seen, known.sound
        scores.drop[here], scores.amplitude[here] = drop_of(known, part, product)
        if tested.flips and known.sound.any():
            shared = tangents.shared(part) if known.shared is None else known.shared
            flipped = _flipped(known, part, product, shared, tested)
            scores.null[g] = np.maximum(scores.null[g], flipped)

    def _information(
        self, key: tuple[int, int, int], part: Part, tangents: Tangents
    ) -> Information:
        """Of the courses of a part: by what the border takes of what is known, or all anew."""
        if (known := self._without_border(key)) is not None:
            new = at_cells(tangents.product[:, :, 1:], part.place.cells)
            return known.less(summed(part, new))
        shared = tangents.shared(part)
        valid = self.battery.families[key[0]].valid[key[1], part.courses, part.scope]
        known = information_of(tangents, part, shared, valid)
        keeps = self.battery.n_columns * shared.shape[2] <= _MOST_KEPT
        return replace(known, shared=shared.astype(np.float32)) if keeps else known

    def _wants_halves(self, key: tuple[int, int, int], tested: "_Tested") -> bool:
        """Whether a part asks for products with the model's own Jacobian."""
        known = self._known.get(key) or self._without_border(key)
        return known is None or (tested.flips and known.shared is None)

    def _without_border(self, key: tuple[int, int, int]) -> Information | None:
        """What is known of a part at the plain fit, where its patterns are the same."""
        terms = self.battery.families[key[0]].groups[key[1]].terms
        if self.plain is None or any(self.new & driven_by(term.driver) for term in terms):
            return None
        return self.plain._known.get(key)

    @property
    def _border(self) -> Float[np.ndarray, "cells rows p"]:
        """What the model has beside the plain one, along the columns of J L^-T."""
        half = self.arrangement.cells.half
        known = half.shape[2] if self.plain is None else self.plain.arrangement.cells.half.shape[2]
        return half[:, :, known:]

    def _tangents(
        self, groups: list[tuple[int, int]], vectors: np.ndarray, full: bool
    ) -> dict[tuple[int, int], Tangents]:
        """Products of the tangents of some groups."""
        families, height = self.battery.families, vectors.shape[1]
        found, alike = {}, []
        for key in groups:
            group = families[key[0]].groups[key[1]]
            if group.mark is not None:
                found[key] = self._of_mark(group, group.mark, vectors, full)
            # Of very many terms the products would take more room than the tangents.
            elif len(group.terms) > height:
                found[key] = self._of_many_terms(group, vectors, full)
            else:
                alike.append(key)
        some = [families[number].groups[g] for number, g in alike]
        if some:
            products = self._of_groups(some, vectors, full)
            found.update(zip(alike, products, strict=True))
        return found

    def _of_groups(
        self, groups: list[Group], vectors: np.ndarray, full: bool
    ) -> Iterator[Tangents]:
        """Products of the tangents of groups that act on all marks, some cells at a time.

        What is multiplied stays in the cache, and what all groups share is read once.
        """
        cells, (n, height, n_vectors) = self.arrangement.cells, vectors.shape
        ends = np.cumsum([len(group.terms) for group in groups])
        each = [slice(end - len(g.terms), end) for g, end in zip(groups, ends, strict=True)]
        own = [factors for group in groups for factors in self._factors(group)]
        product = np.empty((n, len(own), n_vectors))
        halves = [np.empty((n, len(g.terms), cells.half.shape[2])) for g in groups if full]
        square = [np.empty((n, *2 * (len(g.terms),))) for g in groups if full]
        stack = np.empty((min(CELLS, n), len(own), *own[0][0].shape[1:]))
        for first in range(0, n, CELLS):
            here = slice(first, min(first + CELLS, n))
            apart = stack[: here.stop - first]
            for k, (tangent, pattern) in enumerate(own):
                np.multiply(tangent[here], pattern[here], out=apart[:, k])
            piece = apart.reshape(*apart.shape[:2], height)
            product[here] = piece @ vectors[here]
            if not full:
                continue
            half, of_term = piece @ cells.half[here], np.einsum("nkr,nkr->nk", piece, piece)
            for g, terms in enumerate(each):
                halves[g][here] = half[:, terms]
                if len(groups[g].terms) == 1:
                    square[g][here] = of_term[:, terms, None]
                else:
                    alone = piece[:, terms]
                    np.matmul(alone, np.swapaxes(alone, 1, 2), out=square[g][here])
        for g, terms in enumerate(each):
            own_square, own_half = (square[g], halves[g]) if full else (None, None)
            yield Tangents(cells.n_local, own_square, None, own_half, product[:, terms])

    def _of_many_terms(self, group: Group, vectors: np.ndarray, full: bool) -> Tangents:
        """Products of the tangents of a group of very many terms; most act in few cells each."""
        cells, (n, height, n_vectors) = self.arrangement.cells, vectors.shape
        own = self._factors(group)
        acts = np.stack([pattern.any(axis=(1, 2)) for _, pattern in own])
        product = np.zeros((n, len(own), n_vectors))
        halves = np.zeros((n, len(own), cells.half.shape[2])) if full else None
        stack = np.zeros((n, len(own), height)) if full else None
        for first in range(0, n, MANY_TERMS_CELLS):
            here = slice(first, min(first + MANY_TERMS_CELLS, n))
            acting = np.flatnonzero(acts[:, here].any(axis=1))
            tangents = [own[k][0][here] * own[k][1][here] for k in acting]
            if not tangents:
                continue
            piece = np.stack(tangents, axis=1).reshape(here.stop - first, -1, height)
            product[here, acting] = piece @ vectors[here]
            if halves is not None and stack is not None:
                stack[here, acting], halves[here, acting] = piece, piece @ cells.half[here]
        return Tangents(cells.n_local, None, stack, halves, product)

    def _factors(self, group: Group) -> list[tuple[np.ndarray, np.ndarray]]:
        """Of each term of a group the port's derivative [cells, components, width], and what it is
        multiplied by [cells, 1, width]."""
        cells, components = self.arrangement.cells, self.arrangement.components
        shape = len(cells.residual), components, -1
        return [
            (
                cells.tangent[PORT_INDEX[term.port]].reshape(shape),
                self._pattern(term)[:, None],
            )
            for term in group.terms
        ]

    def _of_mark(
        self, group: Group, mark: tuple[int, int], vectors: np.ndarray, full: bool
    ) -> Tangents:
        """Products of the tangents of a group that acts on one mark: it is once in a cell."""
        cells, (n, height, _) = self.arrangement.cells, vectors.shape
        here, place = self._marks[mark]
        width = height // self.arrangement.components
        rows = here[:, None], place[:, None] + width * np.arange(self.arrangement.components)
        own = [
            cells.tangent[PORT_INDEX[term.port]][rows] * self._pattern(term)[here, place][:, None]
            for term in group.terms
        ]
        tangent = np.stack(own, axis=1)

        def in_cells(values: np.ndarray) -> np.ndarray:
            found = np.zeros((n, *values.shape[1:]))
            found[here] = values
            return found

        return Tangents(
            cells.n_local,
            in_cells(tangent @ np.swapaxes(tangent, 1, 2)) if full else None,
            None,
            in_cells(tangent @ cells.half[rows]) if full else None,
            in_cells(tangent @ vectors[rows]),
        )

    def _pattern(self, term: Term) -> Float[np.ndarray, "cells width"]:
        """Pattern of a term over the observations of all cells."""
        own = self._patterns[_key(term)]
        return own if term.weight == 1.0 else term.weight * own

    def _evaluate_patterns(self, pool: ThreadPoolExecutor) -> None:
        """Those that are not known yet, all of a driver and a basis at a time."""
        alike: dict[tuple, dict[tuple, Term]] = {}
        for family in self.battery.families:
            for group in family.groups:
                for term in group.terms:
                    if _key(term) not in self._patterns:
                        alike.setdefault((term.driver, term.basis), {})[_key(term)] = term

        def evaluated(terms: dict[tuple, Term]) -> np.ndarray:
            values = np.asarray(patterns(tuple(terms.values()), self.arrangement.drivers))
            return self.arrangement.of_cells(values.T)

        for terms, values in zip(alike.values(), pool.map(evaluated, alike.values()), strict=True):
            self._patterns.update(zip(terms, values, strict=True))

    @once
    def _marks(self) -> dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]:
        """Of each mark the cells that hold it, and its place in each."""
        obs, arrangement = self.scene.recording.observations, self.arrangement
        number = self.scene.first_point[obs.target] + obs.point
        own = np.zeros(len(arrangement.drivers))
        for start, rows in zip(arrangement.starts, self.scene.tables, strict=False):
            own[start : start + len(rows)] = 1 + number[rows]
        numbers = arrangement.of_cells(own)
        here, place = np.nonzero(numbers)
        label = numbers[here, place].astype(int) - 1
        first = self.scene.first_point
        ends = np.cumsum(np.bincount(label, minlength=first[-1]))
        lists = np.split(np.argsort(label, kind="stable"), ends[:-1])
        return {
            (target, point): (here[lists[start + point]], place[lists[start + point]])
            for target, start in enumerate(first[:-1])
            for point in range(first[target + 1] - start)
        }


@dataclass(frozen=True)
class _Tested:
    """Residuals that are tested, and how."""

    residual: Float[np.ndarray, "cells rows"]  # without what the model explains
    pull: Float[np.ndarray, "epochs shared"]  # of each epoch on the shared unknowns
    n_fitted: float  # epochs with residuals
    variance: float
    signs: Float32[np.ndarray, "epochs repetitions"] | None

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
        single = None if signs is None else signs.astype(np.float32)
        return cls(residual, pull, n_fitted, variance, single)

    @property
    def flips(self) -> bool:
        """Whether the null distribution is wanted."""
        return self.signs is not None

    @property
    def repetitions(self) -> int:
        """Repetitions of the null distribution."""
        return 1 if self.signs is None else self.signs.shape[1]


def _unscored(family: Family, tested: _Tested) -> Scores:
    """Room for the scores of a family."""
    shape = family.valid.shape
    return Scores(
        family,
        drop=np.zeros(shape),
        z=np.full(shape, -np.inf),
        amplitude=np.zeros((*shape, family.n_terms * family.n_bases)),
        seen=np.zeros(shape),
        null=np.full((shape[0], tested.repetitions), -np.inf),
        valid=np.zeros(shape, bool),
        variance=tested.variance,
    )


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
    assert tested.signs is not None
    # Seven digits are enough for what is drawn at random, and take half the time.
    flipped = scores.astype(np.float32) @ tested.signs
    null = np.einsum("bcr,bcr->br", flipped, flipped).max(axis=0)
    # A fitted residual lacks what the shared unknowns take of its epoch, about 1/epochs.
    lost = max(1.0 - 1.0 / tested.n_fitted, 0.5)
    return surprise(null / (lost * tested.variance), shared.shape[1])
