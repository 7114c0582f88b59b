"""Large networks: sparse against dense, selected inverse, chordal starts, gross errors by name."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pose_networks import GRID, N, matrix, network, vector
from scipy.sparse import csc_array
from scipy.stats import chi2

from jaxvm.network.chordal import chordal_poses
from jaxvm.network.cycles import fundamental_cycles
from jaxvm.network.graph import (
    PoseGraph,
    UnconnectedNetwork,
    breadth_first_tree,
    chain_poses,
)
from jaxvm.network.relations import held_poses, link_relations, pose_graph
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.solve import covariance as covariances
from jaxvm.solve import large, snooping
from jaxvm.solve.adjust import adjust
from jaxvm.solve.condition import adjust_conditions
from jaxvm.solve.covariance import covariance, pose_covariances, standard_deviations
from jaxvm.solve.gauge import RankDeficiency
from jaxvm.solve.problem import normal_at, scene_problem
from jaxvm.solve.robust import HuberLoss
from jaxvm.solve.selected import SelectedInverse, selected_inverse
from jaxvm.solve.snooping import link_tests, redundancy, snoop_links
from jaxvm.solve.sparse import Pattern, SparseFactors, SparseNormal, sparse_normal


@pytest.fixture
def sparsely(monkeypatch):
    """Whatever the size, networks are solved as large ones."""
    for module in (large, covariances, snooping):
        monkeypatch.setattr(module, "is_large", lambda problem: True)


@pytest.fixture(scope="module")
def known():
    return network()


def dense_of(normal: SparseNormal) -> np.ndarray:
    lower = np.zeros((normal.pattern.n,) * 2)
    lower[normal.pattern.row, normal.pattern.column] = normal.values
    return lower + np.tril(lower, -1).T


@pytest.mark.parametrize("loss", [None, HuberLoss(1.0)])
def test_sparse_normal_equations_are_the_dense_ones(known, loss):
    problem = scene_problem(build(known.recording), loss)
    pattern = Pattern.of(problem)
    x = jnp.asarray(np.random.default_rng(0).normal(0.0, 0.01, problem.n))
    sparse, arrow = sparse_normal(problem, pattern, x), normal_at(problem, x)
    expected = np.asarray(arrow.hessian.as_matrix())
    assert sparse.cost == pytest.approx(float(arrow.cost), rel=1e-12)
    assert np.allclose(sparse.gradient, arrow.gradient, rtol=1e-10, atol=1e-6)
    assert np.allclose(dense_of(sparse), expected, rtol=1e-10, atol=1e-9 * expected.max())
    assert np.allclose(sparse.diagonal(), np.diagonal(expected))
    v = np.random.default_rng(1).normal(size=problem.n)
    assert np.allclose(sparse.mv(v), expected @ v)
    scale = np.random.default_rng(2).uniform(0.5, 2.0, problem.n)
    assert np.allclose(dense_of(sparse.rescaled(scale)), scale[:, None] * expected * scale)


def test_damped_factors_solve(known):
    problem = scene_problem(build(known.recording))
    pattern = Pattern.of(problem)
    normal = sparse_normal(problem, pattern, jnp.zeros(problem.n))
    matrix_ = dense_of(normal)
    factors = SparseFactors(pattern)
    right = np.random.default_rng(0).normal(size=(problem.n, 3))
    for damping in (0.0, 1e3):
        assert factors.factorise(normal, damping)
        expected = np.linalg.solve(matrix_ + damping * np.eye(problem.n), right)
        assert np.allclose(factors.solve(right), expected, rtol=1e-7)
        assert np.allclose(factors.solve(right[:, 0]), expected[:, 0], rtol=1e-7)
    broken = replace(normal, values=-normal.values)
    assert not factors.factorise(broken)


@given(st.integers(0, 10_000), st.integers(2, 30), st.floats(0.02, 0.6))
@settings(max_examples=60, deadline=None)
def test_selected_inverse_is_the_inverse(seed, n, density):
    rng = np.random.default_rng(seed)
    root = np.where(rng.random((n, n)) < density, rng.normal(size=(n, n)), 0.0)
    full = root @ root.T + np.eye(n)
    full[np.arange(n) % 7 == 6] = full[:, np.arange(n) % 7 == 6] = 0.0  # nothing touches these
    lower = csc_array(np.tril(np.where(np.abs(full) > 1e-12, full, 0.0)) + np.diag([1e-300] * n))
    lower.sort_indices()
    column = np.repeat(np.arange(n), np.diff(lower.indptr))
    diagonal = np.flatnonzero(lower.indices == column)
    pattern = Pattern(n, lower.indices.astype(int), column, diagonal, (), (), (), ())
    values = np.where(np.abs(lower.data) < 1e-200, 0.0, lower.data)
    found = selected_inverse(SparseNormal(pattern, 0.0, np.zeros(n), values))
    live = np.diagonal(full) > 0.0
    expected = np.zeros((n, n))
    expected[np.ix_(live, live)] = np.linalg.inv(full[np.ix_(live, live)])
    assert np.allclose(found, expected[pattern.row, pattern.column], rtol=1e-9, atol=1e-12)
    blocks = SelectedInverse(pattern, found).blocks(np.array([[n - 1, n], [0, n]]))
    assert np.allclose(blocks[:, 0, 0], [expected[-1, -1], expected[0, 0]], atol=1e-12)
    assert not blocks[:, 1].any()


@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt"])
def test_large_networks_are_adjusted_as_small_ones(known, method, monkeypatch):
    scene = build(known.recording)
    dense = adjust(scene, method)
    for module in (large, covariances, snooping):
        monkeypatch.setattr(module, "is_large", lambda problem: True)
    sparse = adjust(scene, method)
    assert sparse.converged
    assert sparse.degrees_of_freedom == dense.degrees_of_freedom
    assert sparse.cost == pytest.approx(dense.cost, rel=1e-9)
    sigma = np.asarray(standard_deviations(sparse).world_from_station)
    apart = np.abs(sparse.scene.state.world_from_station - dense.scene.state.world_from_station)
    assert (apart <= 1e-4 * sigma + 1e-12).all()

    def quantity(state):
        return state.world_from_station[-1] - state.world_from_station[3]

    own = [np.asarray(covariance(sparse, quantity)), pose_covariances(sparse)]
    test, freedom = link_tests(sparse)
    shares = redundancy(sparse)[0]
    monkeypatch.undo()
    assert np.allclose(own[0], covariance(dense, quantity), rtol=1e-4, atol=1e-12)
    assert np.allclose(own[1], pose_covariances(dense), rtol=1e-4, atol=1e-12)
    assert np.allclose(sigma, standard_deviations(dense).world_from_station, rtol=1e-4)
    assert np.allclose(shares, redundancy(dense)[0], atol=1e-5)
    assert np.allclose(test, link_tests(dense)[0], rtol=1e-3, atol=1e-3)
    assert np.trace(shares, axis1=1, axis2=2).sum() == pytest.approx(dense.degrees_of_freedom)
    assert (freedom == 6).all()


def test_estimates_scatter_as_predicted():
    """Squared errors of all poses in the metric of their covariance, over many networks."""
    squares = []
    for seed in range(12):
        known = network(seed=seed)
        found = adjust(build(known.recording), "gauss-newton")
        error = np.asarray(found.scene.state.world_from_station)[1:] - known.truth[1:]
        spread = np.asarray(covariance(found, lambda s: s.world_from_station[1:]))
        squares.append(error.ravel() @ np.linalg.solve(spread, error.ravel()))
        low, high = chi2.ppf([1e-4, 1 - 1e-4], found.degrees_of_freedom)
        assert low < 2.0 * found.cost < high
    low, high = chi2.ppf([0.001, 0.999], 12 * 6 * (N - 1))
    assert low < sum(squares) < high


def test_a_part_that_nothing_holds_is_named(known, sparsely):
    stations = tuple(replace(s, free=frozenset({"pose"})) for s in known.recording.model.stations)
    free = replace(known.recording, model=replace(known.recording.model, stations=stations))
    with pytest.raises(RankDeficiency, match="station s.*shift"):
        adjust(build(free))
    with pytest.raises(RankDeficiency, match="station s"):
        edges = [(a, b) for a, b in GRID if not (a < 6 <= b)]
        adjust(build(network(edges).recording))


def test_a_long_chain_is_weak_but_not_broken(sparsely):
    """Eigenvalues fall with the fourth power of the length; the chain is determined nonetheless."""
    n = 400
    known = network([(k, k + 1) for k in range(n - 1)], n=n, noise=0.0, turn=0.1)
    assert adjust(build(known.recording)).cost < 1e-9


def test_disconnected_parts_are_named():
    edges = [(a, b) for a, b in GRID if not (a < 6 <= b)]
    with pytest.raises(UnconnectedNetwork, match='station "s6"'):
        start(build(network(edges).recording), "chordal")


def test_chordal_start_is_exact_without_noise():
    known = network(noise=0.0, turn=2.5)
    far = replace(known.recording.model, stations=tuple(
        replace(s, pose=np.full(6, 0.3) * k if k else s.pose)
        for k, s in enumerate(known.recording.model.stations)
    ))  # fmt: skip
    found = start(build(replace(known.recording, model=far)), "chordal")
    for pose, true in zip(found.state.world_from_station, known.truth, strict=True):
        assert np.allclose(matrix(pose), matrix(true), atol=1e-9)


def test_a_bad_start_does_not_ruin_it():
    """From nonsense Gauss-Newton ends elsewhere; the start chosen among several does not."""
    known = network(seed=3, turn=2.5)
    rng = np.random.default_rng(0)
    nonsense = tuple(
        replace(s, pose=np.append(rng.uniform(-2.5, 2.5, 3), rng.normal(0, 20, 3)) if k else s.pose)
        for k, s in enumerate(known.recording.model.stations)
    )
    scene = build(replace(known.recording, model=replace(known.recording.model, stations=nonsense)))
    good = adjust(build(known.recording), "gauss-newton")
    found = adjust(start(scene, "best"), "gauss-newton")
    assert found.cost == pytest.approx(good.cost, rel=1e-9)
    assert adjust(scene, "gauss-newton").cost > 10.0 * good.cost


def test_chordal_weights_do_without_gross_errors():
    known = network(noise=0.1)
    links = known.recording.links
    pose = links.pose.copy()
    pose[5] += [1.0, -1.0, 0.5, 3.0, 3.0, -3.0]
    graph = PoseGraph(
        tuple(f"s{i}" for i in range(N)), np.array(GRID), links.name, pose, links.covariance,
        np.zeros(1, int),
    )  # fmt: skip

    def worst(rounds):
        found = chordal_poses(graph, known.truth[:1], rounds)
        apart = [
            np.abs(np.linalg.inv(matrix(a)) @ matrix(b) - np.eye(4)).max()
            for a, b in zip(found, known.truth, strict=True)
        ]
        return max(apart)

    assert worst(0) > 0.2
    assert worst(20) < 0.02


@pytest.mark.parametrize("size", [8.0, 300.0])
def test_gross_errors_are_named(known, size):
    links = known.recording.links
    rng = np.random.default_rng(4)
    bad = [2, 9, 14]
    pose = links.pose.copy()
    for k in bad:
        twist = np.linalg.cholesky(links.covariance[k]) @ rng.standard_normal(6)
        pose[k] = vector(matrix(pose[k]) @ matrix(size * twist))
    scene = build(replace(known.recording, links=replace(links, pose=pose)))
    found, rejected, weights = snoop_links(scene)
    assert sorted(r.row for r in rejected) == bad
    assert {r.where for r in rejected} == {f"link {links.name[k]}" for k in bad}
    assert (weights == 0.0).nonzero()[0].tolist() == bad
    assert found.degrees_of_freedom == 6 * (len(GRID) - len(bad)) - 6 * (N - 1)


def test_what_nothing_checks_is_not_set_aside(known):
    """Two gross errors far apart on one loop: without both the loop would fall in two."""
    ring = [(k, (k + 1) % 8) for k in range(8)]
    recording = network(ring, 8, seed=3).recording
    pose = recording.links.pose.copy()
    for k in (1, 5):
        pose[k, 3:] += 1.0
    scene = build(replace(recording, links=replace(recording.links, pose=pose)))
    found, rejected, weights = snoop_links(scene)
    assert len(rejected) == 1 and found.converged
    assert found.degrees_of_freedom == 0 and found.variance_factor == 1.0
    # Sigmas that are ten times too small: sound links stay where the scale says so.
    small = replace(known.recording.links, covariance=known.recording.links.covariance / 100.0)
    scene = build(replace(known.recording, links=small))
    assert snoop_links(scene, scale=100.0)[1] == []
    assert len(snoop_links(scene)[1]) > 0


def test_sound_networks_keep_their_links():
    lost = 0
    for seed in range(8):
        lost += len(snoop_links(build(network(seed=seed).recording))[1])
    # 8 x 19 links at one in a thousand each.
    assert lost <= 2


def test_link_tests_are_chi_square():
    values = []
    for seed in range(12):
        values.append(link_tests(adjust(build(network(seed=seed).recording)))[0])
    pooled = np.concatenate(values)
    assert np.mean(pooled) == pytest.approx(6.0, abs=4 * np.sqrt(12 / len(pooled)) * 1.5)
    assert 0.02 < np.mean(pooled > chi2.isf(0.05, 6)) < 0.10


def test_conditions_and_the_network_residual_agree():
    """The same scene by cycles with dense matrices, and by all poses at once: to 1e-9."""
    known = network(seed=5)
    scene = build(known.recording)
    graph, _ = pose_graph(scene, link_relations(scene), held_poses(scene, given=False))
    cycles = fundamental_cycles(graph)
    by_cycles = adjust_conditions(graph, cycles)
    adjusted = replace(graph, pose=np.asarray(by_cycles.pose))
    # All ways lead to the same poses now: one tree is enough.
    poses = chain_poses(adjusted, np.zeros((1, 6)), breadth_first_tree(adjusted, np.zeros(1, int)))
    found = adjust(scene, "gauss-newton", rtol=1e-15)
    assert by_cycles.squares == pytest.approx(2.0 * found.cost, rel=1e-9)
    assert by_cycles.redundancy == found.degrees_of_freedom == 6 * len(cycles)
    stations = zip(scene.model.stations[1:], found.scene.state.world_from_station[1:], strict=True)
    for station, pose in stations:
        ours = poses[graph.names.index(f'station "{station.name}"')]
        assert np.allclose(matrix(ours), matrix(pose), atol=1e-9)


@pytest.mark.parametrize("method, rel", [("lbfgs", 1e-6), ("spgd", 0.02)])
def test_descents_reach_the_same_minimum(known, method, rel):
    scene = build(known.recording)
    best = adjust(scene, "gauss-newton").cost
    found = adjust(start(scene, "chordal"), method)
    assert best <= found.cost < (1.0 + rel) * best
    assert len(found.evaluations_at) == len(found.history)
    assert found.history[-1] == pytest.approx(found.cost)


def test_an_unknown_method_is_named(known):
    with pytest.raises(ValueError, match='no method "newton".*spgd, lbfgs'):
        adjust(build(known.recording), "newton")
