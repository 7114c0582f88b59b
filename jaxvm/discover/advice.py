"""What to record next: the further recording that tells a finding from its doubles best.

With N the normal matrix of all shared unknowns (cameras, static bodies, effects) after the poses of
single epochs are eliminated, the matrices of two recordings of the same cameras add. With a the
amplitudes of the finding (columns C), B the other unknowns and R the columns of a rival,

    lambda (1 - rho^2) = a^T (N_CC - N_CP N_PP^-1 N_PC) a,    P = B and R,

is the expected gap in chi-square between the finding and the rival (MATHEMATICS 1.8). What the
first recording has shown is known. A further one that adds d to the gap makes of the log odds l (on
the scale of chi-square) a normal variable of variance 4 d and of mean l + d where the finding is
right, l - d where the rival is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr

from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.plans import PLANS, Plan, planned, possible
from jaxvm.discover.select import decisive_gap
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import room_for
from jaxvm.solve.adjust import with_weights
from jaxvm.solve.arrow import Arrow, factorise
from jaxvm.solve.problem import normal_at, scene_problem

PROMISED = 0.95
"""Chance of coming apart from which on a plan is said to decide."""

_SURE = 0.99
"""Chance from which on plans are as good as each other, and the cheaper one comes first."""


@dataclass(frozen=True)
class Advice:
    """What one plan would bring for one finding.

    Attributes:
        plan: the further recording.
        rivals: what the finding may be mistaken for.
        gaps: expected gap in chi-square to each rival, of both recordings together.
        chances: that finding and rival come apart at 20:1, whichever of the two is right.
    """

    plan: Plan
    rivals: tuple[Hypothesis, ...]
    gaps: tuple[float, ...]
    chances: tuple[float, ...]

    @property
    def odds(self) -> float:
        """Expected odds against the nearest rival."""
        return float(np.exp(min(0.5 * min(self.gaps), 60.0)))

    @property
    def chance(self) -> float:
        """Of the rival that is hardest to tell apart."""
        return min(self.chances)

    @property
    def decides(self) -> bool:
        """Whether all rivals are likely to be told apart at 20:1."""
        return self.chance >= PROMISED


def advise(
    scene: Scene,
    weights: tuple[np.ndarray, ...],
    place: int,
    rivals: Sequence[Hypothesis],
    variance: float,
    plans: tuple[Plan, ...] = PLANS,
    log_odds: Sequence[float] | None = None,
) -> list[Advice]:
    """Plans by what they bring for telling a finding from its rivals, best first.

    Plans that are as good as sure to decide keep the order of their cost.

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
    """
    batches = _batches(scene, rivals)
    kept = [k for _, numbers in batches for k in numbers]
    if not kept:
        return []
    even = np.zeros(len(rivals)) if log_odds is None else np.array(log_odds)

    def gaps(bound: Scene, own: tuple[np.ndarray, ...], known: list[np.ndarray]):
        """Gaps to all rivals, the drop of the finding, and the information of every batch."""
        found, total, drop = [], [], 0.0
        for (with_rivals, numbers), before in zip(batches, known, strict=True):
            again = bound.with_effects(with_rivals.fitted_effects(), scene.room)
            total.append(before + _information(again, own))
            first = len(with_rivals.effects) - len(numbers)
            rest = range(first, len(with_rivals.effects))
            found += [_gap(with_rivals, place, {*rest} - {k}, total[-1]) for k in rest]
            drop = _gap(with_rivals, place, {*rest}, total[-1])
        return np.array(found) / variance, drop / variance, total

    present, _, known = gaps(scene, weights, [np.zeros(())] * len(batches))
    advices = []
    for plan in plans:
        if possible(plan, scene.recording):
            further = planned(plan, scene)
            expected, drop, _ = gaps(further.scene, further.weights, known)
            gain = np.maximum(expected - present, 0.0)
            chances = _chances(even[kept], gain, decisive_gap(drop))
            own = tuple(rivals[k] for k in kept)
            advices.append(Advice(plan, own, tuple(expected.tolist()), tuple(chances.tolist())))
    return sorted(advices, key=lambda advice: -min(advice.chance, _SURE))


def _batches(scene: Scene, rivals: Sequence[Hypothesis]) -> list[tuple[Scene, list[int]]]:
    """The scene with rivals at amplitude zero after its effects, as many at once as have room.

    One that has no room alone is left out: it would need programs of its own.
    """
    present = scene.fitted_effects()
    new = [rival.effect(np.zeros(rival.n_columns)) for rival in rivals]

    def together(numbers: list[int]):
        return (*present, *(new[k] for k in numbers))

    def has_room(numbers: list[int]) -> bool:
        return room_for(together(numbers), scene.room) == scene.room

    batches: list[list[int]] = []
    for k in range(len(rivals)):
        if batches and has_room([*batches[-1], k]):
            batches[-1].append(k)
        elif has_room([k]):
            batches.append([k])
    return [(scene.with_effects(together(own), scene.room), own) for own in batches]


def _chances(log_odds: np.ndarray, gain: np.ndarray, needed: float) -> np.ndarray:
    """Chance that log odds end beyond a limit for the one of two hypotheses that is right."""
    spread = 2.0 * np.sqrt(np.maximum(gain, 1e-9))
    own = 1.0 / (1.0 + np.exp(-0.5 * log_odds))
    right, wrong = (ndtr((s * log_odds + gain - needed) / spread) for s in (1.0, -1.0))
    return own * right + (1.0 - own) * wrong


def _information(scene: Scene, weights: tuple[np.ndarray, ...]) -> np.ndarray:
    """Normal matrix of the shared unknowns, in plain increments, momentary ones eliminated."""
    problem = with_weights(scene_problem(scene), weights)
    return np.asarray(_reduced(normal_at(problem, jnp.zeros(problem.n)).hessian))


@eqx.filter_jit
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


def _gap(scene: Scene, place: int, absent: set[int], information: np.ndarray) -> float:
    """Drop of chi-square by a finding that neither the model nor other effects take.

    Args:
        scene: with rivals after its effects.
        place: number of the finding among the effects.
        absent: numbers of effects that are not in the model.
        information: of the shared unknowns.
    """
    layout, column = scene.network.layout, scene.unknowns.column
    columns = [column[layout.all("amplitude")[own]] for own, _ in scene.places()]
    constants = [column[layout.all("constant")[own]] for _, own in scene.places()]
    left_out = {k for e in {place, *absent} for k in (*columns[e], *constants[e])}
    diagonal = np.diag(information)
    other = [k for k in range(len(information)) if k not in left_out and diagonal[k] > 0]
    other = np.array(other, int)
    own, amplitude = columns[place], np.asarray(scene.state.amplitude)[scene.places()[place][0]]
    scale = 1.0 / np.sqrt(diagonal[other])
    block = scale[:, None] * information[np.ix_(other, other)] * scale
    cross = scale[:, None] * information[np.ix_(other, own)]
    explained = cross.T @ np.linalg.pinv(block, rcond=1e-10, hermitian=True) @ cross
    rest = information[np.ix_(own, own)] - explained
    return max(float(amplitude @ rest @ amplitude), 0.0)
