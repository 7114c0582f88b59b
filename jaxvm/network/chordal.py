"""Poses of a network from its relative poses alone, whatever the start: chordal initialisation.

Rotations are found as plain 3 x 3 matrices by linear least squares and projected to the nearest
rotations, shifts by linear least squares with these rotations (Martinec & Pajdla 2007; Carlone,
Tron, Daniilidis & Dellaert 2015, section III-C). Without noise the result is exact; with noise it
is near enough to the optimum for Gauss-Newton where a start by dead reckoning is not.
"""

import cvxopt
import numpy as np
import scipy.sparse as sp
from cvxopt import cholmod  # pyright: ignore[reportAttributeAccessIssue]
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxvm.network.graph import PoseGraph, UnconnectedNetwork


def chordal_poses(
    graph: PoseGraph, held: Float[np.ndarray, "held 6"], rounds: int = 0
) -> Float[np.ndarray, "nodes 6"]:
    """Poses of all nodes, as turn (rad) and shift (m).

    Args:
        graph: every node joined to a held one.
        held: poses of the held nodes.
        rounds: repetitions with edges weighted down by how badly they fit (weights of the Cauchy
            distribution), against gross errors.

    Raises:
        UnconnectedNetwork: the linear equations are singular.
    """
    n = len(graph.names)
    turn = Rotation.from_rotvec(graph.pose[:, :3]).as_matrix()
    variance = np.diagonal(graph.covariance, axis1=1, axis2=2)
    about = 1.0 / variance[:, :3].mean(axis=1)
    along = 1.0 / variance[:, 3:].mean(axis=1)
    known = np.zeros((n, 6))
    known[graph.held] = held
    rotation = _rotations(graph, turn, about, known)
    shift = _shifts(graph, rotation, along, known)
    for _ in range(rounds):
        factor = _fit(graph, turn, rotation, shift, about, along)
        rotation = _rotations(graph, turn, about * factor, known)
        shift = _shifts(graph, rotation, along * factor, known)
    return np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), shift], axis=1)


def _rotations(graph: PoseGraph, turn, weight, known) -> Float[np.ndarray, "nodes 3 3"]:
    """World_from_node of all nodes: |M_to - M_from R|^2 least, then the nearest rotations.

    The rows of M are separate problems with one matrix.
    """
    matrices = Rotation.from_rotvec(known[:, :3]).as_matrix()
    across = -weight[:, None, None] * turn
    found = _solved(graph, weight, across, np.swapaxes(matrices, 1, 2))
    u, _, vt = np.linalg.svd(np.swapaxes(found, 1, 2))
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt


def _shifts(graph: PoseGraph, rotation, weight, known) -> Float[np.ndarray, "nodes 3"]:
    """Shifts of all nodes: |t_to - t_from - R_from t|^2 least."""
    step = np.einsum("eij,ej->ei", rotation[graph.edges[:, 0]], graph.pose[:, 3:])
    right = np.zeros((len(rotation), 1, 3))
    np.add.at(right[:, 0], graph.edges[:, 1], weight[:, None] * step)
    np.add.at(right[:, 0], graph.edges[:, 0], -weight[:, None] * step)
    across = -weight[:, None, None] * np.ones((1, 1, 1))
    return _solved(graph, weight, across, known[:, None, 3:], right)[:, 0]


def _solved(graph: PoseGraph, weight, across, known, right=None) -> Float[np.ndarray, "n d k"]:
    """Solution of a weighted Laplacian with blocks, its held nodes at known values.

    Args:
        weight: of the diagonal blocks of both ends of each edge.
        across: block of (from, to) of each edge.
        known: values [n, d, k]; those of held nodes count.
        right: right-hand side [n, d, k].
    """
    n, d = known.shape[:2]
    i, j = graph.edges.T
    total = np.bincount(i, weight, n) + np.bincount(j, weight, n)
    place = np.full(n, -1)
    free = np.setdiff1d(np.arange(n), graph.held)
    place[free] = np.arange(len(free))
    right = np.zeros(known.shape) if right is None else right
    # What held nodes contribute moves to the right-hand side.
    for a, b, block in ((i, j, across), (j, i, np.swapaxes(across, 1, 2))):
        own = (place[a] >= 0) & (place[b] < 0)
        np.add.at(right, a[own], -block[own] @ known[b[own]])
    inside = (place[i] >= 0) & (place[j] >= 0)
    a, b, block = place[i[inside]], place[j[inside]], across[inside]
    swap = a < b
    low, high = np.where(swap, b, a), np.where(swap, a, b)
    block = np.where(swap[:, None, None], np.swapaxes(block, 1, 2), block)
    rows = (low[:, None, None] * d + np.arange(d)[:, None]) + np.zeros(d, int)
    columns = (high[:, None, None] * d + np.arange(d)) + np.zeros((d, 1), int)
    lower = sp.coo_matrix(
        (block.ravel(), (rows.ravel(), columns.ravel())), shape=(len(free) * d,) * 2
    )
    diagonal = sp.diags(np.repeat(total[free], d))
    solution = known.copy()
    flat = _cholesky_solve((lower + diagonal).tocoo(), right[free].reshape(len(free) * d, -1))
    solution[free] = flat.reshape(len(free), d, -1)
    return solution


def _cholesky_solve(lower: sp.coo_matrix, right):
    """Solution of a sparse positive definite system, given its lower triangle."""
    matrix = cvxopt.spmatrix(
        lower.data, cvxopt.matrix(lower.row.astype(int)), cvxopt.matrix(lower.col.astype(int)),
        lower.shape,
    )  # fmt: skip
    columns = cvxopt.matrix(np.ascontiguousarray(right))
    try:
        cholmod.linsolve(matrix, columns)
    except ArithmeticError as error:
        raise UnconnectedNetwork(
            "the edges don't join all nodes to held ones well enough for a start: covariances "
            "differ by too many orders of magnitude, or a part hangs on none"
        ) from error
    return np.array(columns)


def _fit(graph: PoseGraph, turn, rotation, shift, about, along) -> Float[np.ndarray, " edges"]:
    """Weights of edges by how well they fit, against the median of all."""
    i, j = graph.edges.T
    back = np.swapaxes(rotation[i], 1, 2)
    turned = Rotation.from_matrix(np.swapaxes(turn, 1, 2) @ back @ rotation[j]).magnitude()
    moved = np.einsum("eij,ej->ei", back, shift[j] - shift[i]) - graph.pose[:, 3:]
    square = about * turned**2 + along * np.sum(moved**2, axis=1)
    return 1.0 / (1.0 + square / max(float(np.median(square)), 1e-300))
