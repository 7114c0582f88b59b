"""Sizes averaged over forms: a gain is no better known than how its quantity is followed.

What follows a quantity at once, with a lag or after a dead time has a gain for a unit of it in any
case. Where the recording hardly tells which it is, each says another gain, and the interval of the
chosen one alone is too narrow. So the other forms are fitted, too, and the spread is that of all
(Bayesian model averaging: Hoeting et al. 1999, Statistical Science 14, 382-417, eq. 6), about the
value of the one that was chosen.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from jaxvm.discover.constants import run_away
from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.first_states import with_first_states
from jaxvm.network.scene import Scene
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import Adjustment, adjust

FOLLOWING = ("linear", "lag", "delay")
"""Forms with a gain for a unit of the driver as their only amplitude."""

_WITH_A_GAIN = {*FOLLOWING, "lag with state"}

_LEAST = 0.01
"""Odds to the chosen form below which another one does not count."""


def with_forms(
    final: Adjustment, finding: Finding, place: int, weights: tuple[np.ndarray, ...]
) -> Finding:
    """A finding whose gains are as uncertain as the form of its course leaves them.

    Args:
        final: the final fit.
        finding: with the values of that fit.
        place: of its effect among those of the scene.
        weights: of all observations.
    """
    effect = finding.final_effect
    if effect.form not in _WITH_A_GAIN:
        return finding
    # A lag from a state of its own has two amplitudes a term; the gain is the first.
    gains = slice(0, effect.n_columns, len(FORMS[effect.form].bases))
    own, variance = np.array(effect.amplitudes)[gains], final.variance_factor * finding.noise
    useless = final.cost - variance * float(np.log(_LEAST))
    odds, squares = [0.0], [np.zeros(len(own))]
    for scene in _otherwise(final.scene, place):
        tried = adjust(scene, weights=weights, rtol=1e-8, wanted=useless, check=False)
        if tried.failed or run_away(scene, tried.scene):
            continue
        other = np.array(tried.scene.fitted_effects()[place].amplitudes)
        odds.append((final.cost - tried.cost) / variance)
        squares.append((other - own) ** 2)
    weight = np.exp(np.array(odds) - np.logaddexp.reduce(odds))
    stds = np.array(finding.final_stds)
    stds[gains] = np.sqrt(stds[gains] ** 2 + weight @ np.array(squares))
    return replace(finding, final_stds=tuple(stds.tolist()))


def _otherwise(scene: Scene, place: int) -> Iterator[Scene]:
    """The scene with the quantity followed in each other form; lags may start anywhere."""
    effects = scene.fitted_effects()
    effect = effects[place]
    late = effect.constants[0] if effect.constants else _spacing(scene)
    gains = effect.amplitudes[:: len(FORMS[effect.form].bases)]
    for form in FOLLOWING:
        if form == effect.form.removesuffix(" with state"):
            continue
        constants = (late,) if FORMS[form].constants else ()
        other = replace(effect, form=form, amplitudes=gains, constants=constants)
        own = [other if e is effect else e for e in effects if e.shares != effect.name]
        yield with_first_states(scene.with_effects(tuple(own), scene.room))


def _spacing(scene: Scene) -> float:
    """Usual time (s) from one epoch to the next."""
    return float(np.median(np.diff(scene.network.channels.epoch_time)))
