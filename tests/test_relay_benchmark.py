"""Functions of benchmarks/relay that are not the package's, against closed forms."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "relay"))

from doubles import by_link_covariances, pointing  # noqa: E402
from intervals import gain, rms  # noqa: E402
from marks import LENGTH, TILTED, double, pictured, relative  # noqa: E402
from meshes import LAYOUTS, layout  # noqa: E402
from scipy.sparse import coo_array  # noqa: E402
from scipy.sparse.csgraph import connected_components  # noqa: E402
from stations import ideal, pairs_of, realistic  # noqa: E402


def test_intervals_are_those_of_normal_errors():
    """Width of the RMS of normal errors: +-1.96 sigma / sqrt(2 n); paired gains of copies are 1."""
    squares = np.random.default_rng(0).normal(0.0, 3.0, (2000, 4)) ** 2
    found = rms(squares)
    half = 0.5 * (np.array(found["high"]) - found["low"])
    np.testing.assert_allclose(half, 1.96 * 3.0 / np.sqrt(4000), rtol=0.12)
    np.testing.assert_allclose(found["value"], 3.0, rtol=0.06)
    own = squares[:, 0]
    assert gain(4.0 * own, own) == pytest.approx({"value": 2.0, "low": 2.0, "high": 2.0})
    apart = gain(4.0 * own, squares[:, 1])
    assert apart["low"] < 2.0 < apart["high"]


def test_a_mean_link_by_link_without_levers_is_that_of_resistors():
    """Each link beside a link and two rungs: k (1 + 2 r) / (2 + 2 r), whatever the weights."""
    k, unit, r = 3, 1e-12, 0.25
    chain = double(k, unit * np.eye(6), unit * np.eye(6), r * unit * np.eye(6), 0.0, 0.0)
    # Neighbouring averages share a rung: its errors, half weighted, cancel there.
    share = 1.0 / (2.0 + 2.0 * r)
    rungs = share**2 * 2.0 * r
    expected = k * ((1.0 - share) ** 2 + share**2) + rungs
    for spread in by_link_covariances(chain, chain):
        np.testing.assert_allclose(spread, expected * unit * np.eye(6), atol=1e-9 * unit)


def test_pointing_needs_a_tilt_that_is_worse_than_the_line_of_sight():
    assert pointing(TILTED.tilt, TILTED.lateral, 10e-6, LENGTH) == pytest.approx(11.96, abs=0.05)
    assert pointing(1e-6, TILTED.lateral, 10e-6, LENGTH) == pytest.approx(1.0, abs=0.01)


def test_a_tilted_plate_is_as_precise_as_mathematics_1_6_says():
    """0.063 mrad of roll, 0.17 mrad of tilt, 0.63 mm, 10 um: those that `marks.TILTED` states."""
    roll, *tilt, depth, right, up = np.sqrt(np.diagonal(pictured(10.0)))
    np.testing.assert_allclose([roll, depth], [TILTED.roll, TILTED.depth], rtol=0.02)
    np.testing.assert_allclose(
        [*tilt, right, up], [TILTED.tilt] * 2 + [TILTED.lateral] * 2, rtol=0.03
    )


def test_plans_of_a_station_and_its_pairs():
    assert [len(pairs_of(plan, 6)) for plan in ("all pairs", "ring and next but one", "ring")] == [
        15, 12, 6,
    ]  # fmt: skip
    pairs = pairs_of("all pairs", 4)
    for station in (ideal, realistic):
        poses = np.asarray(station(4, pairs).pose)
        # Around the loop 0 1 2 the turns about the vertical, or any, multiply to the identity.
        legs = dict(zip(map(tuple, pairs), poses, strict=True))
        there = np.stack([legs[0, 1], np.zeros(6)])
        # 1_from_2 is (0_from_1)^-1 0_from_2.
        again = relative(np.stack([there[0], legs[0, 2]])[None])[0]
        np.testing.assert_allclose(again, legs[1, 2], atol=1e-12)


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("n", [8, 30])
def test_networks_are_joined_and_redundant(name, n):
    a, b = layout(name, n).edges.T
    assert connected_components(coo_array((np.ones(len(a)), (a, b)), shape=(n, n)))[0] == 1
    assert len(a) >= n
