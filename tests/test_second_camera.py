"""A second camera beside the only one: where it stands, what it sees, and what it would decide."""

from dataclasses import replace

import numpy as np
import pytest
from networks import HELD, at_values, predicted
from scipy.spatial.transform import Rotation
from test_advice import ROOM, as_rivals, at_pixels, ones, with_pixels

from jaxvm.discover.advice import _batches, _information, _without_priors, advise
from jaxvm.discover.courses import Course
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.plans import PLANS, planned, possible
from jaxvm.discover.second_camera import ASIDE_RAD, of_first_cameras, with_second_camera
from jaxvm.geometry.targets import grid_points
from jaxvm.network.scene import Scene, build
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
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import standard_deviations

(CAMERA,) = (plan for plan in PLANS if plan.key == "camera")
MARKS = grid_points(5, 7, 0.1) - [0.3, 0.2, 0.0]
N_EPOCHS, WARMER = 8, 3e-4


def hypothesis(port: str, scope: Scope, kind: str) -> Hypothesis:
    """One port that follows the temperature."""
    course = Course("body_degC", "linear", (), 20.0)
    return Hypothesis(Group((Term(port),), kind), course, scope, ())


ASPECT = hypothesis("sensor.aspect", Scope(), "camera")
WIDTH = hypothesis("target.scale_x", Scope(target=("plate",)), "target")


@pytest.fixture(scope="module")
def alone() -> Scene:
    """One camera before a plate that hardly turns, and grows along x with the temperature."""
    camera = Camera(
        "left",
        "desk",
        (1280, 960),
        "opencv4",
        np.full(2, 1000.0),
        np.array([639.5, 479.5]),
        np.zeros(4),
        HELD,
        free=frozenset({"focal", "centre", "distortion"}),
    )
    rng = np.random.default_rng(2)
    turn = 0.02 * rng.normal(size=(N_EPOCHS, 3))
    turn[:3] += [[0.4, 0.0, 0.0], [0.0, 0.4, 0.1], [-0.3, -0.3, 0.0]]
    shift = [0.0, 0.0, 2.0] + rng.uniform(-0.2, 0.2, (N_EPOCHS, 3))
    model = Model(
        "alone",
        (camera,),
        (Station("desk", "static", HELD),),
        (Target("plate", grid_names(5, 7), MARKS, "per-epoch", free=frozenset({"pose"})),),
        up=(0.0, -1.0, 0.0),
    )
    epoch, point = np.divmod(np.arange(N_EPOCHS * len(MARKS)), len(MARKS))
    nothing, n = np.zeros(len(epoch), int), len(epoch)
    seen = Observations(epoch, nothing, nothing, point, np.zeros((n, 2)), np.full(n, 0.1))
    time = 10.0 * np.arange(N_EPOCHS)
    drivers = Drivers(time, {"body_degC": 20.0 + rng.normal(0.0, 4.0, N_EPOCHS)})
    recording = Recording(model, np.arange(N_EPOCHS), time, {}, seen, drivers)
    scene = at_values(build(recording), {"carrier_from_target": np.hstack([turn, shift])})
    scene = scene.with_effects((WIDTH.effect((WARMER,)),), ROOM)
    return at_pixels(scene, with_pixels(scene))


def test_it_stands_aside_and_sees_the_same_marks(alone):
    both = with_second_camera(alone)
    obs = both.recording.observations
    n = len(alone.recording.observations.epoch)
    plain = alone.with_effects((), ROOM)
    pixels = predicted(both)
    np.testing.assert_allclose(pixels[:n], predicted(plain), atol=1e-9)
    # The plate is turned by less than the two lines of sight: all marks but those are seen.
    assert (obs.camera[:n] == 0).all() and (obs.camera[n:] == 1).all()
    assert len(obs.epoch) - n > 0.8 * n
    size = np.array(both.model.cameras[1].image_size)
    inside = ((pixels[n:] > 0.0) & (pixels[n:] < size - 1.0)).all(axis=1)
    assert inside.mean() > 0.95

    first, second = np.asarray(both.state.station_from_camera)
    targets = alone.world_from_targets(np.zeros(n, int), np.arange(n) // len(MARKS))
    marks = Rotation.from_rotvec(targets[:, :3]).apply(np.tile(MARKS, (N_EPOCHS, 1)))
    middle = np.median(marks + targets[:, 3:], axis=0)
    ways = [middle - pose[3:] for pose in (first, second)]
    lengths = [np.linalg.norm(way) for way in ways]
    assert lengths[0] == pytest.approx(lengths[1])
    assert ways[0] @ ways[1] / lengths[0] ** 2 == pytest.approx(np.cos(ASIDE_RAD))
    # To the side, of a sight that is level but for a few hundredths.
    assert abs(second[4] - first[4]) < 0.05 * lengths[0]
    # Nothing more is known of it than of the first one, and it stands on its own feet.
    own, aside = both.model.cameras
    assert aside.free == own.free | {"pose"} and aside.station != own.station


def test_what_is_wrong_with_the_first_camera_is_not_wrong_with_the_second(alone):
    both = with_second_camera(alone)
    effects = tuple(h.effect((1e-4,)) for h in (ASPECT, WIDTH))
    own = of_first_cameras(effects, alone.model, both.model)
    assert own[0].scope == Scope(camera=("left",)) and own[1].scope == WIDTH.scope
    assert of_first_cameras(effects, alone.model, alone.model) == effects
    n = len(alone.recording.observations.epoch)
    plain = predicted(both)
    moved = [np.abs(predicted(both.with_effects((e,), ROOM)) - plain).max(axis=1) for e in own]
    assert moved[0][:n].max() > 0.1 and moved[0][n:].max() < 1e-9
    assert moved[1][:n].max() > 0.1 and moved[1][n:].max() > 0.1


def test_its_own_unknowns_are_paid_for(alone):
    """Both recordings as one network give the same information on what the first one has."""
    further = planned(CAMERA, alone)
    (batch,) = _batches(alone, 0, as_rivals(ASPECT), ())
    added = batch.information(further)
    used = np.zeros(len(further.scene.recording.observations.epoch), bool)
    for rows, weight in zip(further.scene.tables, further.weights, strict=True):
        used[rows] = weight > 0
    scene = _without_priors(batch.under(further.scene))
    every = _information(scene, further.weights)
    theirs, ours = scene.unknowns.names(), batch.scene.unknowns.names()
    s = scene.unknowns.n_shared
    foreign = [k for k in range(s) if "left aside" in theirs[k] and every[k, k] > 0.0]
    assert len(foreign) == 14  # two focal lengths, a centre, four coefficients, a pose
    known = [k for k in range(s) if "left aside" not in theirs[k]]
    assert [theirs[k] for k in known] == ours[: batch.scene.unknowns.n_shared]
    solved = np.linalg.solve(every[np.ix_(foreign, foreign)], every[np.ix_(foreign, known)])
    expected = every[np.ix_(known, known)] - every[np.ix_(known, foreign)] @ solved
    size = np.sqrt(np.maximum(np.diag(every)[known], 1e-300))
    assert np.abs((added - expected) / np.outer(size, size)).max() < 1e-6


def test_the_promised_gap_is_the_difference_of_refits(alone):
    """A camera whose pixels widen and a plate that widens come apart by a second camera."""
    (advice,) = advise(alone, ones(alone), 0, as_rivals(ASPECT), 1.0, (CAMERA,))
    further = planned(CAMERA, alone)
    used = np.zeros(len(further.scene.recording.observations.epoch), bool)
    for rows, weight in zip(further.scene.tables, further.weights, strict=True):
        used[rows] = weight > 0
    both = join(alone.recording, with_pixels(further.scene, used))
    assert [camera.name for camera in both.model.cameras] == ["left", "left aside"]
    poses = np.asarray(alone.state.carrier_from_target)[:N_EPOCHS]
    state = {name: np.asarray(getattr(further.scene.state, name))
             for name in ("focal", "centre", "distortion", "station_from_camera")}  # fmt: skip
    state["carrier_from_target"] = np.concatenate([poses, poses])
    plain = at_values(build(both), state)
    found = {}
    for name, own in (("true", WIDTH), ("rival", ASPECT)):
        own = of_first_cameras((own.effect((0.0,)),), alone.model, both.model)
        fitted = adjust(plain.with_effects(own, ROOM), check=False)
        assert fitted.converged, fitted.why
        found[name] = 2.0 * fitted.cost
    (gap,) = advice.gaps
    assert gap > 20.0
    assert found["rival"] - found["true"] == pytest.approx(gap, rel=0.1)
    before = adjust(alone.with_effects((ASPECT.effect((0.0,)),), ROOM), check=False)
    assert 2.0 * before.cost < 0.5 * gap


def test_one_camera_that_stands_alone_may_have_a_second(alone):
    recording, model = alone.recording, alone.recording.model
    assert possible(CAMERA, recording)
    (camera,) = model.cameras
    two = replace(model, cameras=(camera, replace(camera, name="right")))
    assert not possible(CAMERA, replace(recording, model=two))
    moving = replace(model, stations=(Station("desk", "per-epoch", free=frozenset({"pose"})),))
    assert not possible(CAMERA, replace(recording, model=moving))


def test_a_further_camera_joins_with_its_priors_and_its_start(alone):
    """The first recording says nothing of it, and it has the same values as alone."""
    further = planned(CAMERA, alone).scene
    second = with_pixels(further)
    cameras = tuple(replace(c, powered_on_s=(5.0,)) for c in second.model.cameras)
    second = replace(second, model=replace(second.model, cameras=cameras))
    both = join(alone.recording, second)
    later = both.time[N_EPOCHS] - second.time[0]
    assert [c.powered_on_s for c in both.model.cameras] == [(5.0 + later,)] * 2
    assert (both.observations.epoch[both.observations.camera == 1] >= N_EPOCHS).all()
    fitted = standard_deviations(adjust(build_near(both, further)))
    assert (np.asarray(fitted.station_from_camera)[1] > 0.0).all()

    posed = replace(second.model.stations[1], pose=np.zeros((N_EPOCHS, 6)), motion="per-epoch")
    odd = replace(second.model, stations=(second.model.stations[0], posed))
    with pytest.raises(ValueError, match='station "left aside" has a pose for each'):
        join(alone.recording, replace(second, model=odd))
    fewer = replace(second.model, cameras=second.model.cameras[1:])
    with pytest.raises(ValueError, match="can't be joined"):
        join(alone.recording, replace(second, model=fewer))


def build_near(recording: Recording, further: Scene) -> Scene:
    """A joined recording at the values of the planned one."""
    state = {name: np.asarray(getattr(further.state, name))
             for name in ("focal", "centre", "distortion", "station_from_camera")}  # fmt: skip
    poses = np.asarray(further.state.carrier_from_target)[:N_EPOCHS]
    return at_values(build(recording), state | {"carrier_from_target": np.tile(poses, (2, 1))})
