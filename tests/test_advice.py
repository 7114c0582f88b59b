"""What to record next: information against a dense matrix, gaps against closed forms and refits."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import HELD, IMAGE, at_values, predicted, stereo_recording
from scipy.spatial.transform import Rotation

from jaxvm.discover.advice import (
    _batches,
    _chances,
    _information,
    _without_priors,
    advise,
    under_its_name,
)
from jaxvm.discover.courses import Course
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.plans import PLANS, Plan, planned, possible
from jaxvm.discover.rivals import Rival
from jaxvm.discover.select import DECIDED
from jaxvm.geometry.targets import grid_points
from jaxvm.network.scene import Scene, build
from jaxvm.physics.catalogue import CATALOGUE
from jaxvm.physics.catalogue.entry import each
from jaxvm.physics.effects import Scope, Term
from jaxvm.recording import (
    Camera,
    Drivers,
    Model,
    Observations,
    Recording,
    Station,
    Target,
    join,
)
from jaxvm.recording.model import grid_names
from jaxvm.solve.adjust import adjust, with_weights
from jaxvm.solve.problem import scene_problem

PLAN = {plan.key: plan for plan in PLANS}
ROOM = (4, 4)


def rival(port: str, driver: str, form: str, reference: float = 0.0) -> Hypothesis:
    """One port of the left camera."""
    course = Course(driver, form, (), reference)
    return Hypothesis(Group((Term(port),), "camera"), course, Scope(camera=("left",)), ())


def as_rivals(*hypotheses: Hypothesis) -> tuple[Rival, ...]:
    return tuple(Rival(hypothesis, 0.0, 1.0) for hypothesis in hypotheses)


def with_pixels(scene: Scene, used: np.ndarray | None = None) -> Recording:
    """The recording of a scene with the pixels that the scene predicts, of the used rows."""
    obs = replace(scene.recording.observations, pixel=predicted(scene))
    if used is not None:
        obs = Observations(**{name: values[used] for name, values in vars(obs).items()})
    return replace(scene.recording, observations=obs)


# --- two cameras, a reference and a plate that moves ----------------------------------------------

AMPLITUDE = 1e-3
FOCAL = rival("sensor.focal", "body_degC", "linear", 20.0)
SHIFT = rival("mount.shift_z", "body_degC", "linear", 20.0)


@pytest.fixture(scope="module")
def stereo() -> Scene:
    """A scene at the truth, its left principal distance growing with a temperature, no noise."""
    known = stereo_recording(with_ranges=False, noise=0.0)
    time = known.recording.time
    drivers = Drivers(time, {"body_degC": 20.0 + np.array([0.0, 2.0, 3.0, -1.0, -3.0, -1.0])})
    plate = np.random.default_rng(3).standard_normal((len(time), 6))
    recording = replace(known.recording, drivers=drivers, velocities={"plate": plate})
    effects = (FOCAL.effect((AMPLITUDE,)),)
    scene = at_values(build(recording), known.truth).with_effects(effects, ROOM)
    return at_pixels(scene, with_pixels(scene))


def at_pixels(scene: Scene, recording: Recording) -> Scene:
    """The same values for other measured pixels."""
    new = build(recording).with_effects(scene.fitted_effects(), scene.room)
    return new.with_state(scene.state)


def ones(scene: Scene) -> tuple[np.ndarray, ...]:
    return tuple(np.ones(len(rows)) for rows in scene.tables)


@pytest.mark.parametrize("weighted", [False, True])
def test_information_is_a_dense_schur_complement(stereo, weighted):
    """With momentary poses eliminated by numpy from the Jacobian of all residuals."""
    weights = ones(stereo)
    if weighted:
        weights = tuple((np.arange(len(w)) % 4 > 0).astype(float) for w in weights)
    problem = with_weights(scene_problem(stereo), weights)
    jacobian = np.asarray(dense_jacobian(problem, jnp.zeros(problem.n)))
    dense = jacobian.T @ jacobian
    s = problem.sizes[0]
    assert 0 < s < problem.n
    cross = dense[s:, :s]
    local = np.diag(dense)[s:] > 0
    solved = np.linalg.solve(dense[s:, s:][np.ix_(local, local)], cross[local])
    expected = dense[:s, :s] - cross[local].T @ solved
    got = _information(stereo, weights)
    assert got.shape == (s, s)
    scale = np.sqrt(np.diag(dense)[:s])
    scale = np.where(scale > 0.0, scale, 1.0)
    assert np.abs((got - expected) / np.outer(scale, scale)).max() < 1e-7
    # The elimination is no small correction.
    assert np.abs((dense[:s, :s] - expected) / np.outer(scale, scale)).max() > 1e-2


@eqx.filter_jit
def dense_jacobian(problem, x):
    return jax.jacfwd(
        lambda y: jnp.concatenate([jnp.ravel(r) for r in jax.tree.leaves(problem.residual(y))])
    )(x)


@pytest.mark.parametrize(("driver", "amplitude"), [("body_degC", AMPLITUDE), ("time", 5e-8)])
def test_the_predicted_gap_is_the_difference_of_refits(stereo, driver, amplitude):
    """Noise-free recordings, the present and the planned one, fitted with the rival instead.

    What goes with time has gone on for a day before the second; nothing is promised from that.
    """
    reference = 20.0 if driver == "body_degC" else 0.0
    right = rival("sensor.focal", driver, "linear", reference)
    wrong = rival("mount.shift_z", driver, "linear", reference)
    stereo = stereo.with_effects((right.effect((amplitude,)),), ROOM)
    stereo = at_pixels(stereo, with_pixels(stereo))
    (advice,) = advise(stereo, ones(stereo), 0, as_rivals(wrong), 1.0, (PLAN["farther"],))
    further = planned(PLAN["farther"], stereo, another_day=True)
    (batch,) = _batches(stereo, 0, as_rivals(wrong), ())
    present = _information(batch.scene, ones(stereo))
    planned_scene = _without_priors(batch.under(further.scene))
    both = present + _information(planned_scene, further.weights)
    (gap,) = batch.gaps(both, batch.mimics(present))
    (promised,) = advice.gaps
    if driver == "time":
        assert promised < 0.5 * gap
    else:
        assert promised == pytest.approx(gap, rel=1e-6)
    used = np.zeros(len(stereo.recording.observations.epoch), bool)
    for rows, weight in zip(further.scene.tables, further.weights, strict=True):
        used[rows] = weight > 0
    second = with_pixels(further.scene, used)
    both = join(stereo.recording, second)
    state = {
        name: np.asarray(getattr(stereo.state, name))
        for name in ("focal", "centre", "distortion", "station_from_camera", "world_from_station")
    }
    targets = [np.asarray(s.state.carrier_from_target) for s in (stereo, further.scene)]
    state["carrier_from_target"] = np.concatenate([targets[0], targets[1][1:]])
    plain = at_values(build(both), state)
    found = {}
    for name, hypothesis in (("true", right), ("rival", wrong)):
        fitted = adjust(plain.with_effects((hypothesis.effect((0.0,)),), ROOM), check=False)
        assert fitted.converged, fitted.why
        found[name] = 2.0 * fitted.cost
    assert gap > 10.0
    assert found["rival"] - found["true"] == pytest.approx(gap, rel=0.1)
    # What the present recording alone brings is less.
    alone = adjust(stereo.with_effects((wrong.effect((0.0,)),), ROOM), check=False)
    assert 2.0 * alone.cost < 0.9 * gap


def test_a_rival_may_have_all_terms_of_its_name(stereo):
    """A bracket that grows in z, as far as one recording tells, may have grown in x and y."""
    bracket = next(entry for entry in CATALOGUE if entry.id == "bracket-growth")

    def shift(*ports: str, named: bool = False) -> Hypothesis:
        group = Group(tuple(map(Term, ports)), "camera")
        return replace(SHIFT, group=group, entries=(bracket,) if named else ())

    ports = tuple(f"mount.shift_{axis}" for axis in "xyz")
    further = shift("mount.shift_z", named=True).remainder()
    assert further is not None
    assert [term.port for term in further.group.terms] == ["mount.shift_x", "mount.shift_y"]
    assert shift(*ports, named=True).remainder() is None
    assert shift("mount.shift_z").remainder() is None

    finding = replace(FOCAL, group=Group((Term("sensor.focal"), Term("sensor.cx")), "camera"))
    scene = stereo.with_effects((finding.effect((AMPLITUDE, 0.5)),), (8, 4))

    def behind(hypothesis: Hypothesis) -> float:
        """By how much it is, where the finding is right."""
        (batch,) = _batches(scene, 0, as_rivals(hypothesis), ())
        (effects,) = batch.rivals.values()
        left = batch._without(_information(batch.scene, ones(scene)), [0], effects)
        return float(np.array([AMPLITUDE, 0.5]) @ left @ np.array([AMPLITUDE, 0.5]))

    full = behind(shift(*ports))
    assert behind(shift("mount.shift_z", named=True)) == pytest.approx(full, rel=1e-6)
    assert behind(shift("mount.shift_z")) > 2.0 * full > 1.0
    # So may the finding where the rival is right.
    own = under_its_name(shift("mount.shift_z", named=True), (SHIFT,))
    assert own == [further, SHIFT]


def test_a_name_may_stand_for_other_terms():
    """A distortion that changes with the range may enter with the radius or without."""
    by_id = {entry.id: entry for entry in CATALOGUE}

    def named(entry: str, *terms: Term) -> Hypothesis:
        return replace(FOCAL, group=Group(terms, "camera"), entries=(by_id[entry],))

    slanted = named("distortion-with-range", Term("sensor.focal", "inverse_range", "linear"))
    assert {h.group.terms for h in slanted.instead()} == {
        (Term("lens.k1", "inverse_range", "linear"),),
        (Term("sensor.focal", "radius2_over_range", "linear"),),
    }
    assert under_its_name(slanted, (SHIFT,))[-1] == SHIFT
    # What turned may have shifted: three axes at once, beside those that it lacks itself.
    turned = named("pair-calibration", Term("mount.turn_x"))
    (shifted,) = turned.instead()
    assert {term.port for term in shifted.group.terms} == {f"mount.shift_{a}" for a in "xyz"}
    # A wave of another length is the same kind of physics.
    waves = by_id["range-cyclic"]
    assert named("range-cyclic", *waves.groups[0]).instead() == []
    assert SHIFT.instead() == []


def test_a_rival_may_have_constants_of_its_own(stereo):
    """The same effect with another time constant is told from it by no recording."""

    def lag(seconds: float) -> Hypothesis:
        return replace(FOCAL, course=Course("body_degC", "lag", (seconds,), 20.0))

    tau = float(np.median(np.diff(np.asarray(stereo.network.channels.epoch_time))))
    late = stereo.with_effects((lag(tau).effect((20.0 * AMPLITUDE,)),), ROOM)
    (held,) = _batches(late, 0, as_rivals(lag(1.3 * tau)), ())

    def behind(batch) -> float:
        """By how much it is, where the finding is right."""
        left = batch._without(_information(batch.scene, ones(late)), [0], batch.rivals[0])
        return float((20.0 * AMPLITUDE) ** 2 * left[0, 0])

    assert behind(held) > 1e3
    assert behind(held.awake(ones(late))) < 0.01 * behind(held)


def test_a_larger_effect_and_less_noise_decide_more(stereo):
    plans = (PLAN["nearer"], PLAN["roll"])
    first = advise(stereo, ones(stereo), 0, as_rivals(SHIFT), 1.0, plans)
    louder = advise(stereo, ones(stereo), 0, as_rivals(SHIFT), 4.0, plans)
    for one, two in zip(first, louder, strict=True):
        assert one.plan.key == two.plan.key
        assert two.gaps[0] == pytest.approx(one.gaps[0] / 4.0)
        assert one.odds == pytest.approx(np.exp(min(one.gaps[0] / 2.0, 60.0)))


def test_after_three_sure_plans_no_costlier_one_is_weighed(stereo):
    plans = (PLAN["nearer"], PLAN["farther"])
    quiet = advise(stereo, ones(stereo), 0, as_rivals(SHIFT), 1e-9, 4 * plans)
    assert [a.plan.key for a in quiet] == ["nearer", "farther", "nearer"]
    assert all(a.chance > 0.99 for a in quiet)
    assert len(advise(stereo, ones(stereo), 0, as_rivals(SHIFT), 1e9, 4 * plans)) == 8


def test_a_plan_that_parts_wrong_names_alone_is_no_promise(stereo):
    plans = (PLAN["nearer"],)
    (sure,) = advise(stereo, ones(stereo), 0, as_rivals(SHIFT), 1e-9, plans)
    (less,) = advise(stereo, ones(stereo), 0, as_rivals(SHIFT), 1e-9, plans, among=0.9)
    assert less.parts == sure.parts == sure.chance > 0.99
    assert less.chance == pytest.approx(0.9 * sure.chance)
    assert sure.decides and not less.decides


def test_rivals_beside_each_other_are_weighed_alone(stereo):
    """More at once than the room holds, in any order: each has the gap that it has by itself."""
    turn = rival("mount.turn_x", "body_degC", "linear", 20.0)
    late = rival("sensor.cx", "time", "linear", 0.0)
    parabola = rival("sensor.focal", "body_degC", "parabola", 20.0)
    rivals = (SHIFT, turn, parabola, late)
    assert stereo.room[0] < 1 + 5
    plans = (PLAN["nearer"],)
    (together,) = advise(stereo, ones(stereo), 0, as_rivals(*rivals), 1.0, plans)
    assert together.rivals == rivals
    for k, one in enumerate(rivals):
        (alone,) = advise(stereo, ones(stereo), 0, as_rivals(one), 1.0, plans)
        assert together.gaps[k] == pytest.approx(alone.gaps[0], rel=1e-6, abs=1e-6)
    # What contains the finding fits whatever is recorded.
    assert together.gaps[2] < 0.05 < 1.0 < together.gaps[0]


def test_what_has_no_room_is_not_weighed(stereo):
    wide = Hypothesis(
        Group(each("mark", "target.point_x", numbers=range(20)), "target"),
        Course("constant", "constant"),
        Scope(target=("plate",)),
        (),
    )
    (advice,) = advise(stereo, ones(stereo), 0, as_rivals(wide, SHIFT), 1.0, (PLAN["nearer"],))
    assert advice.rivals == (SHIFT,)
    assert advise(stereo, ones(stereo), 0, as_rivals(wide), 1.0, (PLAN["nearer"],)) == []


@pytest.mark.parametrize(("log_odds", "gain"), [(0.0, 9.0), (4.0, 20.0), (-3.0, 30.0), (2.0, 0.1)])
def test_the_chance_is_the_share_of_simulated_experiments(log_odds, gain):
    """Two Gaussian hypotheses a distance sqrt(gain) apart, one measurement of unit variance."""
    rng = np.random.default_rng(1)
    n = 400_000
    finding = rng.random(n) < 1.0 / (1.0 + np.exp(-0.5 * log_odds))
    measured = np.where(finding, np.sqrt(gain), 0.0) + rng.normal(size=n)
    shown = log_odds + measured**2 - (measured - np.sqrt(gain)) ** 2
    apart = np.where(finding, shown, -shown) > DECIDED
    (got,) = _chances(np.array([log_odds]), np.array([gain]), DECIDED)
    assert got == pytest.approx(apart.mean(), abs=0.004)


# --- one camera before a frontal plate: closed forms ----------------------------------------------

DISTANCE, N_EPOCHS = 2.0, 6
MARKS = grid_points(5, 5, 0.15) - [0.3, 0.3, 0.0]


@pytest.fixture(scope="module")
def frontal() -> Scene:
    """A pinhole whose focal length is a little off; everything else is known and held."""
    camera = Camera(
        "left",
        "desk",
        IMAGE,
        "pinhole",
        np.full(2, 1000.0),
        np.array([639.5, 479.5]),
        None,
        HELD,
        powered_on_s=(-10.0,),
    )
    place = np.array([0.0, 0.0, 0.0, 0.0, 0.0, DISTANCE])
    model = Model(
        "frontal",
        (camera,),
        (Station("desk", "static", HELD),),
        (Target("plate", grid_names(5, 5), MARKS, "per-epoch", place),),
        up=(0.0, -1.0, 0.0),
    )
    epoch, point = np.divmod(np.arange(N_EPOCHS * len(MARKS)), len(MARKS))
    nothing, n = np.zeros(len(epoch), int), len(epoch)
    seen = Observations(epoch, nothing, nothing, point, np.zeros((n, 2)), np.full(n, 0.1))
    recording = Recording(model, np.arange(N_EPOCHS), 10.0 * np.arange(N_EPOCHS), {}, seen)
    effect = rival("sensor.focal", "constant", "constant").effect((AMPLITUDE,))
    scene = build(recording).with_effects((effect,), ROOM)
    return at_pixels(scene, with_pixels(scene))


def size(scene: Scene, weights) -> float:
    """lambda of the finding: its chi-square where nothing else is free."""
    return AMPLITUDE**2 * float(_information(scene, weights)[0, 0])


def test_focal_length_and_axial_shift_come_apart_with_distance_only(frontal):
    """rho = (1 + w / r) / sqrt((1 + w)(1 + w / r^2)) for a pair that differs by a factor 1/Z.

    r is the ratio of the distances and w the ratio of the squared image coordinates: 1/r^2 for the
    same plate. (With w = 1, targets that fill the same field, it is the formula of the table of
    couplings: 0.774 for 2 m and 20 m.)
    """
    twin = rival("mount.shift_z", "constant", "constant")
    plans = (PLAN["farther"], PLAN["nearer"], PLAN["roll"])
    advices = {
        a.plan.key: a.gaps[0]
        for a in advise(frontal, ones(frontal), 0, as_rivals(twin), 1.0, plans)
    }
    alone = size(frontal, ones(frontal))
    assert alone > 10.0
    # Rolled about the axis at the same distance: still one and the same.
    assert advices["roll"] < 1e-4 * alone
    for key, r in (("farther", 2.5), ("nearer", 0.5)):
        further = planned(PLAN[key], frontal)
        assert all((weight == 1.0).all() for weight in further.weights)
        w = 1.0 / r**2
        total = alone + size(further.scene, further.weights)
        assert total == pytest.approx(alone * (1.0 + w), rel=1e-3)
        rho2 = (1.0 + w / r) ** 2 / ((1.0 + w) * (1.0 + w / r**2))
        # A shift that does the same here does less from afar, and more from nearby.
        shifted = alone * (1.0 + w / r**2)
        assert advices[key] == pytest.approx(min(total, shifted) * (1.0 - rho2), rel=0.01)


def test_a_pair_that_distance_does_not_part(frontal):
    """Principal point and detection are the same at every distance and attitude."""
    effect = rival("sensor.cx", "constant", "constant").effect((0.05,))
    scene = frontal.with_effects((effect,), ROOM)
    twin = rival("detect.u", "constant", "constant")
    for advice in advise(scene, ones(scene), 0, as_rivals(twin), 1.0, tuple(PLAN.values())):
        assert advice.gaps[0] < 1e-3 and not advice.decides


def moved(key: str, *by: float) -> Plan:
    return Plan(key, key, poses=lambda poses, middles, eye, up: poses + np.array(by))


def test_what_is_known_beforehand_counts_once(frontal):
    """Nothing is seen under either plan; under the second, marks are next to the camera's plane.

    How large an amplitude may be at most goes by the marks, and there its pattern has no bound.
    """
    course = Course("constant", "constant", (), 0.0)
    over_the_image = Hypothesis(
        Group((Term("sensor.focal", driver="radius"),), "camera"), course, Scope(), ()
    )
    scene = frontal.with_effects((over_the_image.effect((AMPLITUDE,)),), ROOM)
    plans = (
        moved("behind", 0, 0, 0, 0, 0, -2.0 * DISTANCE),
        moved("beside", 0, 0, 0, 5.0, 0, 1e-9 - DISTANCE),
    )
    twin = rival("lens.k1", "constant", "constant")
    behind, beside = advise(scene, ones(scene), 0, as_rivals(twin), 1.0, plans)
    assert behind.gaps[0] > 0.0
    assert beside.gaps[0] == pytest.approx(behind.gaps[0], rel=1e-6)


# --- plans ----------------------------------------------------------------------------------------


def plate_poses(scene: Scene) -> np.ndarray:
    return np.asarray(scene.state.carrier_from_target)[scene.target_row[-1]]


def middles_of(scene: Scene) -> np.ndarray:
    """The middle of the plate's marks in the world, epoch by epoch (m)."""
    poses, points = plate_poses(scene), scene.model.targets[-1].points
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return Rotation.from_rotvec(poses[:, :3]).apply(middle) + poses[:, 3:]


def eye_of(scene: Scene) -> np.ndarray:
    """The middle of the two cameras."""
    station = np.array(scene.state.world_from_station)[0]
    mounted = np.array(scene.state.station_from_camera)[:, 3:]
    return (Rotation.from_rotvec(station[:3]).apply(mounted) + station[3:]).mean(axis=0)


@pytest.mark.parametrize(("key", "factor"), [("farther", 2.5), ("nearer", 0.5)])
def test_distances_are_scaled(stereo, key, factor):
    before, after = plate_poses(stereo), plate_poses(planned(PLAN[key], stereo).scene)
    eye = eye_of(stereo)
    np.testing.assert_allclose(after[:, 3:] - eye, factor * (before[:, 3:] - eye), rtol=1e-12)
    assert np.array_equal(after[:, :3], before[:, :3])


def test_roll_turns_by_a_right_angle_about_the_line_of_sight(stereo):
    after = planned(PLAN["roll"], stereo)
    before, moved = plate_poses(stereo), plate_poses(after.scene)
    sight = middles_of(stereo) - eye_of(stereo)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    turn = (
        Rotation.from_rotvec(moved[:, :3]) * Rotation.from_rotvec(before[:, :3]).inv()
    ).as_rotvec()
    half = len(before) // 2
    np.testing.assert_allclose(turn[:half], 0.0, atol=1e-12)
    np.testing.assert_allclose(turn[half:], 0.5 * np.pi * sight[half:], atol=1e-9)
    # The middle of the plate stays where it is, and the reference as a whole.
    np.testing.assert_allclose(middles_of(after.scene), middles_of(stereo), atol=1e-12)
    obs = stereo.recording.observations
    change = np.abs(predicted(after.scene) - predicted(stereo)).max(axis=1)
    assert change[obs.target == 0].max() < 1e-9
    assert change[(obs.target == 1) & (obs.epoch >= half)].max() > 10.0


def test_the_centre_of_a_rolled_plate_stays_in_the_image(frontal):
    """Marks about the origin of the plate: a mark at (x, y) comes to (-y, x)."""
    after = predicted(planned(PLAN["roll"], frontal).scene) - [639.5, 479.5]
    before = predicted(frontal) - [639.5, 479.5]
    late = frontal.recording.observations.epoch >= N_EPOCHS // 2
    np.testing.assert_allclose(after[~late], before[~late], atol=1e-9)
    expected = np.stack([-before[:, 1], before[:, 0]], axis=1)
    np.testing.assert_allclose(after[late], expected[late], atol=1e-9)


def test_tilt_and_field_keep_the_distance(stereo):
    before, eye = plate_poses(stereo), eye_of(stereo)
    distance = np.linalg.norm(before[:, 3:] - eye, axis=1)
    tilted = plate_poses(planned(PLAN["tilt"], stereo).scene)
    further = planned(PLAN["tilt"], stereo).scene
    np.testing.assert_allclose(middles_of(further), middles_of(stereo), atol=1e-12)
    turn = Rotation.from_rotvec(tilted[:, :3]) * Rotation.from_rotvec(before[:, :3]).inv()
    np.testing.assert_allclose(turn.magnitude(), 0.7, rtol=1e-9)
    across = np.einsum("ij,ij->i", turn.as_rotvec(), middles_of(stereo) - eye)
    np.testing.assert_allclose(across, 0.0, atol=1e-12)
    swept = plate_poses(planned(PLAN["field"], stereo).scene)
    np.testing.assert_allclose(np.linalg.norm(swept[:, 3:] - eye, axis=1), distance, rtol=1e-12)


def seen_by(scene: Scene, change) -> tuple[np.ndarray, np.ndarray]:
    """Whether the marks come to lie inside the image, and their weights, when poses change."""
    further = planned(Plan("other", "other places", poses=change), scene)
    pixel = predicted(further.scene)
    inside = ((pixel > 0) & (pixel < np.array(IMAGE) - 1)).all(axis=1)
    weight = np.zeros(len(inside))
    for rows, own in zip(further.scene.tables, further.weights, strict=True):
        weight[rows] = own
    return inside, weight


def test_marks_outside_the_image_have_no_weight(frontal):
    inside, weight = seen_by(frontal, lambda poses, middles, eye, up: poses + [0, 0, 0, 1.3, 0, 0])
    assert 0 < inside.sum() < len(inside)
    assert np.array_equal(weight, inside.astype(float))


def test_marks_behind_the_camera_have_no_weight(frontal):
    behind = [0.0, 0.0, 0.0, 0.0, 0.0, -2.0 * DISTANCE]
    _, weight = seen_by(frontal, lambda poses, middles, eye, up: poses + behind)
    assert not weight.any()


def test_a_tilted_plate_does_not_reach_through_the_camera(frontal):
    """Its middle is at an eighth of the distance: all of it is nearer than a plan may bring it."""
    inside, weight = seen_by(
        frontal, lambda poses, middles, eye, up: poses + [0, 1.2, 0, 0, 0, 0.25 - DISTANCE]
    )
    assert inside.any() and not weight.any()


def test_a_lens_does_not_fold_what_is_far_outside_into_the_image(frontal):
    """Barrel distortion turns back at r^2 = 1 / (3 k): what is beyond is predicted inside again."""
    (camera,) = frontal.model.cameras
    barrel = replace(camera, lens="opencv5", distortion=np.array([-0.3, 0.0, 0.0, 0.0, 0.0]))
    model = replace(frontal.model, cameras=(barrel,))
    scene = build(replace(frontal.recording, model=model))
    inside, weight = seen_by(scene, lambda poses, middles, eye, up: poses + [0, 0, 0, 3.0, 0, 0])
    assert inside.all() and not weight.any()
    inside, weight = seen_by(scene, lambda poses, middles, eye, up: poses)
    assert inside.all() and weight.all()


@pytest.mark.parametrize("key", ["tilt", "field"])
def test_plans_for_a_camera_that_looks_straight_down(frontal, key):
    model = replace(frontal.model, up=(0.0, 0.0, -1.0))
    scene = replace(frontal, recording=replace(frontal.recording, model=model))
    assert np.isfinite(plate_poses(planned(PLAN[key], scene).scene)).all()


def test_motion_is_reversed_and_power_and_time_change(stereo, frontal):
    reverse = planned(PLAN["reverse"], stereo).scene.recording
    # The other way, and twice as fast.
    old = stereo.recording.velocities["plate"]
    assert np.array_equal(reverse.velocities["plate"], -2.0 * old)
    assert np.array_equal(reverse.time, stereo.recording.time)
    restart = planned(PLAN["restart"], frontal).scene.recording
    assert restart.model.cameras[0].powered_on_s == (-10.0, 25.0)
    longer = planned(PLAN["longer"], stereo).scene.recording
    assert longer.drivers is not None and stereo.recording.drivers is not None
    for one, two in (
        (stereo.recording.time, longer.time),
        (stereo.recording.drivers.time, longer.drivers.time),
    ):
        np.testing.assert_allclose(np.diff(two), 2.0 * np.diff(one))
    cycle = planned(PLAN["cycle"], stereo).scene.recording
    assert cycle.drivers is not None
    was = stereo.recording.drivers.channels["body_degC"]
    now = cycle.drivers.channels["body_degC"]
    assert now.min() == pytest.approx(was.mean()) and now[-1] == pytest.approx(was.mean())
    assert np.ptp(now) <= 2.0 * np.ptp(was) + 1e-12


def test_a_plan_needs_what_it_changes(stereo, frontal):
    could = {plan.key: possible(plan, stereo.recording) for plan in PLANS}
    assert not could.pop("restart") and not could.pop("camera") and all(could.values())
    recording = frontal.recording
    assert not possible(PLAN["cycle"], recording)
    assert not possible(PLAN["reverse"], recording)
    assert possible(PLAN["restart"], recording)
    wind = Drivers(recording.time, {"wind_m_s": recording.time})
    assert not possible(PLAN["cycle"], replace(recording, drivers=wind))
    still = Target("plate", grid_names(5, 5), MARKS, "static", HELD)
    held = replace(recording, model=replace(recording.model, targets=(still,)))
    for plan in PLANS:
        if plan.poses is not None:
            assert possible(plan, recording) and not possible(plan, held)
    assert not possible(PLAN["longer"], replace(recording, timed=False))
    # In so much noise no plan is sure, and all that are possible are weighed.
    keys = {a.plan.key for a in advise(stereo, ones(stereo), 0, as_rivals(SHIFT), 1e9)}
    assert keys == set(could)


# --- plans do what their words say ----------------------------------------------------------------


def test_twice_as_long_is_half_as_fast(stereo):
    recording = stereo.recording
    changed = PLAN["longer"].recording(recording)
    np.testing.assert_allclose(np.ptp(changed.time), 2.0 * np.ptp(recording.time))
    for name, values in recording.velocities.items():
        np.testing.assert_allclose(changed.velocities[name], 0.5 * values)


def test_what_is_switched_on_again_runs_from_its_last_moment(stereo):
    recording = stereo.recording
    first, last = recording.time[[0, -1]]
    often = (float(first) - 5.0, float(last) - 1e-3)
    cameras = tuple(replace(c, powered_on_s=often) for c in recording.model.cameras)
    recording = replace(recording, model=replace(recording.model, cameras=cameras))
    changed = PLAN["restart"].recording(recording)
    for camera in changed.model.cameras:
        assert camera.powered_on_s == tuple(sorted((*often, 0.5 * (first + last))))


def test_what_is_carried_by_a_station_can_not_be_put_nearer(stereo):
    recording = stereo.recording
    assert possible(PLAN["nearer"], recording)
    station = recording.model.stations[0].name
    targets = tuple(replace(t, station=station) for t in recording.model.targets)
    carried = replace(recording, model=replace(recording.model, targets=targets))
    assert not possible(PLAN["nearer"], carried)


def test_a_cycle_returns_while_images_are_taken(stereo):
    """The log may begin a day before the first image and end a day after the last."""
    recording = stereo.recording
    first, last = recording.time[[0, -1]]
    span = last - first
    log = np.linspace(first - 20.0 * span, last + 20.0 * span, 2001)
    warm = 20.0 + np.sin(log / span)
    changed = PLAN["cycle"].recording(replace(recording, drivers=Drivers(log, {"body_degC": warm})))
    course = np.interp(np.linspace(first, last, 50), log, changed.drivers.channels["body_degC"])
    assert np.ptp(course) == pytest.approx(2.0 * np.ptp(warm), rel=0.05)
    assert abs(course[-1] - course[0]) < 0.05 * np.ptp(course)
