"""Rivals of a finding: what has fewer columns may be behind by what it saves."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import recorded

from jaxvm.discover.courses import Course
from jaxvm.discover.diagnose import ROOM, _plain_fit
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Family, Hypothesis
from jaxvm.discover.ranking import top
from jaxvm.discover.rivals import Rival, as_shown, rivals
from jaxvm.discover.score import ScoreTests
from jaxvm.discover.select import decisive_gap, refit, stacked, toll
from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.physics.effects import Scope, Term
from jaxvm.solve.covariance import effect_deviations

PER_KELVIN = 2.8e-5


@pytest.fixture(scope="module")
def warmed(tmp_path_factory):
    """A scene with nothing hidden, and what a focal length that follows the air does to it."""
    _, recording = recorded((), tmp_path_factory.mktemp("warmed"))
    obs, drivers = recording.observations, recording.drivers
    warm = np.interp(recording.time, drivers.time, drivers.channels["ambient_degC"])
    mine = obs.camera == [c.name for c in recording.model.cameras].index("right")
    reach = np.where(mine[:, None], obs.pixel - recording.model.cameras[1].centre_px, 0.0)
    return recording, (warm - warm.mean())[obs.epoch][:, None], reach


def fitted(warmed, bend: float):
    """The plain fit, and that with a parabola of the air's temperature."""
    recording, warm, reach = warmed
    pixel = recording.observations.pixel + (PER_KELVIN * warm + bend * warm**2) * reach
    recording = replace(recording, observations=replace(recording.observations, pixel=pixel))
    scene = start(build(recording, ())).with_effects(recording.model.effects, ROOM)
    parts, plain, _ = _plain_fit(scene, 3)
    tests = ScoreTests.of(plain, enumerate_hypotheses(plain.scene))
    for hypothesis, _, amplitudes in top(tests.score(1.0), plain.scene, 10_000, 2):
        if is_focal(hypothesis, "quadratic"):
            return parts, plain, tests, refit(plain, hypothesis, amplitudes, parts)
    raise AssertionError("no parabola was asked")


def is_focal(hypothesis: Hypothesis, form: str) -> bool:
    ports = [term.port for term in hypothesis.group.terms]
    course = hypothesis.course.driver, hypothesis.course.form
    here = hypothesis.scope.camera == ("right",)
    return ports == ["sensor.focal"] and course == ("ambient_degC", form) and here


@pytest.mark.parametrize("deviations, shown", [(3.5, True), (9.0, False)])
def test_a_line_is_a_rival_of_its_parabola_while_it_saves_more_than_it_loses(
    warmed, deviations, shown
):
    _, _, _, found = fitted(warmed, 0.0)
    std = effect_deviations(found.adjustment)[-1][1]
    bend = deviations * std - found.amplitudes[1]
    parts, plain, tests, found = fitted(warmed, bend)
    assert found.amplitudes[1] / std == pytest.approx(deviations, rel=0.1)
    # What the parabola gains over its line is more than any gap that leaves things open...
    drop = 2.0 * (plain.cost - found.adjustment.cost) / found.adjustment.variance_factor
    assert deviations**2 > decisive_gap(drop)
    _, others = rivals(plain, found.adjustment, found.hypothesis, found.effect, tests, parts.n)
    lines = [r for r in others if is_focal(r.hypothesis, "linear")]
    # ... but a column costs ln n.
    assert bool(lines) == shown
    assert (deviations**2 < decisive_gap(drop) + np.log(parts.n)) == shown


def test_what_no_hypothesis_explains_of_the_change_speaks_against_none(warmed, monkeypatch):
    """From one fit to the other patterns move with the image: a part of it is no tangent."""
    _, _, _, found = fitted(warmed, 0.0)
    bend = 2.0 * effect_deviations(found.adjustment)[-1][1] - found.amplitudes[1]
    parts, plain, tests, found = fitted(warmed, bend)

    def asked():
        own = found.hypothesis, found.effect
        chief, others = rivals(plain, found.adjustment, *own, tests, parts.n)
        return {(r.hypothesis.group, r.hypothesis.scope): r.weight for r in others}, chief.weight

    others, own = asked()
    assert others and own < 0.99
    change = stacked(plain)
    besides = np.random.default_rng(0).standard_normal(change.shape) * (change != 0.0)
    besides *= np.sqrt(4.0 * 53.0 / np.sum(besides**2))
    assert 53.0 > decisive_gap(2.0 * (plain.cost - found.adjustment.cost))

    def more(fit):
        return stacked(fit) + (besides if fit is plain else 0.0)

    monkeypatch.setattr("jaxvm.discover.rivals.stacked", more)
    still, weight = asked()
    assert still.keys() == others.keys()
    assert weight == pytest.approx(own, abs=0.1)


def test_a_rival_pays_no_more_for_its_instant_than_the_finding(warmed):
    """Its grid is the same, also where the finding's own instant lies between two of the grid."""
    recording, _, reach = warmed
    obs, n = recording.observations, len(recording.time)
    late = (obs.epoch >= n // 2)[:, None] & (reach != 0.0).any(axis=1, keepdims=True)
    pixel = obs.pixel + late * [0.1, 0.0]
    moved = replace(recording, observations=replace(obs, pixel=pixel))
    scene = start(build(moved, ())).with_effects(moved.model.effects, ROOM)
    parts, plain, _ = _plain_fit(scene, 3)
    tests = ScoreTests.of(plain, enumerate_hypotheses(plain.scene))

    def is_step(hypothesis: Hypothesis, port: str) -> bool:
        ports = [term.port for term in hypothesis.group.terms]
        return ports == [port] and hypothesis.course.form == "step"

    leading = top(tests.score(1.0), plain.scene, 10_000, 1)
    jump, _, amplitudes = next(item for item in leading if is_step(item[0], "sensor.cx"))
    found = refit(plain, jump, amplitudes, parts)
    assert found is not None
    own = found.hypothesis, found.effect
    chief, others = rivals(plain, found.adjustment, *own, tests, parts.n)
    (turn,) = [r for r in others if is_step(r.hypothesis, "mount.turn_y")]
    assert turn.weight > 0.3 * chief.weight * np.exp(-0.5 * turn.gap)


def test_the_forms_of_a_name_share_its_prior_and_add_up(warmed, monkeypatch):
    """A name that was asked along in two forms is as heavy by both as another by its only one."""
    bend = 2.0 * effect_deviations(fitted(warmed, 0.0)[-1].adjustment)[-1][1]
    parts, plain, tests, found = fitted(warmed, bend)
    own = found.hypothesis
    key = own.entries[0].id

    def at(camera: str, form: str, asked: int) -> Hypothesis:
        course = Course("ambient_degC", form)
        shared = {"course": course, "scope": Scope(camera=(camera,))}
        return replace(own, entries=own.entries[:1], alternatives={key: asked}, **shared)

    alike = [at("once", "linear", 1), at("twice", "linear", 2), at("twice", "quadratic", 2)]

    def resembling(ranking, scene, own, full, variance, limit):
        for hypothesis in alike:
            yield hypothesis, 0.0, 0.0, found.amplitudes[: hypothesis.n_columns]

    monkeypatch.setattr("jaxvm.discover.rivals._resembling", resembling)
    # What a parabola's column costs is no matter here.
    monkeypatch.setattr("jaxvm.discover.rivals.price_of_columns", lambda *_: 0.0)
    _, others = rivals(plain, found.adjustment, own, found.effect, tests, parts.n)
    weights = {r.hypothesis.scope.camera: r.weight for r in others}
    assert weights[("twice",)] == pytest.approx(weights[("once",)], rel=0.02)
    # Both forms follow the one driver, so that there is no other that it may follow.
    assert all(not r.others for r in others)


def test_plausibility_is_no_matter_of_the_noise(warmed):
    """Of two that fit alike the less plausible is as much less likely, however loud the noise."""
    bend = 2.0 * effect_deviations(fitted(warmed, 0.0)[-1].adjustment)[-1][1]
    parts, plain, tests, found = fitted(warmed, bend)
    own, amplitudes = found.hypothesis, found.amplitudes
    key, share = own.entries[0].id, own.alternatives[own.entries[0].id]
    rare = replace(own, scope=Scope(camera=("rare",)), alternatives={key: 2 * share})
    # Its evidence is behind by its price alone.
    shown = [(rare, amplitudes, 2.0 * np.log(2.0))]
    for noise in (1.0, 6.0):
        asked = (plain, found.adjustment, own, found.effect, tests, parts.n)
        _, others = rivals(*asked, shown, noise)
        (found_odds,) = [r.log_odds for r in others if r.hypothesis.scope.camera == ("rare",)]
        assert found_odds == pytest.approx(-np.log(2.0), abs=1e-9)
    # What fits as well with a column less saves it in full, however large the effect.
    narrow, saved = replace(rare, course=Course(own.course.driver, "linear")), np.log(parts.n)
    _, others = rivals(*asked, [(narrow, amplitudes[:1], 2.0 * np.log(2.0) - saved)])
    (narrower,) = [r.log_odds for r in others if r.hypothesis.scope.camera == ("rare",)]
    assert narrower == pytest.approx(0.5 * saved - np.log(2.0), abs=1e-9)
    # What is ahead and was not chosen failed on the held-out epochs, and is no likelier for it.
    _, others = rivals(*asked, [(rare, amplitudes, -30.0)])
    (ahead,) = [r.log_odds for r in others if r.hypothesis.scope.camera == ("rare",)]
    assert ahead == pytest.approx(-np.log(2.0), abs=1e-9)


def test_what_is_remembered_is_not_counted_twice(warmed):
    """Rivals of the same fit weigh the same when they are told what they were."""
    bend = 2.0 * effect_deviations(fitted(warmed, 0.0)[-1].adjustment)[-1][1]
    parts, plain, tests, found = fitted(warmed, bend)
    asked = (plain, found.adjustment, found.hypothesis, found.effect, tests, parts.n)
    chief, others = rivals(*asked)
    again, same = rivals(*asked, remembered=others)
    assert again.weight == pytest.approx(chief.weight, rel=1e-9)
    assert [r.weight for r in same] == pytest.approx([r.weight for r in others], rel=1e-9)
    # What only they knew is still there.
    odds = float(np.log(0.5))
    known = replace(others[0].hypothesis, scope=Scope(camera=("elsewhere",)))
    lone = replace(others[0], hypothesis=known, log_odds=odds)
    _, more = rivals(*asked, remembered=[*others, lone])
    assert ("elsewhere",) in [r.hypothesis.scope.camera for r in more]


def _raised(instants, drops) -> np.ndarray:
    """Drops of ramps from some instants on, with the best one raised to the peak."""
    group = Group((Term("sensor.focal"),), "camera")
    family = Family(
        groups=(group,),
        courses=tuple(Course("time", "ramp", (instant,)) for instant in instants),
        scopes=(Scope(),),
        valid=np.ones((1, len(instants), 1), bool),
        kinds=("time",) * len(instants),
        asked=(1,) * len(instants),
        named={},
    )
    return family.at_peaks(np.array(drops, float)[None, :, None])[0, :, 0]


def test_a_peak_lies_between_points_of_a_grid_and_in_none_of_its_gaps():
    # A parabola over the log of the constant is met exactly...
    x = np.log([100.0, 200.0, 400.0])
    drops = 70.0 - 30.0 * (x - np.log(230.0)) ** 2
    np.testing.assert_allclose(_raised(np.exp(x), drops), [drops[0], 70.0, drops[2]], rtol=1e-12)
    # ... and not through the night between two sessions, where it would rise to thousands.
    drops = [2.0, 65.0, 64.0]
    np.testing.assert_array_equal(_raised([1600.0, 86_500.0, 86_630.0], drops), drops)


def test_a_refit_speaks_of_one_driver_and_form_alone(warmed):
    """Beyond the decisive gap every unit counts; the other forms of the name keep their odds."""
    own = fitted(warmed, 0.0)[-1].hypothesis
    other = replace(own, course=Course("time", "linear"))
    drop = 1e4
    limit = decisive_gap(drop)
    assert toll(limit + 7.0, drop) == pytest.approx(toll(limit, drop) + 7.0)
    rival = Rival(own, 1.0, 0.6, log_odds=2.0, kinds=((2.0, 1.0, own), (1.0, 3.0, other)))
    assert as_shown(rival, 0.5, drop).weight == pytest.approx(0.6)
    shown = as_shown(rival, limit + 40.0, drop)
    assert shown.hypothesis is other and shown.gap == 3.0 and shown.log_odds == 1.0
    assert shown.weight == pytest.approx(0.6 * np.exp(1.0) / (np.exp(1.0) + np.exp(2.0)), rel=1e-3)
    taken = shown.kinds[0][0] - shown.kinds[1][0]
    assert taken == pytest.approx(-1.0 + 0.5 * (toll(limit + 40.0, drop) - toll(1.0, drop)))
