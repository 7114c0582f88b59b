"""What differs from image to image at random: a stabiliser, an autofocus, haze.

No course in time explains it, and random signs of whole epochs leave it as large as it is: it is
not among the hypotheses that are scored together. Every image gets an amount of its own, judged by
chi-square. That supposes noise that the marks of an image don't share: it is asked where
neighbouring marks move clearly alike, or (a zoom) not at all, not where they move a little alike.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Family, Hypothesis
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import Weighing, shortlist
from jaxvm.discover.space import families_of
from jaxvm.network.scene import Scene
from jaxvm.physics.catalogue import CATALOGUE
from jaxvm.physics.catalogue.entry import each

ALIKE = 0.08
"""Correlation of neighbouring marks of one image from which what is left is no noise of marks.

What a readout gives all marks of an image is taken to be a few percent of their noise at most.
"""

MOST_IMAGES = 400
"""Epochs up to which each can have an amount of its own."""

_FAR = 1e6
"""Distance (px) between images, where all marks are sorted at once."""

_ALSO = 0.2
"""Share of the leading evidence from which another camera errs at random, too."""


def likeness(scene: Scene, residual: np.ndarray) -> float:
    """Correlation of the residuals of neighbouring marks in one image; 0 where it may be chance.

    Of the camera where it is largest: one that jumps must not be lost among others that don't.

    Args:
        scene: the fitted scene.
        residual: whitened residuals [observations, 2] in the order of the recording, NaN where not
            fitted.
    """
    near = neighbours(scene, residual, 1)
    if len(near.rows) < 50:
        return 0.0
    error = clipped(residual[near.rows])
    paired = near.known[:, 0]
    own, other = error[paired], error[near.nearest[paired, 0]]
    camera = scene.recording.observations.camera[near.rows][paired]
    return max(
        (_correlation(own[camera == c], other[camera == c]) for c in set(camera)), default=0.0
    )


def _correlation(own: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two series of residuals; 0 where it may be chance."""
    if not own.any():
        return 0.0
    value = float(np.mean(own * other) / np.mean(own**2))
    return value if value > 5.0 / np.sqrt(own.size) else 0.0


def clipped(residual: np.ndarray) -> np.ndarray:
    """Residuals without their tails: gross errors shall not decide."""
    limit = 4.0 * np.median(np.abs(residual)) / 0.67449
    return np.clip(residual, -limit, limit)


@dataclass(frozen=True)
class Neighbours:
    """Marks and the nearest ones of the same target in the same image.

    Attributes:
        rows: of the recording, whose residuals are known.
        at: place of each in its image (px), [marks, 2].
        nearest: their numbers among these rows, the nearest first; 0 where an image has fewer.
        known: whether there is one.
        distance: to them (px).
    """

    rows: np.ndarray
    at: np.ndarray
    nearest: np.ndarray
    known: np.ndarray
    distance: np.ndarray


def neighbours(scene: Scene, residual: np.ndarray, most: int) -> Neighbours:
    """Marks with residuals [observations, 2] that are not NaN, and up to so many around each."""
    obs = scene.recording.observations
    rows = np.flatnonzero(np.isfinite(residual).all(axis=1))
    # A third axis, far longer than the image, keeps images apart.
    n_targets = len(scene.model.targets)
    image = (obs.epoch * len(scene.model.cameras) + obs.camera) * n_targets + obs.target
    at = np.column_stack([obs.pixel[rows], _FAR * image[rows]])
    distance, nearest = (np.asarray(f)[:, 1:] for f in KDTree(at).query(at, k=most + 1))
    known = distance < _FAR
    return Neighbours(
        rows, at[:, :2], np.where(known, nearest, 0), known, np.where(known, distance, 0.0)
    )


def of_each_image(
    scene: Scene,
    tests: ScoreTests,
    variance: float,
    n: int,
    without: Callable[[Hypothesis, np.ndarray], np.ndarray | None],
) -> tuple[list[tuple[Hypothesis, float, np.ndarray]], float]:
    """The leading hypotheses about every image, as `shortlist` gives them, and the p-value.

    None where several cameras err at random, each by an amount of its own: it is no camera then but
    the air between, noise that no model takes away.

    Args:
        scene: the fitted scene.
        tests: score tests at this fit.
        variance: of unit weight.
        n: number of pixel coordinates that are fitted.
        without: the whitened residuals that a hypothesis leaves when it is fitted.
    """
    n_epochs = len(scene.recording.time)
    if n_epochs > MOST_IMAGES:
        return [], 1.0
    tests = tests.about(families_of_images(scene))
    ranking = tests.score(variance)
    leading = shortlist(ranking, scene, Weighing(variance, n), 12)
    if not leading:
        return [], 1.0
    first, foremost, amplitudes = leading[0]
    if len(_single(leading, _ALSO * foremost) - {first.scope.camera}):
        # Where a target moves freely, one of two cameras may err for the other.
        left = without(first, amplitudes)
        again = (
            []
            if left is None
            else shortlist(tests.score(variance, residual=left), scene, Weighing(variance, n), 12)
        )
        if len(first.scope.camera) == 1 and _single(again, _ALSO * foremost):
            return [], 1.0
    return leading, float(min(ranking.n * np.exp(-0.5 * ranking.best_z()), 1.0))


def _single(leading, least: float) -> set[tuple[str, ...]]:
    """Single cameras of which at least so much evidence says that they err at random."""
    cameras = {h.scope.camera for h, evidence, _ in leading if evidence > least}
    return {own for own in cameras if len(own) == 1}


def families_of_images(scene: Scene) -> tuple[Family, ...]:
    """Physics of the catalogue that every image has to an extent of its own."""
    epochs = range(len(scene.recording.time))
    signatures = dict.fromkeys(
        (entry.entity, tuple(term.port for term in terms))
        for entry in CATALOGUE
        for terms in entry.groups
        if terms[0].driver == "epoch"
    )
    groups = [Group(each("epoch", *ports, numbers=epochs), entity) for entity, ports in signatures]
    return families_of(scene, groups)
