"""What to record next: the further recording that tells a finding from its doubles best.

With N the normal matrix of all shared unknowns (cameras, static bodies, effects) after the poses of
single epochs are eliminated, the matrices of two recordings of the same cameras add. With a the
amplitudes of the finding (columns C), B the other unknowns and R the columns of a rival,

    lambda (1 - rho^2) = a^T (N_CC - N_CP N_PP^-1 N_PC) a,    P = B and R,

is the expected gap in chi-square between the finding and the rival (MATHEMATICS 1.8). Where the
rival is right, with the amplitudes that stand for the finding in the first recording, it is that
of the rival to the finding; the smaller of the two counts. Either may have all terms that its name
has (a mount that turned about one axis may turn about three), constants of its own, and any of its
drivers, and nobody knows whether what goes with time begins anew or has gone on for a day: what
parts the two only because of that is no promise.

What the first recording has shown is known. A further one that adds d to the gap makes of the log
odds l (on the scale of chi-square) a normal variable of variance 4 d and of mean l + d where the
finding is right, l - d where the rival is.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count, islice

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr

from jaxvm.compiling import program
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.plans import PLANS, Plan, Planned, planned, possible
from jaxvm.discover.rivals import Rival
from jaxvm.discover.second_camera import of_first_cameras
from jaxvm.discover.select import decisive_gap
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Effect, room_for
from jaxvm.solve.adjust import with_weights
from jaxvm.solve.arrow import Arrow, factorise
from jaxvm.solve.problem import normal_at, scene_problem

PROMISED = 0.95
"""Chance of coming apart from which on a plan is said to decide."""

_ENOUGH = 3
"""Plans that are as good as sure to decide, after which no costlier one is weighed."""

_SURE = 0.99
"""Chance from which on plans are as good as each other, and the cheaper one comes first."""


_TRACE = 1e-5
"""Share of the finding that its rivals stand for in the scene in which plans are weighed."""


@dataclass(frozen=True)
class Advice:
    """What one plan would bring for one finding.

    Attributes:
        plan: the further recording.
        rivals: what the finding may be mistaken for.
        gaps: expected gap in chi-square to each rival, of both recordings together.
        chances: that finding and rival come apart at 20:1, whichever of the two is right.
        among: probability that the finding or one of its rivals is right.
    """

    plan: Plan
    rivals: tuple[Hypothesis, ...]
    gaps: tuple[float, ...]
    chances: tuple[float, ...]
    among: float = 1.0

    @property
    def odds(self) -> float:
        """Expected odds against the nearest rival."""
        return float(np.exp(min(0.5 * min(self.gaps), 60.0)))

    @property
    def parts(self) -> float:
        """Chance that the rival that is hardest to tell apart comes apart, if one of them is right.

        A plan that parts two wrong names leaves nothing that is right.
        """
        return min(self.chances)

    @property
    def chance(self) -> float:
        """Chance that what is right comes apart from all others."""
        return self.among * self.parts

    @property
    def decides(self) -> bool:
        """Whether that is likely."""
        return self.chance >= PROMISED


def advise(
    scene: Scene,
    weights: tuple[np.ndarray, ...],
    place: int,
    rivals: Sequence[Rival],
    variance: float,
    plans: tuple[Plan, ...] = PLANS,
    log_odds: Sequence[float] | None = None,
    others: Sequence[Hypothesis] = (),
    among: float = 1.0,
) -> list[Advice]:
    """Plans by what they bring for telling a finding from its rivals, best first.

    Plans that are as good as sure to decide keep the order of their cost; after three of them the
    costlier ones are not weighed.

    Args:
        scene: the last model, fitted.
        weights: of its observations.
        place: number of the finding among the effects of the scene.
        rivals: what it may be mistaken for; those with more amplitudes than the scene has room for
            are left out.
        variance: of unit weight.
        plans: further recordings to weigh.
        log_odds: twice the natural log of the odds for the finding against each rival, as they
            stand; even without.
        others: the finding's own physics in other terms or after other drivers (`under_its_name`).
        among: probability that the finding or one of the rivals is right.
    """
    batches = [batch.awake(weights) for batch in _batches(scene, place, rivals, others)]
    kept = [number for batch in batches for number in batch.rivals]
    if not kept:
        return []
    even = (np.zeros(len(rivals)) if log_odds is None else np.array(log_odds))[kept]
    present = [_information(batch.scene, weights) for batch in batches]
    mimics = [batch.mimics(own) for batch, own in zip(batches, present, strict=True)]

    def gaps(information: list[np.ndarray]) -> np.ndarray:
        each = zip(batches, information, mimics, strict=True)
        found = [batch.gaps(own, mimic) for batch, own, mimic in each]
        return np.concatenate(found) / variance

    before = gaps(present)
    effects = [effect for batch in batches for effect in batch.scene.effects]
    # What does not go with time is the same on another day.
    days = (False, True) if any(effect.driver == "time" for effect in effects) else (False,)
    advices = []
    for plan in plans:
        if not possible(plan, scene.recording):
            continue
        expected, drop = np.full(len(kept), np.inf), np.inf
        for another_day in days:
            further = planned(plan, scene, another_day)
            both = [
                known + batch.information(further)
                for batch, known in zip(batches, present, strict=True)
            ]
            expected = np.minimum(expected, gaps(both))
            drop = min(drop, batches[0].drop(both[0]) / variance)
        gain = np.maximum(expected - before, 0.0)
        chances = _chances(even, gain, decisive_gap(drop))
        own = tuple(rivals[k].hypothesis for k in kept)
        advices.append(Advice(plan, own, tuple(expected.tolist()), tuple(chances.tolist()), among))
        if sum(advice.parts >= _SURE for advice in advices) == _ENOUGH:
            break
    return sorted(advices, key=lambda advice: -min(advice.parts, _SURE))


def under_its_name(hypothesis: Hypothesis, others: Iterable[Hypothesis]) -> list[Hypothesis]:
    """What may be found under the same name once more is recorded: further terms, other drivers,
    other terms altogether."""
    each = (hypothesis, *others)
    remainders = [further for own in each if (further := own.remainder())]
    return [*remainders[:1], *hypothesis.instead(), *others, *remainders[1:]]


@dataclass(frozen=True)
class _Batch:
    """The scene of a finding, with some rivals after its effects.

    Attributes:
        scene: with all of them, at amplitude zero until it is `awake`.
        place: number of the finding among the effects.
        others: numbers of the effects that are its own physics in other terms or after other
            drivers.
        rivals: numbers of the effects of each rival, the leading one first, by the rival's number.
    """

    scene: Scene
    place: int
    others: tuple[int, ...]
    rivals: dict[int, tuple[int, ...]]

    def under(self, scene: Scene) -> Scene:
        """The same effects under other circumstances."""
        own = of_first_cameras(self.scene.fitted_effects(), self.scene.model, scene.model)
        return scene.with_effects(own, self.scene.room)

    def information(self, further: Planned) -> np.ndarray:
        """What a further recording adds to the information on the shared unknowns."""
        scene = _without_priors(self.under(further.scene))
        return _on_the_same(_information(scene, further.weights), scene, self.scene)

    def drop(self, information: np.ndarray) -> float:
        """What the finding explains and the rest of the model does not."""
        amplitudes = self._amplitudes()
        return _square(amplitudes, self._without(information, [self.place], []))

    def awake(self, weights: tuple[np.ndarray, ...]) -> "_Batch":
        """The batch with a trace of everything in question in its scene.

        The recordings may move the constants of a rival as well as its amplitudes, and at amplitude
        zero nothing depends on them. A trace of what stands for the finding is enough: it moves no
        mark, and how large the columns of an unknown are is nothing to what they explain.
        """
        information = _information(self.scene, weights)
        effects = list(self.scene.fitted_effects())
        for k in (*self.others, *chain(*self.rivals.values())):
            trace = _TRACE * self._mimic(information, k)
            effects[k] = effects[k].with_values(trace, effects[k].constants)
        return replace(self, scene=self.scene.with_effects(tuple(effects), self.scene.room))

    def mimics(self, information: np.ndarray) -> list[np.ndarray]:
        """Amplitudes of the rivals that stand for the finding."""
        return [self._mimic(information, leading) for leading, *_ in self.rivals.values()]

    def _mimic(self, information: np.ndarray, other: int) -> np.ndarray:
        """Amplitudes of an effect that stand for the finding."""
        both = self._without(information, [self.place, other], [])
        n = len(self._columns([self.place]))
        known = np.linalg.pinv(both[n:, n:], rcond=1e-10, hermitian=True)
        return known @ both[n:, :n] @ self._amplitudes()

    def gaps(self, information: np.ndarray, mimics: list[np.ndarray]) -> np.ndarray:
        """The smaller of the gaps where the finding is right and where the rival is, of each."""
        own = (self.place, *self.others)
        found = []
        for mimic, each in zip(mimics, self.rivals.values(), strict=True):
            finding = self._without(information, own[:1], each)
            rival = self._without(information, each[:1], own)
            found.append(min(_square(self._amplitudes(), finding), _square(mimic, rival)))
        return np.array(found)

    def _amplitudes(self) -> np.ndarray:
        return np.asarray(self.scene.state.amplitude)[self.scene.places()[self.place][0]]

    def _columns(self, effects: Iterable[int], constants: bool = False) -> list[int]:
        """Numbers of the unknowns of effects; their constants after their amplitudes."""
        layout, column = self.scene.network.layout, self.scene.unknowns.column
        places = [self.scene.places()[k] for k in effects]
        found = [column[layout.all("amplitude")[own]] for own, _ in places]
        if constants:
            found += [column[layout.all("constant")[own]] for _, own in places]
        return [int(k) for each in found for k in each]

    def _without(
        self, information: np.ndarray, own: Sequence[int], present: Sequence[int]
    ) -> np.ndarray:
        """Information on the amplitudes of effects that the rest of the model leaves.

        Args:
            information: of all shared unknowns.
            own: numbers of the effects; their constants are held.
            present: numbers of those that the rest has, of all that are in question.
        """
        question = {self.place, *self.others, *(k for each in self.rivals.values() for k in each)}
        absent = {*self._columns((question - {*present}) | {*own}, constants=True)}
        diagonal = np.diag(information)
        other = np.array([k for k in np.flatnonzero(diagonal > 0.0) if k not in absent], int)
        columns = np.array(self._columns(own), int)
        return _eliminated(information, columns, other)


def _square(vector: np.ndarray, matrix: np.ndarray) -> float:
    return max(float(vector @ matrix @ vector), 0.0)


def _batches(
    scene: Scene, place: int, rivals: Sequence[Rival], others: Sequence[Hypothesis]
) -> list[_Batch]:
    """As many rivals at once as the scene has room for.

    One that has no room alone is left out: it would need programs of its own. So are the last of
    the drivers that the finding or a rival may follow as well.
    """
    present = scene.fitted_effects()

    def has_room(*hypotheses: Hypothesis) -> bool:
        return room_for((*present, *map(_at_zero, hypotheses)), scene.room) == scene.room

    known = {k: r for k, r in enumerate(rivals) if has_room(r.hypothesis)}
    own: list[Hypothesis] = []
    for other in others:
        if all(has_room(*own, other, rival.hypothesis) for rival in known.values()):
            own.append(other)
    groups: list[dict[int, list[Hypothesis]]] = []
    for number, rival in known.items():
        group = [rival.hypothesis]
        for other in under_its_name(rival.hypothesis, rival.others):
            group += [other] if has_room(*own, *group, other) else []
        if not groups or not has_room(*own, *chain(*groups[-1].values()), *group):
            groups.append({})
        groups[-1][number] = group

    found = []
    for each in groups:
        effects = map(_at_zero, (*own, *chain(*each.values())))
        numbers = count(len(present))
        found.append(
            _Batch(
                scene.with_effects((*present, *effects), scene.room),
                place,
                tuple(islice(numbers, len(own))),
                {k: tuple(islice(numbers, len(group))) for k, group in each.items()},
            )
        )
    return found


def _at_zero(hypothesis: Hypothesis) -> Effect:
    return hypothesis.effect(np.zeros(hypothesis.n_columns))


def _chances(log_odds: np.ndarray, gain: np.ndarray, needed: float) -> np.ndarray:
    """Chance that log odds end beyond a limit for the one of two hypotheses that is right."""
    spread = 2.0 * np.sqrt(np.maximum(gain, 1e-9))
    own = 1.0 / (1.0 + np.exp(-0.5 * log_odds))
    right, wrong = (ndtr((s * log_odds + gain - needed) / spread) for s in (1.0, -1.0))
    return own * right + (1.0 - own) * wrong


def _without_priors(scene: Scene) -> Scene:
    """The scene without what is known beforehand: that counts once, with the first recording.

    How large an amplitude may be goes by the places of all marks, too, and those that a plan brings
    out of sight may be anywhere.
    """
    priors = scene.network.priors
    if priors is None:
        return scene
    nothing = replace(priors, weight=jnp.zeros_like(priors.weight))
    return replace(scene, network=replace(scene.network, priors=nothing))


def _information(scene: Scene, weights: tuple[np.ndarray, ...]) -> np.ndarray:
    """Normal matrix of the shared unknowns, in plain increments, momentary ones eliminated."""
    problem = with_weights(scene_problem(scene), weights)
    return np.asarray(_reduced(normal_at(problem, jnp.zeros(problem.n)).hessian))


def _on_the_same(information: np.ndarray, scene: Scene, first: Scene) -> np.ndarray:
    """Information on the shared unknowns of a first scene, of that on those of another one.

    What the other one has besides (a further camera) is eliminated, like momentary poses.
    """
    ours, theirs = _numbered(first), _numbered(scene)
    if ours == theirs:
        return information
    place = {name: k for k, name in enumerate(theirs)}
    own = np.array([place[name] for name in ours], int)
    rest = np.setdiff1d(np.flatnonzero(np.diag(information) > 0.0), own)
    return _eliminated(information, own, rest)


def _eliminated(information: np.ndarray, own: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Information on some unknowns, of that on all, with others eliminated."""
    scale = 1.0 / np.sqrt(np.diag(information)[rest])
    block = scale[:, None] * information[np.ix_(rest, rest)] * scale
    cross = scale[:, None] * information[np.ix_(rest, own)]
    taken = cross.T @ np.linalg.pinv(block, rcond=1e-10, hermitian=True) @ cross
    return information[np.ix_(own, own)] - taken


def _numbered(scene: Scene) -> list[tuple[str, int]]:
    """Names of the shared unknowns; those of one name (spare ones) are told apart by a number."""
    names = scene.unknowns.names()[: scene.unknowns.n_shared]
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        found.append((name, seen[name]))
        seen[name] += 1
    return found


@program
def _reduced(hessian: Arrow):
    diagonal = hessian.diagonal()
    scale = jnp.where(diagonal > 0.0, 1.0 / jnp.sqrt(jnp.where(diagonal > 0.0, diagonal, 1.0)), 1.0)
    a, b = hessian.split(scale)
    scaled = Arrow(
        a[:, None] * hessian.shared * a,
        b[:, :, None] * hessian.coupling * a,
        b[:, :, None] * hessian.local * b[:, None, :],
    )
    # A momentary pose that too few marks determine is as good as unknown.
    eased = eqx.tree_at(
        lambda m: m.local, scaled, scaled.local + 1e-9 * jnp.eye(scaled.local.shape[1])
    )
    factors = factorise(eased)
    d, s = factors.coupled.shape[1:]
    tall = jnp.reshape(factors.coupled, (-1, s)) if d else jnp.zeros((0, s))
    return (scaled.shared - tall.T @ tall) / (a[:, None] * a)
