"""A board of 30 marks in very many epochs, and residuals with a memory."""

from dataclasses import replace

import numpy as np
from networks import board_recording

from jaxvm.network.scene import Scene, build
from jaxvm.recording import Observations

N_EPOCHS = 200


def long_board() -> Scene:
    """5 % of the marks are lost; only who saw what matters here."""
    recording = board_recording().recording
    seen = np.flatnonzero(np.random.default_rng(0).random(N_EPOCHS * 30) > 0.05)
    epoch, point = np.divmod(seen, 30)
    nothing, n = np.zeros(len(seen), int), len(seen)
    observations = Observations(epoch, nothing, nothing, point, np.zeros((n, 2)), np.ones(n))
    number = np.arange(N_EPOCHS)
    return build(replace(recording, epoch_ids=number, time=1.0 * number, observations=observations))


def autoregressive(rng, phi: float, shape: tuple[int, ...]) -> np.ndarray:
    """Stationary AR(1) series of unit variance along the first axis."""
    white = rng.standard_normal(shape)
    course = np.empty(shape)
    course[0] = white[0]
    for k in range(1, len(course)):
        course[k] = phi * course[k - 1] + np.sqrt(1.0 - phi**2) * white[k]
    return course


def of_marks(scene, courses: np.ndarray) -> np.ndarray:
    """Residuals of the observations: each mark [epochs, marks, 2] has its own course."""
    obs = scene.recording.observations
    return courses[obs.epoch, obs.point]
