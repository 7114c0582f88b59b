"""Errors of what was logged: samples are noisy and rounded, and nothing is known between them.

An effect that shows clearly follows its input better than the log does. The estimates then err by
what the log lacks, which the residuals do not tell. How much is found by the model itself: errors
are drawn for the log, go through all courses and the residual, and move the estimates.
"""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxvm.recording import Drivers
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import influence

_DRAWS = 24
"""Logs that are drawn: a standard deviation is then known to a seventh of itself."""

_LOGGED = {"quantity", "difference", "own"}
"""Kinds of channels that are made of logged ones."""


def sample_error(values: Float[np.ndarray, " samples"]) -> float:
    """Standard deviation of the errors of a log's samples (its unit), from the log alone.

    Fourth differences of what is smooth vanish; those of white noise have 70 times its variance
    (1 + 16 + 36 + 16 + 1). What is rough between samples counts as much as it makes interpolation
    uncertain.
    """
    if len(values) < 8:
        return 0.0
    return float(np.sqrt(np.mean(np.diff(values, 4) ** 2) / 70.0))


def variances_by_inputs(fitted: Adjustment, seed: int = 0) -> list[Float[np.ndarray, " values"]]:
    """Variances that errors of the log give to the amplitudes and constants of each effect.

    Zero for effects that follow nothing that was logged.
    """
    scene, layout = fitted.scene, fitted.problem.network.layout
    channels, drivers = scene.network.channels, scene.recording.drivers
    amplitude, constant = layout.all("amplitude"), layout.all("constant")
    places = [
        np.concatenate([amplitude[columns], constant[constants]])
        for columns, constants in scene.places()
    ]
    found = [np.zeros(len(own)) for own in places]
    logged = [
        k
        for k, effect in enumerate(scene.effects)
        if channels.kinds[channels.index(effect.driver)] in _LOGGED
    ]
    if drivers is None or not logged:
        return found
    weights = influence(fitted, np.concatenate([places[k] for k in logged]))
    base = fitted.residuals()
    rng = np.random.default_rng(seed)
    moved = []
    for _ in range(_DRAWS):
        drawn = _drawn(fitted, drivers, rng)
        change = jax.tree.map(lambda new, old: np.asarray(new) - np.asarray(old), drawn, base)
        pairs = zip(jax.tree.leaves(weights), jax.tree.leaves(change), strict=True)
        moved.append(sum(np.tensordot(own, np.asarray(weight), own.ndim) for weight, own in pairs))
    variance = np.mean(np.square(moved), axis=0)
    ends = np.cumsum([len(places[k]) for k in logged])[:-1]
    for k, own in zip(logged, np.split(variance, ends), strict=True):
        found[k] = own
    return found


def _drawn(fitted: Adjustment, drivers: Drivers, rng: np.random.Generator):
    """Whitened residuals with another draw of the log's errors."""
    channels = {
        name: values + sample_error(values) * rng.standard_normal(len(values))
        for name, values in drivers.channels.items()
    }
    recording = replace(fitted.scene.recording, drivers=Drivers(drivers.time, channels))
    values = recording.channels().values
    problem = eqx.tree_at(lambda p: p.network.channels.values, fitted.problem, values)
    return replace(fitted, problem=problem).residuals()
