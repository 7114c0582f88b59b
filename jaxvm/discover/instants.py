"""When something happened: the posterior of an instant over all gaps between epochs.

Chi-square is no parabola in an instant: it changes where an epoch changes sides, by what that epoch
shows of the effect. One tangent, or the fitted epochs alone, promise too sharp an instant, and a
mark that was not seen for some epochs leaves all of them open.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxvm.discover.courses import Course, at_epochs, gaps
from jaxvm.discover.diagnosis import Finding
from jaxvm.discover.hypotheses import Family, Hypothesis
from jaxvm.discover.score import ScoreTests
from jaxvm.physics.effects import Channels, Effect, Scope
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import Adjustment, adjust

_TIMES = 9
"""Time constants that are weighed with each instant."""

_WHEN = ("instant", "start")
"""First constants that say when something happened."""


@dataclass(frozen=True)
class Instants:
    """How likely it is that something happened in each gap between epochs.

    Attributes:
        at: middles of the gaps (s of the driver).
        width: of the gaps (s).
        weight: posterior probability of each.
    """

    at: Float[np.ndarray, " gaps"]
    width: Float[np.ndarray, " gaps"]
    weight: Float[np.ndarray, " gaps"]

    @property
    def best(self) -> float:
        """Middle of the gap that fits best (s)."""
        return float(self.at[np.argmax(self.weight / self.width)])

    def spread(self, value: float) -> float:
        """Standard deviation (s) about a value; inside a gap all instants are alike."""
        return float(np.sqrt(self.weight @ ((self.at - value) ** 2 + self.width**2 / 12.0)))

    def gap(self, value: float) -> float:
        """Width (s) of the gap in which an instant lies."""
        return float(self.width[np.argmin(np.abs(self.at - value))])


def at_best_instants(
    final: Adjustment, findings: list[Finding], given: int, weights: tuple[np.ndarray, ...]
) -> tuple[Adjustment, list[Instants | None]]:
    """The final fit with each step where all epochs want it, and the posteriors of all instants.

    The posteriors are None for findings that no instant belongs to. `given` is the number of
    effects before those of the findings, `weights` are those of all observations.
    """
    found = []
    for place, finding in enumerate(findings, given):
        instants = instants_of(final, place, finding, weights)
        found.append(instants)
        effects = list(final.scene.fitted_effects())
        if instants is None or effects[place].form != "step":
            continue
        if instants.best != effects[place].constants[0]:
            effects[place] = replace(effects[place], constants=(instants.best,))
            scene = final.scene.with_effects(tuple(effects), final.scene.room)
            tried = adjust(scene, weights=weights, rtol=1e-8, check=False)
            if tried.cost < final.cost:
                final = tried
    return final, found


def instants_of(
    final: Adjustment, place: int, finding: Finding, weights: tuple[np.ndarray, ...]
) -> Instants | None:
    """The posterior of the instant of a finding whose effect has a place in a scene.

    None where it has none. Each instant has the weight exp(drop / 2) of its drop of chi-square when
    the effect is taken out of the model and offered again from there on (flat prior in time; in the
    logarithm of a time constant, which is averaged out).
    """
    scene, effects = final.scene, final.scene.fitted_effects()
    effect, channels = effects[place], scene.network.channels
    constants = FORMS[effect.form].constants
    if not constants or constants[0].name not in _WHEN:
        return None
    # As `gaps`: a few epochs stay on either side.
    at = gaps(effect.driver, channels)
    width = np.diff(np.unique(at_epochs(effect.driver, channels)))[2:-2]
    family = _family(finding.hypothesis, _courses(effect, at, channels))
    others = (*effects[:place], *effects[place + 1 :])
    without = adjust(scene.with_effects(others, scene.room), weights=weights, check=False)
    (scores,) = ScoreTests.of(without, (family,)).score(final.variance_factor).scores
    drop = np.where(scores.valid, scores.drop, -np.inf)[0, :, 0]
    if not np.isfinite(drop).any():
        return None
    weight = np.exp(0.5 * (drop - drop.max()) / (final.variance_factor * finding.noise))
    weight = weight.reshape(len(at), -1).sum(axis=1) * width
    return Instants(at, width, weight / weight.sum())


def with_spread(finding: Finding, instants: Instants | None) -> Finding:
    """A finding with the values of the final fit, its instant as uncertain as its posterior says.

    A fit that refines the instant knows better where it lies inside its gap.
    """
    if instants is None:
        return finding
    effect, stds = finding.final_effect, list(finding.final_stds)
    own, at = effect.constants[0], effect.n_columns
    spread = instants.spread(own)
    if not FORMS[effect.form].constants[0].refined:
        stds[at] = spread
    elif spread > instants.gap(own):
        stds[at] = max(spread, stds[at])
    return replace(finding, final_stds=tuple(stds))


def _courses(effect: Effect, at: np.ndarray, channels: Channels) -> tuple[Course, ...]:
    """The course of an effect from each instant on, with time constants all over their range."""
    constants = [(instant,) for instant in at.tolist()]
    if len(effect.constants) > 1:
        time = np.asarray(channels.epoch_time)
        times = np.geomspace(np.median(np.diff(time)), np.ptp(time), _TIMES)
        constants = [(*one, tau) for one in constants for tau in times.tolist()]
    return tuple(Course(effect.driver, effect.form, own, effect.reference) for own in constants)


def _family(hypothesis: Hypothesis, courses: tuple[Course, ...]) -> Family:
    """The terms of a hypothesis at its place, in other courses."""
    scope = hypothesis.scope
    if hypothesis.group.mark is not None:
        # A mark is found by its group, among all of its target.
        scope = Scope(target=scope.target)
    return Family(
        groups=(hypothesis.group,),
        courses=courses,
        scopes=(scope,),
        valid=np.ones((1, len(courses), 1), bool),
        kinds=("",) * len(courses),
        asked=(1,) * len(courses),
        named={},
    )
