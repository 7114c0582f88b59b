"""Where a pose graph is weak: bridges, redundancy numbers, effective resistance.

Scalar measurements of differences are resistors; MATHEMATICS 1.6 says when poses are.
"""

from dataclasses import dataclass, replace

import numpy as np
import rustworkx as rx
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from jaxvm.network.graph import PoseGraph, components, edge_variance

HARDLY_CHECKED = 0.1
"""Redundancy number below which an error of an edge hardly shows (one of Förstner's classes)."""

_BLOCK = 256
"""Right sides solved at once: 10,000 nodes take 20 MB."""


@dataclass(frozen=True)
class WeakEdge:
    """An edge that the rest of the network checks hardly or not at all.

    Attributes:
        edge: its place in the pose graph.
        name: of the edge.
        ends: names of its nodes.
        redundancy: the share of an error of this edge that shows in its residual; 0 for a bridge.
        bridge: whether it is in no cycle.
    """

    edge: int
    name: str
    ends: tuple[str, str]
    redundancy: float
    bridge: bool

    def words(self) -> str:
        """What is weak and what mends it, in a sentence."""
        edge = f'edge "{self.name}" ({self.ends[0]} to {self.ends[1]})'
        if self.bridge:
            return f"{edge} is in no cycle: nothing checks or improves it; measure another way"
        return (
            f"{edge} is hardly checked: only {100 * self.redundancy:.2g} % of an error in it would "
            "show; repeat it or measure a second way as precise as it"
        )


def held_as_one(graph: PoseGraph) -> PoseGraph:
    """The graph with all held nodes made one: between them nothing is unknown.

    A way from one held node to another is a cycle there. The other held nodes stay without edges.
    """
    ends = graph.edges
    if len(graph.held):
        ends = np.where(np.isin(ends, graph.held), graph.held[0], ends)
    return replace(graph, edges=ends)


def bridges(graph: PoseGraph) -> Int[np.ndarray, " bridges"]:
    """Edges in no cycle, ascending: nothing checks or improves them. Held nodes count as one."""
    pairs, place, times = _pairs(held_as_one(graph))
    network = rx.PyGraph(multigraph=False)
    network.add_nodes_from(range(len(graph.names)))
    network.add_edges_from_no_data([(a, b) for a, b in pairs.tolist() if a != b])
    # rustworkx looks at pairs of nodes; a pair joined twice is a cycle.
    cut = {tuple(sorted(pair)) for pair in rx.bridges(network)}
    alone = [times[k] == 1 and pair in cut for k, pair in enumerate(map(tuple, pairs.tolist()))]
    return np.flatnonzero(np.array(alone, bool)[place])


def _pairs(graph: PoseGraph):
    """Pairs of joined nodes, smaller first; the pair of each edge; the number of its edges."""
    ends = np.sort(graph.edges, axis=1).reshape(-1, 2)
    pairs, place, times = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    return pairs, place.ravel(), times


def effective_resistance(
    graph: PoseGraph, a: int, b: int, variance: Float[np.ndarray, " edges"] | None = None
) -> float:
    """Variance of the adjusted difference of two nodes, one number for each: effective resistance.

    For scalar measurements of differences with these variances the adjusted difference has the
    variance of resistors of these values between the two nodes; for poses it holds with equal
    isotropic noise and small angles (MATHEMATICS 1.6). Infinite where no edges join the nodes.
    Held nodes count as one.

    Args:
        variance: of each edge, positive; `edge_variance` (m^2) if not given.

    Raises:
        ValueError: a variance is not positive and finite.
    """
    value, joined = positive_variances(graph, variance), held_as_one(graph)
    if np.isin([a, b], graph.held).all():
        return 0.0
    a, b = (int(graph.held[0]) if node in graph.held else node for node in (a, b))
    return float(_resistances(joined, np.array([[a, b]]), value)[0])


def redundancy_numbers(
    graph: PoseGraph, variance: Float[np.ndarray, " edges"] | None = None
) -> Float[np.ndarray, " edges"]:
    """r_e = 1 - R_eff(e) / variance_e: the share of an edge's error that shows in its residual.

    0 for bridges, 1 between held nodes; all together they make E - V + C, the held nodes counted as
    one (MATHEMATICS 1.6). One factorisation, and one sparse solve for each pair of joined nodes.

    Args:
        variance: of each edge, positive; `edge_variance` if not given.

    Raises:
        ValueError: a variance is not positive and finite.
    """
    value, joined = positive_variances(graph, variance), held_as_one(graph)
    pairs, place, _ = _pairs(joined)
    redundancy = 1.0 - _resistances(joined, pairs, value)[place] / value
    redundancy[bridges(graph)] = 0.0
    return np.clip(redundancy, 0.0, 1.0)


def weak_edges(
    graph: PoseGraph,
    threshold: float = HARDLY_CHECKED,
    variance: Float[np.ndarray, " edges"] | None = None,
) -> list[WeakEdge]:
    """Bridges, and edges whose redundancy number is below the threshold; the weakest first.

    Args:
        variance: of each edge, positive; `edge_variance` if not given.
    """
    redundancy, alone = redundancy_numbers(graph, variance), bridges(graph)
    weak = np.union1d(alone, np.flatnonzero(redundancy < threshold))
    return [
        WeakEdge(
            int(edge),
            graph.edge_names[edge],
            (graph.names[graph.edges[edge, 0]], graph.names[graph.edges[edge, 1]]),
            float(redundancy[edge]),
            bool(np.isin(edge, alone)),
        )
        for edge in weak[np.argsort(redundancy[weak], kind="stable")]
    ]


def positive_variances(
    graph: PoseGraph, variance: Float[np.ndarray, " edges"] | None
) -> Float[np.ndarray, " edges"]:
    """The variances to use: those given, else `edge_variance` (m^2).

    Raises:
        ValueError: one is not positive and finite; its edge is named.
    """
    value = edge_variance(graph) if variance is None else np.asarray(variance, float)
    sound = np.isfinite(value) & (value > 0.0)
    if not sound.all():
        worst = int(np.flatnonzero(~sound)[0])
        raise ValueError(
            f'the variance of edge "{graph.edge_names[worst]}" is {value[worst]}; '
            "give a positive finite one, or make its two nodes one where it is exact"
        )
    return value


def _resistances(
    graph: PoseGraph, pairs: Int[np.ndarray, "pairs 2"], variance: Float[np.ndarray, " edges"]
) -> Float[np.ndarray, " pairs"]:
    """Effective resistance between the nodes of each pair (Klein & Randić 1993).

    The Laplacian of the conductances 1 / variance, with the first node of each part taken out.
    """
    n, part = len(graph.names), np.zeros(len(graph.names), int)
    kept = np.ones(n, bool)
    for k, nodes in enumerate(components(graph)):
        part[nodes], kept[nodes[0]] = k, False
    place = np.cumsum(kept) - 1
    (a, b), out = pairs.T, np.zeros(len(pairs))
    out[part[a] != part[b]] = np.inf
    wanted = np.flatnonzero((part[a] == part[b]) & (a != b))
    if len(wanted) == 0:
        return out
    rows = np.arange(len(graph.edges))
    ends = coo_array(
        (
            np.repeat([1.0, -1.0], len(rows)) / np.sqrt(np.tile(variance, 2)),
            (np.tile(rows, 2), graph.edges.T.ravel()),
        ),
        (len(rows), n),
    ).tocsr()[:, np.flatnonzero(kept)]
    solver = splu(
        (ends.T @ ends).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    for chosen in np.array_split(wanted, -(-len(wanted) // _BLOCK)):
        right = np.zeros((kept.sum(), len(chosen)))
        column = np.arange(len(chosen))
        for node, sign in ((a[chosen], 1.0), (b[chosen], -1.0)):
            free = kept[node]
            right[place[node[free]], column[free]] = sign
        out[chosen] = np.einsum("ij,ij->j", right, solver.solve(right))
    return out
