"""Monte Carlo of whole networks: measurements drawn anew, adjusted again, errors against theory.

A trial is the adjustment of a scene whose measurements were drawn about a true state: the same
residual, the same normal equations.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxvm.montecarlo.estimators import Estimator, GaussNewton
from jaxvm.montecarlo.results import Results
from jaxvm.montecarlo.run import Progress, run
from jaxvm.montecarlo.trials import Traced, Trial, fingerprint, name_of
from jaxvm.network.draw import Noise, drawn, with_measurements
from jaxvm.network.network import Network
from jaxvm.network.scene import Scene
from jaxvm.network.state import State
from jaxvm.recording.write import model_text
from jaxvm.solve.adjust import degrees_of_freedom
from jaxvm.solve.arrow import Arrow, factorise
from jaxvm.solve.gauge import check_gauge
from jaxvm.solve.large import is_large
from jaxvm.solve.problem import Problem, normal_at, scaled, scene_problem, specialised
from jaxvm.solve.robust import Loss

Quantity = Callable[[State], Float[Array, "..."] | Mapping[str, Float[Array, "..."]]]

Truth = Callable[[PRNGKeyArray, State], State]
"""A true state of a trial, drawn about that of the scene."""


class NetworkTrial(eqx.Module):
    """One trial: draw the truth and its measurements, estimate, compare quantities of the states.

    Attributes:
        problem: the scene's, scaled.
        quantity: whose errors count.
        estimator: how the state is estimated.
        noise: its distribution, in units of the sigmas.
        truth: how the true state is drawn; None where it is always the scene's.
        source: what is drawn from, where the world has physics that the model leaves out.
        sigma: standard deviations foretold at the scene's state.
    """

    problem: Problem
    quantity: Quantity
    estimator: Estimator
    noise: Noise
    truth: Truth | None
    source: tuple[Network, State] | None
    sigma: dict[str, Float[Array, " m"]]

    def __call__(self, key: PRNGKeyArray) -> Trial:
        problem = self.problem
        base = true = problem.state(jnp.zeros(problem.n))
        network, state = (problem.network, base) if self.source is None else self.source
        if self.truth is not None:
            key, own = jax.random.split(key)
            true, state = self.truth(own, base), self.truth(own, state)
        # Priors are the model's own, whatever the world is: they are drawn about its truth.
        measured = drawn(problem.network, true, key, noise=self.noise)
        if self.source is not None:
            measured = with_measurements(measured, drawn(network, state, key, noise=self.noise))
        own = eqx.tree_at(lambda p: p.network, problem, measured)
        found = self.estimator(own, jax.random.fold_in(key, 1))
        aim, got = named(self.quantity(true)), named(self.quantity(own.state(found.x)))
        error = {name: got[name] - aim[name] for name in aim}
        noted = {"cost": found.cost, "evaluations": found.evaluations}
        return Trial(error, found.converged, self.sigma, noted)


class NetworkStudy(Traced):
    """A study of a scene, and what theory foretells of it.

    Attributes:
        covariance: of the quantity, from the Gauss-Newton matrix at the scene's state.
        degrees_of_freedom: observations minus unknowns.
    """

    covariance: Float[np.ndarray, "m m"] = eqx.field(kw_only=True)
    degrees_of_freedom: int = eqx.field(kw_only=True)


def named(quantity: Any) -> dict[str, Float[Array, " m"]]:
    """A quantity as named flat arrays, in the order of their names; `error` if it has none."""
    parts = quantity if isinstance(quantity, Mapping) else {"error": quantity}
    return {name: jnp.ravel(parts[name]) for name in sorted(parts)}


def network_study(
    scene: Scene,
    quantity: Quantity,
    *,
    estimator: Estimator | None = None,
    noise: Noise = jax.random.normal,
    truth: Truth | None = None,
    world: Scene | None = None,
    loss: Loss | None = None,
    told: dict[str, Any] | None = None,
) -> NetworkStudy:
    """The study of a scene whose measurements are drawn anew.

    Args:
        scene: at the true state, or at the one that truths are drawn about, where every estimate
            starts; its sigmas are those of the noise.
        quantity: of the state, whose errors count; an array or several by name; differentiable.
        estimator: Gauss-Newton steps by default (`jaxvm.montecarlo.estimators`).
        noise: its distribution; normal by default (`jaxvm.montecarlo.noise`).
        truth: draws a true state from a key and the scene's state; by default it is the scene's.
        world: the same recording with physics that the model leaves out, at the true state:
            measurements are drawn from it. By default the model leaves out nothing.
        loss: robust loss of the adjustment.
        told: what else the study is, for a file.

    Raises:
        RankDeficiency: the scene does not determine its unknowns.
        ValueError: the network is too large for dense trials.
    """
    problem = scene_problem(scene, loss)
    if is_large(problem):
        raise ValueError(
            f"{problem.sizes[0]} shared unknowns are too many for trials in batches; "
            "take the covariance of one adjustment, or a smaller network"
        )
    problem, normal = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    check_gauge(normal, scene.unknowns)
    estimator = GaussNewton() if estimator is None else estimator
    covariance = np.asarray(_covariance(problem, normal.hessian, quantity))
    _, in_parts = ravel_pytree(named(quantity(problem.state(jnp.zeros(problem.n)))))
    sigma = in_parts(jnp.asarray(np.sqrt(np.diagonal(covariance))))
    source = None
    if world is not None:
        effects = world.network.effects.specialised()
        source = replace(world.network, effects=effects), world.state
    problem = specialised(problem)
    trial = NetworkTrial(problem, quantity, estimator, noise, truth, source, sigma)
    about = {"kind": "network", "noise": name_of(noise), "estimator": name_of(estimator)}
    about["model"] = _model_text(scene)
    return NetworkStudy(
        trial,
        about | {"numbers": fingerprint(trial)} | (told or {}),
        covariance=covariance,
        degrees_of_freedom=degrees_of_freedom(problem, normal.hessian.diagonal()),
    )


def _model_text(scene: Scene) -> str:
    """The scene's model as recording.toml has it; empty where the format can't say it."""
    try:
        return model_text(scene.model)
    except ValueError:
        return ""


class Spread(eqx.Module):
    """True poses of the free stations about those of the scene, normal.

    Attributes:
        turn, shift: standard deviations about and along each axis (rad, m).
        free: 1 for the poses that are drawn.
    """

    turn: Any = eqx.field(converter=jnp.asarray)
    shift: Any = eqx.field(converter=jnp.asarray)
    free: Float[Array, " poses"]

    @classmethod
    def of(cls, scene: Scene, turn: float, shift: float) -> "Spread":
        """Of the stations of a scene that are free."""
        free = np.zeros(len(scene.state.world_from_station))
        for i, station in enumerate(scene.model.stations):
            if "pose" in station.free:
                free[np.unique(scene.station_row[i])] = 1.0
        return cls(turn, shift, jnp.asarray(free))

    def __call__(self, key: PRNGKeyArray, state: State) -> State:
        sigma = jnp.concatenate([jnp.full(3, self.turn), jnp.full(3, self.shift)])
        off = jax.random.normal(key, (len(self.free), 6)) * sigma * self.free[:, None]
        return eqx.tree_at(lambda s: s.world_from_station, state, state.world_from_station + off)


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Errors of a quantity over many trials, and what theory foretells.

    Attributes:
        errors: estimate minus truth of the trials that converged.
        covariance: that of the Gauss-Newton matrix at the truth.
        cost: half the sum of squares of each of these trials.
        degrees_of_freedom: observations minus unknowns.
        failed: which of all trials did not converge.
        results: all that the trials gave.
    """

    errors: Float[np.ndarray, "trials m"]
    covariance: Float[np.ndarray, "m m"]
    cost: Float[np.ndarray, " trials"]
    degrees_of_freedom: int
    failed: Bool[np.ndarray, " all_trials"]
    results: Results

    @property
    def predicted(self) -> Float[np.ndarray, " m"]:
        """Standard deviations that theory foretells."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def measured(self) -> Float[np.ndarray, " m"]:
        """Root mean square errors of the trials; NaN where none converged."""
        return self.results.statistics.rms

    def interval(self, level: float = 0.95) -> Float[np.ndarray, "2 m"]:
        """Interval of the true root mean square errors (chi-square)."""
        return self.results.statistics.interval(level)

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
    key: int | PRNGKeyArray,
    trials: int = 1000,
    batch: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    folder: Any = None,
    **drawing: Any,
) -> MonteCarlo:
    """Adjust a scene many times, its measurements drawn anew, and compare with theory.

    Args:
        scene, quantity: as for `network_study`.
        key, trials, batch, progress, folder: as for `run`.
        drawing: anything else that `network_study` takes: noise, truth, world, estimator.

    Raises:
        RankDeficiency, ValueError: as `network_study`.
        FileExistsError: as `run`.
    """
    study = network_study(scene, quantity, **drawing)
    found = run(study, key, trials, folder=folder, batch=batch, progress=progress)
    columns = found.columns
    return MonteCarlo(
        errors=found.errors,
        covariance=study.covariance,
        cost=columns["cost"][columns["converged"]],
        degrees_of_freedom=study.degrees_of_freedom,
        failed=~columns["converged"],
        results=found,
    )


def station_trials(
    scene: Scene,
    key: int | PRNGKeyArray,
    trials: int = 1000,
    batch: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    **drawing: Any,
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
    found = montecarlo(scene, Stations(jnp.asarray(rows)), key, trials, batch, progress, **drawing)
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


class Stations(eqx.Module):
    """The quantity that poses of stations are, by their rows in the state."""

    rows: Any

    def __call__(self, state: State) -> dict[str, Array]:
        return {"station": state.world_from_station[self.rows]}


@eqx.filter_jit
def _covariance(problem: Problem, hessian: Arrow, quantity: Quantity):
    def flat(y):
        return ravel_pytree(named(quantity(problem.state(y))))[0]

    rows = jax.jacrev(flat)(jnp.zeros(problem.n))
    return rows @ factorise(hessian).solve(rows.T)
