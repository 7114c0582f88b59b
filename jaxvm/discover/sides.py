"""Steps whose instant is an epoch or two off.

One tangent knows little of a large effect: it may put an epoch on the wrong side of a step.
Refitted there, the step leaves that epoch far worse than all others, and a second jump would
explain it.
"""

from collections.abc import Callable
from itertools import chain

import numpy as np
from jaxtyping import Float

from jaxvm.discover.constants import jumps_of, other_instants
from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment

_BAD = 3.0
"""Mean square of an epoch, over that of the median one, from which it may be on the wrong side."""

_MOST = 6
"""Epochs that a step is moved by at most."""


def on_better_sides(
    fitted: Adjustment, fit: Callable[[Scene], Adjustment], weights: tuple[np.ndarray, ...]
) -> Adjustment:
    """The fit with the jumps of its last effect beyond epochs that fit badly, while that helps.

    Args:
        fitted: with the effect last.
        fit: adjusts a scene to the same observations.
        weights: for each pixel table, 1 where an observation is fitted.
    """
    last = len(fitted.scene.effects) - 1
    jumps = [jump for jump in jumps_of(fitted.scene) if jump[0] == last]
    for _ in range(_MOST if jumps else 0):
        of_epoch = mean_squares(fitted, weights)
        known = np.isfinite(of_epoch)
        bad = known & (of_epoch > _BAD * np.median(of_epoch[known]))
        others = chain.from_iterable(
            other_instants(fitted.scene, jump, ~bad, known) for jump in jumps
        )
        moved = [fit(scene) for scene in others]
        best = min((m for m in moved if not m.failed), key=lambda m: m.cost, default=fitted)
        if best.cost >= fitted.cost:
            break
        fitted = best
    return fitted


def mean_squares(fitted: Adjustment, weights: tuple[np.ndarray, ...]) -> Float[np.ndarray, " e"]:
    """Mean square of the whitened pixel residuals of each epoch; NaN where none is fitted."""
    recording = fitted.scene.recording
    square, count = np.zeros((2, len(recording.time)))
    blocks = fitted.residuals().pixels
    for rows, block, weight in zip(fitted.scene.tables, blocks, weights, strict=True):
        own, epoch = weight > 0.0, recording.observations.epoch[rows]
        np.add.at(square, epoch[own], np.mean(np.asarray(block)[: len(rows)][own] ** 2, axis=1))
        np.add.at(count, epoch[own], 1.0)
    return np.where(count > 0.0, square / np.maximum(count, 1.0), np.nan)
