"""One course for all terms: what a fit loses that keeps every term to the same course.

A form of several bases (a lag and a state of its own at first) has an amplitude for each of them
and each term: a target that shifts along x and y by a lag has four. What warms and bends is in one
state, though, and moves along one line; its amplitudes are an outer product

    a_kb = u_k v_b,

of k + b - 1 unknowns. How much worse that fits is told by the covariance of the amplitudes.
"""

import numpy as np
from jaxtyping import Float

_ROUNDS = 30


def lost_by_one_course(
    amplitudes: Float[np.ndarray, " terms*bases"],
    spread: Float[np.ndarray, "terms*bases terms*bases"],
    n_bases: int,
) -> float:
    """Rise of chi-square where amplitudes become the nearest outer product.

    Args:
        amplitudes: of each term one for each basis.
        spread: their covariance.
        n_bases: number of bases.

    Returns:
        The least (a - u v)^T C^-1 (a - u v), by alternating least squares from the course of each
        term and of their sum; infinite where amplitudes are not determined.
    """
    table, variances = np.reshape(amplitudes, (-1, n_bases)), np.diag(spread)
    if not (np.isfinite(spread).all() and np.all(variances > 0.0)):
        return np.inf
    scale = np.sqrt(variances)
    try:
        root = np.linalg.inv(np.linalg.cholesky(spread / np.outer(scale, scale))) / scale
    except np.linalg.LinAlgError:
        return np.inf
    return min(_lost(np.ravel(table), root, course) for course in (*table, table.sum(axis=0)))


def _lost(amplitudes: np.ndarray, root: np.ndarray, course: np.ndarray) -> float:
    """The same from one course; `root` times a change has the square that chi-square rises by."""
    n_bases = len(course)
    n_terms = len(amplitudes) // n_bases
    aim = root @ amplitudes
    left = aim
    for _ in range(_ROUNDS):
        of_terms = np.kron(np.eye(n_terms), course[:, None])
        line = np.linalg.lstsq(root @ of_terms, aim, rcond=None)[0]
        of_bases = np.kron(line[:, None], np.eye(n_bases))
        course = np.linalg.lstsq(root @ of_bases, aim, rcond=None)[0]
        left = aim - root @ of_bases @ course
    return float(left @ left)
