"""Monte Carlo of compensation: a drift model learnt from noisy images, applied to another history.

Learning decides between structures and is no one program, so trials run one by one.
"""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxvm.identify import compensate, identify
from jaxvm.montecarlo.trials import OneByOne, Trial, fingerprint, name_of
from jaxvm.network.draw import Noise
from jaxvm.recording import Recording


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
    (`mean_px`, u and v) and root mean square (`rms_px`), and notes the RMS before.

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
    if np.shape(drift) != np.shape(other.observations.pixel):
        raise ValueError(
            f"{np.shape(drift)} drifts do not fit {np.shape(other.observations.pixel)}"
        )

    def trial(key) -> Trial:
        learnt, applied = jax.random.split(key)
        model = identify(_noisy(train, learnt, noise), **how).model
        taken = -compensate(_noisy(other, applied, noise), model).correction
        left = drift - taken
        return Trial(
            error={"mean_px": left.mean(axis=0), "rms_px": _rms(left)[None]},
            noted={"before_px": _rms(drift)},
        )

    numbers = [own.observations.pixel for own in (train, other)], drift, noise
    about = {"kind": "compensation", "noise": name_of(noise), "numbers": fingerprint(numbers)}
    return OneByOne(trial, about | (told or {}), (ValueError, ArithmeticError))


def _noisy(recording: Recording, key, noise: Noise) -> Recording:
    obs = recording.observations
    sigma = np.broadcast_to(np.asarray(obs.sigma).reshape(len(obs.pixel), -1), obs.pixel.shape)
    pixel = obs.pixel + sigma * np.asarray(noise(key, obs.pixel.shape))
    return replace(recording, observations=replace(obs, pixel=pixel))


def _rms(values: Float[np.ndarray, "n 2"]) -> np.ndarray:
    return np.sqrt(np.mean(np.sum(values**2, axis=1)))
