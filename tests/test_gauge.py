"""Rank: what the observations don't determine is named, and nothing else is."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from networks import (
    at_values,
    board_recording,
    free_points_recording,
    relay_recording,
    scale_recording,
)

from jaxvm.network.scene import build
from jaxvm.recording.model import Prior
from jaxvm.solve.adjust import adjust
from jaxvm.solve.gauge import RankDeficiency, check_gauge, null_directions
from jaxvm.solve.problem import normal_at, scaled, scene_problem


def examined(scene):
    """Scaled normal equations at the scene's values."""
    problem = scene_problem(scene)
    return scaled(problem, normal_at(problem, jnp.zeros(problem.n)))[1]


def nulls(scene):
    return null_directions(examined(scene), scene.unknowns)


def named(directions) -> set[str]:
    return {name for direction in directions for name, _ in direction.unknowns}


@pytest.fixture(scope="module")
def floating():
    """Cameras, frame and cloud with nothing that holds them in the world."""
    known = free_points_recording()
    frame, cloud = known.recording.model.targets
    free = replace(frame, free=frozenset({"pose"}))
    return known, known.with_model(targets=(free, cloud))


def test_determined_networks_are_not_accused():
    for known in (board_recording(), scale_recording(), free_points_recording()):
        scene = known.true_scene()
        normal = examined(scene)
        assert null_directions(normal, scene.unknowns) == []
        check_gauge(normal, scene.unknowns)


def test_undetermined_datum(floating):
    known, recording = floating
    scene = known.true_scene(recording)
    found = nulls(scene)
    # A rigid body in space: three turns and three shifts.
    assert len(found) == 6
    assert all(direction.eigenvalue < 1e-13 for direction in found)
    names = named(found)
    assert all(name.startswith(("station tripod", "target frame")) for name in names)
    assert {f"target frame: shift {a}" for a in "xyz"} <= names
    assert {f"station tripod{i}: shift x" for i in range(4)} <= names
    with pytest.raises(RankDeficiency, match="do not determine: .*(target frame|station tripod)"):
        adjust(scene)


def test_a_prior_ties_the_datum_down(floating):
    known, recording = floating
    prior = Prior("targets.frame.pose", np.zeros(6), np.full(6, 1e-3))
    recording = replace(recording, model=replace(recording.model, priors=(prior,)))
    assert nulls(at_values(build(recording), known.truth)) == []


def test_no_scale_without_ranges():
    known = scale_recording(with_ranges=False)
    found = nulls(known.true_scene())
    assert len(found) == 1
    # The baseline can have any length; turns of the camera are determined.
    names = [name for name, _ in found[0].unknowns]
    assert names[0] == "camera right in its station: shift x"
    assert not any("turn" in name for name in names)
    with pytest.raises(RankDeficiency, match="camera right in its station: shift x"):
        adjust(known.true_scene())


def test_point_seen_by_one_camera():
    known = free_points_recording()
    obs = known.recording.observations
    keep = (obs.target == 0) | (obs.point != 5) | (obs.camera == 1)
    fewer = type(obs)(**{name: values[keep] for name, values in vars(obs).items()})
    scene = known.true_scene(replace(known.recording, observations=fewer))
    found = nulls(scene)
    assert len(found) == 1
    assert {name.rsplit(":")[0] for name in named(found)} == {"point p5 of target cloud"}
    with pytest.raises(RankDeficiency, match="point p5 of target cloud"):
        adjust(scene)


def test_camera_and_its_station_both_free():
    known = free_points_recording()
    cameras = known.recording.model.cameras
    loose = replace(cameras[2], free=cameras[2].free | {"pose"})
    scene = known.true_scene(known.with_model(cameras=(*cameras[:2], loose, cameras[3])))
    found = nulls(scene)
    assert len(found) == 6
    bodies = {name.split(":")[0] for name in named(found)}
    assert bodies == {"camera cam2 in its station", "station tripod2"}


def test_station_that_nothing_joins():
    known = relay_recording()
    scene = known.true_scene()
    # Only the first link and c01 are left, between stations s0 and s1.
    network = eqx.tree_at(
        lambda n: n.links.weight, scene.network, jnp.array([1.0, 0.0, 1.0, 0.0, 0.0])
    )
    found = nulls(replace(scene, network=network))
    assert len(found) == 6
    assert {name.split(":")[0] for name in named(found)} == {"station s2", "target t2"}


@pytest.mark.parametrize("free", [("focal", "centre"), ("focal", "centre", "distortion")])
def test_one_view_of_a_plane(free):
    """A homography has 8 numbers, a pose 6: two of a camera's four are free to choose."""
    known = board_recording(n_epochs=1, free=frozenset(free))
    # A user who knows nothing of the lens starts at no distortion.
    truth = known.truth | {"distortion": np.zeros((1, 14))}
    scene = at_values(build(known.recording), truth)
    found = nulls(scene)
    assert len(found) == 2
    names = named(found)
    cameras = {name for name in names if name.startswith("camera cam: ")}
    assert any("focal" in name for name in cameras)
    assert any("centre" in name for name in cameras)
    with pytest.raises(RankDeficiency, match="camera cam: (focal|centre)"):
        adjust(scene)


def test_one_view_gives_a_focal_length():
    """With the centre held and one focal length, one oblique view is enough."""
    known = board_recording(n_epochs=1, free=frozenset({"aspect-locked-focal"}))
    assert nulls(known.true_scene(known.with_model(priors=()))) == []
