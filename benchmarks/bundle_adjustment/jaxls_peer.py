"""jaxls on a bundle adjustment problem.

    python jaxls_peer.py FILE [--solver dense_cholesky] [--damping LAMBDA] [--repeats N]

To be run by a Python that has jaxls (github.com/brentyi/jaxls); it imports nothing of the project.
Points are eliminated by their Schur complement, as jaxls finds by itself; `--solver` solves what is
left. Same camera (focal length, k1, k2), nothing held, no loss, float64. Prints JSON: for each
repetition the lowest cost so far (half the sum of squares) and the seconds after every step that
was tried, by jaxls' own clock, and why it stopped. The first repetition compiles.
"""

import argparse
import gzip
import json
import sys
import time

import jax
import jax.numpy as jnp
import jaxls
import numpy as np
from loguru import logger

jax.config.update("jax_enable_x64", True)
logger.remove()
logger.add(sys.stderr, level="WARNING")


class Camera(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(9)):
    """Rotation vector, translation, focal length, k1, k2."""


class Point(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):
    """A point in space."""


def rotated(turn, point):
    square = turn @ turn
    angle = jnp.sqrt(jnp.where(square > 0.0, square, 1.0))
    axis = turn / angle
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    turned = cos * point + sin * jnp.cross(axis, point) + (1.0 - cos) * axis * (axis @ point)
    return jnp.where(square > 0.0, turned, point + jnp.cross(turn, point))


@jaxls.Cost.factory
def reprojection(values, camera, point, pixel):
    own = values[camera]
    place = rotated(own[:3], values[point]) + own[3:6]
    image = -place[:2] / place[2]
    square = image @ image
    return own[6] * (1.0 + square * (own[7] + square * own[8])) * image - pixel


def read(file):
    opened = gzip.open(file, "rt") if file.endswith(".gz") else open(file)
    with opened as stream:
        values = np.array(stream.read().split(), float)
    c, p, n = values[:3].astype(int)
    ends = 3 + np.cumsum([4 * n, 9 * c])
    observations = values[3 : ends[0]].reshape(n, 4)
    cameras, points = values[ends[0] : ends[1]].reshape(c, 9), values[ends[1] :].reshape(p, 3)
    return observations, cameras, points


def build(observations, cameras, points):
    camera, point = Camera(jnp.arange(len(cameras))), Point(jnp.arange(len(points)))
    index = jnp.asarray(observations[:, :2].astype(int))
    pixel = jnp.asarray(observations[:, 2:])
    cost = reprojection(Camera(index[:, 0]), Point(index[:, 1]), pixel)
    problem = jaxls.LeastSquaresProblem([cost], [camera, point]).analyze()
    start = [camera.with_value(jnp.asarray(cameras)), point.with_value(jnp.asarray(points))]
    return problem, jaxls.VarValues.make(start)


def solve(problem, start, times, options):
    """Lowest cost so far and seconds after each step that was tried; why it stopped."""
    times.clear()
    began = time.perf_counter()
    _, summary = jax.block_until_ready(
        problem.solve(
            start,
            linear_solver=options.solver,
            trust_region=jaxls.TrustRegionConfig(lambda_initial=options.damping),
            termination=jaxls.TerminationConfig(
                max_iterations=options.iterations,
                cost_tolerance=1e-7,
                gradient_tolerance=0.0,
                parameter_tolerance=0.0,
            ),
            verbose=False,
            return_summary=True,
        )
    )
    jax.effects_barrier()
    steps = int(summary.iterations)
    costs = 0.5 * np.asarray(summary.cost_history)[: steps + 1]
    lowest = np.minimum.accumulate(np.where(np.isfinite(costs), costs, np.inf))
    done = np.asarray(summary.termination_criteria).any()
    why = "converged" if done else f"stopped after {steps} steps: not converged"
    return [[float(c), t - began] for c, t in zip(lowest, times, strict=False)], why


def main():
    asked = argparse.ArgumentParser()
    asked.add_argument("file")
    asked.add_argument("--solver", default="dense_cholesky")
    asked.add_argument("--damping", type=float, default=5e-4)
    asked.add_argument("--repeats", type=int, default=2)
    asked.add_argument("--iterations", type=int, default=200)
    options = asked.parse_args()
    problem, start = build(*read(options.file))
    with jaxls.record_iteration_times() as times:
        found = [solve(problem, start, times, options) for _ in range(options.repeats)]
    runs, why = zip(*found, strict=True)
    print(json.dumps({"jaxls": jaxls.__version__, "runs": runs, "why": why}))


if __name__ == "__main__":
    main()
