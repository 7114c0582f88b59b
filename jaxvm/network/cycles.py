"""Cycles of a pose graph, and what they check.

A relative pose that closes a cycle is a condition on the others. Cycles are closed walks without a
node visited twice; two edges between the same nodes make a cycle of two, and an edge from a node
to itself one of one.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.special import chdtrc

from jaxvm.geometry.poses import pose_from_vector, se3_log
from jaxvm.network.graph import (
    PoseGraph,
    Tree,
    Walk,
    breadth_first_tree,
    components,
    compose,
    n_conditions,
    shortest_path_tree,
    spanning_tree,
)
from jaxvm.network.redundancy import positive_variances

INEFFECTIVE = 0.05
"""Share below which a cycle is said to leave the network as it is."""


@dataclass(frozen=True, eq=False)
class Misclosure:
    """How far the product of the edges around a cycle is from the identity.

    Attributes:
        twist: log of the product, turn (rad) then shift (m), in the axes of the cycle's first node.
        covariance: of that twist, from the covariances of the edges, to first order.
        statistic: twist^T covariance^-1 twist, chi-squared of 6 degrees where the covariances hold.
    """

    twist: Float[np.ndarray, "6"]
    covariance: Float[np.ndarray, "6 6"]
    statistic: float

    @property
    def p_value(self) -> float:
        """Chance of a statistic at least as large if nothing is wrong."""
        return float(chdtrc(6, self.statistic))


@dataclass(frozen=True)
class CycleEffect:
    """What the condition of one cycle does beyond those of the others.

    Attributes:
        share: of the one unit of relative variance that the condition removes, the part that falls
            on the edges of the best tree. The network without any cycle is that tree: near 1 the
            cycle improves it, near 0 it only improves edges that the network does not need.
        edge: the edge that takes most of the unit.
        name: of that edge.
        taken: the part that it takes.
    """

    share: float
    edge: int
    name: str
    taken: float

    @property
    def effective(self) -> bool:
        """Whether the cycle improves the network."""
        return self.share >= INEFFECTIVE

    def words(self) -> str:
        """The effect, in a sentence."""
        what = "improves the network" if self.effective else "leaves the network as it is"
        return (
            f"the cycle {what}: {100 * self.share:.2g} % of its condition falls on the best tree, "
            f'{100 * self.taken:.2g} % on edge "{self.name}"'
        )


def fundamental_cycles(graph: PoseGraph, tree: Tree | None = None) -> list[Walk]:
    """The cycle that each edge outside a tree closes: E - V + C independent ones.

    Each begins with its closing edge, forward. They are short for a breadth-first tree.

    Args:
        tree: with one root in each part; `breadth_first_tree` if not given.

    Raises:
        ValueError: the tree does not reach all nodes, or has two roots in one part.
    """
    tree = breadth_first_tree(graph) if tree is None else tree
    if (tree.depth >= 0).sum() != len(graph.names) or (tree.depth == 0).sum() != len(
        components(graph)
    ):
        raise ValueError(
            "the tree of fundamental cycles must reach every node, from one root in each part; "
            "make it with breadth_first_tree or give shortest_path_tree one root for each part"
        )
    return [_closed_by(graph, tree, int(edge)) for edge in _chords(graph, tree)]


def _chords(graph: PoseGraph, tree: Tree) -> Int[np.ndarray, " chords"]:
    return np.setdiff1d(np.arange(len(graph.edges)), tree.edge)


def _closed_by(graph: PoseGraph, tree: Tree, edge: int) -> Walk:
    """The closing edge, up from its end to where the ways meet, and down to its begin."""
    low, high = (int(node) for node in graph.edges[edge])
    up, down = [], []
    while low != high:
        if tree.depth[high] >= tree.depth[low]:
            up.append((int(tree.edge[high]), -int(tree.sign[high])))
            high = int(tree.parent[high])
        else:
            down.append((int(tree.edge[low]), int(tree.sign[low])))
            low = int(tree.parent[low])
    return [(edge, 1), *up, *down[::-1]]


def minimum_cycle_basis(
    graph: PoseGraph, weight: Float[np.ndarray, " edges"] | None = None
) -> list[Walk]:
    """E - V + C independent cycles with the least total weight, lightest first.

    Candidates are the cycles that an edge closes in the shortest-path tree of a root (Horton, SIAM
    J. Comput. 16:358, 1987). Roots need only meet every cycle (Mehlhorn & Michail, ACM Trans.
    Algorithms 6:8, 2009): here one end of each edge outside a spanning tree. Such candidates
    contain a lightest cycle of odd product with any vector over GF(2), which is what a minimum
    basis is made of (de Pina 1995), whichever of equally short ways a tree takes. Sorted, they
    are taken where independent of those before, by elimination over GF(2).

    With N = E - V + C and F <= min(N, V) roots: F shortest-path trees, F N candidates (16 bytes
    each) and at most N^2 / 64 words for each cycle looked at; seconds for a thousand cycles. For
    far more `fundamental_cycles` serve as well.

    Args:
        weight: the cost of each edge, not negative; if not given each edge counts 1.

    Raises:
        ValueError: a weight is negative or not finite.
    """
    cost = np.ones(len(graph.edges)) if weight is None else np.asarray(weight, float)
    count = n_conditions(graph)
    chords = _chords(graph, breadth_first_tree(graph))
    # A cycle is known by its edges outside one spanning tree.
    bit = {int(edge): 1 << k for k, edge in enumerate(chords)}
    trees = [shortest_path_tree(graph, int(r), cost) for r in np.unique(graph.edges[chords, 0])]
    listed = [_candidates(graph, tree, cost) for tree in trees]
    bound = np.concatenate([bounds for _, bounds in listed] or [np.zeros(0)])
    closing = np.concatenate([edges for edges, _ in listed] or [np.zeros(0, int)])
    of_tree = np.repeat(np.arange(len(trees)), [len(edges) for edges, _ in listed])
    basis, span, known = [], {}, set()
    for k in np.argsort(bound, kind="stable"):
        if len(basis) == count:
            break
        cycle = _closed_by(graph, trees[of_tree[k]], int(closing[k]))
        vector = sum(bit.get(edge, 0) for edge, _ in cycle)
        if vector not in known and _extends(span, vector):
            basis.append(cycle)
        known.add(vector)
    return basis


def _candidates(graph: PoseGraph, tree: Tree, cost: Float[np.ndarray, " edges"]):
    """Edges that close a cycle through the root of a shortest-path tree; costs of the cycles."""
    root = int(tree.roots[0])
    distance, branch = np.full(len(graph.names), np.inf), np.arange(len(graph.names))
    distance[root] = 0.0
    for node in tree.order[1:]:
        parent = tree.parent[node]
        distance[node] = distance[parent] + cost[tree.edge[node]]
        branch[node] = node if parent == root else branch[parent]
    edges = _chords(graph, tree)
    a, b = graph.edges[edges].T
    # Both ends in one branch: the ways meet before the root, and the cycle is another root's.
    apart = np.isfinite(distance[a]) & ((branch[a] != branch[b]) | (a == root) & (b == root))
    edges, a, b = edges[apart], a[apart], b[apart]
    return edges, distance[a] + cost[edges] + distance[b]


def _extends(span: dict[int, int], vector: int) -> bool:
    """Add a vector over GF(2) to an echelon basis (by highest bit), unless it is in its span."""
    while vector:
        top = vector.bit_length()
        if top not in span:
            span[top] = vector
            return True
        vector ^= span[top]
    return False


_log = jax.jit(lambda vector: se3_log(pose_from_vector(vector)))


def misclosure(graph: PoseGraph, cycle: Walk) -> Misclosure:
    """Misclosure of a cycle with its covariance and test statistic (MATHEMATICS 1.6).

    The true poses close, so the product's twist is minus the sum of the edges' twists, moved to the
    first node. First order in the twists: meant for misclosures whose turn is far below 1 rad.

    Raises:
        ValueError: the walk does not close, or its edges leave a direction without variance.
    """
    ends = graph.edges[[edge for edge, _ in cycle]]
    backward = np.array([sign < 0 for _, sign in cycle])
    walked = np.where(backward[:, None], ends[:, ::-1], ends)
    reached, following = walked[:, 1], np.roll(walked[:, 0], -1)
    if (reached != following).any():
        k = int(np.flatnonzero(reached != following)[0])
        raise ValueError(
            f'the walk does not close: edge "{graph.edge_names[cycle[k][0]]}" ends at '
            f"{graph.names[reached[k]]} and the next begins at {graph.names[following[k]]}; "
            "take cycles from fundamental_cycles"
        )
    pose, covariance = compose(graph, cycle)
    twist = np.asarray(_log(pose))
    # Turns in rad and shifts in m may differ by many powers of ten: scale before the test of rank.
    scale = np.sqrt(np.diag(covariance))
    if not (scale > 0.0).all() or np.linalg.matrix_rank(covariance / np.outer(scale, scale)) < 6:
        names = ", ".join(f'"{graph.edge_names[edge]}"' for edge, _ in cycle[:6])
        raise ValueError(
            f"the covariance of the cycle through {names} is singular; "
            "give at least one of its edges a positive definite covariance"
        )
    scaled = twist / scale
    statistic = scaled @ np.linalg.solve(covariance / np.outer(scale, scale), scaled)
    return Misclosure(twist, covariance, float(statistic))


def cycle_effects(
    graph: PoseGraph, cycles: list[Walk], variance: Float[np.ndarray, " edges"] | None = None
) -> list[CycleEffect]:
    """What each cycle constrains beyond the others, given how good the edges are.

    Scalar model: with B the cycles (rows, +-1) and Q the variances, all conditions leave
    Q - Q B^T M^-1 B Q, M = B Q B^T. Without condition c that would be larger by u u^T / (M^-1)_cc,
    u = Q B^T M^-1 e_c, whose relative size, the sum of u_e^2 / variance_e / (M^-1)_cc, is always 1:
    every independent cycle counts, six times for poses. What differs is where the 1 goes: to the
    edges of the best tree (least total variance), or to a weak edge that the cycle merely fixes. A
    chord of variance v over n edges of variance 1 has the share n / (n + v). Where several trees
    are equally good the shares are those of one of them. Dense in the number of cycles.

    Args:
        cycles: independent ones: a basis, or a part of it.
        variance: of each edge, positive; `edge_variance` if not given.

    Raises:
        ValueError: the cycles are not independent.
    """
    value = positive_variances(graph, variance)
    if not cycles:
        return []
    rows = _incidence(cycles, len(value))
    gram = (rows @ rows.T).toarray()
    if np.linalg.matrix_rank(gram, hermitian=True) < len(cycles):
        raise ValueError(
            f"the {len(cycles)} cycles are not independent; "
            "take those of fundamental_cycles or minimum_cycle_basis"
        )
    weighted = rows.multiply(np.sqrt(value)[None, :]).tocsr()
    inverse = np.linalg.inv((weighted @ weighted.T).toarray())
    taken = (weighted.T @ inverse) ** 2 / np.diag(inverse)
    share = taken[spanning_tree(graph, value)].sum(axis=0)
    most = taken.argmax(axis=0)
    return [
        CycleEffect(float(share[c]), int(e), graph.edge_names[e], float(taken[e, c]))
        for c, e in enumerate(most)
    ]


def _incidence(walks: list[Walk], n_edges: int) -> csr_array:
    """How often each walk uses each edge, backward counted negative."""
    row = np.repeat(np.arange(len(walks)), [len(walk) for walk in walks])
    edge, sign = np.array([step for walk in walks for step in walk]).T
    return coo_array((sign.astype(float), (row, edge)), (len(walks), n_edges)).tocsr()
