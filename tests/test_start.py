"""Start values from the data alone, and what is said when the data don't give them."""

from dataclasses import replace

import numpy as np
import pytest
from networks import (
    HELD,
    RECORDINGS,
    adjusted,
    free_points_recording,
    relay_recording,
    stereo_recording,
    without_starts,
)

from jaxvm.network import start as starting
from jaxvm.network.scene import build
from jaxvm.network.start import StartError, start
from jaxvm.recording.model import Station, Target
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import standard_deviations


@pytest.mark.parametrize("name", ["board", "stereo", "points"])
def test_start_ends_where_the_truth_ends(name):
    known, from_truth = adjusted(name)
    assert known.recording is not None
    blind = without_starts(known.recording)
    assert blind.model.cameras[0].focal_px is None
    assert all(body.pose is None for body in blind.model.targets if "pose" in body.free)
    begun = start(build(blind))
    result = adjust(begun)
    assert result.converged
    assert result.cost == pytest.approx(from_truth.cost, rel=1e-8)
    sd = standard_deviations(from_truth).flatten()
    found, expected = (np.asarray(r.scene.state.flatten()) for r in (result, from_truth))
    free = np.asarray(sd) > 0
    assert np.abs((found - expected)[free] / np.asarray(sd)[free]).max() < 1e-2


def test_start_is_near_without_any_adjustment():
    known = stereo_recording(noise=0.0)
    begun = start(build(without_starts(known.recording)))
    for field, tolerance in [("world_from_station", 0.2), ("carrier_from_target", 0.2)]:
        apart = np.asarray(getattr(begun.state, field)) - known.truth[field]
        assert np.abs(apart).max() < tolerance, field
    ratio = np.asarray(begun.state.focal) / known.truth["focal"]
    assert np.abs(np.log(ratio)).max() < 0.25


def test_what_the_model_gives_is_kept():
    known = stereo_recording()
    blind = without_starts(known.recording)
    left, right = blind.model.cameras
    given = known.recording.model.cameras[1].focal_px
    model = replace(blind.model, cameras=(left, replace(right, focal_px=given)))
    begun = start(build(replace(blind, model=model)))
    assert np.array_equal(begun.state.focal[1], given)
    assert not np.array_equal(begun.state.focal[0], known.truth["focal"][0])
    # Held bodies stand where the model puts them.
    assert np.array_equal(begun.state.station_from_camera[0], HELD)
    assert np.array_equal(begun.state.carrier_from_target[0], HELD)


def test_links_carry_the_start():
    known = relay_recording(noise=0.0)
    begun = start(build(without_starts(known.recording)))
    place = np.asarray(begun.state.world_from_station)
    assert np.allclose(place, known.truth["world_from_station"], atol=1e-6)
    target = np.asarray(begun.state.carrier_from_target)
    assert np.allclose(target, known.truth["carrier_from_target"], atol=1e-6)


def test_no_chain_reaches_a_station():
    known = relay_recording()
    blind = without_starts(known.recording)
    blind = replace(blind, links=None, model=replace(blind.model, closures=()))
    with pytest.raises(StartError, match='station "s1".*target "t1"') as error:
        start(build(blind))
    assert '"s0"' not in str(error.value)


def test_no_target_for_the_focal_length():
    known = free_points_recording()
    blind = without_starts(known.recording)
    obs = blind.observations
    # Camera cam2 sees free points only.
    keep = ~((obs.camera == 2) & (obs.target == 0))
    with pytest.raises(StartError, match='focal length of camera "cam2".*focal_px'):
        start(build(replace(blind, observations=thinned(obs, keep))))


def test_target_with_too_few_points():
    """Three marks in a view give no pose: the moving plate can't be placed at any epoch."""
    known = stereo_recording(with_ranges=False)
    blind = without_starts(known.recording)
    obs = blind.observations
    keep = (obs.target == 0) | (obs.point < 3)
    with pytest.raises(StartError, match='target "plate"'):
        start(build(replace(blind, observations=thinned(obs, keep))))


def test_camera_without_a_view():
    """A free camera that sees the reference nowhere can't be placed, intrinsics known or not."""
    known = stereo_recording(with_ranges=False)
    blind = without_starts(known.recording)
    right = replace(blind.model.cameras[1], focal_px=known.recording.model.cameras[1].focal_px)
    model = replace(blind.model, cameras=(blind.model.cameras[0], right))
    obs = blind.observations
    keep = (obs.camera == 0) | (obs.point < 3)
    with pytest.raises(StartError, match='camera "right"'):
        start(build(replace(blind, model=model, observations=thinned(obs, keep))))


def test_point_seen_once():
    known = free_points_recording()
    blind = without_starts(known.recording)
    obs = blind.observations
    own = np.flatnonzero((obs.target == 1) & (obs.point == 4))
    keep = np.ones(len(obs.point), bool)
    keep[own[1:]] = False
    with pytest.raises(StartError, match='point "p4" of target "cloud".*seen 1 time'):
        start(build(replace(blind, observations=thinned(obs, keep))))


def test_unseen_bodies_with_a_known_pose_need_no_view():
    known = RECORDINGS["board"]()
    blind = without_starts(known.recording)
    shed = Station("shed", "static", np.full(6, 0.1))
    spare = Target("spare", ("a",), np.zeros((1, 3)), "static", np.full(6, 0.2))
    model = replace(
        blind.model,
        stations=(*blind.model.stations, shed),
        targets=(*blind.model.targets, spare),
    )
    begun = start(build(replace(blind, model=model)))
    assert np.allclose(begun.state.world_from_station[1], 0.1)
    assert np.allclose(begun.state.carrier_from_target[begun.target_row[-1, 0]], 0.2)


def thinned(obs, keep):
    """The kept rows of the observations."""
    return type(obs)(**{name: values[keep] for name, values in vars(obs).items()})


def test_the_best_start_does_without_a_way_that_fails(monkeypatch):
    """A camera that is free on a free station is no edge of a pose graph; chains reach it."""
    scene = build(relay_recording().recording)

    def refused(*_):
        raise StartError("no chain reaches it")

    monkeypatch.setattr(starting, "_chordal", refused)
    best, given = start(scene, "best"), start(scene, "given")
    assert np.array_equal(best.state.flatten(), given.state.flatten())
    monkeypatch.setattr(starting, "_chain", refused)
    with pytest.raises(StartError, match="no chain reaches it"):
        start(scene, "best")
