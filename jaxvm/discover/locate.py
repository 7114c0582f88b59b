"""Compare: where and when residuals are larger than noise.

The variance factor of the residuals (chi-square over their number, 1 for pure noise) is mapped over
cameras, targets, marks, regions of the image and of the target, epochs and recorded quantities.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from jaxvm.network.scene import Scene


@dataclass(frozen=True)
class Place:
    """One class of observations and how much larger its residuals are than the rest's."""

    kind: str
    name: str
    variance_ratio: float
    count: int

    def words(self) -> str:
        """For a summary."""
        return f"{self.kind} {self.name}: variance {self.variance_ratio:.2f} times the rest"


@dataclass(frozen=True)
class ResidualTable:
    """Pixel residuals with what is known about each observation.

    Attributes:
        pixel: measured image points (px).
        residual: measured minus predicted (px), weighted by reference sigma / sigma.
        camera, target, point, epoch: indices.
        used: True where the observation took part.
    """

    pixel: np.ndarray
    residual: np.ndarray
    camera: np.ndarray
    target: np.ndarray
    point: np.ndarray
    epoch: np.ndarray
    used: np.ndarray


def residual_table(scene: Scene, whitened, used, reference_px: float) -> ResidualTable:
    """Pixel residuals of all tables in one, in the order of the recording.

    Args:
        scene: the scene.
        whitened: whitened residuals (predicted minus measured) of every pixel table.
        used: weights of every pixel table.
        reference_px: the sigma in whose units residuals are quoted.
    """
    obs = scene.recording.observations
    residual = np.zeros((len(obs.epoch), 2))
    sound = np.zeros(len(obs.epoch), bool)
    for rows, block, weight in zip(scene.tables, whitened, used, strict=True):
        residual[rows] = -np.asarray(block) * reference_px
        sound[rows] = np.asarray(weight) > 0
    return ResidualTable(obs.pixel, residual, obs.camera, obs.target, obs.point, obs.epoch, sound)


def locate(scene: Scene, table: ResidualTable, alpha: float = 1e-4) -> list[Place]:
    """Classes of observations whose residuals are significantly larger than all others'.

    Largest excess first. Classes: cameras, targets, thirds of the image radius, image quadrants,
    rings of the target, marks, and blocks of epochs.
    """
    classes = _classes(scene, table)
    square = np.sum(table.residual**2, axis=1)
    found = []
    for kind, label, names in classes:
        n_tests = len(names)
        for k, name in enumerate(names):
            inside = table.used & (label == k)
            outside = table.used & (label != k)
            n_in, n_out = int(inside.sum()), int(outside.sum())
            if n_in < 10 or n_out < 10:
                continue
            ratio = float(square[inside].mean() / square[outside].mean())
            if ratio > 1.15 and fdtrc(2 * n_in, 2 * n_out, ratio) * n_tests < alpha:
                found.append(Place(kind, name, ratio, n_in))
    found.sort(key=lambda place: -(place.variance_ratio - 1.0) * np.sqrt(place.count))
    return found


def _classes(scene: Scene, table: ResidualTable):
    model = scene.model
    classes = []
    if len(model.cameras) > 1:
        classes.append(("camera", table.camera, [c.name for c in model.cameras]))
    if len(model.targets) > 1:
        classes.append(("target", table.target, [t.name for t in model.targets]))
    size = np.array([c.image_size for c in model.cameras], float)[table.camera]
    centre = np.asarray(scene.state.centre)[table.camera]
    radius = np.linalg.norm(table.pixel - centre, axis=1) / (0.5 * np.linalg.norm(size, axis=1))
    edges = np.quantile(radius[table.used], [1 / 3, 2 / 3])
    ring = np.searchsorted(edges, radius)
    classes.append(("image", ring, ["near the axis", "half-way out", "near the edge"]))
    side = (table.pixel[:, 0] > centre[:, 0]) + 2 * (table.pixel[:, 1] > centre[:, 1])
    quadrants = ["upper left", "upper right", "lower left", "lower right"]
    classes.append(("image", side, quadrants))
    classes.append(("target", _target_ring(scene, table), ["centre of the plate", "rim"]))
    blocks = min(8, len(scene.recording.time))
    block = table.epoch * blocks // len(scene.recording.time)
    bounds = [np.flatnonzero(np.arange(len(scene.recording.time)) * blocks
              // len(scene.recording.time) == k) for k in range(blocks)]  # fmt: skip
    ids = scene.recording.epoch_ids
    classes.append(("epochs", block, [f"{ids[b[0]]} to {ids[b[-1]]}" for b in bounds]))
    first = scene.first_point[table.target] + table.point
    marks = [f"{t.name} {p}" for t in model.targets for p in t.point_names]
    if len(marks) <= 400:
        classes.append(("mark", first, marks))
    return classes


def _target_ring(scene: Scene, table: ResidualTable) -> np.ndarray:
    """0 for the inner marks of each target, 1 for the outer ones."""
    outer = []
    for target in scene.model.targets:
        points = target.points[:, :2]
        centre = (points.min(0) + points.max(0)) / 2
        half = np.where(np.ptp(points, axis=0) > 0, np.ptp(points, axis=0) / 2, 1.0)
        outer.append(np.abs((points - centre) / half).max(axis=1) > 0.7)
    return np.concatenate(outer).astype(int)[scene.first_point[table.target] + table.point]
