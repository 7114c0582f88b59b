"""SPGD on the misclosure of a loop alone: it wanders in the null space, and by how much.

Unknowns are the corrections xi of the n links of a ring, in standard deviations, from zero. The
misclosure w + B xi sees d of them (d = 1 for numbers, 6 for poses), the other d n - d move freely:
gradient descent ends in the least-squares adjustment xi_LS, SPGD elsewhere. On average, with
A = B^T S B, S the sum of the covariances of the misclosure over the steps, and P the projector on
the null space of B (the fourth moments of random signs give the mean of s s^T A s s^T),

    E|xi - xi_LS|^2 = eta^2 tr(P (2 A + tr A I - 2 diag A)).

For numbers this is |xi_LS|^2 eta (n-1)(n-2) / (2 - eta (3n-2)): half of eta (n-1)(n-2) for small
gains, and infinite from eta = 2 / (3n-2), where single runs still end somewhere.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from layouts import SIGMA, closed_ring, layout
from scipy.linalg import solve_sylvester

from jaxvm.network.cycles import fundamental_cycles
from jaxvm.network.residual import residual
from jaxvm.network.scene import build
from jaxvm.solve.condition import adjust_conditions
from jaxvm.solve.problem import scene_problem
from jaxvm.solve.spgd import SPGD, ConstantGain

RINGS = (4, 8, 16, 32)
POSE_RING = 8
GAINS = {"1": 1.0, "1/20": 0.05}
"""Gain times tr H."""

_SOFT = 0.3
"""Standard deviation of a closure, in those of a link, where the links have a term, too."""

_GONE = 1e-8
"""Share of the first cost at which the misclosure is gone."""

_AMPLITUDE = 1e-5
"""Of the perturbation: small against what is left of the misclosure."""


class Ring(eqx.Module):
    """Cost of corrections, with and without the term of the links.

    Attributes:
        b, w: derivative of the misclosure, and the misclosure itself, in standard deviations.
        least: the least-squares adjustment.
    """

    b: jax.Array
    w: jax.Array
    least: jax.Array

    def closure(self, x):
        """Misclosure at the unknowns."""
        return self.w + self.b @ x

    def correction(self, x):
        """Corrections at the unknowns, as twists in standard deviations."""
        return x

    def cost(self, x, faithful: bool):
        """Half the squared misclosure; with the links' own term if `faithful`."""
        cost = 0.5 * jnp.sum(self.closure(x) ** 2)
        if not faithful:
            return cost
        return cost / _SOFT**2 + 0.5 * jnp.sum(self.correction(x) ** 2)

    def trace(self, faithful: bool) -> float:
        """Trace of the second derivative of the cost at the start."""
        square = float(jnp.sum(self.b**2))
        return square / _SOFT**2 + self.b.shape[1] if faithful else square


class PoseRing(Ring):
    """A ring of poses: everything through the network's own residual, EdgeFactor, ClosureFactor."""

    problem: eqx.Module

    def closure(self, x):
        return self._residual(x).closures[0]

    def correction(self, x):
        return self._residual(x).edges.ravel()

    def _residual(self, x):
        return residual(self.problem.state(x), self.problem.network)


def number_ring(n: int) -> Ring:
    """A ring of n numbers with a misclosure of as many standard deviations as it should have."""
    w = jnp.full(1, np.sqrt(n))
    return Ring(jnp.ones((1, n)), w, jnp.full(n, -1.0) * w / n)


def pose_ring(n: int, seed: int = 0) -> PoseRing:
    """A ring of n poses with noisy links; unknowns are increments of the links."""
    problem = scene_problem(build(closed_ring(n, seed, 1.0)))
    factor = jnp.zeros_like(problem.factor).at[problem.network.edges.slots].set(jnp.asarray(SIGMA))
    problem = eqx.tree_at(lambda p: (p.factor, p.packets), problem, (factor, ()))
    graph = layout("ring", n, seed).graph
    least = adjust_conditions(graph, fundamental_cycles(graph)).correction / SIGMA
    none = jnp.zeros(0)
    raw = PoseRing(none, none, none, problem)
    at = jnp.zeros(problem.n)
    b = jax.jacfwd(raw.closure)(at) @ jnp.linalg.inv(jax.jacfwd(raw.correction)(at))
    return PoseRing(b, raw.closure(at), jnp.asarray(least.ravel()), problem)


def first_order(ring: Ring, eta: float) -> float:
    """Mean excess |xi - xi_LS|^2 / |xi_LS|^2 for a small gain."""
    b, w = np.asarray(ring.b), np.asarray(ring.w)
    h = b @ b.T
    total = solve_sylvester(eta * h, eta * h, np.outer(w, w))
    a = b.T @ total @ b
    p = np.eye(b.shape[1]) - b.T @ np.linalg.solve(h, b)
    spread = p @ (2.0 * a + np.trace(a) * np.eye(len(a)) - 2.0 * np.diag(np.diag(a)))
    return float(eta**2 * np.trace(spread) / np.sum(np.asarray(ring.least) ** 2))


def exact_mean(n: int, eta: float) -> float:
    """The same for a ring of numbers and any gain."""
    left = 2.0 - eta * (3 * n - 2)
    return eta * (n - 1) * (n - 2) / left if left > 0.0 else np.inf


@eqx.filter_jit
def _excess(ring: Ring, keys, eta, most, faithful: bool):
    """Excess and steps of many runs at a constant gain."""

    def one(key):
        # With the links' term it runs for a given number of steps, else until the misclosure goes.
        solver = SPGD(
            key, ConstantGain(eta), amplitude=_AMPLITUDE, rtol=0.0, max_evaluations=2 * most,
            target_share=-jnp.inf if faithful else _GONE, patience=most,
        )  # fmt: skip
        cost = partial(_cost, faithful)
        found = optx.minimise(
            cost, solver, jnp.zeros(ring.b.shape[1]), ring, max_steps=None, throw=False
        )
        off = jnp.sum((ring.correction(found.value) - ring.least) ** 2) / jnp.sum(ring.least**2)
        left = jnp.linalg.norm(ring.closure(found.value)) / jnp.linalg.norm(ring.w)
        return off, found.stats["evaluations"] // 2, left

    return jax.vmap(one)(keys)


def _cost(faithful, x, ring):
    return ring.cost(x, faithful)


def study(kind: str, n: int, gain: str, runs: int) -> dict:
    """One row: a ring, a gain, many runs without and with the links' term."""
    ring = number_ring(n) if kind == "numbers" else pose_ring(n)
    row = {"kind": kind, "n": n, "gain": gain, "runs": runs}
    for faithful in (False, True):
        eta = GAINS[gain] / ring.trace(faithful)
        # The links' term leaves no eigenvalue below one; at the full gain scatter dies slowly.
        most = int((7.0 + 25.0 * GAINS[gain]) / eta) if faithful else 1_000_000
        keys = jax.random.split(jax.random.key(n), max(runs // 8, 4) if faithful else runs)
        off, steps, left = (np.asarray(v) for v in _excess(ring, keys, eta, most, faithful))
        error = off.std() / np.sqrt(len(keys))
        own = {
            "eta": eta, "mean": float(off.mean()), "error": float(error),
            "median": float(np.median(off)), "most": float(off.max()),
            "steps": float(np.median(steps)), "misclosure_left": float(np.median(left)),
        }  # fmt: skip
        row["with links" if faithful else "misclosure alone"] = own
    eta = row["misclosure alone"]["eta"]
    row["formula"] = first_order(ring, eta)
    exact = exact_mean(n, eta)
    row["exact"] = "–" if kind == "poses" else exact if np.isfinite(exact) else "infinite"
    return row
