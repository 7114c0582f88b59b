"""Gross errors: single observations that no physics explains, found before anything is scored.

One wrong mark bends the pose of its whole image, so the worst mark of every view goes first and
everything is fitted again, until none stands out. What goes on, in most epochs of a mark or over
most of an image, is physics and comes back.
"""

import numpy as np

from jaxvm.discover.heldout import Split, range_weights_of, split, weights_of
from jaxvm.network.residual import residual
from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment, adjust
from jaxvm.solve.snooping import robust_variance

GROSS = 12.0
"""Residuals beyond this many robust standard deviations are mistakes, not physics."""

ISOLATED = 0.25
"""Share of a mark's epochs, or of an image's marks, from which on they are no mistakes."""

_ROUNDS = 6


def without_gross_errors(fitted: Adjustment, parts: Split) -> tuple[Adjustment, Split, int]:
    """The fit and the split without gross errors, and how many there were.

    Args:
        fitted: the plain model, fitted to the epochs of the split.
        parts: the split, with all observations.
    """
    scene, first = fitted.scene, fitted
    all_parts = parts
    labels = _labels(scene)
    for _ in range(_ROUNDS):
        size = _sizes(fitted.scene, parts)
        limit = GROSS * np.sqrt(robust_variance(fitted))
        worst = _worst_of_views(labels["view"], np.where(_all(parts, scene), size, 0.0))
        bad = worst[size[worst] > limit]
        if not len(bad):
            break
        good = _all(parts, scene)
        good[bad] = False
        parts = split(scene, parts.held, tuple(good[rows].astype(float) for rows in scene.tables))
        fitted = parts.fit(fitted.scene)
    if parts is all_parts:
        return first, all_parts, 0
    beyond = _sizes(fitted.scene, parts) > GROSS * np.sqrt(robust_variance(fitted))
    alone = beyond
    for label in (labels["mark"], labels["image"]):
        share = np.bincount(label, beyond) / np.maximum(np.bincount(label), 1)
        alone = alone & (share[label] < ISOLATED)
    parts = split(scene, parts.held, tuple(1.0 - alone[rows] for rows in scene.tables))
    return parts.fit(first.scene), parts, int(alone.sum())


def _labels(scene: Scene) -> dict[str, np.ndarray]:
    obs = scene.recording.observations
    image = obs.camera * len(scene.recording.time) + obs.epoch
    return {
        "mark": obs.camera * scene.first_point[-1] + scene.first_point[obs.target] + obs.point,
        "image": image,
        "view": image * len(scene.model.targets) + obs.target,
    }


def _all(parts: Split, scene: Scene) -> np.ndarray:
    """True for the sound observations, in the order of the recording."""
    good = np.zeros(len(scene.recording.observations.epoch), bool)
    for rows, own in zip(scene.tables, parts.sound, strict=True):
        good[rows] = own > 0
    return good


def _sizes(scene: Scene, parts: Split) -> np.ndarray:
    """Largest whitened residual of each observation, used or not, held-out poses fitted."""
    completed = adjust(
        scene,
        weights=weights_of(scene, parts.held, parts.sound),
        range_weights=range_weights_of(scene, parts.held),
        active=scene.unknowns.of_one_epoch,
        rtol=1e-7,
        check=False,
    ).scene
    size = np.zeros(len(scene.recording.observations.epoch))
    blocks = residual(completed.state, completed.network).pixels
    for rows, block in zip(scene.tables, blocks, strict=True):
        size[rows] = np.abs(np.asarray(block)[: len(rows)]).max(axis=1)
    return np.where(np.isfinite(size), size, np.inf)


def _worst_of_views(view: np.ndarray, size: np.ndarray) -> np.ndarray:
    """The row with the largest size of each view."""
    order = np.lexsort((-size, view))
    return order[np.unique(view[order], return_index=True)[1]]
