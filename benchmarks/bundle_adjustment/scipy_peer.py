"""SciPy's least_squares on a bundle adjustment problem, with residuals and Jacobian by jaxvm.

    python scipy_peer.py FILE [--repeats N] [--limit SECONDS]

Trust region reflective, the step by LSMR, unknowns scaled by the columns of the Jacobian: what
SciPy offers for sparse problems of this size. The sparse Jacobian is exact and compiled, so that
the two differ in what they do with it. Prints JSON: for each repetition the lowest cost so far
(half the sum of squares) and the seconds after every evaluation, why it stopped, and the seconds of
the first evaluation, which compiles.
"""

import argparse
import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from jaxvm.network.scene import build
from jaxvm.recording.bal import import_bal
from jaxvm.solve.problem import Problem, scene_problem


class TimeIsUp(Exception):
    """Raised out of an evaluation of the residuals."""


def sparse_jacobian(problem: Problem):
    """The Jacobian at x as a function: its columns once, its values for every x."""
    (factor,), (packets,) = problem.network.factors(), problem.packets
    n = factor.n_real
    columns = np.asarray(problem.column)[np.asarray(factor.slots)[:n]][:, list(packets.live)]
    columns = np.repeat(columns, 2, axis=0)
    used = columns < problem.n
    starts = np.append(0, np.cumsum(used.sum(axis=1)))

    def at(x):
        (table,) = problem.linearised(jnp.asarray(x))
        values = np.asarray(table.jacobian)[:n].reshape(columns.shape)
        return csr_array((values[used], columns[used], starts), shape=(2 * n, problem.n))

    return at


def solve(problem: Problem, limit: float) -> tuple[list[list[float]], str]:
    """Costs and seconds, and why it stopped: after `limit` seconds wherever it is."""
    n = problem.network.factors()[0].n_real
    rows = []
    # SciPy's first trust region is as large as the unknowns: values, not increments.
    start = np.zeros(problem.n + 1)
    start[np.asarray(problem.column)] = np.asarray(problem.base)
    start = start[:-1]
    began = time.perf_counter()
    jacobian = sparse_jacobian(problem)

    def residual(x):
        (block,) = jax.tree.leaves(problem.residual(jnp.asarray(x - start)))
        value = np.asarray(block)[:n].ravel()
        cost, seconds = 0.5 * float(value @ value), time.perf_counter() - began
        rows.append([min(cost, rows[-1][0]) if rows else cost, seconds])
        if seconds > limit:
            raise TimeIsUp
        return value

    try:
        found = least_squares(
            residual,
            start,
            lambda x: jacobian(x - start),
            method="trf",
            tr_solver="lsmr",
            x_scale="jac",
            ftol=1e-7,
            xtol=None,
            gtol=None,
            max_nfev=10_000,
        )
    except TimeIsUp:
        return rows, f"stopped after {limit:g} s: not converged"
    return rows, "converged" if found.success else found.message


def main() -> None:
    asked = argparse.ArgumentParser()
    asked.add_argument("file")
    asked.add_argument("--repeats", type=int, default=1)
    asked.add_argument("--limit", type=float, default=120.0)
    options = asked.parse_args()
    problem = scene_problem(build(import_bal(options.file)))
    began = time.perf_counter()
    jax.block_until_ready(problem.residual(jnp.zeros(problem.n)))
    sparse_jacobian(problem)(np.zeros(problem.n))
    compiling = time.perf_counter() - began
    runs, why = zip(*(solve(problem, options.limit) for _ in range(options.repeats)), strict=True)
    print(
        json.dumps({"scipy": scipy.__version__, "compiling": compiling, "runs": runs, "why": why})
    )


if __name__ == "__main__":
    main()
