"""Products of the tangents of one group of hypotheses, and the information of its courses.

With G the tangents, J the Jacobian of the model and H = L L^T its normal matrix, G^T M G is
G^T G - Y^T Y with Y = (J L^-T)^T G: all are sums over cells, weighted by a course.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxvm.discover.battery import MOST_PRODUCTS, Part
from jaxvm.discover.cells import gathered

_ABSORBED = 1e-8
"""Relative information below which a direction counts as absorbed by the model."""

_SEEN = 1e-6
"""Share of an effect that the model must leave, so that it can be scored."""

_FEWEST_EPOCHS = 3.0
"""A hypothesis that fewer epochs carry than this can't be told from a few bad images."""

CELLS = 256
"""Cells whose tangents are multiplied at a time: of fewer, threads wait for each other."""


MANY_TERMS_CELLS = 32
"""The same of a group of very many terms: each acts in few of them."""


@dataclass(frozen=True)
class Tangents:
    """Products of the tangents of one group, before its courses, in each cell.

    Attributes:
        n_local: columns of `halves` that belong to local unknowns.
        square: among themselves; None where they are so many that
        stack: the tangents themselves take less room.
        halves: with J L^-T. All three are None where the information is known.
        product: with the residuals, and with what else they are multiplied by.
    """

    n_local: int
    square: Float[np.ndarray, "cells terms terms"] | None
    stack: Float[np.ndarray, "cells terms rows"] | None
    halves: Float[np.ndarray, "cells terms halves"] | None
    product: Float[np.ndarray, "cells terms vectors"]

    def shared(self, part: Part) -> Float[np.ndarray, "b columns shared"]:
        """What the shared unknowns see of each course."""
        assert self.halves is not None
        # With the local columns: what lies together is multiplied without a copy.
        return summed(part, at_cells(self.halves, part.place.cells))[:, :, self.n_local :]

    def gram(self, part: Part) -> Float[np.ndarray, "b columns columns"]:
        """Products of each course's columns, term by term."""
        weights, cells = part.weights, part.place.cells
        b, n_bases, n = weights.shape
        k = self.product.shape[1]
        if self.square is None:
            assert self.stack is not None
            gram = np.zeros((b, k * n_bases, k * n_bases))
            # Of so many terms each acts on a few images, or marks, alone.
            for first in range(0, n, MANY_TERMS_CELLS):
                here = slice(first, first + MANY_TERMS_CELLS)
                piece = np.swapaxes(self.stack[cells[here]], 0, 1)  # k n rows
                acting = np.flatnonzero(piece.any(axis=(1, 2)))
                if not len(acting):
                    continue
                piece = piece[acting]
                place = (acting[:, None] * n_bases + np.arange(n_bases)).ravel()
                for own, course in zip(gram, weights[:, :, here], strict=True):
                    columns = (piece[:, None] * course[:, :, None]).reshape(len(place), -1)
                    own[np.ix_(place, place)] += columns @ columns.T
            return gram
        square = at_cells(self.square, cells)
        if n_bases == 1:
            return ((weights[:, 0] ** 2) @ square.reshape(n, k * k)).reshape(b, k, k)
        gram = np.empty((b, k, n_bases, k, n_bases))
        for i in range(k):
            for j in range(i + 1):
                both = (weights * square[:, i, j]) @ np.swapaxes(weights, 1, 2)
                gram[:, i, :, j] = gram[:, j, :, i] = both
        return gram.reshape(b, k * n_bases, k * n_bases)

    def sizes(self, cells: np.ndarray) -> Float[np.ndarray, " n"]:
        """Sum of squares of all tangents in each cell."""
        if self.square is None:
            assert self.stack is not None
            return np.einsum("nkr,nkr->n", self.stack, self.stack)[cells]
        return np.einsum("nkk->n", self.square)[cells]


def at_cells(values: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Values of some cells, in ascending order; of those that lie together without a copy."""
    first, last = cells[0], cells[-1] + 1
    return values[first:last] if last - first == len(cells) else values[cells]


def summed(part: Part, values: Float[np.ndarray, "n terms ..."]) -> np.ndarray:
    """Sums over the cells of a part, weighted by its courses: [b, columns, ...], term by term."""
    b, n_bases, n = part.weights.shape
    sums = part.weights.reshape(b * n_bases, n) @ values.reshape(n, -1)
    return by_terms(sums.reshape(b * n_bases, *values.shape[1:]), part)


def by_terms(values: Float[np.ndarray, "b_bases terms ..."], part: Part) -> np.ndarray:
    """One axis of columns, term by term."""
    b, n_bases, _ = part.weights.shape
    split = values.reshape(b, n_bases, *values.shape[1:])
    return np.swapaxes(split, 1, 2).reshape(b, n_bases * values.shape[1], *values.shape[2:])


def information_of(
    tangents: Tangents, part: Part, shared: np.ndarray, valid: np.ndarray
) -> "Information":
    """Information of each course, whitened.

    Few large matrix products, in NumPy: a compiled program for every shape of a family would take
    longer to make than to run.
    """
    place, d = part.place, tangents.n_local
    b, n_bases, _ = part.weights.shape
    k = tangents.product.shape[1]
    columns = k * n_bases
    gram = tangents.gram(part)
    information = gram - shared @ np.swapaxes(shared, 1, 2)
    if d:
        assert tangents.halves is not None
        own = at_cells(tangents.halves[:, :, :d], place.cells)
        padded = np.concatenate([own, np.zeros((1, k, d))])[place.group]
        few = place.group.size * place.group.shape[1] * k**2 <= MOST_PRODUCTS
        if few and part.within is not None:
            g, wide = place.group.shape
            rows = padded.reshape(g, wide * k, d)
            alike = (rows @ np.swapaxes(rows, 1, 2)).reshape(g, wide, k, wide, k)
            taken = part.within @ np.swapaxes(alike, 2, 3).reshape(-1, k * k)
            taken = taken.reshape(b, n_bases, n_bases, k, k).transpose(0, 3, 1, 4, 2)
            information -= taken.reshape(b, columns, columns)
        else:
            local = part.by_group @ padded.reshape(*place.group.shape, k * d)  # G (b i) (k d)
            local = np.moveaxis(local, 0, 1).reshape(b * n_bases, -1, k, d)
            local = by_terms(np.swapaxes(local, 1, 2), part).reshape(b, columns, -1)
            information -= local @ np.swapaxes(local, 1, 2)

    # Directions that the model absorbs to eight digits carry no information.
    size = np.diagonal(gram, axis1=1, axis2=2)
    unit = 1.0 / np.sqrt(np.where(size > 0.0, size, 1.0))
    of_epoch = gathered(tangents.sizes(place.cells), place.epoch)  # E w
    carried = (part.by_epoch**2 @ of_epoch[:, :, None])[:, :, 0].T
    carried = carried.reshape(b, n_bases, -1).sum(axis=1)
    total = carried.sum(axis=1)
    # By the size of the effect, not its square: a near image does not make others count less.
    n_carrying = np.sqrt(carried).sum(axis=1) ** 2 / np.maximum(total, 1e-300)
    fewest = min(_FEWEST_EPOCHS, 0.5 * len(place.epoch))
    sound = valid & (total > 0.0) & (n_carrying >= fewest)
    return Information.of(information * unit[:, :, None] * unit[:, None, :], unit, sound)


def whitener_of(information: Float[np.ndarray, "b k k"]) -> Float[np.ndarray, "b k k"]:
    """W with W^T W the inverse of what information is left, and nearly nothing along the rest.

    What the model absorbs leaves rounding behind, whose eigenvalues may be negative where the model
    itself is badly conditioned.
    """
    try:
        root = np.linalg.cholesky(information + _ABSORBED * np.eye(information.shape[-1]))
        return np.linalg.inv(root)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(information)
        size = np.sqrt(np.where(values > _ABSORBED, values + _ABSORBED, np.inf))
        return np.swapaxes(vectors / size[:, None, :], 1, 2)


@dataclass(frozen=True)
class Information:
    """What the courses of a part can show, whatever the residuals.

    Attributes:
        scaled: information, for columns of unit length.
        unit: by which columns are multiplied for that.
        whitener: W with W^T W the inverse information, so that the drop is |W S|^2.
        seen: share of the effect that the model does not absorb.
        sound: hypotheses that the model does not absorb and that enough epochs carry.
        shared: what the shared unknowns see of each course; None where it is not kept.
    """

    scaled: Float[np.ndarray, "b columns columns"]
    unit: Float[np.ndarray, "b columns"]
    whitener: Float[np.ndarray, "b columns columns"]
    seen: Float[np.ndarray, " b"]
    sound: Bool[np.ndarray, " b"]
    shared: Float[np.ndarray, "b columns shared"] | None = None

    @classmethod
    def of(cls, scaled: np.ndarray, unit: np.ndarray, sound: np.ndarray) -> "Information":
        """Of scaled information, and of the hypotheses that are sound but for what is absorbed."""
        seen = np.diagonal(scaled, axis1=1, axis2=2).max(axis=1)
        whitener = whitener_of(scaled) * unit[:, None, :]
        return cls(scaled, unit, whitener, seen, sound & (seen > _SEEN))

    def less(self, taken: Float[np.ndarray, "b columns p"]) -> "Information":
        """What is left when further unknowns see so much of each course."""
        own = self.unit[:, :, None] * taken
        left = Information.of(self.scaled - own @ np.swapaxes(own, 1, 2), self.unit, self.sound)
        if self.shared is None:
            return left
        return replace(left, shared=np.concatenate([self.shared, taken], axis=2))


def drop_of(
    known: Information, part: Part, product: Float[np.ndarray, "cells terms vectors"]
) -> tuple[Float[np.ndarray, "b vectors"], Float[np.ndarray, "b columns vectors"]]:
    """Drops of chi-square and one-step amplitudes, by each of the vectors."""
    score = known.whitener @ summed(part, at_cells(product, part.place.cells))
    return np.sum(score**2, axis=1), -np.swapaxes(known.whitener, 1, 2) @ score
