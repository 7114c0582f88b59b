"""Nonlinear constants of effects (time constants, instants, ...): sensible ones, and held ones."""

from collections.abc import Iterator
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from jaxvm.discover.courses import at_epochs, longest_session
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Effect, courses, room_for, tabulate
from jaxvm.physics.forms import FORMS

_STILL = 0.25
"""Share of its size by which a course must change, or it is as good as constant."""


def constants_held(scene: Scene, since: int = 0) -> np.ndarray:
    """Active unknowns of a scene with the nonlinear constants of effects held, from one on."""
    active = scene.unknowns.active.copy()
    first = scene.places()[since][1].start if since else 0
    columns = scene.unknowns.column[scene.network.layout.all("constant")[first:]]
    active[columns[columns < scene.unknowns.n]] = False
    return active


def run_away(before: Scene, after: Scene) -> bool:
    """Whether constants of an effect that were sensible before a fit no longer are after it."""
    pairs = zip(before.effects, after.fitted_effects(), strict=True)
    return any(sensible(before, own) and not sensible(after, fitted) for own, fitted in pairs)


def sensible(scene: Scene, effect: Effect) -> bool:
    """Whether refined constants stayed positive and within reach of the recording.

    What settles faster than epochs follow each other is a step, and can't be told from it. What
    hardly changes any more (after a dead time as long as the recording, say) has become a constant
    under another name.
    """
    channels = scene.network.channels
    time = np.asarray(channels.epoch_time)
    span = longest_session(channels) or 1.0
    if effect.form == "settling" and effect.constants[1] < np.median(np.diff(time)):
        return False
    for constant, value in zip(FORMS[effect.form].constants, effect.constants, strict=True):
        if not np.isfinite(value):
            return False
        if not constant.refined:
            continue
        if value <= 0.0:
            return False
        if constant.unit == "s" and value > 3.0 * span:
            return False
    return not effect.constants or _changes(scene, effect)


def _changes(scene: Scene, effect: Effect) -> bool:
    """Whether any term of an effect changes over the views, for its size."""
    channels = scene.network.channels
    room = room_for((effect,), scene.room)
    table, amplitude, constant = tabulate((effect,), channels, *room)
    each = amplitude[:, None] * np.asarray(courses(table, jnp.asarray(constant), channels))
    terms = each[: effect.n_columns].reshape(len(effect.terms), -1, each.shape[1]).sum(axis=1)
    sizes = np.abs(terms).max(axis=1)
    return not sizes.any() or bool((np.ptp(terms, axis=1) > _STILL * sizes)[sizes > 0.0].any())


def jumps_of(scene: Scene) -> list[tuple[int, int]]:
    """Every jump of the effects of a scene: number of the effect, and of its instant."""
    return [
        (number, k)
        for number, effect in enumerate(scene.effects)
        if FORMS[effect.form].single == "step"
        for k in range(len(effect.constants))
    ]


def other_instants(
    scene: Scene, jump: tuple[int, int], sure: np.ndarray, seen: np.ndarray | None = None
) -> Iterator[Scene]:
    """Scenes with a jump on the other side of an epoch beside it whose side is open.

    That is an epoch which was not fitted, or which fits badly where it is.

    Args:
        scene: a fitted scene.
        jump: number of the effect, and of its instant (`jumps_of`).
        sure: for each epoch whether its side is known.
        seen: the epochs that count at all; all of them where it is not given.
    """
    (number, k), effects = jump, list(scene.fitted_effects())
    instants = list(effects[number].constants)
    at = at_epochs(effects[number].driver, scene.network.channels)
    order = np.argsort(at)
    order = order if seen is None else order[seen[order]]
    at, sure = at[order], sure[order]
    first = int(np.searchsorted(at, instants[k]))
    for beside, gap in ((first - 1, first - 1), (first, first + 1)):
        if 0 < gap < len(at) and not sure[beside]:
            instants[k] = float(0.5 * (at[gap - 1] + at[gap]))
            effects[number] = replace(effects[number], constants=tuple(instants))
            yield scene.with_effects(tuple(effects), scene.room)
