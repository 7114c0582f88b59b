"""The benchmark of SPGD's claim: its networks, its fits, and the theory of wandering in loops."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "spgd_claim"))
import layouts  # noqa: E402
import verdict  # noqa: E402
import wander  # noqa: E402

from jaxvm.network.graph import n_conditions  # noqa: E402


@pytest.mark.parametrize(
    "kind, n, links",
    [("ring", 12, 12), ("ladder", 12, 16), ("random 1.2", 50, 60), ("random 4", 50, 200)],
)
def test_networks_are_what_they_are_called(kind, n, links):
    made = layouts.layout(kind, n, 0)
    edges = np.sort(made.graph.edges, axis=1)
    assert len(np.unique(edges, axis=0)) == links == len(edges)
    assert n_conditions(made.graph) == links - n + 1
    tree = layouts.depth_first_tree(made.graph)
    assert (tree.depth >= 0).all() and (tree.depth == 0).sum() == 1
    # In a depth-first tree every link joins a station to one of its ancestors.
    for a, b in edges:
        low, high = (a, b) if tree.depth[a] > tree.depth[b] else (b, a)
        while tree.depth[low] > tree.depth[high]:
            low = tree.parent[low]
        assert low == high
    assert layouts.attitude_error(made.reckoned, made.truth) < 1e-2


def test_exponents_are_those_of_powers_and_censored_sizes_are_left_out():
    cells = [
        {"n": n, "status": "censored" if n == 80 and seed else "reached", "x": factor * n**2.5}
        for n in (10, 20, 40, 80)
        for seed, factor in enumerate((1.0, 1.1))
    ]
    fit = verdict.fitted(cells, lambda cell: cell["x"])
    assert fit.sizes == (10, 20, 40) and fit.left_out == (80,)
    assert fit.exponent == pytest.approx(2.5) and fit.low < 2.5 < fit.high


@pytest.mark.parametrize("n", [4, 9])
def test_wandering_of_small_gains_is_that_of_the_closed_form(n):
    eta = 1e-3 / n
    formula = 0.5 * eta * (n - 1) * (n - 2)
    assert wander.first_order(wander.number_ring(n), eta) == pytest.approx(formula, rel=1e-9)
    assert wander.exact_mean(n, eta) == pytest.approx(formula, rel=3e-3)
