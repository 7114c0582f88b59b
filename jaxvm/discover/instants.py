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
"""Last words of the constants that say when something happened; they come first."""


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

    def gain(self, value: float) -> float:
        """By how much (log density) the best instant is likelier than the gap of another one."""
        density = np.maximum(self.weight / self.width, 1e-300)
        return float(np.log(density.max() / density[np.argmin(np.abs(self.at - value))]))

    def gap(self, value: float) -> float:
        """Width (s) of the gap in which an instant lies."""
        return float(self.width[np.argmin(np.abs(self.at - value))])


def at_best_instants(
    final: Adjustment, findings: list[Finding], given: int, weights: tuple[np.ndarray, ...]
) -> tuple[Adjustment, list[tuple[Instants, ...]]]:
    """The final fit with steps and jumps where all epochs want them, and the posteriors of all
    instants of each finding.

    `given` is the number of effects before those of the findings, `weights` are those of all
    observations.
    """
    found = []
    for place, finding in enumerate(findings, given):
        instants = instants_of(final, place, finding, weights)
        for _ in range(2 * len(instants)):
            moved = _at_better(final, place, instants, weights)
            if moved.cost >= final.cost:
                break
            final = moved
            if len(instants) > 1:
                instants = instants_of(final, place, finding, weights)
        found.append(instants)
    return final, found


def _at_better(
    final: Adjustment, place: int, instants: tuple[Instants, ...], weights: tuple[np.ndarray, ...]
) -> Adjustment:
    """The fit with that instant of an effect where it is likeliest that gains most by it.

    Each is sought beside the others: together they would run to the same place. The fit itself
    where it refines them, or where all are at their best.
    """
    effects = list(final.scene.fitted_effects())
    own = list(effects[place].constants)
    if FORMS[effects[place].form].constants[0].refined:
        return final
    gains = [posterior.gain(value) for posterior, value in zip(instants, own, strict=True)]
    most = int(np.argmax(gains))
    if instants[most].best == own[most]:
        return final
    own[most] = instants[most].best
    effects[place] = replace(effects[place], constants=tuple(own))
    scene = final.scene.with_effects(tuple(effects), final.scene.room)
    return adjust(scene, weights=weights, rtol=1e-8, check=False)


def instants_of(
    final: Adjustment, place: int, finding: Finding, weights: tuple[np.ndarray, ...]
) -> tuple[Instants, ...]:
    """The posteriors of the instants of a finding whose effect has a place in a scene.

    Of several each beside the others; none where it has none. Each instant has the weight
    exp(drop / 2) of its drop of chi-square when the effect is taken out of the model and offered
    again from there on (flat prior in time; in the logarithm of a time constant, which is averaged
    out).
    """
    scene, effects = final.scene, final.scene.fitted_effects()
    effect, channels = effects[place], scene.network.channels
    constants = FORMS[effect.form].constants
    which = [k for k, constant in enumerate(constants) if constant.name.split()[-1] in _WHEN]
    if not which:
        return ()
    # As `gaps`: a few epochs stay on either side.
    at = gaps(effect.driver, channels)
    width = np.diff(np.unique(at_epochs(effect.driver, channels)))[2:-2]
    families = tuple(_family(finding.hypothesis, _courses(effect, k, at, channels)) for k in which)
    others = (*effects[:place], *effects[place + 1 :])
    without = adjust(scene.with_effects(others, scene.room), weights=weights, check=False)
    found = []
    for scores in ScoreTests.of(without, families).score(final.variance_factor).scores:
        drop = np.where(scores.valid, scores.drop, -np.inf)[0, :, 0]
        if not np.isfinite(drop).any():
            return ()
        weight = np.exp(0.5 * (drop - drop.max()) / (final.variance_factor * finding.noise))
        weight = weight.reshape(len(at), -1).sum(axis=1) * width
        found.append(Instants(at, width, weight / weight.sum()))
    return tuple(found)


def with_spread(finding: Finding, instants: tuple[Instants, ...]) -> Finding:
    """A finding with the values of the final fit, its instants as uncertain as they are.

    A fit that refines an instant knows better where it lies inside its gap.
    """
    effect, stds = finding.final_effect, list(finding.final_stds)
    for k, posterior in enumerate(instants):
        own, at = effect.constants[k], effect.n_columns + k
        spread = posterior.spread(own)
        if not FORMS[effect.form].constants[k].refined:
            stds[at] = spread
        elif spread > posterior.gap(own):
            stds[at] = max(spread, stds[at])
    return replace(finding, final_stds=tuple(stds))


def _courses(effect: Effect, k: int, at: np.ndarray, channels: Channels) -> tuple[Course, ...]:
    """The course of an effect with its k-th constant at each instant.

    A time constant is all over its range; other instants stay where they are.
    """
    own = effect.constants
    constants = [(*own[:k], instant, *own[k + 1 :]) for instant in at.tolist()]
    if len(own) > 1 and FORMS[effect.form].constants[1].refined:
        time = np.asarray(channels.epoch_time)
        times = np.geomspace(np.median(np.diff(time)), np.ptp(time), _TIMES)
        constants = [(one[0], tau) for one in constants for tau in times.tolist()]
    return tuple(Course(effect.driver, effect.form, one, effect.reference) for one in constants)


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
