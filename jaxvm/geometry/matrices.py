"""Poses as 4 x 4 matrices on the host, many at a time: for tables and graphs, not for derivatives.

`jaxvm.geometry.poses` has the same as pure functions of JAX.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def matrices(vectors) -> Float[np.ndarray, "n 4 4"]:
    """Matrices of many poses (turn, shift)."""
    vectors = np.array(vectors, float).reshape(-1, 6)
    poses = np.tile(np.eye(4), (len(vectors), 1, 1))
    if len(vectors):
        poses[:, :3, :3] = Rotation.from_rotvec(vectors[:, :3]).as_matrix()
    poses[:, :3, 3] = vectors[:, 3:]
    return poses


def matrix(vector) -> Float[np.ndarray, "4 4"]:
    """Matrix of a pose (turn, shift)."""
    return matrices(vector)[0]


def vector(pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
    """(turn, shift) of a matrix; the turn has length at most pi."""
    return vectors(pose[None])[0]


def vectors(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 6"]:
    """(turn, shift) of many matrices; turns have length at most pi."""
    turns = np.zeros((0, 3))
    if len(poses):
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    return np.concatenate([turns, poses[:, :3, 3]], axis=1)


def adjoint_of_inverse(poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, "n 6 6"]:
    """Ad(P)^-1 = [R^T, 0; -R^T hat(t), R^T], for twists (turn, shift)."""
    back = np.swapaxes(poses[:, :3, :3], 1, 2)
    out = np.zeros((len(poses), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = back
    # Column j of -hat(t) is e_j x t.
    out[:, 3:, :3] = back @ np.cross(np.eye(3), poses[:, None, :3, 3]).swapaxes(1, 2)
    return out
