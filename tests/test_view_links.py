"""Views as relative poses: their covariance by Monte Carlo; pixel level against pose level."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
from networks import matrix, vector
from pose_networks import exponential
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxvm.geometry.matrices import matrices
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.pose.chains import Link
from jaxvm.pose.view_links import pose_level, view_links
from jaxvm.recording.model import Prior, Station
from jaxvm.recording.recording import Links
from jaxvm.scenes import parse_description, simulate_network
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import covariance

SHIP = """
layout = "ship"
stations = 6
[structure]
length_m = 40.0
width_m = 10.0
[marks]
size_m = 1.5
"""
SECTORS = """
layout = "random"
stations = 5
[sights]
redundancy = 3.0
[structure]
spacing_m = 4.0
[cameras]
each = "sector"
image_size = [6000, 4000]
lens = "opencv5"
distortion = [-0.05, 0.02, 3e-4, -2e-4, 0.0]
"""
PLATES = """
layout = "chain"
stations = 4
[sights]
both_ways = true
[marks]
kind = "plates"
tilt_deg = 30
"""
STATION = """
layout = "station"
[cameras]
count = 3
pose = "free"
[time]
epochs = 3
"""


@cache
def made(text, noise=1.0, seed=0):
    return simulate_network(parse_description(text), seed, noise)


def true_scene(text, noise=1.0, seed=0):
    found = made(text, noise, seed)
    scene = build(found.recording)
    return scene.with_state(found.truth.state(scene))


def true_links(scene, links: Links) -> np.ndarray:
    """from_from_to of the links at the scene's state, as matrices."""
    state, model = jax.tree.map(np.asarray, scene.state), scene.model
    places = {s.name: i for i, s in enumerate(model.stations)}

    def world(node, epoch):
        kind, i = node
        if kind == "station":
            return matrix(state.world_from_station[scene.station_row[i, epoch]])
        body = (model.cameras if kind == "camera" else model.targets)[i]
        table = state.station_from_camera if kind == "camera" else state.carrier_from_target
        own = matrix(table[i if kind == "camera" else scene.target_row[i, epoch]])
        return world(("station", places[body.station]), epoch) @ own if body.station else own

    ends = zip(links.from_node, links.to_node, links.epoch, strict=True)
    return np.array([np.linalg.inv(world(a, e)) @ world(b, e) for a, b, e in ends])


def twists(links: Links, true: np.ndarray) -> np.ndarray:
    """log(measured^-1 . true): small, so that two terms of the inverse Jacobian are enough."""
    off = np.linalg.inv(matrices(links.pose)) @ true
    turn, shift = Rotation.from_matrix(off[:, :3, :3]).as_rotvec(), off[:, :3, 3]
    once = np.cross(turn, shift)
    return np.concatenate([turn, shift - once / 2 + np.cross(turn, once) / 12], axis=1)


@pytest.mark.parametrize("text", [SHIP, SECTORS, PLATES, STATION])
def test_exact_pixels_give_the_true_relative_poses(text):
    """From poses that are near, and from none at all: only mounts and intrinsics are known."""
    scene = true_scene(text, noise=0.0)
    links = view_links(scene)
    obs = scene.recording.observations
    views = np.unique(np.stack([obs.camera, obs.target, obs.epoch]), axis=1).shape[1]
    assert len(links.name) == views and len(set(links.name)) == views
    assert np.abs(twists(links, true_links(scene, links))).max() < 1e-9
    if text == PLATES:
        alone = view_links(build(scene.recording))
        np.testing.assert_allclose(alone.pose, links.pose, atol=1e-8)
        np.testing.assert_allclose(alone.covariance, links.covariance, rtol=1e-5, atol=1e-14)
    if text != STATION:
        assert {kind for kind, _ in (*links.from_node, *links.to_node)} == {"station"}


def test_the_covariance_is_that_of_many_draws():
    """Each view drawn a thousand times: squares of twists by their covariance are chi-square.

    Marks of unlike precision, plates (anisotropic) on turned mounts: in any other axes, or about
    any other point, the squares are far off.
    """
    draws = 1000
    scene = true_scene(PLATES.replace("stations = 4", "stations = 3"), noise=0.0)
    recording, obs = scene.recording, scene.recording.observations
    one = view_links(scene)
    n = len(obs.epoch)
    rng = np.random.default_rng(1)
    sigma = 0.05 * (1.0 + (np.arange(n) % 3))
    pixel = np.tile(obs.pixel, (draws, 1)) + np.tile(sigma, draws)[:, None] * rng.standard_normal(
        (draws * n, 2)
    )
    many = {name: np.tile(values, draws) for name, values in vars(obs).items() if name != "pixel"}
    many |= dict(epoch=np.repeat(np.arange(draws), n), sigma=np.tile(sigma, draws), pixel=pixel)
    repeated = replace(
        recording,
        epoch_ids=np.arange(draws),
        time=np.arange(float(draws)),
        observations=replace(obs, **many),
    )
    large = build(repeated)
    true = large.with_state(scene.state)
    links = view_links(true)
    assert len(links.name) == draws * len(one.name)
    error = twists(links, true_links(true, links))

    def whitened(covariances):
        return np.linalg.solve(np.linalg.cholesky(covariances), error[:, :, None])[:, :, 0]

    white = whitened(links.covariance)
    low, high = chi2.ppf([0.001, 0.999], white.size) / white.size
    assert low < np.mean(white**2) < high
    # In the axes of the other end and about it, they would not fit at all.
    back = jax.vmap(Link.back)(Link(links.pose, links.covariance))
    assert np.mean(whitened(np.asarray(back.covariance)) ** 2) > 2
    # View by view, and its whole covariance: that of the errors, whitened, is the identity.
    for k in range(len(one.name)):
        own = np.array([name.startswith(f"{one.name[k]}, epoch") for name in links.name])
        spread = white[own].T @ white[own] / draws
        assert np.abs(spread - np.eye(6)).max() < 5 * np.sqrt(2 / draws)
        assert np.abs(white[own].mean(axis=0)).max() < 4.5 / np.sqrt(draws)


def both_levels(scene):
    """Adjusted pixels and adjusted relative poses; state errors of the stations apart, by sigma."""
    pixels = adjust(start(scene))
    poses = adjust(start(build(pose_level(pixels.scene))))
    assert pixels.converged and poses.converged
    c_pixel, c_pose = (np.asarray(covariance(a, stations)) for a in (pixels, poses))
    sigma = np.sqrt(np.diag(c_pixel))
    free = sigma > 0
    apart = (stations(poses.scene.state) - stations(pixels.scene.state)).ravel()
    unit = sigma[free, None] * sigma[free]
    return (
        pixels,
        poses,
        apart[free] / sigma[free],
        *(c[np.ix_(free, free)] / unit for c in (c_pixel, c_pose)),
    )


def stations(state):
    return state.world_from_station


@pytest.mark.parametrize("text", [SHIP, SECTORS, PLATES])
def test_with_known_cameras_nothing_is_lost(text):
    """Exact pixels: equal covariances. Noise: estimates apart by a small share of their sigmas."""
    _, _, apart, c_pixel, c_pose = both_levels(true_scene(text, noise=0.0))
    assert np.abs(apart).max() < 1e-3
    np.testing.assert_allclose(c_pose, c_pixel, atol=1e-7)
    pixels, poses, apart, c_pixel, c_pose = both_levels(build(made(text).recording))
    assert np.abs(apart).max() < 0.1
    np.testing.assert_allclose(c_pose, c_pixel, atol=0.02)
    # Chi-square parts: what views have within themselves, and what they say against each other.
    links = len(poses.scene.recording.links.name)
    marks = len(pixels.scene.recording.observations.epoch)
    assert pixels.degrees_of_freedom - poses.degrees_of_freedom == 2 * marks - 6 * links
    low, high = chi2.ppf([0.001, 0.999], poses.degrees_of_freedom)
    assert low < 2 * poses.cost < high


def test_free_mounts_stay_shared():
    """Cameras and targets that links begin and end at stay, with what was free: nothing is lost."""
    scene = true_scene(STATION, noise=0.0)
    pixels = adjust(scene)
    recording = pose_level(scene)
    assert [c.name for c in recording.model.cameras] == [
        c.name for c in scene.model.cameras if "pose" in c.free
    ]
    assert len(recording.observations.epoch) == 0
    poses = adjust(start(build(recording)))

    def mounts(state):
        return state.station_from_camera[-len(recording.model.cameras) :]

    first, second = (np.asarray(covariance(a, mounts)) for a in (pixels, poses))
    sigma = np.sqrt(np.diag(first))
    np.testing.assert_allclose(second / sigma / sigma[:, None], first / sigma / sigma[:, None],
                               atol=1e-6)  # fmt: skip


def with_free(recording, names, **changes):
    cameras = tuple(replace(c, free=c.free | names) for c in recording.model.cameras)
    return replace(recording, model=replace(recording.model, cameras=cameras, **changes))


def test_free_intrinsics_are_lost_where_views_share_them():
    """Never better; equal where each view has its own camera, worse where they share one."""
    for text, shared in ((SHIP, False), (SECTORS, True)):
        recording = with_free(made(text, 0.0).recording, {"aspect-locked-focal"})
        scene = build(recording)
        scene = scene.with_state(made(text, 0.0).truth.state(scene))
        *_, apart, c_pixel, c_pose = both_levels(scene)
        assert np.abs(apart).max() < 1e-3
        least, *_, most = np.linalg.eigvalsh(c_pose - c_pixel)
        assert least > -1e-6
        assert most > 0.3 if shared else most < 1e-6


def test_own_intrinsics_of_a_view_have_the_maximum_likelihood():
    """Pose level of views with free focal lengths: a camera for each view, adjusted from pixels."""
    recording = with_free(made(SHIP).recording, {"aspect-locked-focal", "centre"}, priors=tuple(
        Prior(f"cameras.{c.name}.centre", c.centre_px + 0.1, np.full(2, 0.5))
        for c in made(SHIP).recording.model.cameras))  # fmt: skip
    scene = build(recording)
    links = view_links(scene.with_state(made(SHIP).truth.state(scene)))
    k = 4
    obs = recording.observations
    name = links.name[k].split(" sees ")[0]
    camera = next(i for i, c in enumerate(recording.model.cameras) if c.name == name)
    own = np.flatnonzero(obs.camera == camera)
    target = obs.target[own[0]]
    free = frozenset({"pose"})
    model = replace(
        recording.model,
        cameras=(replace(recording.model.cameras[camera], station="here"),),
        stations=(Station("here", "static", np.zeros(6)),),
        targets=(replace(recording.model.targets[target], station="", pose=None, free=free),),
        priors=(recording.model.priors[camera],),
    )  # fmt: skip
    none = np.zeros(len(own), int)
    seen = replace(obs, **{n: v[own] for n, v in vars(obs).items()})
    alone = replace(recording, model=model, observations=replace(seen, camera=none, target=none))
    found = adjust(start(build(alone)))
    mount = matrix(recording.model.targets[target].pose)
    pose = matrix(found.scene.state.carrier_from_target[0]) @ np.linalg.inv(mount)
    off = np.linalg.inv(pose) @ matrix(links.pose[k])
    assert np.abs(vector(off) / links.sigma[k]).max() < 1e-3
    # Its covariance by finite differences of (turn, shift) over the link's twist.
    slope = np.zeros((6, 6))
    for i, step in enumerate(1e-6 * np.eye(6)):
        moved = [vector(pose @ exponential(s * step) @ mount) for s in (1, -1)]
        slope[:, i] = (moved[0] - moved[1]) / 2e-6
    expected = np.asarray(covariance(found, lambda s: s.carrier_from_target[0]))
    got = slope @ links.covariance[k] @ slope.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(got / scale / scale[:, None], expected / scale / scale[:, None],
                               atol=1e-3)  # fmt: skip


def test_what_one_view_can_not_tell_is_named():
    scene = build(with_free(made(PLATES).recording, {"focal", "centre", "distortion"}))
    scene = scene.with_state(made(PLATES).truth.state(scene))
    with pytest.raises(ValueError, match=r"sees .* don't determine the free centre, .* hold it"):
        view_links(scene)


WARM = """
layout = "random"
stations = 4
[sights]
redundancy = 3.0
[time]
epochs = 3
interval_s = 7200
[temperature]
swing_K = 10.0
[[effects]]
port = "sensor.focal"
per_K = 2e-4
driver = "ambient"
model = "{model}"
"""


def test_known_effects_are_taken_off_and_hidden_ones_stay():
    for model, largest in (("known", 1e-9), ("hidden", np.inf)):
        scene = true_scene(WARM.format(model=model), noise=0.0)
        links = view_links(scene)
        assert set(links.epoch) == {0, 1, 2}
        error = np.abs(twists(links, true_links(scene, links)) / links.sigma).max()
        assert error < largest
    assert error > 3


def test_marks_that_are_set_aside_and_short_views_do_not_count():
    scene = true_scene(SHIP)
    obs, whole = scene.recording.observations, view_links(scene)
    first = np.flatnonzero((obs.camera == obs.camera[0]) & (obs.target == obs.target[0]))
    factor = scene.network.pixels[0]
    weight = np.array(factor.weight)
    rows = scene.tables[0]
    weight[: len(rows)][np.isin(rows, first[3:])] = 0.0
    network = replace(scene.network, pixels=(replace(factor, weight=jax.numpy.asarray(weight)),))
    short = view_links(replace(scene, network=network))
    assert len(short.name) == len(whole.name) - 1
    kept = [whole.name.index(name) for name in short.name]
    np.testing.assert_allclose(short.pose, whole.pose[kept], atol=1e-12)


def test_the_recording_of_links_keeps_what_was_held_and_measured():
    given = made(SHIP).recording
    recording = pose_level(build(given))
    for a, b in zip(recording.model.stations, given.model.stations, strict=True):
        assert a.free == b.free and a.motion == b.motion
    assert recording.model.cameras == () and recording.model.targets == ()
    assert len(recording.observations.epoch) == 0
    with_links = made('observe = "both"\n' + SHIP).recording
    assert with_links.links is not None
    joined = pose_level(build(with_links)).links
    assert joined.name[: len(with_links.links.name)] == with_links.links.name
    assert len(joined.name) > len(with_links.links.name)
