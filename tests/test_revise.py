"""Earlier findings beside amounts of every image that could follow them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.courses import Course
from jaxvm.discover.diagnose import _plain_fit
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.naming import Naming
from jaxvm.discover.revise import followed, follows, hidden, likelier, lost_without, prune
from jaxvm.discover.rivals import Rival
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.physics.catalogue import entries_for
from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.solve.adjust import adjust

N_EPOCHS = 24
CAMERA, BOARD = Scope(camera=("cam",)), Scope(target=("board",))
MARKS = each("mark", "target.point_z", numbers=range(30))
AMOUNTS = each("epoch", "sensor.focal", numbers=range(N_EPOCHS))


@dataclass(frozen=True)
class Told:
    """Of a finding, what is asked here."""

    hypothesis: Hypothesis
    effect: Effect
    drop: float = 1e3
    final_effect: Effect | None = None
    stds: tuple[float, ...] = ()
    weight: float = 1.0
    others: tuple = ()
    rivals: tuple[Rival, ...] = ()
    alternatives: tuple[Hypothesis, ...] = ()
    noise: float = 1.0


def told(effect):
    course = Course(effect.driver, effect.form, effect.constants)
    group = Group(effect.terms, "camera")
    return Told(Hypothesis(group, course, effect.scope, ()), effect)


def refitted(scene, weights):
    return adjust(scene, weights=weights, check=False)


@pytest.fixture(scope="module")
def known():
    return board_recording(n_epochs=N_EPOCHS, free=frozenset())


def fitted(known, effects, rng):
    """A camera before a board that is known, with effects; its fit, and how it is fitted."""
    (board,) = known.recording.model.targets
    held = replace(board, pose=known.truth["carrier_from_target"], free=frozenset())
    recording = known.with_model(targets=(held,))
    room = (N_EPOCHS + 8, 4)
    obs = recording.observations
    pixel = predicted(known.true_scene(recording).with_effects(effects, room))
    pixel += obs.sigma[:, None] * rng.standard_normal(pixel.shape)
    drawn = replace(recording, observations=replace(obs, pixel=pixel))
    scene = known.true_scene(drawn).with_effects(effects, room)
    weights = tuple(np.ones(len(rows)) for rows in scene.tables)
    return refitted(scene, weights), lambda scene: refitted(scene, weights)


def stepping(known, port, size):
    """A step in the middle of the recording."""
    instant = float(np.mean(known.recording.time[11:13]))
    return Effect("jump", (Term(port),), "time", "step", (instant,), 0.0, CAMERA, (size,))


def hunting(size, rng):
    """An amount of every image."""
    every = tuple(size * rng.standard_normal(N_EPOCHS))
    return Effect("hunts", AMOUNTS, scope=CAMERA, amplitudes=every, spread=6e-3)


def pruned(known, jump, hunts, seed=3, idle=()):
    """Names left of a jump of the focal length, idle effects, and amounts of every image."""
    rng = np.random.default_rng(seed)
    effects = stepping(known, "sensor.focal", jump), *idle, hunting(hunts, rng)
    current, fit = fitted(known, effects, rng)
    findings = [told(effect) for effect in current.scene.fitted_effects()]
    left, kept = prune(current, findings, 2 * len(current.scene.recording.observations.epoch), fit)
    assert [f.effect.name for f in kept] == [e.name for e in left.scene.fitted_effects()]
    return [f.effect.name for f in kept]


def test_a_course_stays_beside_amounts_that_could_follow_it(known):
    assert pruned(known, jump=4e-3, hunts=2e-4) == ["jump", "hunts"]


def test_what_comes_after_a_course_that_stays_goes_all_the_same(known):
    idle = Effect("idle", (Term("sensor.cx"),), "time", "linear", (), 0.0, CAMERA, (0.0,))
    assert pruned(known, jump=4e-3, hunts=2e-4, idle=(idle,)) == ["jump", "hunts"]


def test_a_course_that_saves_the_amounts_nothing_goes(known):
    for seed in range(4):
        assert pruned(known, jump=0.0, hunts=2e-3, seed=seed) == ["hunts"]


def test_amounts_follow_what_acts_at_their_ports_and_place():
    hunts = Effect("hunts", AMOUNTS, scope=CAMERA, amplitudes=(0.0,) * N_EPOCHS)
    step = Effect("jump", (Term("sensor.focal"),), "time", "step", (1.0,), 0.0, CAMERA, (0.0,))
    elsewhere = replace(step, scope=Scope(camera=("other",)))
    shift = replace(step, terms=(Term("sensor.cx"),))
    assert follows(hunts, step)
    assert not any(follows(hunts, other) for other in (elsewhere, shift))
    assert not follows(step, hunts)
    # The principal point follows a camera that turns, not one that comes nearer.
    jumps = replace(hunts, terms=each("epoch", "sensor.cx", "sensor.cy", numbers=range(N_EPOCHS)))
    turn, nearer = (replace(step, terms=(Term(p),)) for p in ("mount.turn_x", "mount.shift_z"))
    assert follows(jumps, turn) and not follows(jumps, nearer) and not follows(hunts, turn)
    # What bends the rays of an image moves it, too.
    shimmers = replace(hunts, terms=each("epoch", "medium.bend_u", numbers=range(N_EPOCHS)))
    assert follows(shimmers, turn) and not follows(shimmers, nearer)
    findings = [told(step), told(hunts), told(shift)]
    assert [followed(findings, k) for k in range(3)] == [True, False, False]


def test_amounts_hide_what_they_took_wherever_they_act(known):
    """A camera that comes nearer magnifies; only the distances of the marks tell it apart."""
    rng = np.random.default_rng(4)
    nearer = stepping(known, "mount.shift_z", 4e-3)
    alone, _ = fitted(known, (nearer,), rng)
    (drop,) = lost_without(alone, [told(nearer)])
    assert drop > 1e3
    current, _ = fitted(known, (nearer, hunting(2e-3, rng)), rng)
    step, hunts = (told(effect) for effect in current.scene.fitted_effects())
    findings = [replace(step, drop=drop), hunts]
    assert not followed(findings, 0) and hidden(current, findings, 0)
    assert not hidden(alone, [replace(step, drop=drop)], 0)
    # What was found beside the amounts is all there.
    (left, _) = lost_without(current, findings)
    assert not hidden(current, [replace(step, drop=left), hunts], 0)
    assert not hidden(current, findings, 1)


# --- what has no name ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drifting(known):
    """What judges names, a fit with a drift of the focal length, and the finding without a name."""
    size = 5e-3 / float(np.ptp(known.recording.time))
    drift = Effect("drift", (Term("sensor.focal"),), "time", "linear", (), 0.0, CAMERA, (size,))
    room = (16, 8)
    truth = known.true_scene().with_effects((drift,), room)
    obs = known.recording.observations
    noise = obs.sigma[:, None] * np.random.default_rng(4).standard_normal(obs.pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=predicted(truth) + noise))
    parts, plain, _ = _plain_fit(known.true_scene(recording).with_effects((), room), 3)
    plain, heldout = parts.proven(plain)
    naming = Naming(ScoreTests.of(plain, enumerate_hypotheses(plain.scene)), parts, heldout)
    return naming, parts.fit(plain.scene.with_effects((drift,), room)), told(drift)


def test_names_at_its_place_are_tried_for_what_has_none(drifting):
    naming, fit, before = drifting
    tried = naming.with_names_to_try(fit, [before], 0).alternatives
    assert 0 < len(tried) <= 3
    assert all(h.entries and h.scope == before.hypothesis.scope for h in tried)
    # What settles slowly after power-on is nearly a straight line.
    assert "focal-warm-up" in {entry.id for h in tried for entry in h.entries}


def test_other_names_are_tried_for_what_has_one(drifting):
    naming, fit, before = drifting
    tried = naming.with_names_to_try(fit, [before], 0).alternatives
    named = replace(before, hypothesis=tried[0])
    again = naming.with_names_to_try(fit, [named], 0).alternatives
    own = {(h.entries[0].id, h.scope) for h in again}
    assert 0 < len(again) == len(own) <= 3
    assert (tried[0].entries[0].id, tried[0].scope) not in own
    assert "focal-jump" in {entry.id for h in again for entry in h.entries}


@pytest.mark.parametrize("weight, leads", [(0.9, False), (1.1, True)])
def test_a_name_leads_as_soon_as_it_is_as_likely(drifting, weight, leads):
    naming, fit, unnamed = drifting
    named = naming.with_names_to_try(fit, [unnamed], 0).alternatives[0]
    # As far behind as it is, or more.
    findings = [replace(unnamed, rivals=(Rival(named, 1e6, weight),))]
    _, found = likelier(fit, findings, 0, naming.parts.fit)
    assert bool(found[0].hypothesis.entries) == leads
    # Of two names one must be clearly likelier.
    among = [replace(findings[0], hypothesis=named)]
    assert likelier(fit, among, 0, naming.parts.fit)[1] is among


def test_a_double_whose_refit_is_far_behind_does_not_lead(drifting):
    """What was expected of it is no matter once it is refitted: the recording has spoken."""
    naming, fit, unnamed = drifting
    named = naming.with_names_to_try(fit, [unnamed], 0).alternatives[0]
    aside = replace(named, group=Group((Term("sensor.cx"),), "camera"))
    drop = 2.0 * (naming.tests.fit.cost - fit.cost)
    finding = replace(unnamed, drop=drop, weight=0.3, rivals=(Rival(aside, 0.0, 0.7),))
    fitted, (found,) = likelier(fit, [finding], 0, naming.parts.fit)
    (rival,) = found.rivals
    assert fitted is fit and not found.hypothesis.entries
    assert rival.gap > 0.8 * drop > 15.0
    assert rival.weight < 0.7 * np.exp(-0.3 * drop + 3.0)
    assert found.weight + rival.weight == pytest.approx(1.0)


def test_what_took_the_place_of_another_is_named_anew(drifting):
    """Beside what it replaced it was compared with what adds to that one."""
    naming, drift, unnamed = drifting
    names = naming.with_names_to_try(drift, [unnamed], 0).alternatives
    jump = next(h for h in names if h.course.form == "step")
    scene = drift.scene.with_effects((jump.effect((0.0,)),), drift.scene.room)
    fit = naming.parts.fit(scene)
    (effect,) = fit.scene.fitted_effects()
    drop = 2.0 * (naming.tests.fit.cost - fit.cost)
    found = replace(unnamed, hypothesis=jump, effect=effect, drop=drop)
    _, (kept,) = naming.last(fit, [found])
    assert kept.hypothesis is jump and not kept.rivals
    _, (anew,) = naming.last(fit, [found], replaced=True)
    assert anew.alternatives and anew.rivals
    assert anew.weight + sum(rival.weight for rival in anew.rivals) == pytest.approx(1.0, abs=0.1)


def test_amounts_of_all_marks_lead_when_they_are_likelier(known):
    """Their spread belongs to them: without it they would fit what they can't know."""
    depths = 2e-4 * np.random.default_rng(3).standard_normal(len(MARKS))
    true = Effect("depths", MARKS, "constant", "constant", (), 0.0, BOARD, tuple(depths))
    room, obs = (64, 8), known.recording.observations
    pixel = predicted(known.true_scene().with_effects((true,), room))
    pixel += obs.sigma[:, None] * np.random.default_rng(4).standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    parts, plain, _ = _plain_fit(known.true_scene(recording).with_effects((), room), 3)
    entries = entries_for(MARKS, "target", ("constant",), "constant")
    wide = Hypothesis(Group(MARKS, "target"), Course("constant", "constant"), BOARD, entries)
    small = Effect("bow", (Term("target.bow_x"),), "constant", "constant", (), 0.0, BOARD, (0.0,))
    fit = parts.fit(plain.scene.with_effects((small,), room))
    finding = replace(told(small), rivals=(Rival(wide, 0.0, 0.9),), weight=0.1)
    fitted, (found,) = likelier(fit, [finding], 0, parts.fit)
    assert found.hypothesis is wide
    spread = fitted.scene.effects[-1].spread
    assert spread == pytest.approx(3.0 * np.median(np.abs(found.effect.amplitudes)), rel=0.2)
    # But for a plane, which is a pose of the board.
    points = known.recording.model.targets[0].points
    plane = np.column_stack([np.ones(len(points)), points[:, :2]])
    off = np.array(found.effect.amplitudes) - depths
    off -= plane @ np.linalg.lstsq(plane, off, rcond=None)[0]
    assert np.sqrt(np.mean(off**2)) < 0.3 * np.std(depths)
