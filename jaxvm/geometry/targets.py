"""Targets: coordinates of marks on common patterns."""

import numpy as np
from jaxtyping import Float


def grid_points(rows: int, columns: int, spacing: float) -> Float[np.ndarray, "points 3"]:
    """Marks of a grid, row by row: x = column * spacing, y = row * spacing, z = 0 (m)."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.stack([column * spacing, row * spacing, np.zeros(rows * columns)], axis=1)
