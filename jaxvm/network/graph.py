"""Networks as graphs: bodies joined by measured or calibrated relative poses."""

from dataclasses import dataclass

import numpy as np
import rustworkx as rx
from jaxtyping import Float, Int
from rustworkx.visit import BFSVisitor, DijkstraVisitor
from scipy.spatial.transform import Rotation

from jaxvm.geometry.matrices import adjoint_of_inverse, matrices, vector

Walk = list[tuple[int, int]]
"""Edges walked one after the other, each with +1 (from its from to its to) or -1 (backward)."""


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Nodes and the relative poses that were measured between them.

    Several edges may join the same two nodes. An edge is measured = true . exp(-twist), that is
    twist = log(measured^-1 . true), turn (rad) then shift (m), with the covariance given.

    Attributes:
        names: of the nodes, as they stand in a sentence: station "bow".
        edges: from and to, places in `names`.
        edge_names: of the edges.
        pose: from_from_to of each edge as turn (rad) and shift (m).
        covariance: of the twist of each edge.
        held: nodes whose pose is known: the gauge.
    """

    names: tuple[str, ...]
    edges: Int[np.ndarray, "edges 2"]
    edge_names: tuple[str, ...]
    pose: Float[np.ndarray, "edges 6"]
    covariance: Float[np.ndarray, "edges 6 6"]
    held: Int[np.ndarray, " held"]


class UnconnectedNetwork(ValueError):
    """No chain of edges joins nodes that have to be joined; the message names the parts."""


@dataclass(frozen=True, eq=False)
class Tree:
    """Ways from the roots to all nodes that edges reach: a tree, or one for each root.

    Attributes:
        roots: nodes where the ways begin.
        parent: the node before each node; -1 at the roots and at nodes not reached.
        edge: from the parent to each node; -1 where there is no parent.
        sign: +1 where that edge is measured from the parent to the node, -1 where backward, else 0.
        order: the nodes reached, each after its parent.
        depth: edges between each node and its root; -1 where not reached.
    """

    roots: Int[np.ndarray, " roots"]
    parent: Int[np.ndarray, " nodes"]
    edge: Int[np.ndarray, " nodes"]
    sign: Int[np.ndarray, " nodes"]
    order: Int[np.ndarray, " reached"]
    depth: Int[np.ndarray, " nodes"]

    def way_to(self, node: int) -> Walk:
        """The edges from the root to a node."""
        steps = []
        while self.parent[node] >= 0:
            steps.append((int(self.edge[node]), int(self.sign[node])))
            node = self.parent[node]
        return steps[::-1]


@dataclass(frozen=True, eq=False)
class Path:
    """A way through the network and what it measures.

    Attributes:
        steps: the edges from a to b.
        pose: a_from_b along them, as turn (rad) and shift (m).
        covariance: of the twist log(pose^-1 . true), turn (rad) then shift (m), in b's axes.
    """

    steps: Walk
    pose: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "6 6"]


def components(graph: PoseGraph) -> list[Int[np.ndarray, " part"]]:
    """Nodes of each connected part, in ascending order; parts in the order of their first node."""
    parts = rx.connected_components(_with_edges(graph, np.arange(len(graph.edges))))
    return sorted((np.array(sorted(part)) for part in parts), key=lambda part: part[0])


def n_conditions(graph: PoseGraph) -> int:
    """Number of independent cycles E - V + C; for poses each is six conditions.

    Every held node of a part beyond its first adds six conditions more, which are not counted here.
    """
    return len(graph.edges) - len(graph.names) + len(components(graph))


def unheld_parts(graph: PoseGraph) -> list[Int[np.ndarray, " part"]]:
    """Parts without a held node: no observation tells where they are."""
    return [part for part in components(graph) if not np.isin(part, graph.held).any()]


def check_connected(graph: PoseGraph) -> None:
    """Raise UnconnectedNetwork, naming the parts, where edges don't join all nodes to held ones."""
    parts = unheld_parts(graph)
    if not parts:
        return
    listed = "; ".join(_names(graph, part) for part in parts[:3])
    more = f"; and {len(parts) - 3} more parts" if len(parts) > 3 else ""
    raise UnconnectedNetwork(
        f"no chain of edges joins these nodes to one with a known pose: {listed}{more}; "
        "record an edge that joins each part to the rest, or hold one of its nodes"
    )


def _names(graph: PoseGraph, nodes) -> str:
    shown = ", ".join(graph.names[node] for node in nodes[:6])
    return shown + (f" and {len(nodes) - 6} more" if len(nodes) > 6 else "")


def typical_length(graph: PoseGraph) -> float:
    """Median length (m) of the edges that have one; 1 m where none has."""
    length = np.linalg.norm(graph.pose[:, 3:], axis=1)
    return float(np.median(length[length > 0.0])) if (length > 0.0).any() else 1.0


def edge_variance(graph: PoseGraph, length_m: float | None = None) -> Float[np.ndarray, " edges"]:
    """One variance (m^2) for each edge: its shift, and its turn at the end of a lever.

    tr(turn) / 3 . length^2 + tr(shift) / 3 of the covariance: the mean variance along an axis of
    the shift, and of what a turn moves over that length. It is a scale to choose ways by, not the
    variance of a result.

    Args:
        length_m: lever arm at which a turn counts; `typical_length` if not given.
    """
    length = typical_length(graph) if length_m is None else length_m
    diagonal = np.diagonal(graph.covariance, axis1=1, axis2=2)
    return diagonal[:, :3].mean(axis=1) * length**2 + diagonal[:, 3:].mean(axis=1)


def spanning_tree(
    graph: PoseGraph, weight: Float[np.ndarray, " edges"] | None = None
) -> Int[np.ndarray, " tree"]:
    """Edges of the tree (one for each part) of the least total weight, ascending (Kruskal 1956).

    Args:
        weight: the cost of each edge, not negative; `edge_variance` if not given.

    Raises:
        ValueError: a weight is negative or not finite.
    """
    cost = _costs(graph, weight)
    network = _with_edges(graph, np.arange(len(graph.edges)))
    chosen = rx.minimum_spanning_edges(network, weight_fn=lambda edge: cost[edge])
    return np.array(sorted(edge for _, _, edge in chosen), int)


def shortest_path_tree(
    graph: PoseGraph,
    root: int | Int[np.ndarray, " roots"],
    weight: Float[np.ndarray, " edges"] | None = None,
) -> Tree:
    """Ways of least total weight from the root to every node (Dijkstra 1959).

    With several roots each node is reached from the one that is nearest to it.

    Args:
        weight: the cost of each edge, not negative; `edge_variance` if not given.

    Raises:
        ValueError: a weight is negative or not finite.
    """
    cost = _costs(graph, weight)
    roots = np.atleast_1d(np.asarray(root, int))
    network = _with_edges(graph, np.arange(len(graph.edges)))
    # One source joined to all roots at no cost makes the distances joint ones.
    source = network.add_node(None)
    network.add_edges_from([(source, int(node), -1) for node in roots])
    seen = _Nearest(source)
    rx.dijkstra_search(network, [source], lambda edge: cost[edge] if edge >= 0 else 0.0, seen)
    return _tree(graph, roots, seen)


def breadth_first_tree(
    graph: PoseGraph,
    roots: Int[np.ndarray, " roots"] | None = None,
    edges: Int[np.ndarray, " some"] | None = None,
) -> Tree:
    """Ways with the fewest edges; each part is rooted at the first of its roots.

    Args:
        roots: where the ways begin; if not given, in each part the node with the most edges.
        edges: the only edges to use, for example those of `spanning_tree`; all if not given.
    """
    if roots is None:
        degree = np.bincount(graph.edges.ravel(), minlength=len(graph.names))
        roots = np.array([part[np.argmax(degree[part])] for part in components(graph)], int)
    network = _with_edges(graph, np.arange(len(graph.edges)) if edges is None else edges)
    seen = _Breadth()
    rx.bfs_search(network, [int(node) for node in roots], seen)
    return _tree(graph, roots, seen)


def chain_poses(
    graph: PoseGraph, root_poses: Float[np.ndarray, "roots 6"], tree: Tree
) -> Float[np.ndarray, "nodes 6"]:
    """world_from_node of all nodes along a tree, as turns (rad) and shifts (m).

    Every node's pose relative to an ancestor is composed with that ancestor's own; the way to the
    ancestor doubles each time, so that all nodes are done after log2(depth) steps (pointer jumping,
    Wyllie 1979).

    Args:
        root_poses: world_from_node of `tree.roots`, in their order.

    Returns:
        the poses, turns at most pi long; NaN at nodes that the tree does not reach.
    """
    n = len(graph.names)
    pose, ancestor = np.zeros((n, 6)), tree.parent.copy()
    inner = np.flatnonzero(ancestor >= 0)
    pose[inner] = graph.pose[tree.edge[inner]]
    pose[tree.depth < 0] = np.nan
    # With two roots in one part a breadth-first tree begins only at the first.
    begins = tree.parent[tree.roots] < 0
    pose[tree.roots[begins]] = np.reshape(root_poses, (-1, 6))[begins]
    shift, reached = pose[:, 3:], np.flatnonzero(tree.depth >= 0)
    quaternion = np.full((n, 4), np.nan)
    quaternion[reached] = Rotation.from_rotvec(pose[reached, :3]).as_quat()
    back = np.flatnonzero(tree.sign < 0)
    if len(back):
        inverse = Rotation.from_quat(quaternion[back]).inv()
        quaternion[back], shift[back] = inverse.as_quat(), -inverse.apply(shift[back])
    while len(inner):
        before = ancestor[inner]
        turn = Rotation.from_quat(quaternion[before])
        moved = turn.apply(shift[inner]) + shift[before]
        turned = (turn * Rotation.from_quat(quaternion[inner])).as_quat()
        shift[inner], quaternion[inner] = moved, turned
        ancestor[inner] = ancestor[before]
        inner = inner[ancestor[inner] >= 0]
    pose[reached, :3] = Rotation.from_quat(quaternion[reached]).as_rotvec()
    return pose


def best_path(
    graph: PoseGraph, a: int, b: int, weight: Float[np.ndarray, " edges"] | None = None
) -> Path:
    """The way from node a to node b with the least sum of variances, and the pose that it measures.

    The way is chosen by one number for each edge; the covariance is then propagated in full.

    Args:
        weight: the cost of each edge, not negative; `edge_variance` if not given.

    Raises:
        UnconnectedNetwork: no chain of edges joins the two nodes.
    """
    tree = shortest_path_tree(graph, a, weight)
    if tree.depth[b] < 0:
        raise UnconnectedNetwork(
            f"no chain of edges joins {graph.names[a]} to {graph.names[b]}; "
            "record an edge between their parts"
        )
    steps = tree.way_to(b)
    return Path(steps, *compose(graph, steps))


def compose(
    graph: PoseGraph, walk: Walk
) -> tuple[Float[np.ndarray, "6"], Float[np.ndarray, "6 6"]]:
    """Product of the edges of a walk: a_from_b (turn rad, shift m) and the covariance of its twist.

    To first order. With S_k the pose of step k and P_k the product of those behind it,
    S exp(xi) P = S P exp(Ad(P)^-1 xi), and a backward step T^-1 of T exp(xi) is
    exp(-xi) T^-1 (MATHEMATICS 1.6, condition form). A walk may use an edge twice.
    """
    if not walk:
        return np.zeros(6), np.zeros((6, 6))
    edges, signs = np.array(walk, int).T
    behind, levers = np.eye(4), np.zeros((len(edges), 4, 4))
    steps = matrices(graph.pose[edges])
    for k in reversed(range(len(edges))):
        if signs[k] > 0:
            levers[k], behind = behind, steps[k] @ behind
        else:
            levers[k] = behind = np.linalg.inv(steps[k]) @ behind
    used, place = np.unique(edges, return_inverse=True)
    jacobian = np.zeros((len(used), 6, 6))
    np.add.at(jacobian, place, signs[:, None, None] * adjoint_of_inverse(levers))
    covariance = np.einsum(
        "kij,kjl,kml->im", jacobian, graph.covariance[used], jacobian, optimize=True
    )
    return vector(behind), covariance


def _costs(graph: PoseGraph, weight: Float[np.ndarray, " edges"] | None) -> list[float]:
    cost = edge_variance(graph) if weight is None else np.asarray(weight, float)
    if not (np.isfinite(cost) & (cost >= 0.0)).all():
        worst = int(np.flatnonzero(~(np.isfinite(cost) & (cost >= 0.0)))[0])
        raise ValueError(
            f'the weight of edge "{graph.edge_names[worst]}" is {cost[worst]}; '
            "give a finite one that is not negative"
        )
    return cost.tolist()


def _with_edges(graph: PoseGraph, edges: Int[np.ndarray, " some"]) -> rx.PyGraph:
    """The nodes and these edges; what each edge carries is its place in the pose graph."""
    network = rx.PyGraph(multigraph=True)
    network.add_nodes_from(range(len(graph.names)))
    ends = graph.edges[edges]
    network.add_edges_from(
        list(zip(ends[:, 0].tolist(), ends[:, 1].tolist(), edges.tolist(), strict=True))
    )
    return network


class _Breadth(BFSVisitor):
    def __init__(self):
        self.order, self.before = [], {}

    def discover_vertex(self, v):
        self.order.append(v)

    def tree_edge(self, e):
        self.before[e[1]] = (e[0], e[2])


class _Nearest(DijkstraVisitor):
    def __init__(self, source: int):
        self.source, self.order, self.before = source, [], {}

    def discover_vertex(self, v, score):
        if v != self.source:
            self.order.append(v)

    def edge_relaxed(self, edge):
        if edge[0] != self.source:
            self.before[edge[1]] = (edge[0], edge[2])


def _tree(graph: PoseGraph, roots, seen: _Breadth | _Nearest) -> Tree:
    parent, edge, sign, depth = np.zeros((4, len(graph.names)), int) - [[1], [1], [0], [1]]
    for node in seen.order:
        if node in seen.before:
            parent[node], edge[node] = seen.before[node]
            depth[node] = depth[parent[node]] + 1
        else:
            depth[node] = 0
    inner = np.flatnonzero(edge >= 0)
    sign[inner] = np.where(graph.edges[edge[inner], 0] == parent[inner], 1, -1)
    return Tree(np.asarray(roots, int), parent, edge, sign, np.array(seen.order, int), depth)
