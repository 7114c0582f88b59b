"""Rotations as matrices and rotation vectors (rad); everything works on stacks."""

import numpy as np


def matrix(vector):
    """Rotation matrices [..., 3, 3] of rotation vectors [..., 3] (rad), by Rodrigues' formula."""
    vector = np.asarray(vector, float)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    small = angle < 1e-7
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    cross = crossing(vector)
    return np.eye(3) + first * cross + second * (cross @ cross)


def crossing(vector):
    """Matrices [..., 3, 3] that take the cross product with vectors [..., 3]."""
    x, y, z = np.moveaxis(np.asarray(vector, float), -1, 0)
    zero = np.zeros_like(x)
    rows = [zero, -z, y, z, zero, -x, -y, x, zero]
    return np.stack(rows, axis=-1).reshape(*x.shape, 3, 3)


def vector(rotation):
    """Rotation vector (rad) of one matrix, also near half a turn."""
    quaternion = _quaternion(np.asarray(rotation, float))
    if quaternion[0] < 0.0:
        quaternion = -quaternion
    sine = np.linalg.norm(quaternion[1:])
    if sine < 1e-12:
        return 2.0 * quaternion[1:]
    return quaternion[1:] / sine * 2.0 * np.arctan2(sine, quaternion[0])


def _quaternion(r):
    """Unit quaternion (w, x, y, z): eigenvector of Bar-Itzhack's matrix."""
    k = np.array(
        [
            [r[0, 0] + r[1, 1] + r[2, 2], 0, 0, 0],
            [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], 0, 0],
            [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    return np.linalg.eigh(k / 3.0)[1][:, -1]


def looking(direction, down=(0.0, 1.0, 0.0)):
    """Camera axes (columns x right, y down, z ahead) that look along a direction."""
    z = np.asarray(direction, float) / np.linalg.norm(direction)
    x = np.cross(np.asarray(down, float), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def apply(rotation, points):
    """Rotate points [..., 3] with matrices [..., 3, 3]."""
    return np.einsum("...ij,...j->...i", rotation, points)


def back(rotation, points):
    """Rotate points [..., 3] with the inverses of matrices [..., 3, 3]."""
    return np.einsum("...ji,...j->...i", rotation, points)
