"""Described networks: what is asked for is there, and adjustment finds the truth that was kept."""

import json
import re
from dataclasses import replace
from functools import cache

import equinox as eqx
import numpy as np
import pandas as pd
import pytest
from networks import dense_residuals, matrix, vector
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.stats import chi2

import jaxvm.compiling
import jaxvm.scenes.describe
from jaxvm.cli import main
from jaxvm.network.residual import residual
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.recording import RecordingError, read_recording
from jaxvm.scenes import (
    LAYOUTS,
    example_names,
    parse_description,
    read_description,
    simulate_network,
)
from jaxvm.scenes.deform import MODES, displacements
from jaxvm.solve.adjust import adjust
from jaxvm.solve.covariance import covariance

SMALL = {
    "ship": 'layout = "ship"\nstations = 6',
    "ship that bends": 'layout = "ship"\nstations = 6\n[time]\nepochs = 3\n'
    "[deformation]\nbending_m = 0.05\nsway_m = 0.02\ntorsion_rad = 0.002",
    "tunnel": 'layout = "tunnel"\nstations = 6\n[structure]\nlength_m = 60.0',
    "bridge": 'layout = "bridge"\nstations = 7\n[structure]\nlength_m = 120.0\ntowers = 1',
    "wind-tunnel": 'layout = "wind-tunnel"\nstations = 7',
    "chain": 'layout = "chain"\nstations = 4',
    "double chain": 'layout = "chain"\nstations = 4\n[sights]\nboth_ways = true\n'
    '[marks]\nkind = "plates"\ntilt_deg = 30',
    "chain of links": 'layout = "chain"\nstations = 5\nobserve = "links"',
    "ring": 'layout = "ring"\nstations = 5\nobserve = "both"\n[links]\nturn_factor = 5',
    "station": 'layout = "station"\n[cameras]\ncount = 3\npose = "free"\n[time]\nepochs = 3',
    "station of links": 'layout = "station"\nobserve = "links"\n[cameras]\ncount = 4',
    "random": 'layout = "random"\nstations = 6\n[sights]\nredundancy = 2.5',
    "random with sectors": 'layout = "random"\nstations = 6\n[sights]\nredundancy = 3.0\n'
    '[structure]\nspacing_m = 4.0\n[cameras]\neach = "sector"\nimage_size = [6000, 4000]',
    "held elsewhere": 'layout = "chain"\nstations = 4\nheld = ["s2", "s4"]',
}
"""A small network of each kind."""

DAY = """
layout = "random"
stations = 5
[sights]
redundancy = 3.0
[marks]
count = 8
[time]
epochs = 8
interval_s = 7200
[temperature]
swing_K = 10.0
[[effects]]
port = "sensor.focal"
per_K = 2e-4
driver = "{driver}"
lag_s = {lag}
model = "{model}"
"""


@cache
def network(text: str, seed: int = 0, noise: float = 1.0):
    """A network and its truth."""
    return simulate_network(parse_description(text), seed, noise)


def free_poses(scene) -> np.ndarray:
    """Positions of the poses of stations and cameras in the flat state that are free."""
    layout, unknowns = scene.network.layout, scene.unknowns
    poses = [layout.all(name) for name in ("world_from_station", "station_from_camera")]
    poses = np.concatenate(poses)
    return poses[unknowns.column[poses] < unknowns.n]


def true_residuals(made) -> np.ndarray:
    """Whitened residuals of all observations at the truth."""
    scene = build(made.recording)
    scene = scene.with_state(made.truth.state(scene))
    blocks = residual(scene.state, scene.network)
    pixels = tuple(
        np.asarray(block)[: len(rows)]
        for block, rows in zip(blocks.pixels, scene.tables, strict=True)
    )
    return dense_residuals(blocks._replace(pixels=pixels))


def test_every_layout_is_here():
    assert {parse_description(text).layout for text in SMALL.values()} == set(LAYOUTS)


@pytest.mark.parametrize("name", SMALL)
def test_adjustment_finds_the_truth_within_its_covariance(name, tmp_path):
    """Errors of all free poses together follow the chi-square of their covariance."""
    total, count, free = 0.0, 0, np.zeros(0, int)

    def poses(state):
        return state.flatten()[free]

    for seed in range(3):
        made = network(SMALL[name], seed)
        made.write(tmp_path / f"{seed}")
        recording = read_recording(tmp_path / f"{seed}")
        result = adjust(start(build(recording)))
        assert result.cost < 1.2 * np.sum(true_residuals(made) ** 2) / 2
        true = np.asarray(made.truth.state(result.scene).flatten())
        free = free_poses(result.scene)
        error = (np.asarray(result.scene.state.flatten()) - true)[free]
        spread = np.asarray(covariance(result, poses))
        total += float(error @ np.linalg.solve(spread, error))
        count += len(free)
    assert chi2.ppf(1e-4, count) < total < chi2.ppf(1.0 - 1e-4, count)


@pytest.mark.parametrize("name", SMALL)
def test_noise_has_its_size_and_nothing_else_is_in_it(name):
    whitened = true_residuals(network(SMALL[name], 4))
    assert chi2.ppf(1e-4, len(whitened)) < np.sum(whitened**2)
    assert np.sum(whitened**2) < chi2.ppf(1 - 1e-4, len(whitened))
    # 1e-6 of a sigma of a pixel is 5e-8 px; links have sigmas of 5e-5 rad.
    assert np.abs(true_residuals(network(SMALL[name], 4, 0.0))).max() < 1e-5


def test_noise_free_start_and_adjustment_end_at_nothing():
    result = adjust(start(build(network(SMALL["ship that bends"], 0, 0.0).recording)))
    assert result.cost < 1e-8


@pytest.mark.parametrize("name", SMALL)
def test_a_recording_is_read_as_it_was(name, tmp_path):
    made = network(SMALL[name])
    made.write(tmp_path / "scene")
    back = read_recording(tmp_path / "scene")
    given = made.recording
    assert np.allclose(back.observations.pixel, given.observations.pixel, rtol=1e-14, atol=0)
    for kind in ("camera", "target"):
        bodies = getattr(given.model, f"{kind}s"), getattr(back.model, f"{kind}s")
        own, other = (
            [body[k].name for k in getattr(recording.observations, kind)]
            for body, recording in zip(bodies, (given, back), strict=True)
        )
        assert own == other
    assert np.array_equal(back.time, given.time)
    if given.links is not None:
        assert np.allclose(back.links.covariance, given.links.covariance, rtol=1e-12, atol=0)
        assert np.array_equal(back.links.epoch, given.links.epoch)
    stations = {station.name: station for station in back.model.stations}
    for station in given.model.stations:
        own = stations[station.name]
        assert own.free == station.free and own.motion == station.motion
        assert (own.pose is None) == (station.pose is None)


def test_same_seed_same_recording():
    text = DAY.format(driver="body", lag=0, model="free")
    once, again, other = (simulate_network(parse_description(text), k) for k in (3, 3, 5))
    assert np.array_equal(once.recording.observations.pixel, again.recording.observations.pixel)
    for name, values in once.recording.drivers.channels.items():
        assert np.array_equal(values, again.recording.drivers.channels[name])
    apart = once.recording.observations.pixel - other.recording.observations.pixel
    # The seed of a recording draws noise, not another network.
    assert 0.0 < np.abs(apart).max() < 1.0
    moved = simulate_network(parse_description("seed = 1\n" + text), 3)
    assert np.abs(moved.truth.world_from_station - once.truth.world_from_station).max() > 0.1


@pytest.mark.parametrize("each", ["sight", "sector"])
@pytest.mark.parametrize(("n", "redundancy"), [(7, 0.86), (40, 1.0), (40, 6.5), (12, 11.0)])
def test_random_networks_have_the_redundancy_asked_for(n, redundancy, each):
    text = f'layout = "random"\nstations = {n}\n[sights]\nredundancy = {redundancy}\n'
    text += f'[cameras]\neach = "{each}"'
    recording = network(text).recording
    obs, model = recording.observations, recording.model
    place = {station.name: k for k, station in enumerate(model.stations)}
    sees = np.array([place[camera.station] for camera in model.cameras])[obs.camera]
    seen = np.array([place[target.station] for target in model.targets])[obs.target]
    lines = np.unique(np.stack([sees, seen]), axis=1)
    assert lines.shape[1] == round(redundancy * n)
    graph = coo_matrix((np.ones(lines.shape[1]), lines), (n, n))
    assert connected_components(graph, directed=False, return_labels=False) == 1


def test_residuals_of_a_target_on_a_station_are_those_of_one_in_the_world():
    """The composite pose is what counts, not who carries it."""
    made = network(SMALL["ship"])
    scene = build(made.recording)
    scene = scene.with_state(made.truth.state(scene))
    model = made.recording.model
    world = {
        name: matrix(pose)
        for name, pose in zip(made.truth.stations, made.truth.world_from_station[:, 0], strict=True)
    }
    placed = tuple(
        replace(target, station="", pose=vector(world[target.station] @ matrix(target.pose)))
        for target in model.targets
    )
    other = build(replace(made.recording, model=replace(model, targets=placed)))
    other = other.with_state(
        eqx.tree_at(lambda s: s.world_from_station, other.state, scene.state.world_from_station)
    )
    a, b = (np.asarray(residual(s.state, s.network).pixels[0]) for s in (scene, other))
    assert np.abs(a - b).max() < 1e-6
    assert np.abs(a).max() > 1.0


def test_links_whiten_with_their_full_covariances():
    """Components of whitened links are uncorrelated and of unit variance."""
    text = (
        'layout = "random"\nstations = 300\nobserve = "links"\n[sights]\nredundancy = 10\n'
        "[links]\nturn_factor = 20\ndepth_factor = 8\nsigma_rad = 1e-4\nsigma_m = 1e-3"
    )
    made = network(text, 2)
    links = made.recording.links
    whitened = true_residuals(made).reshape(-1, 6)
    n = len(whitened)
    assert n == 3000
    # Entries of a sample covariance of n draws have standard deviations of at most sqrt(2 / n).
    assert np.abs(whitened.T @ whitened / n - np.eye(6)).max() < 4.5 * np.sqrt(2.0 / n)
    values = np.sqrt(np.linalg.eigvalsh(links.covariance[:, 3:, 3:]))
    assert np.allclose(values, [1e-3, 1e-3, 8e-3])
    # Depth is along the line, which ends in the axes of the station that is seen.
    seen = links.from_node[0][1], links.to_node[0][1]
    poses = [matrix(made.truth.world_from_station[k, 0]) for k in seen]
    line = poses[1][:3, :3].T @ (poses[1][:3, 3] - poses[0][:3, 3])
    line /= np.linalg.norm(line)
    assert line @ links.covariance[0, 3:, 3:] @ line == pytest.approx(8e-3**2)
    assert line @ links.covariance[0, :3, :3] @ line == pytest.approx(1e-4**2)


def test_deformation_is_recovered_epoch_by_epoch():
    """Movement of every station since the first epoch, against its covariance."""
    made = network(SMALL["ship that bends"], 7)
    result = adjust(start(build(made.recording)))
    scene = result.scene
    far = [station.name for station in scene.model.stations].index("deck1-3")
    rows = scene.station_row[far]
    moved = made.truth.world_from_station[made.truth.stations.index("deck1-3")]
    moved = moved[2] - moved[0]
    # Half a metre of a hull's deck would be a wreck; centimetres are far above the noise.
    assert 0.02 < np.linalg.norm(moved[3:]) < 0.2

    def since(state):
        return state.world_from_station[rows[2]] - state.world_from_station[rows[0]]

    error = np.asarray(since(scene.state)) - moved
    spread = np.asarray(covariance(result, since))
    assert error @ np.linalg.solve(spread, error) < chi2.ppf(1.0 - 1e-4, 6)
    # Across the hull; along it is the depth of every view.
    assert (5.0 * np.sqrt(np.diag(spread))[4:] < np.abs(moved[4:])).all()


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("epochs", [2, 3, 4, 6])
def test_something_moves_whatever_the_number_of_epochs(mode, epochs):
    text = f'layout = "ship"\n[time]\nepochs = {epochs}\n[deformation]\n{mode} = 0.1\n'
    described = parse_description(text)
    time = described.interval_s * np.arange(described.epochs)
    far = np.array([[40.0, 1.0, 1.0]])
    axis, origin = (1.0, 0.0, 0.0), np.zeros(3)
    _, shift = displacements(far, axis, origin, {mode: 0.1}, time, described.period_s)
    assert np.ptp(shift[0], axis=0).max() > 0.02


@pytest.mark.parametrize("mode", MODES)
def test_stations_turn_as_the_structure_does(mode):
    """A short arm on the structure moves with the turn of its station: dX = turn x arm."""
    rng = np.random.default_rng(3)
    at = rng.uniform(-1.0, 1.0, (20, 3)) * [40.0, 3.0, 5.0]
    corner = np.array([[40.0, 3.0, 5.0]])
    axis, origin, when = (0.6, 0.8, 0.0), np.zeros(3), np.array([0.0, 30.0])

    def field(points):
        # The farthest point sets the scale of the mode.
        return displacements(np.concatenate([points, corner]), axis, origin, {mode: 1e-3}, when, 97)

    turn, shift = (part[:-1] for part in field(at))
    step = 1e-3
    gradient = np.stack(
        [(field(at + step * e)[1] - field(at - step * e)[1])[:-1] / (2 * step) for e in np.eye(3)],
        axis=3,
    )
    skew = 0.5 * (gradient - np.swapaxes(gradient, 2, 3))
    expected = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=2)
    assert np.allclose(turn, expected, atol=1e-9)
    assert np.abs(turn).max() > 1e-7
    # The place where nothing moves.
    assert np.allclose(field(np.zeros((1, 3)))[1][0], 0.0, atol=1e-12)
    assert np.abs(shift).max() <= 1e-3 * 60.0


@pytest.mark.parametrize("driver", ["ambient", "body"])
def test_hidden_temperature_raises_the_variance_factor_and_known_does_not(driver):
    factor = {}
    for model in ("known", "free", "hidden"):
        made = network(DAY.format(driver=driver, lag=0, model=model))
        result = adjust(start(build(made.recording)))
        factor[model] = result.variance_factor
        if model == "hidden":
            assert made.recording.model.effects == ()
            assert made.truth.hidden == tuple(effect.name for effect in made.truth.effects)
            continue
        amplitudes = [effect.amplitudes[0] for effect in result.scene.fitted_effects()]
        assert len(amplitudes) == (1 if driver == "ambient" else len(made.recording.model.cameras))
        assert np.median(amplitudes) == pytest.approx(2e-4, rel=0.05)
        given = made.recording.model.effects[0].amplitudes[0]
        assert given == (2e-4 if model == "known" else 0.0)
    low, high = chi2.ppf([1e-5, 1.0 - 1e-5], result.degrees_of_freedom)
    for model in ("known", "free"):
        assert low < factor[model] * result.degrees_of_freedom < 1.01 * high
    assert factor["hidden"] > 1.5


def test_a_lag_of_an_effect_is_found():
    made = network(DAY.format(driver="ambient", lag=5000, model="free"))
    result = adjust(start(build(made.recording)))
    (effect,) = result.scene.fitted_effects()
    assert effect.amplitudes[0] == pytest.approx(2e-4, rel=0.1)
    assert effect.constants[0] == pytest.approx(5000, rel=0.3)


def test_free_cameras_start_away_from_the_truth():
    made = network(SMALL["station"])
    first, *others = made.recording.model.cameras
    # Nobody sees the station itself: its first camera is what it is known by.
    assert first.free == frozenset() and all(c.free == {"pose"} for c in others)
    true = dict(zip(made.truth.cameras, made.truth.station_from_camera, strict=True))
    assert np.array_equal(first.pose, true[first.name])
    assert all(np.abs(c.pose - true[c.name]).max() > 1e-3 for c in others)


@pytest.mark.parametrize("kind", ["body", "plate", "plates"])
def test_marks_are_seen_from_where_they_should_be(kind):
    """Plates only from the front and not too steeply; all marks inside the images."""
    text = f'layout = "wind-tunnel"\n[marks]\nkind = "{kind}"\n'
    text += "tilt_deg = 20\nincidence_deg = 50" if kind != "body" else ""
    made = network(text)
    recording, truth = made.recording, made.truth
    obs, model = recording.observations, recording.model
    size = np.array(model.cameras[0].image_size)
    assert (obs.pixel > 19.0).all() and (obs.pixel < size - 20.0).all()
    station = dict(zip(truth.stations, truth.world_from_station[:, 0], strict=True))
    views = np.unique(np.stack([obs.camera, obs.target]), axis=1).T
    steepest = 0.0
    for c, t in views:
        camera, target = model.cameras[c], model.targets[t]
        eye = (matrix(station[camera.station]) @ matrix(camera.pose))[:3, 3]
        plate = matrix(station[target.station]) @ matrix(target.pose)
        middle = plate[:3, :3] @ target.points.mean(axis=0) + plate[:3, 3]
        ray = (middle - eye) / np.linalg.norm(middle - eye)
        steepest = max(steepest, np.degrees(np.arccos(plate[:3, 2] @ ray)))
    if kind == "plates":
        # Turned out of the line of sight by just what was asked for.
        assert steepest == pytest.approx(20.0, abs=0.01)
    elif kind == "plate":
        assert 25.0 < steepest < 50.5
    else:
        assert np.linalg.matrix_rank(model.targets[0].points - model.targets[0].points[0]) == 3


def test_walls_of_a_tunnel_hide():
    """In a curve of small radius stations of the inner wall don't see past the next ones."""
    text = 'layout = "tunnel"\nstations = 20\n[structure]\nradius_m = {}\n[sights]\nreach_m = 90'
    straight, curved = (len(network(text.format(r)).recording.model.cameras) for r in (5000, 60))
    assert curved < 0.8 * straight


BAD = [
    ('layout = "shipp"', "line 1: layout is .shipp.; it must be one of ship, tunnel"),
    ("", "layout"),
    ('layout = "ship"\nstation = 9', 'line 2: unknown key "station".*did you mean "stations"'),
    ('layout = "ship"\n[structure]\nspan_m = 3', 'line 3: unknown key "span_m" for layout "ship"'),
    ('layout = "chain"\nstations = 1', "line 2: stations is 1; .* from 2"),
    ('layout = "ship"\nstations = 5\n[structure]\ndecks = 4', "line 2: 5 .*give at least 8"),
    ('layout = "tunnel"\n[structure]\nradius_m = 9', "line 3: a tunnel 200 m long"),
    ('layout = "bridge"\nstations = 6', "line 2: 6 stations leave 2 for the deck"),
    ('layout = "wind-tunnel"\n[structure]\ndistance_m = 0.5', "line 3: outer stations 0.5 m"),
    ('layout = "random"\n[sights]\nredundancy = 0.5', "line 3: 20 stations.*give 1"),
    ('layout = "random"\nstations = 3\n[sights]\nredundancy = 5', "line 4: .*more than 6; give 2"),
    ('layout = "chain"\n[sights]\nredundancy = 5', 'line 3: only layout "random" draws'),
    ('layout = "chain"\n[sights]\nreach_m = 5', "line 3: no station sees another; raise"),
    ('layout = "chain"\nheld = ["s99"]', 'line 2: there is no station "s99" to be held'),
    ('layout = "chain"\n[marks]\nsize_m = 50', 'station "s02" is seen by no station'),
    ('layout = "ship"\n[sights]\nreach_m = 13', "line 3: station .* is .*raise sights.reach_m"),
    ('layout = "chain"\n[deformation]\nbending_m = 1', "line 2: one epoch shows no deformation"),
    ('layout = "chain"\n[time]\nepochs = 2\n[deformation]\nperiod_s = 1', "line 4: nothing moves"),
    ('layout = "ring"\nobserve = "links"\n[time]\nepochs = 2', "line 4: links alone have one"),
    ('layout = "ring"\n[[effects]]\nport = "sensor.focal"', r"line 2: .*add a table \[temp"),
    (
        'layout = "ring"\n[temperature]\n[[effects]]\nport = "sensor.focus"\nper_K = 1',
        "line 4: effects.0..port is .sensor.focus",
    ),
    (
        'layout = "ring"\n[temperature]\n[[effects]]\nport = "sensor.focal"\nper_K = 1e-5\n'
        'camera = ["s01-to-s2"]',
        'line 6: there is no camera "s01-to-s2" for an effect; did you mean "s01-to-s02"',
    ),
    ('layout = "ring"\n[cameras]\npose = "free"', "line 3: 12 views can't give 23 free poses"),
    ('layout = "ring"\n[cameras]\ncount = 3', "line 3: a camera for each sight line has no"),
    ('layout = "ring"\n[cameras]\neach = "sector"\ncount = 2', "line 4: 2 cameras .* give count"),
    ('layout = "ring"\n[marks]\ntilt_deg = 3', "line 3: a body is seen from all sides"),
    ('layout = "ring"\n[marks]\nkind = "plate"\ntilt_deg = 70', "line 4: plates turned by 70"),
    ('layout = "station"\nstations = 2', "line 2: .*cameras.count"),
    ("layout = ", "not valid TOML"),
]


@pytest.mark.parametrize(("text", "words"), BAD)
def test_errors_name_file_line_and_mend(text, words):
    with pytest.raises(RecordingError, match=words) as error:
        simulate_network(parse_description(text, "my.toml"))
    assert str(error.value).startswith("my.toml")
    assert "recording.toml" not in str(error.value) and "\n" not in str(error.value)


def test_the_station_that_nobody_sees_is_named():
    text = 'layout = "chain"\nstations = 5\nheld = ["s3"]\n[time]\nepochs = 2\n[deformation]\n'
    text += "settling_m = 4.0\n[cameras]\nfocal_px = 10000"
    with pytest.raises(RecordingError, match=r'station "s\d" is joined to no held.*at epoch 1'):
        simulate_network(parse_description(text))


TABLES = ("structure", "sights", "cameras", "marks", "time", "deformation", "temperature", "links",
          "noise")  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_key_is_in_the_one_table(layout):
    words = jaxvm.scenes.describe.__doc__
    for table in TABLES:
        with pytest.raises(RecordingError) as error:
            parse_description(f'layout = "{layout}"\n[{table}]\nqzx = 1')
        known = re.search("known here: (.*)", str(error.value))[1].split(", ")
        assert known and all(f"`{key}`" in words for key in known), table
    with pytest.raises(RecordingError) as error:
        parse_description("layout = 1\nqzx = 1")
    known = re.search("known here: (.*)", str(error.value))[1].split(", ")
    assert all(f"`{key}`" in words or f"[{key}]" in words for key in known)


def test_examples_come_with_the_package():
    assert {read_description(name).layout for name in example_names()} == set(LAYOUTS)
    with pytest.raises(RecordingError, match='no example of that name; did you mean "ship"'):
        read_description("shib")
    with pytest.raises(RecordingError, match="known here: deformation, bridge, chain"):
        read_description("submarine", ("deformation",))


def test_simulate_writes_recording_and_truth_apart(tmp_path, capsys):
    folder = tmp_path / "bridge"
    assert main(["simulate", "chain", "--out", str(folder), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["recording"] == str(folder) and told["hidden"] == []
    recording = read_recording(folder)
    assert len(recording.model.stations) == 10
    truth = pd.read_csv(tmp_path / "bridge-truth" / "stations.csv")
    assert list(truth.columns[:3]) == ["station", "epoch", "turn_x"] and len(truth) == 10
    again = ["simulate", "chain", "--out", str(folder)]
    assert main(again) == 2 and "already there" in capsys.readouterr().err
    inside = str(tmp_path / "new" / "truth")
    assert main(["simulate", "chain", "--out", str(tmp_path / "new"), "--truth", inside]) == 2
    assert "give the truth a folder of its own" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_simulate_takes_a_file(tmp_path, capsys):
    file = tmp_path / "mine.toml"
    file.write_text(SMALL["chain of links"])
    out, truth = tmp_path / "mine", tmp_path / "key"
    assert main(["simulate", str(file), "--out", str(out), "--truth", str(truth)]) == 0
    assert "4 links" in capsys.readouterr().out
    assert {f.name for f in truth.iterdir()} == {"stations.csv", "effects.toml"}
    file.write_text('layout = "ring"\nstations = 2')
    assert main(["simulate", str(file), "--out", str(tmp_path / "none")]) == 2
    assert "mine.toml line 2: stations is 2" in capsys.readouterr().err
    assert main(["simulate", "chain", "--hide", "x", "--out", str(tmp_path / "none")]) == 2
    assert "--hide is for deformation" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_nothing_hidden_is_in_the_recording(tmp_path):
    made = network(DAY.format(driver="ambient", lag=0, model="hidden"))
    beside = made.write(tmp_path / "day")
    text = "".join(f.read_text() for f in (tmp_path / "day").iterdir())
    assert "sensor.focal" not in text and "effects" not in text
    assert "sensor.focal" in (beside / "effects.toml").read_text()
    assert read_recording(tmp_path / "day").model.effects == ()
