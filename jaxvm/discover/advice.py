"""What to record next: the further recording that tells a finding from its doubles best.

With N the normal matrix of all shared unknowns (cameras, static bodies, effects) after the poses of
single epochs are eliminated, the matrices of two recordings of the same cameras add. With a the
amplitudes of the finding (columns C), B the other unknowns and R the columns of a rival,

    lambda (1 - rho^2) = a^T (N_CC - N_CP N_PP^-1 N_PC) a,    P = B and R,

is the expected gap in chi-square between the finding and the rival (MATHEMATICS 1.8); exp(gap / 2)
are the odds that it brings.
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.plans import PLANS, Plan, planned, possible
from jaxvm.discover.select import DECIDED
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Effect, room_for
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import with_weights
from jaxvm.solve.arrow import Arrow, factorise
from jaxvm.solve.problem import normal_at, scene_problem


@dataclass(frozen=True)
class Advice:
    """What one plan would bring for one finding.

    Attributes:
        plan: the further recording.
        rivals: what the finding may be mistaken for.
        gaps: expected gap in chi-square to each rival, of both recordings together.
    """

    plan: Plan
    rivals: tuple[Hypothesis, ...]
    gaps: tuple[float, ...]

    @property
    def odds(self) -> float:
        """Expected odds against the nearest rival."""
        return float(np.exp(min(0.5 * min(self.gaps), 60.0)))

    @property
    def decides(self) -> bool:
        """Whether all rivals would be told apart at 20:1."""
        return min(self.gaps) >= DECIDED


def advise(
    scene: Scene,
    weights: tuple[np.ndarray, ...],
    place: int,
    rivals: tuple[Hypothesis, ...],
    variance: float,
    plans: tuple[Plan, ...] = PLANS,
) -> list[Advice]:
    """Plans by what they bring for telling a finding from its rivals, best first.

    Plans that bring nearly the same (beyond a sure decision) keep the order of their cost.

    Args:
        scene: the last model, fitted.
        weights: of its observations.
        place: number of the finding among the effects of the scene.
        rivals: what it may be mistaken for.
        variance: of unit weight.
        plans: further recordings to weigh.
    """
    pairs = [(rival, _with_rival(scene, rival)) for rival in rivals]
    # A rival for which there is no room would need programs of its own; it is left out.
    pairs = [(rival, with_rival) for rival, with_rival in pairs if with_rival.room == scene.room]
    if not pairs:
        return []
    rivals, own = (tuple(part) for part in zip(*pairs, strict=True))
    now = [_information(with_rival, weights) for with_rival in own]
    found = []
    for plan in plans:
        if not possible(plan, scene.recording):
            continue
        gaps = []
        further = planned(plan, scene)
        for with_rival, present in zip(own, now, strict=True):
            room = with_rival.room
            bound = further.scene.with_effects(with_rival.fitted_effects(), room)
            total = present + _information(bound, further.weights)
            gaps.append(_gap(with_rival, place, total) / variance)
        found.append(Advice(plan, rivals, tuple(gaps)))
    sure = 2.0 * DECIDED
    return sorted(found, key=lambda advice: -min(min(advice.gaps), sure))


def _with_rival(scene: Scene, rival: Hypothesis) -> Scene:
    """The scene with a rival as its last effect, at amplitude zero."""
    columns = len(rival.group.terms) * len(FORMS[rival.course.form].bases)
    effects: tuple[Effect, ...] = (*scene.fitted_effects(), rival.effect(np.zeros(columns)))
    return scene.with_effects(effects, room_for(effects, scene.room))


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


def _gap(scene: Scene, place: int, information: np.ndarray) -> float:
    """Expected gap between the finding at `place` and the last effect of the scene."""
    layout, column = scene.network.layout, scene.unknowns.column
    columns, constants = scene.places()[place]
    own = column[layout.all("amplitude")[columns]]
    amplitude = np.asarray(scene.state.amplitude)[columns]
    left_out = set(own) | set(column[layout.all("constant")[constants]])
    diagonal = np.diag(information)
    other = np.array([k for k in range(len(information)) if k not in left_out and diagonal[k] > 0])
    scale = 1.0 / np.sqrt(diagonal[other])
    block = scale[:, None] * information[np.ix_(other, other)] * scale
    cross = scale[:, None] * information[np.ix_(other, own)]
    explained = cross.T @ np.linalg.pinv(block, rcond=1e-10, hermitian=True) @ cross
    rest = information[np.ix_(own, own)] - explained
    return max(float(amplitude @ rest @ amplitude), 0.0)
