"""Condition adjustment against an independent parametric one, closed forms and Monte Carlo."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxvm.network.graph import PoseGraph
from jaxvm.pose.chains import Link
from jaxvm.pose.relay import adjust_relay
from jaxvm.solve.condition import adjust_conditions

TRIALS = 1000


# SE(3) with 4x4 and 6x6 matrices, apart from what jaxvm does


def hat(w):
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def matrix(vector):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:]
    return out


def exponential(twist):
    return expm(np.block([[hat(twist[:3]), twist[3:, None]], [np.zeros((1, 4))]]))


def series(x, sign):
    """sum (sign x)^n / (n + 1)!: the left (1) or right (-1) Jacobian of a matrix group."""
    total, term = np.eye(len(x)), np.eye(len(x))
    for n in range(2, 60):
        term = sign * term @ x / n
        total = total + term
    return total


def logarithm(pose):
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    return np.append(turn, np.linalg.solve(series(hat(turn), 1), pose[:3, 3]))


def adjoint(pose):
    r, t = pose[:3, :3], pose[:3, 3]
    return np.block([[r, np.zeros((3, 3))], [hat(t) @ r, r]])


def small_adjoint(twist):
    w = hat(twist[:3])
    return np.block([[w, np.zeros((3, 3))], [hat(twist[3:]), w]])


def vector(pose):
    return np.append(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3])


def parametric(graph, node):
    """Dense Gauss-Newton over the poses of all nodes but the first, started at given ones.

    Returns residual twists log(measured^-1 . adjusted), their covariance, and the sum of squares.
    """
    node = [n.copy() for n in node]
    measured = [matrix(v) for v in graph.pose]
    weight = block_diag(*np.linalg.inv(graph.covariance))
    for _ in range(60):
        slope, residual = np.zeros((6 * len(measured), 6 * len(node))), []
        for e, (a, b) in enumerate(graph.edges):
            between = np.linalg.inv(node[a]) @ node[b]
            twist = logarithm(np.linalg.inv(measured[e]) @ between)
            right = np.linalg.inv(series(small_adjoint(twist), -1))
            rows = slice(6 * e, 6 * e + 6)
            slope[rows, 6 * b : 6 * b + 6] += right
            slope[rows, 6 * a : 6 * a + 6] -= right @ adjoint(np.linalg.inv(between))
            residual.append(twist)
        residual, slope = np.concatenate(residual), slope[:, 6:]
        normal = slope.T @ weight @ slope
        change = -np.linalg.solve(normal, slope.T @ weight @ residual)
        node[1:] = [
            n @ exponential(c) for n, c in zip(node[1:], change.reshape(-1, 6), strict=True)
        ]
        if np.abs(change).max() < 1e-13:
            break
    spread = slope @ np.linalg.solve(normal, slope.T)
    return residual.reshape(-1, 6), spread, residual @ weight @ residual


# Networks


def network(edges, node, spread, rng, scale=1.0):
    """Measured relative poses of true nodes, with noise of the covariances (times scale^2)."""
    pose = []
    for (a, b), covariance in zip(edges, spread, strict=True):
        noise = scale * np.linalg.cholesky(covariance) @ rng.normal(size=6)
        pose.append(vector(np.linalg.inv(node[a]) @ node[b] @ exponential(-noise)))
    return PoseGraph(
        names=tuple(f"n{i}" for i in range(len(node))),
        edges=np.array(edges),
        edge_names=tuple(f"e{i}" for i in range(len(edges))),
        pose=np.array(pose),
        covariance=np.array(spread),
        held=np.array([0]),
    )


def random_network(seed, nodes=7, extra=8, sigma=0.03):
    """A random tree and random chords: some edges twice, full covariances of very unlike size."""
    rng = np.random.default_rng(seed)
    edges = [(int(rng.integers(i)), i) for i in range(1, nodes)]
    edges += [tuple(map(int, rng.choice(nodes, 2, replace=False))) for _ in range(extra - 1)]
    edges += [edges[2][::-1]]
    edges = [edge[:: int(rng.choice([1, -1]))] for edge in edges]
    node = [matrix(np.append(rng.normal(0, 1, 3), rng.normal(0, 2, 3))) for _ in range(nodes)]
    root = sigma * rng.normal(size=(len(edges), 6, 6)) * rng.uniform(0.1, 1, (len(edges), 1, 1))
    return network(edges, node, root @ root.transpose(0, 2, 1), rng), node


def fundamental(graph):
    """Cycle of each edge outside the tree of the first edges that reach each node."""
    to_root, chords = {0: []}, []
    waiting = list(range(len(graph.edges)))
    while waiting:
        for e in list(waiting):
            a, b = graph.edges[e]
            if a in to_root and b in to_root:
                continue
            waiting.remove(e)
            if a in to_root:
                to_root[b] = [(e, -1), *to_root[a]]
            elif b in to_root:
                to_root[a] = [(e, 1), *to_root[b]]
            else:
                waiting.append(e)
        chords += [e for e in waiting if all(n in to_root for n in graph.edges[e])]
        waiting = [e for e in waiting if e not in chords]

    def walk(e):
        a, b = graph.edges[e]
        out, back = to_root[b], to_root[a]
        return [(e, 1), *out, *((f, -s) for f, s in reversed(back))]

    return [walk(e) for e in chords]


def effective_resistance(edges, nodes, resistance):
    laplacian = np.zeros((nodes, nodes))
    ends = np.zeros((len(edges), nodes))
    for e, (a, b) in enumerate(edges):
        ends[e, a], ends[e, b] = 1.0, -1.0
        laplacian += np.outer(ends[e], ends[e]) / resistance[e]
    return np.einsum("en,nm,em->e", ends, np.linalg.pinv(laplacian), ends)


@pytest.mark.parametrize("seed", range(6))
def test_conditions_and_parameters_give_the_same(seed):
    """Poses, sum of squares and covariances of random multigraphs agree to 1e-9."""
    graph, node = random_network(seed)
    got = adjust_conditions(graph, fundamental(graph))
    residual, spread, squares = parametric(graph, node)
    assert got.converged
    assert got.redundancy == 6 * (len(graph.edges) - len(graph.names) + 1)
    np.testing.assert_allclose(got.squares, squares, rtol=1e-9)
    for e in range(len(graph.edges)):
        expected = matrix(graph.pose[e]) @ exponential(residual[e])
        np.testing.assert_allclose(matrix(got.pose[e]), expected, atol=1e-9)
    joint = got.joint_covariance
    np.testing.assert_allclose(joint, spread, atol=1e-9 * np.abs(spread).max())
    blocks = joint.reshape(-1, 6, len(graph.edges), 6)
    for e, own in enumerate(got.covariance):
        np.testing.assert_allclose(own, blocks[e, :, e], atol=1e-12 * np.abs(own).max())
    assert got.edge_redundancy.sum() == pytest.approx(got.redundancy, rel=1e-9)


def test_large_errors_of_long_networks_converge_to_the_same():
    """Turns of a tenth of a radian around twenty nodes: many iterations, no other answer."""
    graph, node = random_network(11, nodes=20, extra=5, sigma=0.1)
    got = adjust_conditions(graph, fundamental(graph))
    _, _, squares = parametric(graph, node)
    assert got.converged and got.iterations > 3
    np.testing.assert_allclose(got.squares, squares, rtol=1e-9)


def test_any_basis_of_the_cycles_and_any_start_of_a_walk_give_the_same():
    graph, _ = random_network(3)
    cycles = fundamental(graph)
    first = adjust_conditions(graph, cycles)
    turned = [[(e, -s) for e, s in reversed(walk)] for walk in cycles]
    moved = [walk[1:] + walk[:1] for walk in turned]
    second = adjust_conditions(graph, moved)
    np.testing.assert_allclose(second.pose, first.pose, atol=1e-10)
    np.testing.assert_allclose(second.squares, first.squares, rtol=1e-10)
    np.testing.assert_allclose(
        second.covariance, first.covariance, atol=1e-10 * np.abs(first.covariance).max()
    )


def test_an_edge_walked_twice_counts_twice():
    """Figure of eight around a shared edge: two loops in one walk, and one of them alone."""
    graph, _ = square_with_diagonal()
    # n0 n1 n2 n0 and n0 n2 n3 n0; their walk in a row passes n2 n0 once, and n0 n2 once.
    loops = [[(0, 1), (1, 1), (4, -1)], [(4, 1), (2, 1), (3, 1)]]
    in_a_row = [loops[0] + loops[1], loops[1]]
    twice = [loops[0] + loops[0] + loops[1], loops[1]]
    expected = adjust_conditions(graph, loops)
    for cycles in (in_a_row, twice):
        got = adjust_conditions(graph, cycles)
        np.testing.assert_allclose(got.pose, expected.pose, atol=1e-10)
        np.testing.assert_allclose(got.squares, expected.squares, rtol=1e-9)


def square_with_diagonal():
    rng = np.random.default_rng(2)
    edges = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (3, 4)]
    node = [matrix(np.append(rng.normal(0, 1, 3), rng.normal(0, 2, 3))) for _ in range(5)]
    return network(edges, node, np.tile(1e-4 * np.eye(6), (6, 1, 1)), rng), node


@pytest.mark.parametrize("n", [3, 5, 16])
def test_a_loop_of_n_edges(n):
    """sigma^2 (1 - 1/n) for each edge, sigma^2 a (n - a)/n for nodes a apart."""
    edges = [(i, (i + 1) % n) for i in range(n)]
    graph = in_place(edges, n, np.full(n, 4e-6))
    got = adjust_conditions(graph, [[(e, 1) for e in range(n)]])
    np.testing.assert_allclose(
        got.covariance, np.tile((1 - 1 / n) * 4e-6 * np.eye(6), (n, 1, 1)), atol=1e-18
    )
    np.testing.assert_allclose(got.edge_redundancy, 6 / n)
    # Errors of a edges in a row, carried into the axes of the last one.
    a = n // 2
    carry, rest = np.zeros((6, 6 * n)), np.eye(4)
    for e in range(a - 1, -1, -1):
        carry[:, 6 * e : 6 * e + 6] = adjoint(np.linalg.inv(rest))
        rest = matrix(got.pose[e]) @ rest
    row = carry @ got.joint_covariance @ carry.T
    np.testing.assert_allclose(row, 4e-6 * a * (n - a) / n * np.eye(6), atol=1e-18)


def in_place(edges, nodes, variance, noise=0.0):
    """Nodes in one place, turned anyhow; isotropic variances."""
    rng = np.random.default_rng(1)
    node = [matrix(np.append(rng.normal(0, 1, 3), np.zeros(3))) for _ in range(nodes)]
    return network(edges, node, np.asarray(variance)[:, None, None] * np.eye(6), rng, noise)


def test_adjusted_variances_are_effective_resistances():
    """A random multigraph in one place: every edge a resistor of its variance."""
    rng = np.random.default_rng(7)
    graph, _ = random_network(5, nodes=9, extra=10)
    variance = rng.uniform(1e-8, 1e-6, len(graph.edges))
    graph = in_place(graph.edges, 9, variance)
    got = adjust_conditions(graph, fundamental(graph))
    resistance = effective_resistance(graph.edges, 9, variance)
    expected = resistance[:, None, None] * np.eye(6)
    np.testing.assert_allclose(got.covariance, expected, atol=1e-10 * variance.max())
    # Foster: redundancies of the edges add up to the number of cycles.
    np.testing.assert_allclose(got.edge_redundancy, 6 * (1 - resistance / variance), rtol=1e-8)


def test_a_station_by_conditions_is_the_station_by_parameters():
    """All pairs of five cameras: `adjust_relay` holds the loops without writing them down."""
    rng = np.random.default_rng(9)
    edges = [(a, b) for a in range(5) for b in range(a + 1, 5)]
    node = [matrix(np.append(rng.normal(0, 1, 3), rng.normal(0, 0.3, 3))) for _ in range(5)]
    root = 1e-3 * rng.normal(size=(10, 6, 6))
    graph = network(edges, node, root @ root.transpose(0, 2, 1), rng)
    got = adjust_conditions(graph, fundamental(graph))
    relay = adjust_relay(graph.edges, Link(graph.pose, graph.covariance))
    np.testing.assert_allclose(relay.correction, got.correction, atol=1e-12)
    np.testing.assert_allclose(relay.squares, got.squares, rtol=1e-9)
    for e, (a, b) in enumerate(edges):
        link = relay.between(a, b)
        np.testing.assert_allclose(link.pose, got.pose[e], atol=1e-12)
        # Its twist is that of the adjusted pose, ours that of the measured one.
        right = series(small_adjoint(got.correction[e]), -1)
        expected = right @ got.covariance[e] @ right.T
        np.testing.assert_allclose(link.covariance, expected, atol=1e-9 * np.abs(expected).max())


def test_misclosures_are_the_products_around_the_cycles():
    graph, node = square_with_diagonal()
    cycles = [[(0, 1), (1, 1), (4, -1)], [(0, 1), (1, 1), (2, 1), (3, 1)]]
    got = adjust_conditions(graph, cycles)
    t = [matrix(v) for v in graph.pose]
    np.testing.assert_allclose(
        got.misclosure,
        [logarithm(t[0] @ t[1] @ np.linalg.inv(t[4])), logarithm(t[0] @ t[1] @ t[2] @ t[3])],
        atol=1e-12,
    )
    # After it the loops close, and the edge that is in none is as it was.
    t = [matrix(v) for v in got.pose]
    np.testing.assert_allclose(t[0] @ t[1] @ np.linalg.inv(t[4]), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(t[0] @ t[1] @ t[2] @ t[3], np.eye(4), atol=1e-12)
    assert np.array_equal(got.correction[5], np.zeros(6))
    np.testing.assert_allclose(got.covariance[5], graph.covariance[5], rtol=1e-14)


def test_a_thousand_adjustments_scatter_as_predicted():
    """Errors of adjusted edges, sums of squares and misclosures within chi-square bounds."""
    rng = np.random.default_rng(12)
    graph, node = random_network(4, nodes=5, extra=3, sigma=1e-4)
    cycles = fundamental(graph)
    true = [np.linalg.inv(node[a]) @ node[b] for a, b in graph.edges]
    exact = replace(graph, pose=np.array([vector(t) for t in true]))
    predicted = adjust_conditions(exact, cycles)
    sums = np.zeros((TRIALS, 5))
    for trial in range(TRIALS):
        drawn = network(graph.edges, node, graph.covariance, rng)
        got = adjust_conditions(drawn, cycles)
        sums[trial, 0] = got.squares
        w, spread = got.misclosure[0], predicted.misclosure_covariance[0]
        sums[trial, 1] = w @ np.linalg.solve(spread, w)
        for k, e in enumerate((0, 1, 2)):
            error = logarithm(np.linalg.inv(matrix(got.pose[e])) @ true[e])
            sums[trial, 2 + k] = error @ np.linalg.solve(predicted.covariance[e], error)
    degrees = np.array([predicted.redundancy, 6, 6, 6, 6])
    low, high = chi2.ppf([[0.001], [0.999]], degrees * TRIALS) / TRIALS
    assert (low < sums.mean(axis=0)).all() and (sums.mean(axis=0) < high).all()
    # Not only the mean: the whole distribution of the sum of squares.
    above = (sums[:, 0] > chi2.ppf(0.95, predicted.redundancy)).mean()
    assert abs(above - 0.05) < 4 * np.sqrt(0.05 * 0.95 / TRIALS)


def test_without_cycles_nothing_changes():
    graph, _ = square_with_diagonal()
    got = adjust_conditions(graph, [])
    np.testing.assert_allclose(got.pose, graph.pose, atol=1e-14)
    assert np.array_equal(got.covariance, graph.covariance)
    assert got.redundancy == 0 and got.squares == 0.0 and got.converged


@pytest.mark.parametrize(
    "cycles, message",
    [
        (
            [[(0, 1), (1, 1)]],
            r"cycle 0 \(e0 e1\) is not closed: e1 leads to n2, e0 goes on from n0",
        ),
        ([[(0, 1), (1, -1), (4, 1)]], "e0 leads to n1, e1 goes on from n2"),
        ([[]], "cycle 0 has no edges"),
        ([[(9, 1)]], r"entry \(9, 1\): an edge is a number from 0 to 5"),
        ([[(0, 2)]], r"entry \(0, 2\).*its direction 1 or -1"),
        ([[(0, 1), (0, -1)]], r"cycle 0 \(e0 -e0\) walks each edge as often back as forth"),
        (
            [
                [(0, 1), (1, 1), (4, -1)],
                [(4, 1), (2, 1), (3, 1)],
                [(0, 1), (1, 1), (2, 1), (3, 1)],
            ],
            r"cycle 2 \(e0 e1 e2 e3\) is implied by cycle 0 \(e0 e1 -e4\), 1 \(e4 e2 e3\)",
        ),
    ],
)
def test_cycles_that_are_none_are_named(cycles, message):
    graph, _ = square_with_diagonal()
    with pytest.raises(ValueError, match=message):
        adjust_conditions(graph, cycles)


def test_two_held_nodes_of_one_part_are_named():
    graph, _ = square_with_diagonal()
    with pytest.raises(ValueError, match="n0, n3 are held and joined"):
        adjust_conditions(replace(graph, held=np.array([0, 3])), [])
