"""Data snooping: redundancy numbers, standardised residuals, and what they reject.

Baarda 1968: w = v / (sigma_v) with sigma_v^2 = r sigma^2, r the observation's redundancy number.
For the two components of an image point the test is on both: T = v^T (R)^-1 v ~ chi2(2).
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment, adjust
from jaxvm.solve.arrow import factorise
from jaxvm.solve.large import is_large
from jaxvm.solve.problem import Problem
from jaxvm.solve.reduced import half_rows, packet_of_rows
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
    jacobians = [table.jacobian for table in tables]
    counted = [factor.weight > 0.0 for factor in problem.network.factors()]
    if is_large(problem):
        return _large_complements(problem, x, jacobians, counted)
    hessian = problem.assembled(tables).hessian
    return _complements(hessian, problem.packets, jacobians, counted, problem.sizes)


@eqx.filter_jit
def _complements(hessian, packets_of, jacobians, counted, sizes):
    factors = factorise(hessian)
    result = []
    for packets, jacobian, used in zip(packets_of, jacobians, counted, strict=True):
        half = half_rows(factors, packets, jacobian, sizes)
        hat = jnp.einsum("nak,nbk->nab", half, half)
        result.append(used[:, None, None] * jnp.eye(hat.shape[1]) - hat)
    return result


def _large_complements(problem: Problem, x, jacobians, counted) -> list[np.ndarray]:
    """The same through the selected inverse: an observation needs its own unknowns' block only."""
    inverse = SelectedInverse.of(problem, x)
    result = []
    for packets, jacobian, used in zip(problem.packets, jacobians, counted, strict=True):
        blocks = inverse.blocks(np.asarray(packets.columns))
        jacobian = np.asarray(jacobian)
        packet = np.asarray(packet_of_rows(packets, len(jacobian)))
        hat = np.einsum("nak,nkl,nbl->nab", jacobian, blocks[packet], jacobian, optimize=True)
        result.append(np.asarray(used)[:, None, None] * np.eye(hat.shape[1]) - hat)
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
    limit = chi2.isf(alpha, 2)
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


def robust_variance(adjustment: Adjustment) -> float:
    """Squared scale of whitened pixel residuals from their median absolute value."""
    values = np.concatenate([np.asarray(r).ravel() for r in adjustment.residuals().pixels])
    weights = np.concatenate(
        [np.repeat(np.asarray(f.weight)[: f.n_real], 2) for f in adjustment.problem.network.pixels]
    )
    return float((np.median(np.abs(values[weights > 0])) / 0.67449) ** 2)


def _where(scene: Scene, row: int) -> str:
    obs, model = scene.recording.observations, scene.model
    target = model.targets[obs.target[row]]
    return (
        f"camera {model.cameras[obs.camera[row]].name}, target {target.name}, "
        f"point {target.point_names[obs.point[row]]}, "
        f"epoch {scene.recording.epoch_ids[obs.epoch[row]]}"
    )
