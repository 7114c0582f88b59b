"""Classical condition adjustment of a network of relative poses, with dense matrices.

The unknowns are corrections xi of the measured poses T. Around each independent cycle the corrected
poses multiply to the identity,

    f(xi) = log prod [T_e exp(xi_e)]^(+-1) = 0,    linearised    B xi + w = 0,    w = f(xi) - B xi,

and of all such corrections the least in the metric of their covariance Q is

    xi = -Q B^T (B Q B^T)^-1 w,    Q_adjusted = Q - Q B^T (B Q B^T)^-1 B Q,

iterated with B and w anew at the present xi. This is the adjustment that Chao et al. 2010 (Appl.
Opt. 49:5192) and the thesis behind it use; Bai, Vidal-Calleja and Grisetti 2022 (arXiv 2203.15597)
do the same in sparse form. It gives what the parametric adjustment gives. The matrix to factorise
has 6 rows for each cycle instead of 6 for each node, which pays where cycles are few.

The misclosure and its derivatives are those of `jaxvm.network.factors.ClosureFactor`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag, cho_factor, cho_solve, solve_triangular

from jaxvm.geometry import pose_from_vector, se3_exp, vector_from_pose
from jaxvm.network.factors import ClosureFactor
from jaxvm.network.graph import PoseGraph, Walk, components
from jaxvm.physics.ports import PortValues

_ITERATIONS = 50


@dataclass(frozen=True, eq=False)
class ConditionAdjustment:
    """Relative poses that fulfil all conditions, and how well they are known.

    Attributes:
        pose: adjusted from_from_to of each edge, turn (rad) and shift (m).
        correction: twist of each edge, log(measured^-1 . adjusted), turn (rad) and shift (m).
        covariance: of the corrected twist of each edge, one at a time; edges in no cycle keep
            theirs.
        misclosure: of each cycle before the adjustment: turn (rad) and shift (m) of its twist.
        misclosure_covariance: what each of them was expected to scatter by: diagonal blocks of
            B Q B^T.
        squares: weighted sum of squares of the corrections; chi-square with `redundancy` degrees of
            freedom when the covariances are right.
        redundancy: number of conditions, 6 for each cycle.
        iterations: linearisations.
        last: length of the last change of all corrections, in standard deviations.
        converged: whether that change had become nothing but rounding.
        gain: Q B^T L^-T with L L^T = B Q B^T: covariances fall by gain gain^T. [6 edges, 6 cycles].
        measured_covariance: of the twist of each edge before the adjustment.
    """

    pose: Float[np.ndarray, "edges 6"]
    correction: Float[np.ndarray, "edges 6"]
    covariance: Float[np.ndarray, "edges 6 6"]
    misclosure: Float[np.ndarray, "cycles 6"]
    misclosure_covariance: Float[np.ndarray, "cycles 6 6"]
    squares: float
    redundancy: int
    iterations: int
    last: float
    converged: bool
    gain: Float[np.ndarray, "edges6 conditions"]
    measured_covariance: Float[np.ndarray, "edges 6 6"]

    @property
    def joint_covariance(self) -> Float[np.ndarray, "edges6 edges6"]:
        """Covariance of the twists of all edges together: singular, for they fulfil conditions."""
        return block_diag(*self.measured_covariance) - self.gain @ self.gain.T

    @property
    def edge_redundancy(self) -> Float[np.ndarray, " edges"]:
        """Share of each edge that others check, 0 (in no cycle) to 6; the sum is `redundancy`."""
        fallen = self.measured_covariance - self.covariance
        return np.trace(np.linalg.solve(self.measured_covariance, fallen), axis1=1, axis2=2)


def adjust_conditions(graph: PoseGraph, cycles: Sequence[Walk]) -> ConditionAdjustment:
    """Adjust measured relative poses under the conditions that cycles close.

    With a basis of the cycles the result is that of the parametric adjustment; with fewer cycles
    only these are fulfilled. Time grows with the cube of the number of cycles, memory with cycles
    times edges.

    Args:
        graph: edges with covariances. Held nodes only fix the frame: at most one in each connected
            part, since this form knows no poses of nodes.
        cycles: independent closed walks over the edges.

    Raises:
        ValueError: a cycle that is empty, not closed, or of edges that are not there; a cycle that
            others imply; two held nodes in one part. The message names edges and nodes.
    """
    _check_walks(graph, cycles)
    _check_held(graph)
    _check_independent(graph, cycles)
    n = len(graph.edges)
    closures = _closures(n, cycles)
    measured, spread = jnp.asarray(graph.pose), np.asarray(graph.covariance)
    roots = np.linalg.cholesky(spread)
    correction = np.zeros((n, 6))
    misclosure, b = _linearised(closures, measured, correction)
    system = _System(b, roots)
    before_it, expected = misclosure, system.blocks
    iterations, last, converged = 0, np.inf, False
    while iterations < _ITERATIONS and not converged:
        w = misclosure.ravel() - b @ correction.ravel()
        change = system.corrections(w) - correction
        correction = correction + change
        previous, last = last, _length(roots, change)
        # The second rule ends at the rounding of the misclosures, where changes no longer shrink.
        converged = last < 1e-10 or (last < 1e-5 and last > 0.5 * previous)
        iterations += 1
        misclosure, b = _linearised(closures, measured, correction)
        system = _System(b, roots)

    gain = system.gain
    fallen = gain.reshape(n, 6, 6 * len(cycles))
    return ConditionAdjustment(
        pose=np.array(_corrected(measured, jnp.asarray(correction))),
        correction=correction,
        covariance=spread - np.einsum("eik,ejk->eij", fallen, fallen),
        misclosure=before_it,
        misclosure_covariance=expected,
        squares=_length(roots, correction) ** 2,
        redundancy=6 * len(cycles),
        iterations=iterations,
        last=last,
        converged=converged,
        gain=gain,
        measured_covariance=spread,
    )


class _System:
    """B Q B^T factorised, with rows scaled to a unit diagonal: turns and shifts differ in size."""

    def __init__(self, b: np.ndarray, roots: np.ndarray):
        edges = len(roots)
        # B times the roots of Q, edge by edge; Q itself is never filled up with zeros.
        half = np.einsum("cei,eij->cej", b.reshape(len(b), edges, 6), roots)
        self.half = half.reshape(b.shape)
        self.roots = roots
        normal = self.half @ self.half.T
        size = len(b) // 6
        self.blocks = normal.reshape(size, 6, size, 6)[np.arange(size), :, np.arange(size)]
        self.scale = 1.0 / np.sqrt(np.diagonal(normal))
        self.factor = cho_factor(normal * self.scale[:, None] * self.scale, lower=True)

    def corrections(self, w: np.ndarray) -> np.ndarray:
        """-Q B^T (B Q B^T)^-1 w."""
        multipliers = -self.scale * cho_solve(self.factor, self.scale * w)
        whitened = (self.half.T @ multipliers).reshape(-1, 6)
        return np.einsum("eij,ej->ei", self.roots, whitened)

    @property
    def gain(self) -> np.ndarray:
        """Q B^T L^-T."""
        scaled = self.scale[:, None] * self.half
        whitened = solve_triangular(self.factor[0], scaled, lower=True).T
        each = whitened.reshape(len(self.roots), 6, len(scaled))
        return np.einsum("eij,ejk->eik", self.roots, each).reshape(whitened.shape)


def _length(roots, twists) -> float:
    """Length of twists of all edges in standard deviations."""
    return float(np.linalg.norm(np.linalg.solve(roots, twists[:, :, None])))


def _closures(edges: int, cycles: Sequence[Walk]) -> ClosureFactor:
    """Cycles as a table of the one residual; behind the edges its state holds an identity."""
    longest = max(map(len, cycles), default=1)
    edge = np.full((len(cycles), longest), edges)
    forward = np.ones((len(cycles), longest))
    for row, walk in enumerate(cycles):
        edge[row, : len(walk)], forward[row, : len(walk)] = np.array(walk).T
    slots = (6 * edge[:, :, None] + np.arange(6)).reshape(len(cycles), 6 * longest)
    return ClosureFactor(
        slots=jnp.asarray(slots),
        sigma=jnp.ones((len(cycles), 6)),
        weight=jnp.ones(len(cycles)),
        forward=jnp.asarray(forward),
    )


def _linearised(closures: ClosureFactor, measured, correction) -> tuple[np.ndarray, np.ndarray]:
    """Misclosures [cycles, 6] and B [6 cycles, 6 edges] at the corrections."""
    misclosure, b = _derivatives(closures, measured, jnp.asarray(correction))
    return np.array(misclosure), np.asarray(b)


@eqx.filter_jit
def _derivatives(closures: ClosureFactor, measured, correction):
    cycles, edges = len(closures.forward), len(measured)
    edge = closures.slots[:, ::6] // 6

    def local(change, poses, forward):
        value = closures.local(_corrected(poses, change), forward, PortValues())
        return value, value

    def of_walks(table):
        return jnp.concatenate([table, jnp.zeros((1, 6))])[edge]

    slopes, value = jax.vmap(jax.jacrev(local, has_aux=True))(
        of_walks(correction), of_walks(measured), closures.data()
    )
    # An edge may be walked twice, so that its derivatives add up; the last column takes what
    # belongs to the filling of short cycles.
    b = jnp.zeros((cycles, edges + 1, 6, 6)).at[jnp.arange(cycles)[:, None], edge]
    b = b.add(slopes.transpose(0, 2, 1, 3))[:, :edges].transpose(0, 2, 1, 3)
    return value, b.reshape(6 * cycles, 6 * edges)


@jax.jit
def _corrected(pose, correction):
    """T exp(xi), edge by edge."""

    def one(pose, twist):
        return vector_from_pose(pose_from_vector(pose) @ se3_exp(twist))

    return jax.vmap(one)(pose, correction)


def _check_walks(graph: PoseGraph, cycles: Sequence[Walk]) -> None:
    for number, walk in enumerate(cycles):
        if not len(walk):
            raise ValueError(f"cycle {number} has no edges: leave it out")
        for edge, sign in walk:
            if not 0 <= edge < len(graph.edges) or sign not in (1, -1):
                raise ValueError(
                    f"cycle {number} has the entry ({edge}, {sign}): an edge is a number from 0 to "
                    f"{len(graph.edges) - 1}, its direction 1 or -1"
                )
        ends = [graph.edges[edge][::sign] for edge, sign in walk]
        for k, (_, at) in enumerate(ends):
            following = (k + 1) % len(walk)
            if at != ends[following][0]:
                names = [graph.edge_names[walk[i][0]] for i in (k, following)]
                raise ValueError(
                    f"cycle {number} ({_path(graph, walk)}) is not closed: {names[0]} leads to "
                    f"{graph.names[at]}, {names[1]} goes on from {graph.names[ends[following][0]]}"
                )


def _path(graph: PoseGraph, walk: Walk) -> str:
    """Edges of a walk by name, with a minus where they are walked backwards."""
    return " ".join(("" if sign > 0 else "-") + graph.edge_names[edge] for edge, sign in walk)


def _check_held(graph: PoseGraph) -> None:
    for part in components(graph):
        held = np.intersect1d(graph.held, part)
        if len(held) > 1:
            both = ", ".join(graph.names[i] for i in held)
            raise ValueError(
                f"{both} are held and joined by edges: their known poses are conditions that no "
                "cycle states; hold one of them, or join them by one more edge of high precision"
            )


def _check_independent(graph: PoseGraph, cycles: Sequence[Walk]) -> None:
    """B has full rank exactly where the signed edges of the cycles are independent vectors.

    At closed cycles every block of B is +-Ad(base from edge), so B is the incidence of cycles and
    edges but for invertible factors on both sides.
    """
    incidence = np.zeros((len(cycles), len(graph.edges)))
    for row, walk in zip(incidence, cycles, strict=True):
        edge, sign = np.array(walk).T
        np.add.at(row, edge, sign)
    reduced = np.linalg.qr(incidence.T, mode="r")
    pivots = np.zeros(len(cycles))
    pivots[: len(reduced)] = np.abs(np.diagonal(reduced))
    small = pivots < 1e-9 * np.maximum(1.0, np.linalg.norm(incidence, axis=1))
    if not small.any():
        return
    # Without pivoting the first vanishing pivot is the first cycle that those before it imply.
    number = int(np.argmax(small))
    shares = np.linalg.lstsq(incidence[:number].T, incidence[number])[0]
    others = [
        f"{i} ({_path(graph, cycles[int(i)])})" for i in np.flatnonzero(np.abs(shares) > 1e-6)
    ]
    named = f"cycle {number} ({_path(graph, cycles[number])})"
    if not others:
        raise ValueError(f"{named} walks each edge as often back as forth: leave it out")
    raise ValueError(f"{named} is implied by cycle {', '.join(others)}: leave one of them out")
