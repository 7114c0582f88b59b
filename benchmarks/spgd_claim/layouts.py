"""Networks of stations joined by measured relative poses, with known truth, of any size.

Links are 10 m long, their turns good to 20 urad and their shifts to 0.2 mm in all directions (the
chain of MATHEMATICS 1.6): a turn moves the next station as far as a shift does.
"""

from dataclasses import dataclass

import jax
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import Delaunay, cKDTree
from scipy.spatial.transform import Rotation

from jaxvm.geometry import pose_from_vector, se3_exp, vector_from_pose
from jaxvm.network.graph import PoseGraph, Tree, chain_poses
from jaxvm.recording.model import Closure, Model, Station
from jaxvm.recording.recording import Links, Recording, no_observations, uncorrelated

LENGTH_M, SIGMA_RAD, SIGMA_M = 10.0, 20e-6, 0.2e-3
SIGMA = np.repeat([SIGMA_RAD, SIGMA_M], 3)
TURN_RAD = 1.2
"""Stations are turned by up to so much about each axis."""

ROUGH = 1000.0
"""A rough start: every station off by so many standard deviations of a link, on its own."""

_CANDIDATES = 16
"""Nearest stations that a station of a random network may be linked to."""


@dataclass(frozen=True, eq=False)
class Layout:
    """A network as a graph, its true poses, and two starts.

    Attributes:
        graph: measured links; station 0 is held.
        truth: world_from_station.
        reckoned: by dead reckoning along a depth-first tree from station 0.
        rough: the truth, every station off on its own by `ROUGH` standard deviations.
    """

    graph: PoseGraph
    truth: np.ndarray
    reckoned: np.ndarray
    rough: np.ndarray

    def recording(self) -> Recording:
        """As a recording of links alone; the stations are given at their true poses."""
        free = frozenset({"pose"})
        stations = tuple(
            Station(name, "static", pose, free if i else frozenset())
            for i, (name, pose) in enumerate(zip(self.graph.names, self.truth, strict=True))
        )
        return _recording(self.graph, stations)


def layout(kind: str, n: int, seed: int) -> Layout:
    """A network of n stations: "ring", "ladder", or "random 2" with 2 links for each station."""
    rng = np.random.default_rng([seed, n])
    points, edges = _places(kind, n, rng)
    truth = np.hstack([rng.uniform(-TURN_RAD, TURN_RAD, (n, 3)), points])
    graph = _measured(truth, edges, rng)
    off = ROUGH * SIGMA * rng.standard_normal((n, 6))
    off[0] = 0.0
    return Layout(graph, truth, reckoned(graph, truth[0]), truth + off)


def possible(kind: str, n: int) -> bool:
    """Whether n stations have pairs enough, and a random network links to spare beyond a tree."""
    if not kind.startswith("random"):
        return n >= 4
    return n - 1 < _count(kind, n) <= n * (n - 1) // 2


def _count(kind: str, n: int) -> int:
    return round(float(kind.split()[1]) * n)


def _places(kind: str, n: int, rng) -> tuple[np.ndarray, np.ndarray]:
    """Points (m) and pairs of stations."""
    points = np.zeros((n, 3))
    each = np.arange(n)
    if kind == "ring":
        angle, radius = 2.0 * np.pi * each / n, 0.5 * LENGTH_M / np.sin(np.pi / n)
        points[:, 0], points[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
        return points, np.stack([each, (each + 1) % n], axis=1)
    if kind == "ladder":
        points[:, 0], points[:, 1] = each // 2 * LENGTH_M, each % 2 * LENGTH_M
        rungs = np.stack([each[: n - 1 : 2], each[: n - 1 : 2] + 1], axis=1)
        return points, np.concatenate([rungs, np.stack([each[:-2], each[2:]], axis=1)])
    points[:, :2] = rng.uniform(0.0, LENGTH_M * np.sqrt(n), (n, 2))
    return points, _random_pairs(points, _count(kind, n), rng)


def _random_pairs(points: np.ndarray, count: int, rng) -> np.ndarray:
    """The least spanning tree of points, and random ones of the other pairs of near points."""
    n = len(points)
    _, near = cKDTree(points).query(points, min(_CANDIDATES, n - 1) + 1)
    pairs = np.stack([np.repeat(np.arange(n), near.shape[1] - 1), near[:, 1:].ravel()], axis=1)
    triangles = Delaunay(points[:, :2]).simplices
    pairs = np.concatenate([pairs, triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, ::2]])
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    least = minimum_spanning_tree(coo_array((length, pairs.T), shape=(n, n)).tocsr()).tocoo()
    tree = np.sort(np.stack([least.row, least.col], axis=1), axis=1)
    assert connected_components(least)[0] == 1
    others = np.setdiff1d(pairs @ [n, 1], tree @ [n, 1])
    chosen = np.sort(rng.permutation(others)[: count - len(tree)])
    both = np.concatenate([tree, np.stack([chosen // n, chosen % n], axis=1)])
    assert len(both) == count
    return both


def _measured(truth: np.ndarray, edges: np.ndarray, rng) -> PoseGraph:
    """Links between true poses, measured = true . exp(-twist)."""
    twist = SIGMA * rng.standard_normal((len(edges), 6))
    a, b = edges.T
    pose = np.array(_link(truth[a], truth[b], twist))
    names = tuple(f"s{i}" for i in range(len(truth)))
    spread = np.full(len(edges), SIGMA_RAD), np.full(len(edges), SIGMA_M)
    return PoseGraph(
        names, edges, tuple(f"{i}-{j}" for i, j in edges.tolist()), pose,
        uncorrelated(*spread), np.zeros(1, int),
    )  # fmt: skip


@jax.jit
@jax.vmap
def _link(a, b, twist):
    relative = pose_from_vector(a).inverse() @ pose_from_vector(b)
    return vector_from_pose(relative @ se3_exp(-twist))


def reckoned(graph: PoseGraph, first: np.ndarray) -> np.ndarray:
    """World_from_station by dead reckoning along a depth-first tree from station 0."""
    return chain_poses(graph, first[None], depth_first_tree(graph))


def depth_first_tree(graph: PoseGraph) -> Tree:
    """Ways from station 0 that go on while they can: the longest chains, the worst start."""
    n = len(graph.names)
    ahead: list[list[tuple[int, int, int]]] = [[] for _ in range(n)]
    for edge, (a, b) in enumerate(graph.edges.tolist()):
        ahead[a].append((b, edge, 1))
        ahead[b].append((a, edge, -1))
    parent, through, sign, depth = np.zeros((4, n), int) - [[1], [1], [0], [1]]
    depth[0], order, ways = 0, [0], [(0, iter(ahead[0]))]
    while ways:
        node, left = ways[-1]
        for to, edge, way in left:
            if depth[to] < 0:
                parent[to], through[to], sign[to], depth[to] = node, edge, way, depth[node] + 1
                order.append(to)
                ways.append((to, iter(ahead[to])))
                break
        else:
            ways.pop()
    return Tree(np.zeros(1, int), parent, through, sign, np.array(order), depth)


def closed_ring(n: int, seed: int, sigma: float) -> Recording:
    """A ring of n links as the unknowns themselves, under one closure.

    Args:
        sigma: standard deviation of the closure, in units of that of a link.
    """
    made = layout("ring", n, seed)
    closed = Closure(
        tuple((name, 1) for name in made.graph.edge_names), sigma * SIGMA_RAD, sigma * SIGMA_M
    )
    stations = tuple(Station(name, "static", np.zeros(6), frozenset()) for name in made.graph.names)
    return _recording(made.graph, stations, (closed,))


def _recording(graph: PoseGraph, stations, closures: tuple[Closure, ...] = ()) -> Recording:
    links = Links(
        name=graph.edge_names,
        from_node=[("station", a) for a in graph.edges[:, 0].tolist()],
        to_node=[("station", b) for b in graph.edges[:, 1].tolist()],
        pose=graph.pose,
        covariance=graph.covariance,
        epoch=np.full(len(graph.edges), -1),
    )
    model = Model("network", (), stations, (), closures=closures)
    return Recording(
        model, np.zeros(1, int), np.zeros(1), {}, no_observations(), links=links, timed=False
    )


def attitude_error(poses: np.ndarray, truth: np.ndarray) -> float:
    """Largest angle (rad) between poses and the truth."""
    own, true = (Rotation.from_rotvec(p[:, :3]) for p in (poses, truth))
    return float((own.inv() * true).magnitude().max())
