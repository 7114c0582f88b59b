"""Adjustment: the truth within its own standard deviations, and what it is told to respect."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import (
    adjusted,
    at_values,
    board_recording,
    matrix,
    nudged,
    relay_recording,
    stereo_recording,
    vector,
)
from scipy.spatial.transform import Rotation

from jaxvm.network.residual import residual
from jaxvm.network.scene import build
from jaxvm.physics.effects import Effect, Term
from jaxvm.recording.model import Closure, Prior
from jaxvm.recording.recording import Links, uncorrelated
from jaxvm.solve.adjust import adjust
from jaxvm.solve.arrow import factorise
from jaxvm.solve.covariance import standard_deviations
from jaxvm.solve.problem import normal_at, scene_problem


@pytest.mark.parametrize("name", ["board", "stereo", "points", "scale"])
def test_truth_within_standard_deviations(name):
    known, result = adjusted(name)
    assert result.converged, result.why
    sd = standard_deviations(result)
    scores = []
    for field, true in known.truth.items():
        found, sigma = (
            np.asarray(getattr(result.scene.state, field)),
            np.asarray(getattr(sd, field)),
        )
        free = sigma > 0
        if field == "point":
            # Rows behind the last mark are spare.
            found, sigma, free = found[: len(true)], sigma[: len(true)], free[: len(true)]
        scores.append(((found - true)[free] / sigma[free]).ravel())
        # What has no standard deviation is held, and has not moved by a single bit.
        assert np.array_equal(found[~free], np.asarray(true)[~free])
    scores = np.concatenate(scores)
    unknowns = result.scene.unknowns
    assert len(scores) == np.sum(unknowns.column < unknowns.n)
    assert np.abs(scores).max() < 4.5
    assert 0.4 < np.sqrt(np.mean(scores**2)) < 1.6


@pytest.mark.parametrize("name", ["board", "stereo", "points", "scale"])
def test_variance_factor_near_one(name):
    known, result = adjusted(name)
    n_obs = 2 * len(known.recording.observations.epoch)
    n_obs += sum(len(prior.value) for prior in known.recording.model.priors)
    n_obs += 0 if known.recording.ranges is None else len(known.recording.ranges.epoch)
    columns = result.scene.unknowns.column
    n_free = len(np.unique(columns[columns < result.scene.unknowns.n]))
    assert result.degrees_of_freedom == n_obs - n_free
    assert abs(result.variance_factor - 1.0) < 4.0 * np.sqrt(2.0 / result.degrees_of_freedom)


def test_result_tells_what_happened():
    known = board_recording()
    result = adjust(nudged(known, known.true_scene(), 1e-3))
    _, same = adjusted("board")
    assert result.cost == pytest.approx(same.cost, rel=1e-8)
    assert result.cost_before == result.history[0] > result.cost == result.history[-1]
    assert (np.diff(result.history) <= 0).all()
    assert 1 < result.accepted <= result.evaluations == len(result.history)
    assert result.why == "converged: the cost no longer changes" and result.converged
    blocks = result.residuals()
    assert len(blocks.pixels[0]) == len(known.recording.observations.epoch)
    square = sum(float(np.sum(np.square(b))) for b in blocks.pixels)
    # What the board's prior adds is nothing.
    assert result.cost == pytest.approx(0.5 * square, rel=1e-9)
    text = result.summary()
    assert result.why in text and f"{result.degrees_of_freedom} degrees of freedom" in text
    few = adjust(nudged(known, known.true_scene(), 1e-3), max_steps=2)
    assert not few.converged and "2 evaluations" in few.why


def test_what_is_out_of_reach_is_given_up():
    known = board_recording()
    off = nudged(known, known.true_scene(), 1e-3)
    whole = adjust(off)
    within = adjust(off, wanted=1.01 * whole.cost)
    assert within.cost == whole.cost and within.why == whole.why
    beyond = adjust(off, wanted=0.9 * whole.cost)
    assert not beyond.converged and not beyond.failed
    assert beyond.why.startswith("given up") and beyond.evaluations < whole.evaluations


def test_unknown_method_is_refused():
    known = board_recording()
    with pytest.raises(ValueError, match='no method "newton".*gauss-newton.*levenberg-marquardt|'
                                         'no method "newton".*levenberg-marquardt'):  # fmt: skip
        adjust(known.true_scene(), method="newton")


def test_inactive_unknowns_stay():
    known = board_recording()
    scene = known.true_scene()
    active = np.array(["distortion" not in name for name in scene.unknowns.names()])
    result = adjust(scene, active=active)
    assert np.array_equal(result.scene.state.distortion, scene.state.distortion)
    assert (np.asarray(result.scene.state.centre) != np.asarray(scene.state.centre)).all()
    assert result.degrees_of_freedom == adjusted("board")[1].degrees_of_freedom + 4
    sd = standard_deviations(result)
    assert (np.asarray(sd.distortion) == 0).all() and (np.asarray(sd.focal) > 0).all()


def test_aspect_locked_focal_keeps_its_ratio():
    known, result = adjusted("points")
    true, focal = known.truth["focal"][3], np.asarray(result.scene.state.focal)[3]
    assert true[1] / true[0] > 1.005
    assert focal[0] != true[0]
    assert focal[1] / focal[0] == pytest.approx(true[1] / true[0], rel=1e-13)
    sd = np.asarray(standard_deviations(result).focal)[3]
    assert sd[1] / sd[0] == pytest.approx(true[1] / true[0], rel=1e-10)
    assert np.abs(focal - true).max() < 4 * sd.max()
    assert "camera cam3: focal" in result.scene.unknowns.names()


def test_a_pattern_follows_the_principal_point_that_the_fit_moves():
    """Radial distortion as an effect is about the fitted centre, wherever the fit began."""
    known = board_recording(free=frozenset({"focal", "centre"}))
    radial = Effect("radial", (Term("sensor.focal", driver="radius", basis="square"),))
    scene = at_values(build(known.recording, (radial,)), known.truth)
    state = eqx.tree_at(lambda s: s.distortion, scene.state, replace_fn=jnp.zeros_like)
    far = eqx.tree_at(lambda s: s.centre, state, state.centre + jnp.array([[80.0, -60.0]]))
    held = np.array(["centre" not in name for name in scene.unknowns.names()])
    far = adjust(scene.with_state(far), active=held).scene.state  # the poses lean with it
    near, moved = (adjust(scene.with_state(own)) for own in (state, far))
    sd = np.asarray(standard_deviations(near).centre)
    assert (np.abs(near.scene.state.centre - moved.scene.state.centre) < 0.5 * sd).all()
    assert moved.cost == pytest.approx(near.cost, rel=1e-2)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_prior_pulls_as_its_weight_says(share):
    """Data with sigma s and a prior with sigma p agree on the weighted mean."""
    known, plain = adjusted("board")
    data = np.asarray(plain.scene.state.centre)[0, 0]
    s = float(standard_deviations(plain).centre[0, 0])
    p = {0.0: 1e4 * s, 0.5: s, 1.0: 1e-3 * s}[share]
    wanted = data + s
    # The second component's prior is too wide to matter.
    prior = Prior("cameras.cam.centre", np.array([wanted, 0.0]), np.array([p, 1e9]))
    scene = at_values(build(known.with_model(priors=(prior,))), known.truth)
    result = adjust(scene)
    got = np.asarray(result.scene.state.centre)[0, 0]
    assert (got - data) / s == pytest.approx(share, abs=0.01)
    sigma = float(standard_deviations(result).centre[0, 0])
    assert sigma == pytest.approx(s * p / np.hypot(s, p), rel=0.01)


@pytest.mark.parametrize("name", ["board", "stereo", "points"])
def test_packets_hold_every_observation_once_and_little_else(name):
    known, _ = adjusted(name)
    problem = scene_problem(known.true_scene())
    for factor, packets in zip(problem.network.factors(), problem.packets, strict=True):
        rows, n = np.asarray(packets.rows), factor.slots.shape[0]
        assert np.array_equal(np.sort(rows[rows < n]), np.arange(factor.n_real))
        # All rows of a packet touch the same unknowns.
        free = np.asarray(packets.columns) < problem.n
        touched = np.asarray(problem.column)[np.asarray(factor.slots)]
        for own, columns, used in zip(rows, np.asarray(packets.columns), free, strict=True):
            mine = touched[own[own < n]]
            assert np.isin(mine[mine < problem.n], columns[used]).all()
        assert rows.size < 4 * factor.n_real + 64 * len(rows)


def test_what_is_known_of_held_parameters_does_no_harm():
    """A table of observations none of whose parameters is free: here a prior on a held centre."""
    known = board_recording(free=frozenset({"focal"}))
    assert known.recording.model.priors[0].parameter == "cameras.cam.centre"
    problem = scene_problem(known.true_scene())
    normal = normal_at(problem, jnp.zeros(problem.n))
    assert np.isfinite(np.asarray(normal.gradient)).all()


def test_a_range_to_what_no_camera_sees_says_nothing():
    known = stereo_recording()
    obs, ranges = known.recording.observations, known.recording.ranges
    moving = next(
        t for t, target in enumerate(known.recording.model.targets) if target.motion != "static"
    )
    lone = np.flatnonzero((ranges.target == moving) & (ranges.epoch == 2))
    assert len(lone)
    seen = (obs.target != moving) | (obs.epoch != 2)
    unseen = type(obs)(**{name: own[seen] for name, own in vars(obs).items()})
    recording = replace(known.recording, observations=unseen)
    with_it = adjust(known.true_scene(recording), rtol=1e-10)
    assert np.array_equal(
        np.flatnonzero(np.asarray(with_it.scene.network.ranges.weight) == 0.0), lone
    )
    assert f"{len(lone)} ranges to or from what nothing places" in with_it.summary()
    kept = np.delete(np.arange(len(ranges.epoch)), lone)
    fewer = type(ranges)(**{name: own[kept] for name, own in vars(ranges).items()})
    without = adjust(known.true_scene(replace(recording, ranges=fewer)), rtol=1e-10)
    assert with_it.cost == pytest.approx(without.cost, rel=1e-9)
    assert with_it.degrees_of_freedom == without.degrees_of_freedom


def test_a_range_to_what_is_given_linked_or_still_counts():
    known = stereo_recording()
    recording, obs, ranges = known.recording, known.recording.observations, known.recording.ranges
    targets = recording.model.targets
    moving = next(t for t, target in enumerate(targets) if target.motion != "static")
    still = next(t for t in range(len(targets)) if t != moving)
    assert "pose" not in targets[still].free

    def weights(of, epoch=None, **changes):
        unseen = (obs.target == of) & ((obs.epoch == epoch) | (epoch is None))
        kept = type(obs)(**{name: own[~unseen] for name, own in vars(obs).items()})
        scene = known.true_scene(replace(recording, observations=kept, **changes))
        own = (ranges.target == of) & ((ranges.epoch == epoch) | (epoch is None))
        return np.asarray(scene.network.ranges.weight)[own]

    assert len(weights(moving, 2)) and not weights(moving, 2).any()
    # Where its pose is given, it is somewhere, seen or not.
    assert weights(still).all()
    # One unknown pose for all epochs may be known by ranges alone.
    free = replace(targets[still], free=frozenset({"pose"}))
    model = replace(
        recording.model, targets=[free if t == still else own for t, own in enumerate(targets)]
    )
    assert weights(still, model=model).all()
    # A link to it in that epoch says where it is.
    links = Links(
        name=("tape",),
        from_node=[("station", 0)],
        to_node=[("target", moving)],
        pose=np.zeros((1, 6)),
        covariance=np.eye(6)[None],
        epoch=np.array([2]),
    )
    assert weights(moving, 2, links=links).all()


def test_ranges_give_scale():
    """Without ranges the same network has no scale: see test_gauge."""
    known, result = adjusted("scale")
    sd = float(standard_deviations(result).station_from_camera[1, 3])
    baseline = np.asarray(result.scene.state.station_from_camera)[1, 3:]
    assert 1e-6 < sd < 5e-3
    ranges = known.recording.ranges
    longer = replace(known.recording, ranges=replace(ranges, distance=ranges.distance * 1.01))
    other = adjust(known.true_scene(longer))
    # The rangefinder's own place on the bar does not grow with the ranges, so not exactly 1 %.
    ratio = np.linalg.norm(other.scene.state.station_from_camera[1, 3:]) / np.linalg.norm(baseline)
    assert ratio == pytest.approx(1.01, abs=1e-3)


def test_loop_of_links_closes():
    known = relay_recording()
    # Gauss-Newton by hand: its program is the one that test_gauge uses.
    problem = scene_problem(known.true_scene())
    x = jnp.zeros(problem.n)
    for _ in range(4):
        normal = normal_at(problem, x)
        x = x - factorise(normal.hessian).solve(normal.gradient)
    state, normal = problem.state(x), normal_at(problem, x)
    # 36 marks, 5 links between bodies, 3 of them adjusted on their own, and the closure,
    # against 5 poses and 3 links.
    freedom = 2 * 36 + 6 * 9 - 6 * 8
    assert abs(2 * float(normal.cost) / freedom - 1.0) < 4.0 * np.sqrt(2.0 / freedom)
    links, closure = known.recording.links, known.recording.model.closures[0]
    measured = [matrix(p) for p in links.pose[2:]]
    found = [matrix(p) for p in state.link]

    def gap(poses):
        return vector(poses[0] @ np.linalg.inv(poses[1]) @ poses[2])

    assert np.abs(gap(found)).max() < 5e-6 < 1e-4 < np.abs(gap(measured)).max()
    assert closure.sigma_m == 1e-5
    # Three turns with equal sigmas share the gap in equal parts.
    change = [
        Rotation.from_matrix(np.linalg.inv(m[:3, :3]) @ f[:3, :3]).magnitude()
        for m, f in zip(measured, found, strict=True)
    ]
    whole = Rotation.from_rotvec(gap(measured)[:3]).magnitude()
    assert sum(change) == pytest.approx(whole, rel=0.2)
    # Stations that see nothing in common stand where the links say.
    true = known.truth["world_from_station"]
    place = np.asarray(state.world_from_station)
    assert np.array_equal(place[0], true[0])
    assert np.abs(place - true)[1:, 3:].max() < 5e-3 and np.abs(place - true)[1:, :3].max() < 2e-3
    assert (place[1:] != true[1:]).all()


def test_a_link_in_a_loop_still_joins_its_bodies():
    """Closing a loop adds knowledge: it must not cut what the links hold together."""
    known = relay_recording(noise=0.0)
    links = known.recording.links
    stations = [matrix(p) for p in known.truth["world_from_station"]]
    ends = [(0, 1), (1, 2), (0, 2)]
    poses = [vector(np.linalg.inv(stations[a]) @ stations[b]) for a, b in ends]
    links = replace(
        links,
        name=("ab", "bc", "ac"),
        from_node=[("station", a) for a, _ in ends],
        to_node=[("station", b) for _, b in ends],
        pose=np.array(poses),
        covariance=uncorrelated(np.full(3, 1e-4), np.full(3, 1e-3)),
        epoch=np.full(3, -1),
    )
    closure = Closure((("ab", 1), ("bc", 1), ("ac", -1)), 1e-5, 1e-5)
    recording = replace(known.with_model(closures=(closure,)), links=links)
    scene = build(recording)
    # Station s1 and its target move together: no camera can see it, the links must.
    step = matrix([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    fields = ("world_from_station", "carrier_from_target")
    place, target = (np.array(known.truth[field]) for field in fields)
    place[1], target[1] = (vector(step @ matrix(p[1])) for p in (place, target))
    moved = at_values(scene, {"world_from_station": place, "carrier_from_target": target})

    def cost(scene):
        blocks = eqx.filter_jit(residual)(scene.state, scene.network)
        return sum(float(jnp.sum(b**2)) for b in jax.tree.leaves(blocks))

    assert cost(scene) < 1e-12
    assert cost(moved) > 1e3
