"""Tangents of groups of terms over the cells of a fit, and their products.

A tangent is a port's derivative times a pattern over observations; courses over epochs come later.
"""

from collections.abc import Iterable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jaxvm.discover.cells import Arrangement
from jaxvm.discover.groups import Group
from jaxvm.discover.once import once
from jaxvm.discover.products import CELLS, MANY_TERMS_CELLS, Tangents
from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import driven_by, patterns
from jaxvm.physics.effects import Term
from jaxvm.physics.ports import PORT_INDEX


@dataclass(frozen=True)
class TangentsAt:
    """Tangents at a fit.

    Attributes:
        scene: the fitted scene.
        arrangement: its residuals, and the derivatives of its ports.
    """

    scene: Scene
    arrangement: Arrangement
    _patterns: dict[tuple, np.ndarray] = field(default_factory=dict)

    def evaluate(self, groups: Iterable[Group], pool: Executor) -> None:
        """The patterns that are not known yet, all of a driver and a basis at a time."""
        alike: dict[tuple, dict[tuple, Term]] = {}
        for group in groups:
            for term in group.terms:
                if _key(term) not in self._patterns:
                    alike.setdefault((term.driver, term.basis), {})[_key(term)] = term

        def evaluated(terms: dict[tuple, Term]) -> np.ndarray:
            values = np.asarray(patterns(tuple(terms.values()), self.arrangement.drivers))
            return self.arrangement.of_cells(values.T)

        for terms, values in zip(alike.values(), pool.map(evaluated, alike.values()), strict=True):
            self._patterns.update(zip(terms, values, strict=True))

    def at(self, scene: Scene, arrangement: Arrangement, new: frozenset[str]) -> "TangentsAt":
        """At another fit; patterns are kept but those that depend on drivers that are new."""
        kept = {key: p for key, p in self._patterns.items() if not new & driven_by(key[0])}
        return TangentsAt(scene, arrangement, kept)

    def products(self, groups: list[Group], vectors: np.ndarray, full: bool) -> list[Tangents]:
        """Products of the tangents of some groups, whose patterns are known, with some vectors.

        Args:
            groups: terms that are asked together.
            vectors: over the cells [cells, rows, vectors].
            full: whether products among themselves and with J L^-T are wanted, too.
        """
        found: dict[int, Tangents] = {}
        for k, group in enumerate(groups):
            if group.mark is not None:
                found[k] = self._of_mark(group, group.mark, vectors, full)
            # Of very many terms the products would take more room than the tangents.
            elif len(group.terms) > vectors.shape[1]:
                found[k] = self._of_many_terms(group, vectors, full)
        alike = [k for k in range(len(groups)) if k not in found]
        if alike:
            of_few = self._of_groups([groups[k] for k in alike], vectors, full)
            found.update(zip(alike, of_few, strict=True))
        return [found[k] for k in range(len(groups))]

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
                self.pattern(term)[:, None],
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
            cells.tangent[PORT_INDEX[term.port]][rows] * self.pattern(term)[here, place][:, None]
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

    def pattern(self, term: Term) -> Float[np.ndarray, "cells width"]:
        """Pattern of a term over the observations of all cells."""
        own = self._patterns[_key(term)]
        return own if term.weight == 1.0 else term.weight * own

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


def _key(term: Term) -> tuple:
    """What the pattern of a term depends on."""
    return term.driver, term.basis, term.constants
