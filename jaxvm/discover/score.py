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
from jaxvm.discover.hypotheses import Family
from jaxvm.discover.products import (
    Information,
    Tangents,
    at_cells,
    by_terms,
    drop_of,
    information_of,
    summed,
)
from jaxvm.discover.ranking import Ranking, Scores, surprise
from jaxvm.discover.tangents import TangentsAt
from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import driven_by
from jaxvm.solve.adjust import Adjustment

_STACKED, _AT_ONCE = 32, 1700000
"""Terms whose tangents are multiplied at a time, of as many groups as have them; and numbers in
these tangents, which bound the terms where observations are many: more is hardly faster."""

_THREADS = min(os.cpu_count() or 1, 4)
"""More wait for Python's interpreter between their products: sixteen take longer than two."""

_MOST_KEPT = 30_000_000
"""Numbers that are kept of what shared unknowns see of all hypotheses: 240 MB."""


@dataclass(frozen=True)
class ScoreTests:
    """Score tests (Rao 1948) of all hypotheses of a battery at one fit.

    The information is the same whatever residuals are scored: it is computed once, and kept.

    Attributes:
        fit: the adjusted scene.
        tangents: of its residuals, by all ports.
        battery: the hypotheses.
        plain: tests at the fit without its last effects, whose information is known.
        first: tests at the fit that was there first; None for these.
        new: observation-like drivers that are not those of the plain fit.
    """

    fit: Adjustment
    tangents: TangentsAt
    battery: Battery
    plain: "ScoreTests | None" = None
    first: "ScoreTests | None" = None
    new: frozenset[str] = frozenset()
    _known: dict[tuple[int, int, int], Information] = field(default_factory=dict)

    @classmethod
    def of(cls, fit: Adjustment, families: tuple[Family, ...]) -> "ScoreTests":
        """Tests of the hypotheses of some families at a fit."""
        arrangement = arrange(fit)
        asked = battery(fit.scene, arrangement, families)
        return cls(fit, TangentsAt(fit.scene, arrangement), asked)

    @property
    def scene(self) -> Scene:
        """The fitted scene."""
        return self.fit.scene

    @property
    def arrangement(self) -> Arrangement:
        """Its residuals, and the derivatives of its ports."""
        return self.tangents.arrangement

    def about(self, families: tuple[Family, ...]) -> "ScoreTests":
        """Tests of other hypotheses at the same fit."""
        asked = battery(self.scene, self.arrangement, families)
        return ScoreTests(self.fit, self.tangents, asked)

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
                tangents = known.tangents.at(fit.scene, arrangement, new)
                return ScoreTests(fit, tangents, self.battery, known, first, new)
        arrangement = arrange(fit)
        tangents = TangentsAt(fit.scene, arrangement)
        if np.array_equal(arrangement.rows, self.arrangement.rows):
            # Where the image and the marks are does not change with the fit: nor do most patterns.
            new = moved(self.arrangement.drivers, arrangement.drivers, least=0.0)
            tangents = self.tangents.at(fit.scene, arrangement, new)
        return ScoreTests(fit, tangents, self.battery, first=first)

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
        return self._ranked(_Tested.of(cells, [e], variance, signs))[0]

    def score_many(
        self,
        variance: float,
        residuals: Float[np.ndarray, "vectors observations components"],
    ) -> list[Ranking]:
        """Score all hypotheses against each of many vectors: thirty take four to eight times as
        long as one.

        Vectors as for `score`; the tangents are multiplied with all of them together. The rankings
        share what does not depend on the vector.
        """
        each = [self.arrangement.in_cells(own) for own in residuals]
        return self._ranked(_Tested.of(self.arrangement.cells, each, variance, None))

    def _ranked(self, tested: "_Tested") -> list[Ranking]:
        """The ranking by each of the vectors that are tested."""
        families = self.battery.families
        scores = tuple(_unscored(f, tested) for f in families)
        # NumPy lets other threads run while it multiplies.
        with ThreadPoolExecutor(_THREADS) as pool:
            self.tangents.evaluate((g for family in families for g in family.groups), pool)
            for _ in pool.map(lambda own: self._score_groups(own, tested, scores), self._batches()):
                pass
        rankings = [
            Ranking(own, np.max([s.null.max(axis=0) for s in own], axis=0))
            for own in zip(*scores, strict=True)
        ]
        for ranking in rankings:
            for own in ranking.scores:
                drop = own.drop[own.valid] / tested.variance
                own.z[own.valid] = surprise(drop, own.amplitude.shape[-1])
        return rankings

    def _batches(self) -> Iterator[list[tuple[int, int]]]:
        """Groups by family and number, so many that they have about `_STACKED` terms, or fewer."""
        most = min(_STACKED, _AT_ONCE // max(self.arrangement.cells.residual.size, 1))
        own, terms = [], 0
        for number, family in enumerate(self.battery.families):
            for g in range(len(family.groups)):
                own.append((number, g))
                terms += family.n_terms
                if terms >= most:
                    yield own
                    own, terms = [], 0
        if own:
            yield own

    def _score_groups(
        self,
        groups: list[tuple[int, int]],
        tested: "_Tested",
        scores: tuple[list[Scores], ...],
    ) -> None:
        wanted = []
        for number, g in groups:
            valid = self.battery.families[number].valid[g]
            for p, part in enumerate(self.battery.parts[number]):
                if valid[part.courses, part.scope].any():
                    wanted.append((number, g, p))
        # Where the information is known, products with residuals and with what is new do.
        full = any(self._wants_halves(key, tested) for key in wanted)
        vectors = np.concatenate([tested.residuals, self._border], axis=2)
        asked = [self.battery.families[number].groups[g] for number, g in groups]
        found = dict(zip(groups, self.tangents.products(asked, vectors, full), strict=True))
        for key in wanted:
            self._score_part(key, found[key[:2]], tested, scores[key[0]])
        for number in {number for number, _ in groups}:
            for part in self.battery.parts[number]:
                part.forget()

    def _score_part(
        self, key: tuple[int, int, int], tangents: Tangents, tested: "_Tested", scores: list[Scores]
    ) -> None:
        number, g, p = key
        part, product = self.battery.parts[number][p], tangents.product[:, :, : tested.n]
        here = g, part.courses, part.scope
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = self._information(key, part, tangents, tested.n)
        drop, amplitude = drop_of(known, part, product)
        scores[0].seen[here], scores[0].valid[here] = known.seen, known.sound
        for k, own in enumerate(scores):
            own.drop[here], own.amplitude[here] = drop[..., k], amplitude[..., k]
        if tested.flips and known.sound.any():
            shared = tangents.shared(part) if known.shared is None else known.shared
            flipped = _flipped(known, part, product[:, :, 0], shared, tested)
            scores[0].null[g] = np.maximum(scores[0].null[g], flipped)

    def _information(
        self, key: tuple[int, int, int], part: Part, tangents: Tangents, n: int
    ) -> Information:
        """Of the courses of a part: by what the border takes of what is known, or all anew.

        The border's products come after those of the `n` vectors that are tested.
        """
        if (known := self._without_border(key)) is not None:
            new = at_cells(tangents.product[:, :, n:], part.place.cells)
            return known.less(summed(part, new))
        shared = tangents.shared(part)
        valid = self.battery.families[key[0]].valid[key[1], part.courses, part.scope]
        known = information_of(tangents, part, shared, valid)
        keeps = self.battery.n_columns * shared.shape[2] <= _MOST_KEPT
        return replace(known, shared=shared) if keeps else known

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


@dataclass(frozen=True)
class _Tested:
    """Residuals that are tested, and how; signs flip those of the first vector alone."""

    residuals: Float[np.ndarray, "cells rows vectors"]  # without what the model explains
    pull: Float[np.ndarray, "epochs shared"]  # of each epoch on the shared unknowns
    n_fitted: float  # epochs with residuals
    variance: float
    signs: Float32[np.ndarray, "epochs repetitions"] | None

    @classmethod
    def of(cls, cells: Cells, each: list[np.ndarray], variance: float, signs):
        """Vectors in cells; at the minimum the model explains nothing more of the residuals."""
        residuals = np.stack([cells.projected(e) for e in each], axis=2)
        if signs is None:
            return cls(residuals, np.zeros((0, 0)), 0.0, variance, None)
        half = cells.half[:, :, cells.n_local :]
        of_cell = np.einsum("nr,nrs->ns", residuals[:, :, 0], half, optimize=True)
        pull = np.zeros((cells.n_epochs, half.shape[2]))
        np.add.at(pull, cells.epoch_of, of_cell)
        touched = np.bincount(cells.epoch_of, np.sum(each[0] ** 2, axis=1), cells.n_epochs) > 0.0
        n_fitted = max(float(touched.sum()), 2.0)
        return cls(residuals, pull, n_fitted, variance, signs.astype(np.float32))

    @property
    def n(self) -> int:
        """Number of vectors."""
        return self.residuals.shape[2]

    @property
    def flips(self) -> bool:
        """Whether the null distribution is wanted."""
        return self.signs is not None

    @property
    def repetitions(self) -> int:
        """Repetitions of the null distribution."""
        return 1 if self.signs is None else self.signs.shape[1]


def _unscored(family: Family, tested: _Tested) -> list[Scores]:
    """Room for the scores of a family, by each of the vectors."""
    shape = family.valid.shape
    seen, valid = np.zeros(shape), np.zeros(shape, bool)
    return [
        Scores(
            family,
            drop=np.zeros(shape),
            z=np.full(shape, -np.inf),
            amplitude=np.zeros((*shape, family.n_terms * family.n_bases)),
            seen=seen,
            null=np.full((shape[0], tested.repetitions), -np.inf),
            valid=valid,
            variance=tested.variance,
        )
        for _ in range(tested.n)
    ]


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
