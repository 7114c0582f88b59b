"""Networks as graphs: against closed forms, networkx, dense algebra and Monte Carlo."""

from dataclasses import replace

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from jaxvm.network.cycles import cycle_effects, fundamental_cycles, minimum_cycle_basis, misclosure
from jaxvm.network.graph import (
    PoseGraph,
    UnconnectedNetwork,
    best_path,
    breadth_first_tree,
    chain_poses,
    check_connected,
    components,
    compose,
    edge_variance,
    n_conditions,
    shortest_path_tree,
    spanning_tree,
    typical_length,
    unheld_parts,
)
from jaxvm.network.redundancy import bridges, effective_resistance, redundancy_numbers, weak_edges

SIGMAS = 5.0
"""Monte Carlo: 36 elements of a covariance stay within this many of their own deviations."""


def network(n, edges, pose=None, covariance=None, held=(0,)) -> PoseGraph:
    """A pose graph of n nodes; identity poses and unit covariances if none are given."""
    edges = np.array(edges, int).reshape(-1, 2)
    m = len(edges)
    return PoseGraph(
        tuple(f"n{i}" for i in range(n)),
        edges,
        tuple(f"e{i}" for i in range(m)),
        np.zeros((m, 6)) if pose is None else pose,
        np.tile(np.eye(6), (m, 1, 1)) if covariance is None else covariance,
        np.array(held, int),
    )


def ring(n):
    return network(n, [(i, (i + 1) % n) for i in range(n)])


def complete(n):
    return network(n, [(i, j) for i in range(n) for j in range(i)])


def ladder(k):
    """Rails of k links (even nodes, odd nodes), then k + 1 rungs."""
    rails = [(i, i + 2) for i in range(2 * k)]
    return network(2 * k + 2, rails + [(2 * i, 2 * i + 1) for i in range(k + 1)])


def grid(s):
    at = np.arange(s * s).reshape(s, s)
    across = np.column_stack([at[:, :-1].ravel(), at[:, 1:].ravel()])
    return network(s * s, np.vstack([across, np.column_stack([at[1:].ravel(), at[:-1].ravel()])]))


PARALLEL = network(4, [(0, 1), (1, 0), (0, 1), (1, 2), (3, 3), (2, 3), (3, 2)])
NAMED = [ring(3), ring(9), ladder(4), complete(5), grid(4), PARALLEL, network(3, [])]


@st.composite
def graphs(draw, simple=False):
    """Networks of up to 9 nodes, most of them with several parts, loops and parallel edges."""
    n = draw(st.integers(1, 9))
    node = st.integers(0, n - 1)
    edges = draw(st.lists(st.tuples(node, node), max_size=18))
    if simple:
        edges = sorted({(min(e), max(e)) for e in edges if e[0] != e[1]})
    return network(n, edges)


def peer(graph, weight=None) -> nx.MultiGraph:
    """The same in networkx, edges keyed by their place."""
    out = nx.MultiGraph()
    out.add_nodes_from(range(len(graph.names)))
    for k, (a, b) in enumerate(graph.edges.tolist()):
        out.add_edge(a, b, key=k, weight=1.0 if weight is None else weight[k])
    return out


def weights(graph, seed=0):
    """Some positive number for each edge, over two decades."""
    return 10.0 ** np.random.default_rng(seed).uniform(-1.0, 1.0, len(graph.edges))


# --- poses ---------------------------------------------------------------------------------------


def matrix(vector):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:]
    return out


def twist_matrices(twists):
    out = np.zeros((*twists.shape[:-1], 4, 4))
    x, y, z = np.moveaxis(twists[..., :3], -1, 0)
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = x, y, z
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -x, -y, -z
    out[..., :3, 3] = twists[..., 3:]
    return out


def small_twists(matrices):
    """Logarithm of matrices near the identity, to second order: M - (M - I)^2 / 2."""
    d = matrices - np.eye(4)
    d = d - 0.5 * d @ d
    return np.stack(
        [d[..., 2, 1], d[..., 0, 2], d[..., 1, 0], *np.moveaxis(d[..., :3, 3], -1, 0)], -1
    )


def random_poses(rng, n):
    return np.hstack([rng.normal(0.0, 1.0, (n, 3)), rng.normal(0.0, 5.0, (n, 3))])


def measured(graph, seed=0, scale=1e-4) -> tuple[PoseGraph, np.ndarray]:
    """The network with true poses of all nodes that its edges fulfil, and full covariances."""
    rng = np.random.default_rng(seed)
    world_from_node = [matrix(p) for p in random_poses(rng, len(graph.names))]
    pose = np.zeros((len(graph.edges), 6))
    for k, (a, b) in enumerate(graph.edges):
        between = np.linalg.inv(world_from_node[a]) @ world_from_node[b]
        pose[k, :3] = Rotation.from_matrix(between[:3, :3]).as_rotvec()
        pose[k, 3:] = between[:3, 3]
    root = rng.normal(size=(len(graph.edges), 6, 6)) * rng.uniform(0.3, 3.0, (1, 6, 1))
    covariance = scale**2 * root @ root.swapaxes(1, 2)
    return replace(graph, pose=pose, covariance=covariance), np.array(world_from_node)


def draws(graph, n, seed=0):
    """n times the true matrices of all edges, if what is measured is `pose`: [n, edges, 4, 4]."""
    rng = np.random.default_rng(seed)
    root = np.linalg.cholesky(graph.covariance)
    twists = np.einsum("eij,nej->nei", root, rng.normal(size=(n, len(graph.edges), 6)))
    return np.array([matrix(p) for p in graph.pose]) @ expm(twist_matrices(twists))


def product(edges, walk):
    """Of the edges' matrices [..., edges, 4, 4] along a walk."""
    out = np.eye(4)
    for edge, sign in walk:
        step = edges[..., edge, :, :]
        out = out @ (step if sign > 0 else np.linalg.inv(step))
    return out


def assert_same_covariance(sample, expected):
    n = len(sample)
    found = sample.T @ sample / n
    deviation = np.sqrt((np.outer(*[np.diag(expected)] * 2) + expected**2) / n)
    assert np.abs((found - expected) / deviation).max() < SIGMAS


# --- parts ---------------------------------------------------------------------------------------


@given(graphs())
def test_parts_and_conditions_are_those_of_networkx(graph):
    found = components(graph)
    assert [set(p.tolist()) for p in found] == sorted(nx.connected_components(peer(graph)), key=min)
    assert n_conditions(graph) == len(graph.edges) - len(graph.names) + len(found)
    assert all((np.diff(part) > 0).all() for part in found)


def test_counts_of_known_networks():
    assert [n_conditions(g) for g in NAMED] == [1, 1, 4, 6, 9, 4, 0]


def test_parts_without_a_held_node_are_named():
    graph = network(14, [(0, 1), *((i, i + 1) for i in range(2, 11)), (12, 13)], held=(1,))
    assert [p.tolist() for p in unheld_parts(graph)] == [list(range(2, 12)), [12, 13]]
    with pytest.raises(UnconnectedNetwork) as error:
        check_connected(graph)
    words = str(error.value)
    assert "n2, n3, n4, n5, n6, n7 and 4 more; n12, n13;" in words
    assert "n0" not in words and "hold one of its nodes" in words
    with pytest.raises(UnconnectedNetwork, match="and 2 more parts"):
        check_connected(network(5, [], held=()))
    check_connected(replace(graph, held=np.array([1, 5, 12])))


# --- trees ---------------------------------------------------------------------------------------


@given(graphs(), st.integers(0, 5))
def test_spanning_tree_is_as_light_as_that_of_networkx(graph, seed):
    weight = weights(graph, seed)
    tree = spanning_tree(graph, weight)
    expected = nx.minimum_spanning_edges(peer(graph, weight), keys=True, data=False)
    assert sorted(key for _, _, key in expected) == tree.tolist()
    assert len(tree) == len(graph.names) - len(components(graph))


@given(graphs(), st.integers(0, 5))
def test_shortest_ways_are_as_short_as_those_of_networkx(graph, seed):
    weight = weights(graph, seed)
    roots = np.unique([0, len(graph.names) // 2])
    tree = shortest_path_tree(graph, roots, weight)
    expected = nx.multi_source_dijkstra_path_length(peer(graph, weight), set(roots.tolist()))
    assert set(tree.order.tolist()) == set(expected)
    for node, distance in expected.items():
        way = tree.way_to(node)
        assert len(way) == tree.depth[node]
        assert sum(weight[edge] for edge, _ in way) == pytest.approx(distance, rel=1e-12)
        at = node
        for edge, sign in reversed(way):
            ends = graph.edges[edge][::sign]
            assert ends[1] == at and tree.parent[at] == ends[0]
            at = ends[0]
        assert at in roots and tree.depth[at] == 0


@given(graphs())
def test_breadth_first_ways_have_the_fewest_edges(graph):
    tree = breadth_first_tree(graph, np.array([0]))
    assert {n: tree.depth[n] for n in tree.order} == nx.single_source_shortest_path_length(
        peer(graph), 0
    )
    position = {node: k for k, node in enumerate(tree.order.tolist())}
    assert all(position[tree.parent[n]] < position[n] for n in tree.order if tree.depth[n] > 0)


def test_breadth_first_tree_keeps_to_the_edges_given():
    graph = grid(6)
    weight = weights(graph)
    chosen = spanning_tree(graph, weight)
    tree = breadth_first_tree(graph, np.array([7]), chosen)
    assert sorted(tree.edge[tree.edge >= 0].tolist()) == chosen.tolist()


@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_weights_that_are_no_costs_are_refused(weight):
    with pytest.raises(ValueError, match='weight of edge "e2"'):
        spanning_tree(ring(4), np.array([1.0, 1.0, weight, 1.0]))


@given(graphs(), st.integers(0, 3))
@settings(deadline=None)
def test_chained_poses_are_the_true_ones(graph, seed):
    graph, world_from_node = measured(graph, seed)
    for tree in (breadth_first_tree(graph), shortest_path_tree(graph, 0)):
        found = chain_poses(graph, vectors(world_from_node[tree.roots]), tree)
        reached = np.isin(np.arange(len(graph.names)), tree.order)
        assert np.isnan(found[~reached]).all()
        got = np.array([matrix(p) for p in found[reached]])
        np.testing.assert_allclose(got, world_from_node[reached], atol=1e-12)


def vectors(matrices):
    return np.hstack([Rotation.from_matrix(matrices[:, :3, :3]).as_rotvec(), matrices[:, :3, 3]])


def test_two_roots_of_one_part_keep_their_poses():
    graph, world_from_node = measured(ring(8))
    tree = shortest_path_tree(graph, np.array([5, 1]), np.ones(8))
    assert tree.depth.max() == 2
    off = vectors(world_from_node)[[5, 1]]
    off[1, 3:] += 1.0
    found = chain_poses(graph, off, tree)
    np.testing.assert_array_equal(found[[5, 1], 3:], off[:, 3:])
    np.testing.assert_allclose(found[6, 3:], world_from_node[6, :3, 3], atol=1e-12)
    assert np.linalg.norm(found[2, 3:] - world_from_node[2, :3, 3]) == pytest.approx(np.sqrt(3.0))


@pytest.mark.parametrize("make", [lambda: ring(10_000), lambda: grid(100)])
def test_ten_thousand_nodes(make):
    graph, world_from_node = measured(make())
    for tree in (
        shortest_path_tree(graph, 0),
        breadth_first_tree(graph, np.array([0]), spanning_tree(graph)),
    ):
        assert len(tree.order) == 10_000
        found = chain_poses(graph, vectors(world_from_node[:1]), tree)
        np.testing.assert_allclose(found[:, 3:], world_from_node[:, :3, 3], atol=1e-8)
    assert len(fundamental_cycles(graph)) == n_conditions(graph)
    assert len(bridges(graph)) == 0


# --- ways ----------------------------------------------------------------------------------------


def test_one_variance_for_each_edge():
    covariance = np.zeros((3, 6, 6))
    covariance[:] = np.diag([1.0, 2.0, 3.0, 10.0, 20.0, 60.0])
    pose = np.zeros((3, 6))
    pose[:, 3:] = [[0, 0, 0], [0, 3, 4], [0, 0, 3]]
    graph = network(2, [(0, 1)] * 3, pose, covariance)
    assert typical_length(graph) == 4.0
    np.testing.assert_allclose(edge_variance(graph), 2.0 * 16.0 + 30.0)
    np.testing.assert_allclose(edge_variance(graph, 0.5), 2.0 * 0.25 + 30.0)
    assert typical_length(ring(3)) == 1.0


def test_best_path_takes_the_best_of_parallel_edges_and_of_ways():
    graph = network(4, [(0, 1), (1, 0), (1, 2), (0, 2), (3, 2)])
    path = best_path(graph, 0, 3, np.array([2.0, 1.0, 1.0, 3.0, 1.0]))
    assert path.steps == [(1, -1), (2, 1), (4, -1)]
    assert best_path(graph, 0, 3, np.array([2.0, 1.0, 1.0, 1.5, 1.0])).steps == [(3, 1), (4, -1)]


def test_path_to_itself_and_path_that_does_not_exist():
    path = best_path(ring(4), 2, 2)
    assert path.steps == [] and not path.pose.any() and not path.covariance.any()
    with pytest.raises(UnconnectedNetwork, match="joins n0 to n2"):
        best_path(network(3, [(0, 1)]), 0, 2)


@pytest.mark.parametrize("seed", range(3))
def test_covariance_of_a_path_is_that_of_monte_carlo(seed):
    rng = np.random.default_rng(seed)
    chain = [(i, i + 1)[:: rng.choice([1, -1])] for i in range(6)]
    graph, world_from_node = measured(network(7, chain), seed)
    path = best_path(graph, 0, 6)
    assert len({sign for _, sign in path.steps}) == 2  # forward and backward edges
    a_from_b = np.linalg.inv(world_from_node[0]) @ world_from_node[6]
    np.testing.assert_allclose(matrix(path.pose), a_from_b, atol=1e-12)
    sample = small_twists(np.linalg.inv(a_from_b) @ product(draws(graph, 20_000), path.steps))
    assert_same_covariance(sample, path.covariance)


def test_a_path_backward_has_the_inverse_pose_and_its_covariance_in_other_axes():
    graph, _ = measured(ladder(4))
    there, back = best_path(graph, 0, 9), best_path(graph, 9, 0)
    assert back.steps == [(edge, -sign) for edge, sign in reversed(there.steps)]
    b_from_a = matrix(back.pose)
    np.testing.assert_allclose(b_from_a @ matrix(there.pose), np.eye(4), atol=1e-12)
    # T exp(xi) inverted is T^-1 exp(-Ad(T) xi); Ad column by column from its definition.
    a_from_b = matrix(there.pose)
    moved = a_from_b @ twist_matrices(np.eye(6)) @ b_from_a
    adjoint = np.stack([moved[:, 2, 1], moved[:, 0, 2], moved[:, 1, 0], *moved[:, :3, 3].T], axis=0)
    np.testing.assert_allclose(
        back.covariance, adjoint @ there.covariance @ adjoint.T, rtol=1e-10, atol=1e-18
    )


def test_a_walk_that_returns_on_its_own_edge_is_certain():
    graph, _ = measured(ring(4))
    pose, covariance = compose(graph, [(0, 1), (1, 1), (1, -1), (0, -1)])
    np.testing.assert_allclose(pose, 0.0, atol=1e-14)
    np.testing.assert_allclose(covariance, 0.0, atol=1e-20)


def test_growth_of_a_straight_chain():
    """MATHEMATICS 1.6: turn n, lateral n t^2 + r^2 L^2 (n-1) n (2n-1) / 6, axial n t^2."""
    n, length, turn, shift = 12, 10.0, 20e-6, 2e-4
    pose = np.zeros((n, 6))
    pose[:, 3] = length
    covariance = np.tile(np.diag([turn**2] * 3 + [shift**2] * 3), (n, 1, 1))
    graph = network(n + 1, [(i, i + 1) for i in range(n)], pose, covariance)
    found = np.diag(best_path(graph, 0, n).covariance)
    lateral = n * shift**2 + turn**2 * length**2 * (n - 1) * n * (2 * n - 1) / 6
    np.testing.assert_allclose(
        found, [n * turn**2] * 3 + [n * shift**2, lateral, lateral], rtol=1e-12
    )


# --- cycles --------------------------------------------------------------------------------------


def rank_over_gf2(cycles, n_edges):
    rows = np.zeros((len(cycles), n_edges), bool)
    for row, cycle in zip(rows, cycles, strict=True):
        for edge, _ in cycle:
            row[edge] ^= True
    rank = 0
    for column in range(n_edges):
        pivot = np.flatnonzero(rows[rank:, column])
        if len(pivot):
            rows[[rank, rank + pivot[0]]] = rows[[rank + pivot[0], rank]]
            below = np.flatnonzero(rows[rank + 1 :, column]) + rank + 1
            rows[below] ^= rows[rank]
            rank += 1
    return rank


def assert_basis(graph, cycles):
    """As many as conditions, independent, each closed and through no node twice."""
    assert len(cycles) == n_conditions(graph)
    assert rank_over_gf2(cycles, len(graph.edges)) == len(cycles)
    for cycle in cycles:
        walked = np.array([graph.edges[edge][::sign] for edge, sign in cycle])
        assert (walked[:, 1] == np.roll(walked[:, 0], -1)).all()
        assert len(set(walked[:, 0].tolist())) == len(cycle) == len({edge for edge, _ in cycle})


@pytest.mark.parametrize("graph", NAMED)
def test_bases_of_known_networks(graph):
    assert_basis(graph, fundamental_cycles(graph))
    assert_basis(graph, minimum_cycle_basis(graph))


@given(graphs(), st.integers(0, 5))
@settings(deadline=None)
def test_bases_of_random_networks(graph, seed):
    assert_basis(graph, fundamental_cycles(graph))
    spanning = breadth_first_tree(graph, None, spanning_tree(graph, weights(graph, seed)))
    assert_basis(graph, fundamental_cycles(graph, spanning))
    assert_basis(graph, minimum_cycle_basis(graph))
    assert_basis(graph, minimum_cycle_basis(graph, weights(graph, seed)))


def total(cycles, weight):
    return sum(weight[edge] for cycle in cycles for edge, _ in cycle)


def peer_total(graph, weight):
    simple = nx.Graph(peer(graph, weight))
    return sum(
        simple[a][b]["weight"]
        for cycle in nx.minimum_cycle_basis(simple, weight="weight")
        for a, b in zip(cycle, [*cycle[1:], cycle[0]], strict=True)
    )


@given(graphs(simple=True), st.integers(0, 5))
@settings(deadline=None)
def test_minimum_basis_is_as_light_as_that_of_networkx(graph, seed):
    # Few different weights: many ways are equally short. Real ones: none are.
    for weight in (
        np.ones(len(graph.edges)),
        np.round(weights(graph, seed)),
        weights(graph, seed),
    ):
        expected = peer_total(graph, weight)
        assert total(minimum_cycle_basis(graph, weight), weight) == pytest.approx(expected)
        assert total(fundamental_cycles(graph), weight) > expected - 1e-9


def test_minimum_basis_of_a_larger_network():
    rng = np.random.default_rng(1)
    pairs = [(i, j) for i in range(40) for j in range(i) if rng.random() < 0.12]
    graph = network(40, pairs)
    weight = weights(graph)
    found = minimum_cycle_basis(graph, weight)
    assert_basis(graph, found)
    assert total(found, weight) == pytest.approx(peer_total(graph, weight))
    lengths = [total([cycle], weight) for cycle in found]
    assert lengths == sorted(lengths)


def test_minimum_bases_known_by_sight():
    assert {len(c) for c in minimum_cycle_basis(grid(7))} == {4}
    assert {len(c) for c in minimum_cycle_basis(complete(6))} == {3}
    assert {len(c) for c in minimum_cycle_basis(ladder(30))} == {4}
    assert sorted(len(c) for c in minimum_cycle_basis(PARALLEL)) == [1, 2, 2, 2]


def test_a_tree_that_is_no_spanning_tree_gives_no_cycles():
    with pytest.raises(ValueError, match="reach every node"):
        fundamental_cycles(ring(5), shortest_path_tree(ring(5), np.array([0, 2])))
    with pytest.raises(ValueError, match="reach every node"):
        fundamental_cycles(network(4, [(0, 1), (2, 3)]), shortest_path_tree(ring(4), 0))


# --- misclosures ---------------------------------------------------------------------------------


def test_true_poses_close_and_a_shift_shows_in_the_first_nodes_axes():
    graph, _ = measured(grid(3))
    for cycle in minimum_cycle_basis(graph):
        found = misclosure(graph, cycle)
        np.testing.assert_allclose(found.twist, 0.0, atol=1e-12)
        assert found.p_value == pytest.approx(1.0)
    # The last edge of a cycle ends at its first node.
    cycle = next(c for c in fundamental_cycles(graph) if c[-1][1] > 0)
    moved, shift = graph.pose.copy(), [1e-3, -2e-3, 3e-3]
    moved[cycle[-1][0], 3:] += matrix(moved[cycle[-1][0]])[:3, :3] @ shift
    found = misclosure(replace(graph, pose=moved), cycle).twist
    np.testing.assert_allclose(found, [0, 0, 0, *shift], atol=1e-12)


def test_misclosures_have_the_covariance_told_and_a_chi_squared_statistic():
    truth, _ = measured(network(5, [(0, 1), (2, 1), (2, 3), (4, 3), (4, 0)]))
    cycle = fundamental_cycles(truth)[0]
    assert {sign for _, sign in cycle} == {1, -1}
    # measured = true . exp(-twist) and the twists are symmetric.
    poses = draws(truth, 20_000)
    assert_same_covariance(small_twists(product(poses, cycle)), misclosure(truth, cycle).covariance)
    statistics = []
    for edges in poses[:1500]:
        found = misclosure(replace(truth, pose=vectors(edges)), cycle)
        statistics.append(found.statistic)
    assert np.mean(statistics) == pytest.approx(6.0, abs=SIGMAS * np.sqrt(12.0 / 1500))
    assert kstest(statistics, "chi2", args=(6,)).pvalue > 1e-3


def test_large_misclosures_are_logarithms():
    turn = np.array([0.3, -0.5, 0.2])
    graph = network(2, [(0, 1), (0, 1)], np.array([[*turn, 1, 2, 3], [0, 0, 0, 0, 0, 0]]))
    found = misclosure(graph, [(0, 1), (1, -1)]).twist
    np.testing.assert_allclose(expm(twist_matrices(found)), matrix(graph.pose[0]), atol=1e-12)


def test_misclosure_names_what_it_can_not_use():
    with pytest.raises(ValueError, match='edge "e1" ends at n2 and the next begins at n0'):
        misclosure(ring(4), [(0, 1), (1, 1)])
    flat = replace(ring(3), covariance=np.zeros((3, 6, 6)))
    with pytest.raises(ValueError, match="singular"):
        misclosure(flat, fundamental_cycles(flat)[0])


# --- weakness ------------------------------------------------------------------------------------


@given(graphs())
def test_bridges_are_the_edges_that_part_the_network(graph):
    expected = []
    for k in range(len(graph.edges)):
        without = network(len(graph.names), np.delete(graph.edges, k, axis=0))
        if len(components(without)) > len(components(graph)):
            expected.append(k)
    assert bridges(graph).tolist() == expected


def test_resistances_of_rings_and_complete_graphs():
    """MATHEMATICS 1.6: loops 1 - 1/n and a (n - a) / n; all pairs of m: 2 / m."""
    for n in (3, 16, 101):
        for a in range(1, n):
            expected = a * (n - a) / n
            assert effective_resistance(ring(n), 0, a, np.ones(n)) == pytest.approx(expected)
    assert effective_resistance(ring(16), 3, 4, np.ones(16)) == pytest.approx(0.9375)
    for m in (3, 4, 6, 8):
        graph = complete(m)
        unit = np.ones(len(graph.edges))
        assert effective_resistance(graph, 0, m - 1, 5.0 * unit) == pytest.approx(10.0 / m)
        np.testing.assert_allclose(redundancy_numbers(graph, unit), 1.0 - 2.0 / m)


@pytest.mark.parametrize("k", [5, 20])
def test_resistance_of_a_ladder(k):
    """MATHEMATICS 1.6: k / 2 + 0.11, rungs of a quarter of the links' variance."""
    variance = np.concatenate([np.ones(2 * k), np.full(k + 1, 0.25)])
    found = effective_resistance(ladder(k), 0, 2 * k, variance)
    assert found == pytest.approx(0.5 * k + 0.1124, abs=1e-4)


def test_resistance_without_a_way_and_of_nothing():
    graph = network(4, [(0, 1), (2, 3)])
    assert effective_resistance(graph, 0, 3) == np.inf
    assert effective_resistance(graph, 1, 1) == 0.0
    with pytest.raises(ValueError, match='variance of edge "e1" is 0.0'):
        effective_resistance(graph, 0, 1, np.array([1.0, 0.0]))


@given(graphs(), st.integers(0, 5))
@settings(deadline=None)
def test_redundancy_is_that_of_dense_least_squares_and_sums_to_the_conditions(graph, seed):
    variance = weights(graph, seed)
    m, n = len(graph.edges), len(graph.names)
    found = redundancy_numbers(graph, variance)
    assert found.sum() == pytest.approx(n_conditions(graph), abs=1e-9)
    design = np.zeros((m, n))
    np.add.at(design, (np.arange(m), graph.edges[:, 1]), 1.0)
    np.add.at(design, (np.arange(m), graph.edges[:, 0]), -1.0)
    design /= np.sqrt(variance)[:, None]
    hat = design @ np.linalg.pinv(design)
    np.testing.assert_allclose(found, 1.0 - np.diag(hat), atol=1e-9)
    assert set(bridges(graph)) == set(np.flatnonzero(found < 1e-9))


def test_redundancy_of_a_large_network_sums_to_the_conditions():
    graph = grid(40)
    found = redundancy_numbers(graph, weights(graph))
    assert found.sum() == pytest.approx(n_conditions(graph), abs=1e-8)


def test_weak_edges_are_named_with_their_mend():
    graph = network(5, [(0, 1), (1, 2), (2, 0), (2, 3), (3, 4), (3, 4)])
    variance = np.array([1.0, 1.0, 1.0, 1.0, 0.01, 1.0])
    found = weak_edges(graph, 0.1, variance)
    assert [w.name for w in found] == ["e3", "e4"]
    assert found[0].redundancy == 0.0 and 'edge "e3" (n2 to n3) is in no' in found[0].words()
    assert found[1].redundancy == pytest.approx(0.01 / 1.01)
    assert "only 0.99 % of an error" in found[1].words()
    assert {w.name for w in weak_edges(graph, 0.5, variance)[2:]} == {"e0", "e1", "e2"}
    assert weak_edges(complete(5)) == []


# --- effects of cycles ---------------------------------------------------------------------------


def test_share_of_a_ring_and_of_a_weak_chord():
    for n, v in ((2, 1.0), (5, 1.0), (5, 1e3), (8, 0.5)):
        graph = ring(n) if n > 2 else network(2, [(0, 1), (0, 1)])
        variance = np.array([1.0] * (n - 1) + [v])
        (effect,) = cycle_effects(graph, fundamental_cycles(graph), variance)
        # The heaviest edge is outside the best tree.
        worst = max(v, 1.0)
        assert effect.share == pytest.approx(1.0 - worst / (n - 1 + v))
        assert effect.taken == pytest.approx(worst / (n - 1 + v))
    graph = ring(5)
    variance = np.array([1.0, 1, 1e4, 1, 1])
    (effect,) = cycle_effects(graph, fundamental_cycles(graph), variance)
    assert not effect.effective and effect.name == "e2"
    assert "leaves the network as it is" in effect.words()


@pytest.mark.parametrize("basis", [fundamental_cycles, minimum_cycle_basis])
@pytest.mark.parametrize("graph", [ladder(4), complete(5), grid(4), PARALLEL])
def test_shares_are_what_leaving_one_cycle_out_costs(graph, basis):
    variance = weights(graph)
    cycles = basis(graph)
    rows = np.zeros((len(cycles), len(graph.edges)))
    for row, cycle in zip(rows, cycles, strict=True):
        for edge, sign in cycle:
            row[edge] = sign

    def relative(kept):
        across = kept * variance
        left = np.diag(variance) - across.T @ np.linalg.pinv(across @ kept.T) @ across
        return np.diag(left) / variance

    everything, tree = relative(rows), spanning_tree(graph, variance)
    # Kept conditions leave what redundancy numbers tell.
    np.testing.assert_allclose(1.0 - everything, redundancy_numbers(graph, variance), atol=1e-10)
    for c, effect in enumerate(cycle_effects(graph, cycles, variance)):
        cost = relative(np.delete(rows, c, axis=0)) - everything
        assert cost.sum() == pytest.approx(1.0)
        assert effect.share == pytest.approx(cost[tree].sum())
        assert effect.taken == pytest.approx(cost.max()) == pytest.approx(cost[effect.edge])


def test_dependent_cycles_are_refused():
    first, second = fundamental_cycles(ladder(2))
    with pytest.raises(ValueError, match="not independent"):
        cycle_effects(ladder(2), [first, second, first])
    assert cycle_effects(network(3, []), []) == []
