"""Lenses: from the direction of a ray to the image, in units of the principal distance."""

import numpy as np


def image(camera, ray):
    """Image coordinates [n, 2] of ray directions [n, 3] in camera axes; NaN behind the camera."""
    return wide(ray, camera.wide) if camera.wide is not None else straight(ray, camera.brown)


def straight(ray, brown):
    """A lens that images straight lines, then Brown's radial and decentring displacement."""
    ahead = np.where(ray[:, 2] > 1e-9, ray[:, 2], np.nan)
    x, y = ray[:, 0] / ahead, ray[:, 1] / ahead
    k1, k2, p1, p2, k3 = brown
    q = x * x + y * y
    stretch = 1.0 + q * (k1 + q * (k2 + q * k3))
    return np.stack(
        [
            x * stretch + 2.0 * p1 * x * y + p2 * (q + 2.0 * x * x),
            y * stretch + p1 * (q + 2.0 * y * y) + 2.0 * p2 * x * y,
        ],
        axis=1,
    )


def wide(ray, odd):
    """A lens whose image radius is an odd polynomial of the angle to the axis."""
    across = np.hypot(ray[:, 0], ray[:, 1])
    angle = np.arctan2(across, ray[:, 2])
    radius = angle * (1.0 + angle**2 * (odd[0] + angle**2 * (odd[1] + angle**2 * odd[2])))
    scale = np.where(across > 1e-12, radius / np.where(across > 1e-12, across, 1.0), 1.0)
    out = ray[:, :2] * scale[:, None]
    out[angle > 1.3] = np.nan
    return out


def angle_to_axis(ray):
    """Angle (rad) between rays [n, 3] and the optical axis."""
    return np.arctan2(np.hypot(ray[:, 0], ray[:, 1]), ray[:, 2])
