"""Monte Carlo of compensation: a drift model learnt from noisy images, applied to another history.

A model of one structure is learnt by the adjustment of the network, gains and time constants
together with all else: trials of that are traced, and run in batches. To decide between structures
is no one program: such trials run one by one.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from jaxvm.identify import compensate, identify
from jaxvm.identify.compensate import moves
from jaxvm.identify.inputs import Inputs, inputs_of
from jaxvm.identify.lags import Lags, Padded, Structure, padded, regressors_at
from jaxvm.identify.model import CameraDrift
from jaxvm.identify.one_step import ENOUGH, Places, adjusted
from jaxvm.identify.poses import mark_depths
from jaxvm.montecarlo.estimators import Estimator, LevenbergMarquardt
from jaxvm.montecarlo.trials import OneByOne, Traced, Trial, fingerprint, name_of
from jaxvm.network.draw import Noise
from jaxvm.network.scene import Scene
from jaxvm.network.state import State
from jaxvm.recording import Recording
from jaxvm.solve.problem import Problem, normal_at, scaled, scene_problem, specialised

_DAMPING = 1e-11
"""From the answer without noise a full step is nearly right; damping comes where it is not."""


def compensation_study(
    train: Recording,
    other: Recording,
    drift: Float[np.ndarray, "observations 2"],
    noise: Noise = jax.random.normal,
    told: dict[str, Any] | None = None,
    **how: Any,
) -> OneByOne:
    """The study of what a drift model takes off another history of temperature.

    A trial draws noise on the pixels of both recordings, identifies a model on the first
    (`jaxvm.identify.identify`), and compensates the second. It gives the drift that remains, mean
    (`mean_px`, u and v) and root mean square (`rms_px`), and notes the RMS before. Where the
    structure is known, `structure_study` is several times as fast.

    Args:
        train, other: recordings without noise; their sigmas are those of the noise.
        drift: true drift of every observation of `other` (px), against the camera that a model
            compensates to: the mean state of the training.
        noise: its distribution; normal by default.
        told: what else the study is, for a file.
        how: anything else that `identify` takes: structures, steps.

    Raises:
        ValueError: drifts that are not those of the observations of `other`.
    """
    _check(drift, other)

    def trial(key) -> Trial:
        learnt, applied = jax.random.split(key)
        model = identify(_noisy(train, learnt, noise), **how).model
        taken = -compensate(_noisy(other, applied, noise), model).correction
        left = drift - taken
        return Trial(
            error={"mean_px": left.mean(axis=0), "rms_px": _rms(left)[None]},
            noted={"before_px": _rms(drift)},
        )

    both = [(own.observations.pixel, own.observations.sigma) for own in (train, other)]
    numbers = fingerprint(
        (both, drift, noise), words=sorted((k, v) for k, v in how.items() if not callable(v))
    )
    about = {"kind": "compensation", "noise": name_of(noise), "numbers": numbers}
    return OneByOne(trial, about | (told or {}), (ValueError, ArithmeticError))


def structure_study(
    train: Recording,
    other: Recording,
    drift: Float[np.ndarray, "observations 2"],
    structure: Structure,
    noise: Noise = jax.random.normal,
    estimator: Estimator | None = None,
    told: dict[str, Any] | None = None,
) -> Traced:
    """The study of what a drift model of one structure takes off another history of temperature.

    A trial draws noise on the pixels of the training and adjusts its network with the gains and
    time constants of all cameras, as `identify` does in its one step, begun at the answer without
    noise; which ports of a camera show and a delay are those of that, too. It gives and notes what
    `compensation_study` does. In single precision the normal equations are near singular: begin
    with more damping there and end sooner, `LevenbergMarquardt(rtol=1e-6, damping=1e-6)`.

    Args:
        train, other: recordings without noise; the sigmas of `train` are those of the noise.
        drift: true drift of every observation of `other` (px), as for `compensation_study`.
        structure: static or time constants.
        noise: its distribution; normal by default.
        estimator: damped steps by default, which end as those of the one step do.
        told: what else the study is, for a file.

    Raises:
        ValueError: drifts that are not those of the observations of `other`; a parabola or no drift
            at all, whose gains are no part of the network; a camera of the training that is not in
            `other`; an adjustment without noise that fails; what `identify` raises.
    """
    _check(drift, other)
    if structure.power != 1:
        raise ValueError(
            f'"{structure.name}" is learnt outside the network; take compensation_study for it'
        )
    found = identify(train, [structure], one_step=False)
    drifts = [own.drift for own in found.cameras]
    missing = {own.camera for own in drifts} - {own.name for own in other.model.cameras}
    if missing:
        raise ValueError(f"the other recording has no camera {', '.join(sorted(missing))}")
    inputs = inputs_of(train)
    fit = adjusted(found.plain, drifts, inputs)
    if fit.failed:
        raise ValueError(f"the training can't be adjusted with {structure.name}: {fit.why}")
    problem = scene_problem(fit.scene)
    problem, _ = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    learnt = [_Learnt.of(own, fit.scene, inputs, other) for own in drifts]
    if estimator is None:
        estimator = LevenbergMarquardt(rtol=ENOUGH, damping=_DAMPING)
    trial = _Learning(specialised(problem), learnt, jnp.asarray(drift), noise, estimator)
    about = {"kind": "compensation", "noise": name_of(noise), "estimator": name_of(estimator)}
    return Traced(trial, about | {"numbers": fingerprint(trial)} | (told or {}))


class _Learnt(eqx.Module):
    """What the state of the training says about the pixels of a camera in another recording."""

    places: tuple[Int[Array, "ports regressors"], Int[Array, " order"], Float[Array, " ports"]]
    delay: Float[Array, ""]
    train: Padded
    trained: Int[Array, " epochs"]  # those that are not padding
    other: Padded
    rows: Int[Array, " own"]  # observations of the camera
    epoch: Int[Array, " own"]
    moves: Float[Array, "own 2 ports"]

    @classmethod
    def of(cls, drift: CameraDrift, scene: Scene, inputs: Inputs, other: Recording) -> "_Learnt":
        model, at = drift.dynamics, Places.of(drift, scene)
        assert isinstance(model, Lags)
        names = [camera.name for camera in other.model.cameras]
        number, obs = names.index(drift.camera), other.observations
        rows = np.flatnonzero(obs.camera == number)
        depth = mark_depths(other)[rows] if drift.has_shifts else np.full(len(rows), drift.depth_m)
        unit = moves(other.model.cameras[number], drift, obs.pixel[rows], depth)
        return cls(
            (jnp.asarray(at.gain), jnp.asarray(at.tau), jnp.asarray(at.size)),
            jnp.asarray(float(model.delay)),
            padded(inputs.only(model.inputs), model.reference),
            jnp.arange(len(inputs.epoch)),
            padded(inputs_of(other).only(model.inputs), model.reference),
            jnp.asarray(rows),
            jnp.asarray(obs.epoch[rows]),
            jnp.asarray(unit),
        )

    def taken(self, state: State) -> Float[Array, "own 2"]:
        """Displacement (px) that the model foretells."""
        places, at, size = self.places
        gain, tau = state.amplitude[places] * size[:, None], state.constant[at]
        centre = regressors_at(self.train, tau, self.delay, 1)[self.trained].mean(axis=0)
        ports = (regressors_at(self.other, tau, self.delay, 1) - centre) @ gain.T
        return jnp.einsum("ncp,np->nc", self.moves, ports[self.epoch])


class _Learning(eqx.Module):
    """One trial: noise on the pixels of the training, the adjustment, and what drift remains."""

    problem: Problem
    learnt: list[_Learnt]
    drift: Float[Array, "observations 2"]
    noise: Noise
    estimator: Estimator

    def __call__(self, key: PRNGKeyArray) -> Trial:
        problem, pixels = self.problem, []
        keys = jax.random.split(key, len(problem.network.pixels) + 1)
        for own, factor in zip(keys, problem.network.pixels, strict=False):
            off = factor.sigma * self.noise(own, factor.sigma.shape)
            pixel = factor.circumstances.pixel + off
            pixels.append(eqx.tree_at(lambda f: f.circumstances.pixel, factor, pixel))
        problem = eqx.tree_at(lambda p: p.network.pixels, problem, tuple(pixels))
        found = self.estimator(problem, keys[-1])
        left, state = self.drift, problem.state(found.x)
        for camera in self.learnt:
            left = left.at[camera.rows].add(-camera.taken(state))
        return Trial(
            error={"mean_px": left.mean(axis=0), "rms_px": _rms(left)[None]},
            converged=found.converged,
            noted={"before_px": _rms(self.drift), "evaluations": found.evaluations},
        )


def _check(drift: np.ndarray, other: Recording) -> None:
    if np.shape(drift) != np.shape(other.observations.pixel):
        raise ValueError(
            f"{np.shape(drift)} drifts do not fit {np.shape(other.observations.pixel)}"
        )


def _noisy(recording: Recording, key, noise: Noise) -> Recording:
    obs = recording.observations
    sigma = np.broadcast_to(np.asarray(obs.sigma).reshape(len(obs.pixel), -1), obs.pixel.shape)
    pixel = obs.pixel + sigma * np.asarray(noise(key, obs.pixel.shape))
    return replace(recording, observations=replace(obs, pixel=pixel))


def _rms(values: Float[ArrayLike, "n 2"]) -> Float[Array, ""]:
    return jnp.sqrt(jnp.mean(jnp.sum(jnp.asarray(values) ** 2, axis=1)))
