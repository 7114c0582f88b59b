"""Names of a hypothesis: by size, one by one, and not for what an unnamed effect left over."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from networks import board_recording, predicted

from jaxvm.discover.accept import STRONG, _comparable
from jaxvm.discover.constants import sensible
from jaxvm.discover.courses import Course
from jaxvm.discover.diagnose import _plain_fit
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.select import (
    Candidate,
    best_named,
    evidence,
    identity,
    log_prior,
    price,
    price_of_columns,
    price_of_constants,
    refit,
)
from jaxvm.physics.catalogue import entries_for
from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.forms import FORMS
from jaxvm.solve.adjust import adjust

FOCAL = (Term("sensor.focal"),)
DRIFT = Hypothesis(
    Group(FOCAL, "camera"),
    Course("body_degC", "linear"),
    Scope(camera=("left",)),
    entries_for(FOCAL, "camera", ("quantity", "temperature"), "linear"),
)


@pytest.mark.parametrize(
    "per_kelvin, name",
    [(3e-5, "focal-drift"), (-3e-5, "focal-drift"), (2e-3, "device-compensates")],
)
def test_the_size_decides_between_two_names(per_kelvin, name):
    assert {entry.id for entry in DRIFT.entries} == {"focal-drift", "device-compensates"}
    named = best_named(DRIFT, np.array([per_kelvin]))
    assert named.entries[0].id == name
    assert set(named.entries) == set(DRIFT.entries)
    # The likelier name has the larger prior when each stands alone.
    alone = [replace(named, entries=(entry,)) for entry in named.entries]
    priors = [log_prior(own, np.array([per_kelvin])) for own in alone]
    assert priors[0] > priors[1]
    assert len({identity(own) for own in alone}) == 2


def test_shifts_in_pixels_are_no_part_of_the_size_of_a_lens():
    terms = (*FOCAL, Term("sensor.cx"), Term("sensor.cy"))
    names = entries_for(terms, "camera", ("quantity", "temperature"), "rate")
    assert [entry.id for entry in names] == ["window-heats"]
    course = Course("body_degC", "rate")
    heats = Hypothesis(Group(terms, "camera"), course, Scope(camera=("left",)), names)
    plausible = [log_prior(heats, np.array([2e-4, *px])) for px in ((0.0, 0.0), (0.04, 0.1))]
    assert plausible[0] == plausible[1]
    assert log_prior(heats, np.array([5e-3, 0.0, 0.0])) < plausible[0] - 2.0


@pytest.mark.parametrize("form", ["affine", "affine lag", "lag with state", "hysteresis"])
def test_what_a_course_is_at_zero_is_no_part_of_its_size(form):
    """A plate of steel that counts from 20 degrees is a plate of steel."""
    terms = (Term("target.scale"),)
    names = entries_for(terms, "target", ("quantity", "temperature"), "linear")
    bases = FORMS[form].bases
    amplitudes = np.where([basis in ("one", "first state") for basis in bases], -3e-3, 1.2e-5)

    def prior(form: str, amplitudes) -> float:
        constants = (100.0,) * len(FORMS[form].constants)
        course = Course("ambient_degC", form, constants)
        own = Hypothesis(Group(terms, "target"), course, Scope(target=("plate",)), names[:1])
        return log_prior(own, np.array(amplitudes))

    assert names[0].id == "target-expansion"
    assert prior(form, amplitudes) == prior("linear", [1.2e-5]) == 0.0
    assert prior(form, 100.0 * amplitudes) < -3.0


def test_the_size_of_a_vibration_has_no_phase():
    terms = (Term("mount.turn_x"),)
    names = entries_for(terms, "camera", ("time",), "periodic")
    course = Course("time", "periodic", (10.0,))
    shakes = Hypothesis(Group(terms, "camera"), course, Scope(camera=("left",)), names)
    tiny = names[0].plausible[0] / 100.0
    phases = [tiny * np.array([np.cos(phase), np.sin(phase)]) for phase in (0.0, 1.0, np.pi / 2)]
    priors = [log_prior(shakes, amplitudes) for amplitudes in phases]
    assert priors[0] < -3.0
    np.testing.assert_allclose(priors, priors[0])


@pytest.mark.parametrize("late, name", [(1.3e-3, "trigger-late"), (0.4, "frame-slip")])
def test_no_camera_loses_a_thousandth_of_a_second(late, name):
    terms = (Term("clock.offset"),)
    names = entries_for(terms, "camera", ("time",), "step")
    assert {entry.id for entry in names} == {"trigger-late", "frame-slip"}
    step = Course("time", "step", (10.0,))
    delay = Hypothesis(Group(terms, "camera"), step, Scope(camera=("left",)), names)
    assert best_named(delay, np.array([late])).entries[0].id == name


def test_amounts_of_epochs_that_are_set_aside_cost_nothing():
    many, fewer, drop, n = 60, 40, 130.0, 5000
    group = Group(each("epoch", "sensor.focal", numbers=range(many)), "camera")
    hunts = Hypothesis(group, Course("constant", "constant"), Scope(camera=("left",)), ())
    amounts = np.full(many, 1e-4)
    aside = np.where(np.arange(many) % 3 == 2, 0.0, amounts)
    own = [evidence(hunts, drop, amplitudes, 1.0, n) for amplitudes in (aside, amounts)]
    # Each amount costs 1 + ln(drop / number), as its prior is as wide as they are.
    price = [k * (1.0 + np.log(drop / k)) for k in (fewer, many)]
    assert own[0] - own[1] == pytest.approx(price[1] - price[0])
    assert own[0] > own[1]


def unnamed(driver: str, form: str, *ports: str) -> Hypothesis:
    return Hypothesis(
        Group(tuple(map(Term, ports)), "camera"),
        Course(driver, form),
        Scope(camera=("left",)),
        (),
    )


def test_a_remainder_of_what_has_no_name_gets_none():
    curve = unnamed("time", "curve", "mount.turn_x")
    assert DRIFT.covered(curve)
    assert not curve.covered(DRIFT)
    assert not unnamed("time", "fine curve", "mount.turn_x").covered(curve)


def test_another_place_or_another_kind_is_no_remainder():
    curve = unnamed("time", "curve", "mount.turn_x")
    assert not replace(DRIFT, scope=Scope(camera=("right",))).covered(curve)
    assert not replace(DRIFT, course=Course("constant", "constant")).covered(curve)
    assert not DRIFT.covered(unnamed("constant", "constant", "detect.u"))
    assert not DRIFT.covered(DRIFT)


def test_a_parabola_contains_its_line():
    parabola = replace(DRIFT, course=Course("body_degC", "quadratic"))
    assert parabola.contains(DRIFT)
    assert DRIFT.contains(DRIFT)
    assert not DRIFT.contains(parabola)
    assert not replace(parabola, scope=Scope(camera=("right",))).contains(DRIFT)
    assert not replace(parabola, course=Course("room_degC", "quadratic")).contains(DRIFT)


@pytest.mark.parametrize("pauses, sound", [(0.3, False), (3.0, True), (1e4, False)])
def test_what_settles_between_two_epochs_is_a_step(pauses, sound):
    scene = board_recording().true_scene()
    time = np.asarray(scene.network.channels.epoch_time)
    pause = float(np.median(np.diff(time)))
    slow = Effect(
        "it settles",
        (Term("mount.shift_x"),),
        driver="time",
        form="settling",
        constants=(0.5 * float(time[-1]), pauses * pause),
        scope=Scope(camera=("cam",)),
        amplitudes=(1e-3,),
    )
    assert sensible(scene, slow) == sound


@pytest.mark.parametrize("share, sound", [(0.1, True), (0.95, False), (1.5, False)])
def test_what_stands_still_for_its_dead_time_is_a_constant(share, sound):
    scene = board_recording().true_scene()
    channels = scene.network.channels
    values = np.asarray(channels.values[channels.index("time")])
    late = Effect(
        "it follows late",
        (Term("target.scale"),),
        driver="time",
        form="delay",
        constants=(share * float(np.ptp(channels.epoch_time)),),
        reference=float(values.mean()),
        scope=Scope(target=("board",)),
        amplitudes=(1e-5,),
    )
    assert sensible(scene, late) == sound
    # Nothing is known of the course while it has no size.
    assert sensible(scene, replace(late, amplitudes=(0.0,)))


def test_a_curve_in_time_is_sensible_though_its_knots_begin_before_the_recording():
    scene = board_recording().true_scene()
    time = np.asarray(scene.network.channels.epoch_time)
    spacing = float(np.ptp(time)) / 9.0
    own = FORMS["curve"]
    curve = Effect(
        "it moves",
        (Term("mount.shift_x"),),
        driver="time",
        form="curve",
        constants=(float(time[0]) - spacing, spacing),
        scope=Scope(camera=("cam",)),
        amplitudes=tuple(1e-4 * np.arange(len(own.bases))),
    )
    assert curve.constants[0] < 0.0 and not own.constants[0].refined
    assert sensible(scene, curve)


@dataclass(frozen=True)
class Fitted:
    """Of a fit, what it costs and leaves."""

    cost: float
    variance_factor: float


def test_candidates_are_compared_at_one_variance():
    """2 ln of the likelihood ratio of two fits is n ln of the ratio of what they leave."""
    n, before, left = 1000, 10_000.0, np.array([1010.0, 1000.0])
    current = Fitted(0.5 * before, before / n)
    candidates = [
        Candidate(DRIFT, Fitted(0.5 * chi2, chi2 / n), (before - chi2) / (chi2 / n))  # pyright: ignore[reportArgumentType]
        for chi2 in left
    ]
    best, other = _comparable(candidates, current)  # pyright: ignore[reportArgumentType]
    assert best.adjustment.cost == 500.0
    assert best.evidence - other.evidence == pytest.approx(n * np.log(1.01), rel=0.02)


def test_constants_cost_the_same_when_they_are_taken_and_when_they_are_kept():
    """A refined constant never costs more than a column, and one that any value does nothing."""
    lagging = replace(DRIFT, course=Course("body_degC", "lag", (600.0,)))
    n = 40_000
    assert price_of_constants(DRIFT, 50.0, n) == 0.0
    assert price_of_constants(lagging, 1e-9, n) == pytest.approx(0.0, abs=1e-6)
    assert 0.0 < price_of_constants(lagging, 28.0, n) < np.log(n)
    assert price_of_constants(lagging, 1e12, n) == pytest.approx(np.log(n))
    columns = price_of_columns(lagging, np.ones(1), 28.0, n)
    prior = 2.0 * log_prior(lagging, np.ones(1))
    whole = price(lagging, 28.0, np.ones(1), n)
    assert whole == pytest.approx(columns + price_of_constants(lagging, 28.0, n) - prior)


def test_depths_of_marks_do_not_run_away_with_the_poses():
    """Depths that rise across the board are the board's pose: none of that is in what is found."""
    known = board_recording(n_epochs=12)
    obs, scope = known.recording.observations, Scope(target=("board",))
    terms = each("mark", "target.point_z", numbers=range(30))
    names = entries_for(terms, "target", ("constant",), "constant")
    assert [entry.id for entry in names] == ["marks-of-other-depth"]
    depths = Hypothesis(Group(terms, "target"), Course("constant", "constant"), scope, names)
    true = 3e-4 * np.random.default_rng(4).standard_normal(30)
    scene = known.true_scene().with_effects((depths.effect(true),), (40, 4))
    pixel = predicted(scene)
    pixel += obs.sigma[:, None] * np.random.default_rng(5).standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    parts, plain, _ = _plain_fit(known.true_scene(recording), 3)
    # The poses could take back as much as a hundred times what is there.
    found = refit(plain, depths, 3e-2 * np.ones(30), parts)
    assert found is not None and found.evidence > STRONG
    flat = np.column_stack([np.ones(30), known.recording.model.targets[0].points[:, :2]])

    def beside_the_pose(z):
        return z - flat @ np.linalg.lstsq(flat, z, rcond=None)[0]

    np.testing.assert_allclose(beside_the_pose(found.amplitudes), beside_the_pose(true), atol=2e-4)
    assert np.abs(found.amplitudes).max() < 1.5 * np.abs(true).max()


def test_a_refit_goes_on_until_the_camera_has_made_room():
    # A tilted sensor, where centre and decentring are free: they go dozens of pixels with it.
    known = board_recording(n_epochs=30)
    obs, rng = known.recording.observations, np.random.default_rng(4)
    camera = Scope(camera=("cam",))
    terms = (Term("lens.tilt_y"),)
    tilted = Effect("", terms, "constant", "constant", (), 0.0, camera, (0.15,))
    pixel = predicted(known.true_scene().with_effects((tilted,), (8, 4)))
    pixel += obs.sigma[:, None] * rng.standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    parts, plain, _ = _plain_fit(known.true_scene(recording), 3)
    names = entries_for(terms, "camera", ("constant",), "constant")
    course = Course("constant", "constant")
    hypothesis = Hypothesis(Group(terms, "camera"), course, camera, names)
    candidate = refit(plain, hypothesis, np.array([0.1]), parts)
    assert candidate is not None
    best = adjust(
        candidate.adjustment.scene, weights=parts.weights, rtol=1e-13, max_steps=200, check=False
    )
    drop, most = (2.0 * (plain.cost - fit.cost) for fit in (candidate.adjustment, best))
    assert most > 100.0
    assert drop > most - 1.0
    (size,) = candidate.amplitudes
    assert abs(size - 0.15) < 0.03


def test_a_seam_costs_as_much_as_an_instant():
    def stitched(*seams):
        terms = tuple(Term(f"detect.{a}", "column", "step", (at,)) for at in seams for a in "uv")
        entries = entries_for(terms, "camera", ("constant",), "constant")
        return Hypothesis(Group(terms, "camera"), Course("constant", "constant"), Scope(), entries)

    for n, seams in ((1, (0.04,)), (2, (-0.12, 0.2))):
        expected = n * np.log(5000)
        assert price_of_constants(stitched(*seams), 300.0, 5000) == pytest.approx(expected)
    instant = replace(DRIFT, course=Course("time", "step", (7.0,)))
    assert price_of_constants(instant, 300.0, 5000) == pytest.approx(np.log(5000))
