"""Targets: coordinates of marks on common patterns."""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree


def grid_points(rows: int, columns: int, spacing: float) -> Float[np.ndarray, "points 3"]:
    """Marks of a grid, row by row: x = column * spacing, y = row * spacing, z = 0 (m)."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.stack([column * spacing, row * spacing, np.zeros(rows * columns)], axis=1)


def checker(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, " points"]:
    """+1 and -1 in turn over the marks of a grid, as on a chessboard; NaN where there is no grid.

    Marks are on a grid where their x and y differ by whole multiples of the smallest distance, to a
    twentieth of it, so that measured coordinates count, too.
    """
    none = np.full(len(points), np.nan)
    if len(points) < 4 or not np.isfinite(points).all():
        return none
    distinct = np.unique(points, axis=0)
    if len(distinct) < 2:
        return none
    spacing = np.median(KDTree(distinct).query(distinct, k=2)[0][:, 1])
    step = (points[:, :2] - points[0, :2]) / spacing
    if np.abs(step - np.round(step)).max() > 0.05:
        return none
    return 1.0 - 2.0 * (np.round(step).sum(axis=1) % 2)
