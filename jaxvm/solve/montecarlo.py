"""Monte Carlo of whole networks: measurements drawn anew, adjusted again, errors against theory.

A trial is the adjustment of a scene whose measurements were drawn about its present state. Trials
are one program under `vmap`: the same residual, the same normal equations.
"""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from scipy.stats import chi2

from jaxvm.network.draw import drawn, with_measurements
from jaxvm.network.scene import Scene
from jaxvm.network.state import State
from jaxvm.solve.adjust import degrees_of_freedom
from jaxvm.solve.arrow import factorise
from jaxvm.solve.gauge import check_gauge
from jaxvm.solve.large import is_large
from jaxvm.solve.problem import Problem, normal_at, scaled, scene_problem

Quantity = Callable[[State], Float[Array, " m"]]

_STEPS = 20
_SETTLED = 1e-6
"""Largest change of a unit-diagonal unknown at which a trial has converged.

Rounding moves weak combinations by as much as 1e-7 where the condition number is 1e8.
"""


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Errors of a quantity over many trials, and what theory foretells.

    Attributes:
        errors: estimate minus truth of the trials that converged.
        covariance: that of the Gauss-Newton matrix at the truth.
        cost: half the sum of squares of each of these trials.
        degrees_of_freedom: observations minus unknowns.
        failed: which of all trials did not converge.
    """

    errors: Float[np.ndarray, "trials m"]
    covariance: Float[np.ndarray, "m m"]
    cost: Float[np.ndarray, " trials"]
    degrees_of_freedom: int
    failed: Bool[np.ndarray, " all_trials"]

    @property
    def predicted(self) -> Float[np.ndarray, " m"]:
        """Standard deviations that theory foretells."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def measured(self) -> Float[np.ndarray, " m"]:
        """Root mean square errors of the trials."""
        return np.sqrt(np.mean(self.errors**2, axis=0))

    def interval(self, level: float = 0.95) -> Float[np.ndarray, "2 m"]:
        """Interval of the true root mean square errors (chi-square)."""
        n = len(self.errors)
        bounds = chi2.ppf([0.5 + 0.5 * level, 0.5 - 0.5 * level], n)
        return self.measured * np.sqrt(n / bounds)[:, None]

    @property
    def chi_square(self) -> float:
        """Mean of e^T C^+ e over the rank of C: 1 where the predicted covariance is right."""
        # Turns in rad and shifts in m differ by many orders of magnitude.
        scale = np.where(self.predicted > 0.0, self.predicted, 1.0)
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        kept = values > 1e-10 * values[-1]
        white = self.errors / scale @ vectors[:, kept] / np.sqrt(values[kept])
        return float(np.mean(white**2))


def montecarlo(
    scene: Scene,
    quantity: Quantity,
    key: PRNGKeyArray,
    trials: int = 1000,
    batch: int = 128,
    progress: Callable[[int], None] | None = None,
    world: Scene | None = None,
) -> MonteCarlo:
    """Adjust a scene many times, its measurements drawn about its present state.

    Trials start at the truth and take Gauss-Newton steps.

    Args:
        scene: at the true state; its sigmas are those of the noise.
        world: the same recording with physics that the model leaves out, at the true state:
            measurements are drawn from it. By default the model leaves out nothing.
        quantity: of the state, whose errors count; differentiable.
        key: of the noise; trial k is the same whatever the number of trials and the batch.
        trials: how many.
        batch: how many at a time.
        progress: told after each batch how many trials are done.

    Raises:
        RankDeficiency: the scene does not determine its unknowns.
        ValueError: the network is too large for dense trials.
    """
    problem = scene_problem(scene)
    if is_large(problem):
        raise ValueError(
            f"{problem.sizes[0]} shared unknowns are too many for trials in batches; "
            "take the covariance of one adjustment, or a smaller network"
        )
    problem, normal = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    check_gauge(normal, scene.unknowns)
    keys = jax.vmap(lambda k: jax.random.fold_in(key, k))(jnp.arange(-(-trials // batch) * batch))
    source = None if world is None else (world.network, world.state)
    parts = []
    for first in range(0, trials, batch):
        found = _trials(problem, quantity, keys[first : first + batch], source)
        parts.append(jax.tree.map(np.asarray, found))
        if progress is not None:
            progress(min(first + batch, trials))
    errors, cost, converged = (np.concatenate(part)[:trials] for part in zip(*parts, strict=True))
    return MonteCarlo(
        errors=errors[converged],
        covariance=np.asarray(_covariance(problem, quantity)),
        cost=cost[converged],
        degrees_of_freedom=degrees_of_freedom(problem, normal.hessian.diagonal()),
        failed=~converged,
    )


def station_trials(
    scene: Scene,
    key: PRNGKeyArray,
    trials: int = 1000,
    batch: int = 128,
    progress: Callable[[int], None] | None = None,
    world: Scene | None = None,
) -> tuple[MonteCarlo, pd.DataFrame]:
    """Monte Carlo of the poses of all stations that are free, and a table of it.

    The table has a row for every station and epoch and each part of its pose: error foretold,
    measured and the 95 % interval of the latter (rad, m), and the mean error. Arguments as for
    `montecarlo`.

    Raises:
        ValueError: no station is free.
    """
    rows, labels = [], []
    ids = scene.recording.epoch_ids
    for i, station in enumerate(scene.model.stations):
        if "pose" not in station.free:
            continue
        own, first = np.unique(scene.station_row[i], return_index=True)
        moving = station.motion == "per-epoch"
        rows += own.tolist()
        labels += [(station.name, str(ids[k]) if moving else "") for k in first]
    if not rows:
        raise ValueError("no station is free: there is nothing to adjust")
    at = jnp.asarray(rows)
    found = montecarlo(
        scene, lambda s: s.world_from_station[at], key, trials, batch, progress, world
    )
    low, high = found.interval()
    parts = [f"{part}_{axis}" for part in ("turn", "shift") for axis in "xyz"]
    frame = pd.DataFrame(
        [(*label, part) for label in labels for part in parts],
        columns=["station", "epoch", "part"],
    )
    frame["predicted"], frame["measured"] = found.predicted, found.measured
    frame["low"], frame["high"] = low, high
    frame["mean"] = found.errors.mean(axis=0) if len(found.errors) else np.nan
    return found, frame


@eqx.filter_jit
def _trials(problem: Problem, quantity: Quantity, keys, source):
    """Errors, costs, and whether each trial converged."""
    truth = problem.state(jnp.zeros(problem.n))
    aim = jnp.ravel(quantity(truth))
    network, state = (problem.network, truth) if source is None else source

    def one(key):
        # Priors are the model's own, whatever the world is: they are drawn about its truth.
        own = drawn(problem.network, truth, key)
        measured = own if source is None else with_measurements(own, drawn(network, state, key))
        own = eqx.tree_at(lambda p: p.network, problem, measured)

        def step(state):
            x, _, k = state
            normal = own.normal(x)
            change = -factorise(normal.hessian).solve(normal.gradient)
            return x + change, jnp.max(jnp.abs(change)), k + 1

        def going(state):
            _, change, k = state
            return (change > _SETTLED) & (k < _STEPS)

        x, change, _ = jax.lax.while_loop(
            going, step, (jnp.zeros(problem.n), jnp.array(jnp.inf), jnp.array(0))
        )
        return jnp.ravel(quantity(own.state(x))) - aim, own.cost(x), change <= _SETTLED

    return jax.vmap(one)(keys)


@eqx.filter_jit
def _covariance(problem: Problem, quantity: Quantity):
    x = jnp.zeros(problem.n)
    rows = jax.jacrev(lambda y: jnp.ravel(quantity(problem.state(y))))(x)
    return rows @ factorise(problem.normal(x).hessian).solve(rows.T)
