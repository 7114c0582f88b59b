"""Chessboards among targets: which marks are a grid, and on which fields they stand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxvm.geometry.targets import checker, grid_points


@given(st.integers(2, 9), st.integers(2, 9), st.floats(1e-3, 2.0))
@settings(deadline=None, max_examples=30)
def test_neighbours_differ_and_diagonals_agree(rows, columns, spacing):
    signs = checker(grid_points(rows, columns, spacing)).reshape(rows, columns)
    assert set(np.unique(signs)) == {-1.0, 1.0}
    assert np.all(signs[1:] == -signs[:-1])
    assert np.all(signs[:, 1:] == -signs[:, :-1])


def test_measured_coordinates_are_still_a_grid():
    points = grid_points(6, 8, 0.04)
    moved = points + np.random.default_rng(0).normal(scale=1e-4, size=points.shape)
    assert np.array_equal(checker(moved), checker(points))


@pytest.mark.parametrize(
    "points",
    [
        np.random.default_rng(1).uniform(size=(20, 3)),
        grid_points(1, 3, 0.1),
        np.full((9, 3), np.nan),
    ],
    ids=["scattered", "too few", "unknown"],
)
def test_what_is_no_grid_has_no_fields(points):
    assert np.isnan(checker(points)).all()
