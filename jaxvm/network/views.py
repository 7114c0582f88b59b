"""Views: single images of single targets, and what one of them tells before any adjustment.

Principal distance and pose of the camera relative to the target come from each view alone, by
OpenCV's closed-form solutions; they are start values and nothing more.
"""

from dataclasses import dataclass

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxvm.compiling import program
from jaxvm.geometry.lenses import BrownConrady, LensFamily, lens_family
from jaxvm.physics.blocks import rounded
from jaxvm.recording import Recording

MIN_POINTS = 4
"""Fewest points of a view that give a pose."""


@dataclass(frozen=True)
class View:
    """One target in one image.

    Attributes:
        camera, target, epoch: indices into the recording.
        points: marks in target coordinates (m).
        pixels: their image points (px).
    """

    camera: int
    target: int
    epoch: int
    points: np.ndarray
    pixels: np.ndarray


def collect_views(recording: Recording) -> list[View]:
    """All views of targets with known coordinates and enough points."""
    obs, targets = recording.observations, recording.model.targets
    key = np.stack([obs.camera, obs.target, obs.epoch], axis=1)
    distinct, where = np.unique(key, axis=0, return_inverse=True)
    order = np.argsort(where.ravel(), kind="stable")
    ends = np.cumsum(np.bincount(where.ravel(), minlength=len(distinct)))[:-1]
    views = []
    # Without any observation there is still one (empty) piece.
    pieces = np.split(order, ends)[: len(distinct)]
    for (camera, target, epoch), rows in zip(distinct, pieces, strict=True):
        points = targets[target].points[obs.point[rows]]
        known = np.isfinite(points).all(axis=1)
        if known.sum() >= MIN_POINTS:
            rows = rows[known]
            views.append(View(camera, target, epoch, points[known], obs.pixel[rows]))
    return views


def rays_of_pixels(
    family: LensFamily, focal: np.ndarray, centre: np.ndarray, distortion: np.ndarray, pixels
) -> np.ndarray:
    """Unit-z rays (camera frame) of many pixels through a lens, or through one lens for each."""
    image_points = (np.asarray(pixels) - centre) / focal
    n = len(image_points)
    coefficients = np.broadcast_to(
        np.asarray(distortion)[..., : family.n_coefficients], (n, family.n_coefficients)
    )
    spare = ((0, rounded(n) - n), (0, 0))
    padded = np.pad(image_points, spare), np.pad(coefficients, spare, mode="edge" if n else "empty")
    rays = np.asarray(_undistort(family, *map(jnp.asarray, padded)))[:n]
    return rays / rays[:, 2:]


@program
def _undistort(family, image_points, coefficients):
    return jax.vmap(lambda p, c: family.undistort(c, p))(image_points, coefficients)


def pose_of_view(points: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Pose camera_from_target as (turn, shift), and the RMS error in the unit-focal image.

    Planar targets have two solutions; the one with the smaller error is taken. None when there is
    no solution in front of the camera.
    """
    ok, turn, shift = _solve_pnp(np.ascontiguousarray(points, float), rays[:, :2])
    if not ok:
        return None
    assert turn is not None and shift is not None
    camera = cv2.Rodrigues(turn)[0] @ points.T + shift
    if (camera[2] <= 0).any():
        return None
    error = (camera[:2] / camera[2]).T - rays[:, :2]
    return np.concatenate([turn.ravel(), shift.ravel()]), float(np.sqrt(np.mean(error**2)))


def _solve_pnp(points: np.ndarray, image_points: np.ndarray):
    image_points = np.ascontiguousarray(image_points, float)
    # SQPNP refuses views that look small; the other one needs six marks where they are no plane.
    for flags in (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_ITERATIVE):
        try:
            ok, turn, shift = cv2.solvePnP(points, image_points, np.eye(3), None, flags=flags)
            if ok:
                turn, shift = cv2.solvePnPRefineLM(
                    points, image_points, np.eye(3), None, turn, shift
                )
                return True, turn, shift
        except cv2.error:
            continue
    return False, None, None


def guess_intrinsics(
    views: list[View], image_size: tuple[int, int], lens: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start values of focal (px), centre (px) and distortion of a camera from its views.

    A few projections (perspective, stereographic, equidistant) times a geometric series of focal
    lengths are tried with the centre in the middle of the image; the pair whose poses explain the
    views best wins. The coefficients of the lens are then fitted to that projection.

    Raises:
        ValueError: no view gives a pose.
    """
    size = np.asarray(image_size, float)
    centre = (size - 1.0) / 2.0
    sample = views[:: max(1, len(views) // 30)]
    best = (np.inf, float(size.max()), "perspective")
    for name, to_tangent in _PROJECTIONS.items():
        for focal in size.max() * np.geomspace(0.25, 8.0, 36):
            error = _median_error(sample, centre, focal, to_tangent)
            if error < best[0]:
                best = (error, focal, name)
    error, focal, name = best
    if not np.isfinite(error):
        raise ValueError("no view of a target gives a pose of its camera")
    radius = np.concatenate([np.linalg.norm(v.pixels - centre, axis=1) for v in views]) / focal
    distortion = _fit_distortion(lens_family(lens), name, radius.max())
    return np.full(2, focal), centre, distortion


_PROJECTIONS = {
    "perspective": lambda r: r,
    "stereographic": lambda r: np.tan(np.minimum(2.0 * np.arctan(r / 2.0), 1.45)),
    "equidistant": lambda r: np.tan(np.minimum(r, 1.45)),
}
"""Tangent of the field angle from the radius in the unit-focal image."""


def _median_error(views, centre, focal, to_tangent) -> float:
    errors = []
    for view in views:
        image_points = (view.pixels - centre) / focal
        radius = np.maximum(np.linalg.norm(image_points, axis=1), 1e-12)
        tangent = to_tangent(radius)
        rays = np.column_stack([image_points * (tangent / radius)[:, None], np.ones(len(radius))])
        found = pose_of_view(view.points, rays)
        if found is not None:
            turn, shift = found[0][:3], found[0][3:]
            camera = (cv2.Rodrigues(turn)[0] @ view.points.T).T + shift
            back = camera[:, :2] / camera[:, 2:] - rays[:, :2]
            # Compared in pixels: the projection compresses errors towards the edge.
            scale = focal * radius / tangent / (1.0 + tangent**2 * (tangent > radius))
            errors.append(np.sqrt(np.mean(np.sum(back**2, axis=1) * scale**2)))
    return float(np.median(errors)) if len(errors) * 2 > len(views) else np.inf


def _fit_distortion(family: LensFamily, projection: str, radius: float) -> np.ndarray:
    """Coefficients with which a lens comes near a projection up to an image radius."""
    n = family.n_coefficients
    coefficients = np.zeros(n)
    image = np.linspace(0.02, radius, 200)
    tangent = _PROJECTIONS[projection](image)
    if isinstance(family, BrownConrady):
        if n == 0 or projection == "perspective":
            return coefficients
        powers = [tangent**3, tangent**5] + ([tangent**7] if n >= 5 else [])
        positions = [0, 1] + ([4] if n >= 5 else [])
        if n >= 8:
            powers += [-image * tangent**k for k in (2, 4, 6)]
            positions += [5, 6, 7]
        coefficients[positions] = np.linalg.lstsq(np.stack(powers, 1), image - tangent)[0]
        return coefficients
    angle = np.arctan(tangent)
    design = np.stack([angle ** (2 * k + 3) for k in range(n)], 1)
    return np.linalg.lstsq(design, image - angle)[0]
