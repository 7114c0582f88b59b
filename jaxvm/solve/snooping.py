"""Data snooping: redundancy numbers, standardised residuals, and what they reject.

Baarda 1968: w = v / (sigma_v) with sigma_v^2 = r sigma^2, r the observation's redundancy number.
For the two components of an image point the test is on both: T = v^T (R)^-1 v ~ chi2(2).
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.special import chdtri

from jaxvm.compiling import program
from jaxvm.network.factors import LinkFactor
from jaxvm.network.relations import held_poses, link_relations
from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment, adjust, n_used
from jaxvm.solve.arrow import factorise
from jaxvm.solve.large import is_large
from jaxvm.solve.problem import Problem
from jaxvm.solve.reduced import half_rows, packet_of_rows
from jaxvm.solve.robust import CauchyLoss
from jaxvm.solve.selected import SelectedInverse


@dataclass(frozen=True)
class Rejected:
    """One rejected observation: row of `recording.observations` and its test value."""

    row: int
    test: float
    where: str


def redundancy(adjustment: Adjustment) -> tuple[np.ndarray, ...]:
    """Redundancy matrices [observations, c, c] of every table: I - J H^-1 J^T, block by block.

    Their traces add up to the degrees of freedom.
    """
    blocks = _redundancies(adjustment.problem, adjustment.x)
    factors = adjustment.problem.network.factors()
    return tuple(np.asarray(b)[: f.n_real] for b, f in zip(blocks, factors, strict=True))


def _redundancies(problem: Problem, x):
    tables = problem.linearised(x)
    counted = [np.asarray(factor.weight) > 0.0 for factor in problem.network.factors()]
    hats = _hats(problem, x, tables, tables)
    return [
        used[:, None, None] * np.eye(hat.shape[1]) - hat
        for used, hat in zip(counted, hats, strict=True)
    ]


def _hats(problem: Problem, x, tables, own) -> list[np.ndarray]:
    """J H^-1 J^T of every observation of linearised tables, H being that of the problem's own."""
    jacobians = [table.jacobian for table in tables]
    if is_large(problem):
        return _large_hats(problem, x, jacobians)
    hessian = problem.assembled(own).hessian
    return _arrow_hats(hessian, problem.packets, jacobians, problem.sizes)


@program
def _arrow_hats(hessian, packets_of, jacobians, sizes):
    factors = factorise(hessian)
    result = []
    for packets, jacobian in zip(packets_of, jacobians, strict=True):
        half = half_rows(factors, packets, jacobian, sizes)
        result.append(jnp.einsum("nak,nbk->nab", half, half))
    return result


def _large_hats(problem: Problem, x, jacobians) -> list[np.ndarray]:
    """The same through the selected inverse: an observation needs its own unknowns' block only."""
    inverse = SelectedInverse.of(problem, x)
    result = []
    for packets, jacobian in zip(problem.packets, jacobians, strict=True):
        blocks = inverse.blocks(np.asarray(packets.columns))
        jacobian = np.asarray(jacobian)
        own = blocks[np.asarray(packet_of_rows(packets, len(jacobian)))]
        result.append(np.einsum("nak,nkl,nbl->nab", jacobian, own, jacobian, optimize=True))
    return result


def snoop(
    scene: Scene,
    alpha: float = 0.001,
    scale: float | None = None,
    weights: tuple[np.ndarray, ...] | None = None,
    max_rounds: int = 10,
) -> tuple[Adjustment, list[Rejected], tuple[np.ndarray, ...]]:
    """Adjust and reject image points whose residuals are too large, worst first.

    In each round the worst point of every frame (camera and epoch) that fails is set aside, then
    everything is adjusted again.

    Args:
        scene: scene at start values.
        alpha: probability to reject one sound observation (Baarda's 0.001: |w| > 3.29).
        scale: variance of unit weight; by default the squared robust scale of the residuals.
        weights: initial weights.
        max_rounds: bound on the rounds.

    Returns:
        The last adjustment, what was rejected, and the final weights.
    """
    weights = weights or tuple(np.ones(len(rows)) for rows in scene.tables)
    rejected: list[Rejected] = []
    limit = chdtri(2, alpha)
    adjustment = adjust(scene, weights=weights)
    for _ in range(max_rounds):
        tests = image_point_tests(adjustment)
        variance = scale if scale is not None else robust_variance(adjustment)
        found = False
        weights = tuple(w.copy() for w in weights)
        for table, (rows, test) in enumerate(zip(scene.tables, tests, strict=True)):
            value = np.where(weights[table] > 0, test / variance, 0.0)
            obs = scene.recording.observations
            frame = obs.camera[rows] * len(scene.recording.time) + obs.epoch[rows]
            order = np.lexsort((-value, frame))
            worst = order[np.unique(frame[order], return_index=True)[1]]
            for k in worst[value[worst] > limit]:
                weights[table][k] = 0.0
                rejected.append(
                    Rejected(int(rows[k]), float(value[k]), _where(scene, int(rows[k])))
                )
                found = True
        if not found:
            break
        adjustment = adjust(adjustment.scene, weights=weights, check=False)
    return adjustment, rejected, weights


def image_point_tests(adjustment: Adjustment) -> list[np.ndarray]:
    """Test values v^T R^-1 v of all image points, chi-square with 2 degrees of freedom."""
    tests = []
    for r, block in zip(adjustment.residuals().pixels, redundancy(adjustment), strict=False):
        block = block + 1e-9 * np.eye(2)
        v = np.asarray(r)
        tests.append(np.einsum("na,na->n", v, np.linalg.solve(block, v[:, :, None])[:, :, 0]))
    return tests


_CHECKED = 1e-6
"""Redundancy of a combination of components below which nothing checks it."""


def link_tests(adjustment: Adjustment) -> tuple[Float[np.ndarray, " links"], np.ndarray]:
    """Test values of all links, and the degrees of freedom of each.

    A link in use has v^T R^- v, R its redundancy; what nothing else checks counts nothing. One that
    is set aside has v^T (I + J H^-1 J^T)^-1 v: it is compared with what the others foretell.
    """
    problem, x = adjustment.problem, adjustment.x
    factors = problem.network.factors()
    place = next(i for i, factor in enumerate(factors) if isinstance(factor, LinkFactor))
    used = np.asarray(factors[place].weight) > 0.0
    # Linearised with all of them in use; the normal equations are those of the adjustment.
    every = eqx.tree_at(lambda p: p.network.links.weight, problem, jnp.ones(len(used)))
    tables = every.linearised(x)
    hat = np.asarray(_hats(problem, x, tables, problem.linearised(x))[place])
    value, vector = np.linalg.eigh(np.eye(6) + np.where(used[:, None, None], -hat, hat))
    checked = value > _CHECKED
    along = np.einsum("nij,ni->nj", vector, np.asarray(tables[place].value))
    squares = np.where(checked, along**2 / np.where(checked, value, 1.0), 0.0)
    return squares.sum(axis=1), checked.sum(axis=1)


def snoop_links(
    scene: Scene,
    alpha: float = 0.001,
    method: str = "levenberg-marquardt",
    max_rounds: int = 20,
    scale: float = 1.0,
) -> tuple[Adjustment, list[Rejected], Float[np.ndarray, " links"]]:
    """Adjust a network and reject links with gross errors, by name.

    A robust adjustment (Cauchy) first takes the network to where most links agree, and sets aside
    what is far off there. Then rounds of least squares: of the links that fail, those that are
    worst at both of their bodies are set aside, and those that pass again come back. A link stays
    where without it links would no longer join what they join now: nothing else checks it.

    Args:
        scene: with links, at start values.
        alpha: probability to reject one sound link (Baarda 1968).
        method: of `adjust`.
        max_rounds: bound on the rounds.
        scale: variance of unit weight. 1 trusts the stated covariances: where they are too small
            by far, many sound links fail.

    Returns:
        The last adjustment, the rejected links (`row` counts links), and the weights of all.

    Raises:
        ValueError: the recording has no links.
        RankDeficiency: the links that are left don't determine all unknowns, by name.
    """
    links = scene.recording.links
    if links is None:
        raise ValueError("the recording has no links; image points are snooped by `snoop`")
    robust = adjust(scene, method, CauchyLoss())
    square = np.sum(np.asarray(robust.residuals().links) ** 2, axis=1) / scale
    ends = _ends(scene)
    weights = np.ones(len(square))
    weights = _without(ends, weights, square * (square > _FAR * chdtri(6, alpha)))
    tried: set[bytes] = set()
    while True:
        tried.add(weights.tobytes())
        adjustment = adjust(robust.scene, method, link_weights=weights)
        test, freedom = link_tests(adjustment)
        test = test / scale
        fails = test > chdtri(np.maximum(freedom, 1), alpha)
        changed = np.where((weights == 0.0) & ~fails, 1.0, weights)
        worst = _worst_at_both_ends(ends, np.where(fails & (weights > 0.0), test, 0.0))
        changed = _without(ends, changed, np.where(worst, test, 0.0))
        if changed.tobytes() in tried or len(tried) >= max_rounds:
            break
        weights = changed
    rejected = [
        Rejected(int(k), float(test[k]), _where_link(scene, int(k)))
        for k in np.flatnonzero(weights == 0.0)
    ]
    return adjustment, rejected, weights


_FAR = 4.0
"""How many times the limit of a test a robust residual has to be for the link to be set aside."""


def _ends(scene: Scene) -> Int[np.ndarray, "links 2"]:
    """Numbers of what each link joins: unknown poses, and one for all that is held."""
    held, bodies = held_poses(scene, given=False), {}

    def number(chain) -> int:
        return bodies.setdefault(tuple(key for key in chain if key not in held), len(bodies))

    return np.array([[number(link.a), number(link.b)] for link in link_relations(scene)])


def _worst_at_both_ends(ends: Int[np.ndarray, "links 2"], value: np.ndarray) -> np.ndarray:
    """Which links have the largest (positive) value among all links at both of their bodies."""
    largest = np.zeros(int(ends.max(initial=-1)) + 1)
    for side in (0, 1):
        np.maximum.at(largest, ends[:, side], value)
    return (value > 0.0) & (value >= largest[ends].max(axis=1))


def _without(ends: Int[np.ndarray, "links 2"], weights, value) -> Float[np.ndarray, " links"]:
    """Weights without the links of positive value, the worst first, that the others can spare."""
    weights, n = np.array(weights), int(ends.max(initial=-1)) + 1

    def parts() -> int:
        used = ends[weights > 0.0]
        joined = coo_array((np.ones(len(used)), tuple(used.T)), (n, n))
        return connected_components(joined, directed=False, return_labels=False)

    before = parts()
    for k in np.argsort(-value, kind="stable")[: int(np.sum(value > 0.0))]:
        weights[k] = 0.0
        if parts() > before:
            weights[k] = 1.0
    return weights


def _where_link(scene: Scene, k: int) -> str:
    links = scene.recording.links
    assert links is not None
    when = f", epoch {scene.recording.epoch_ids[links.epoch[k]]}" if links.epoch[k] >= 0 else ""
    return f"link {links.name[k]}{when}"


def robust_variance(adjustment: Adjustment) -> float:
    """Variance factor of pixel noise from the median absolute whitened residual.

    Residuals are smaller than noise, for unknowns follow it: on the whole by the share of the
    degrees of freedom in the observations.
    """
    values = np.concatenate([np.asarray(r).ravel() for r in adjustment.residuals().pixels])
    weights = np.concatenate(
        [np.repeat(np.asarray(f.weight)[: f.n_real], 2) for f in adjustment.problem.network.pixels]
    )
    used, freedom = n_used(adjustment.problem), adjustment.degrees_of_freedom
    kept = freedom / used if freedom > 0 else 1.0
    return float((np.median(np.abs(values[weights > 0])) / 0.67449) ** 2 / kept)


def _where(scene: Scene, row: int) -> str:
    obs, model = scene.recording.observations, scene.model
    target = model.targets[obs.target[row]]
    return (
        f"camera {model.cameras[obs.camera[row]].name}, target {target.name}, "
        f"point {target.point_names[obs.point[row]]}, "
        f"epoch {scene.recording.epoch_ids[obs.epoch[row]]}"
    )
