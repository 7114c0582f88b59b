"""Identification and compensation: known systems, scipy's solutions, streams, files, bad input."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import predicted, stereo_recording
from scipy.signal import lfilter, lsim

from jaxvm.cli import main
from jaxvm.discover.cells import arrange
from jaxvm.identify import Compensator, DriftModel, compensate, identify, read_drift_model
from jaxvm.identify.difference import Orders, fit_difference
from jaxvm.identify.identify import CONTINUOUS, DISCRETE, _choice
from jaxvm.identify.inputs import Inputs, inputs_of
from jaxvm.identify.lags import Structure, fit, regressors
from jaxvm.identify.maps import drift_map, settled_after
from jaxvm.identify.model import CameraDrift, Trained
from jaxvm.identify.poses import image_poses
from jaxvm.identify.trajectories import (
    CAMERA_PORTS,
    _camera_of_cells,
    _of_epochs,
    trajectories,
)
from jaxvm.montecarlo import LevenbergMarquardt, run
from jaxvm.montecarlo.drift import compensation_study, structure_study
from jaxvm.network.residual import residual
from jaxvm.network.scene import build
from jaxvm.physics.drivers import POWER_ON
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.ports import PORT_INDEX
from jaxvm.recording import Drivers, Observations, Recording, read_recording
from jaxvm.recording.model import Camera, Model, Station, Target
from jaxvm.solve.adjust import adjust

HOURS, STEP = 10.0, 120.0
STILL = np.zeros(6)


def weather(time: np.ndarray, seed: int = 0) -> np.ndarray:
    """Steps and ramps of the air (degC) between 12 and 30."""
    rng = np.random.default_rng(seed)
    knots = np.sort(rng.uniform(time[0], time[-1], 24))
    return np.interp(time, knots, rng.uniform(12.0, 30.0, 24))


def made_inputs(seed: int = 0, on: float = 1800.0) -> Inputs:
    log = np.arange(-3600.0, 3600.0 * HOURS + 61.0, 60.0)
    epochs = np.arange(0.0, 3600.0 * HOURS + 1.0, STEP)
    time = np.unique(np.concatenate([log, epochs]))
    values = np.stack([weather(time, seed), time - on])
    return Inputs(("ambient_degC", POWER_ON + "left"), time, values, np.searchsorted(time, epochs))


def outputs(inputs: Inputs, taus=(600.0, 3000.0), seed: int = 0, noise: float = 1.0):
    """Three outputs of known gains on the lags of both inputs."""
    rng = np.random.default_rng(seed)
    reference = np.array([20.0, 0.0])
    found = regressors(inputs, reference, Structure(len(taus)), np.array(taus), 0.0)
    gain = rng.normal(size=(3, found.shape[1])) * [30.0, 0.0, *[60.0, 800.0] * len(taus)]
    clean = (found - found.mean(axis=0)) @ gain.T
    return clean, clean + noise * rng.normal(size=clean.shape)


BLOCKS = np.arange(301) // 5 % 5
LARGE = np.full(3, 2000.0)


def test_a_lag_is_scipys_response_of_a_first_order_system():
    inputs = made_inputs()
    found = regressors(inputs, np.zeros(2), Structure(1), np.array([900.0]), 0.0)
    x = inputs.values[0]
    # lsim interpolates linearly as well, but wants equal steps.
    time = np.arange(inputs.time[0], inputs.time[-1], 20.0)
    drive = np.interp(time, inputs.time, x) - x[0]
    _, expected, _ = lsim(([1.0], [900.0, 1.0]), drive, time - time[0])
    at = inputs.time[inputs.epoch]
    np.testing.assert_allclose(found[:, 2], x[0] + np.interp(at, time, expected), atol=0.03)
    since = np.maximum(at - 1800.0, 0.0)
    np.testing.assert_allclose(found[:, 3], 1.0 - np.exp(-since / 900.0), atol=1e-12)


def test_time_constants_and_outputs_are_recovered_within_their_deviations():
    inputs = made_inputs()
    clean, noisy = outputs(inputs)
    found = fit(inputs, noisy, np.ones_like(noisy), Structure(2), BLOCKS, LARGE)
    z = (found.model.tau - [600.0, 3000.0]) / found.model.tau_sigma
    assert np.all(np.abs(z) < 4.0), (found.model.tau, found.model.tau_sigma)
    left = np.sqrt(np.mean((found.courses - clean) ** 2))
    assert left < 0.4  # noise 1, 3 x 13 unknowns over 3 x 301 numbers: 0.21 expected
    chi = found.chi.sum() / (noisy.size - found.unknowns)
    assert abs(chi - 1.0) < 4.0 * np.sqrt(2.0 / noisy.size)


def test_a_model_foretells_another_history_that_it_has_never_seen():
    inputs, other = made_inputs(0), made_inputs(5, on=-600.0)
    _, noisy = outputs(inputs)
    found = fit(inputs, noisy, np.ones_like(noisy), Structure(2), BLOCKS, LARGE)
    reference = np.array([20.0, 0.0])
    rng = np.random.default_rng(0)
    rows = regressors(other, reference, Structure(2), np.array([600.0, 3000.0]), 0.0)
    gain = rng.normal(size=(3, 6)) * [30.0, 0.0, 60.0, 800.0, 60.0, 800.0]
    own = regressors(inputs, reference, Structure(2), np.array([600.0, 3000.0]), 0.0)
    truth = (rows - own.mean(axis=0)) @ gain.T
    left = found.model.response(other) - truth
    assert np.sqrt(np.mean(left**2)) < 0.01 * np.sqrt(np.mean(truth**2))


def test_a_delay_is_recovered():
    inputs = made_inputs()
    late = regressors(inputs, np.array([20.0, 0.0]), Structure(1, delayed=True), [600.0], 900.0)
    z = np.outer(late[:, 2], [50.0, -20.0, 10.0])
    z += np.random.default_rng(1).normal(size=z.shape)
    z -= z.mean(axis=0)
    found = fit(inputs, z, np.ones_like(z), Structure(1, delayed=True), BLOCKS, LARGE).model
    assert abs(found.delay - 900.0) < 3.0 * found.delay_sigma < 150.0
    assert abs(found.tau[0] - 600.0) < 4.0 * found.tau_sigma[0]


def test_the_chosen_order_is_that_of_the_system():
    """Odds of 20:1 for a further state let at most one system in twenty have one too many."""
    assert [s.order for s in CONTINUOUS[:5:2]] == [0, 1, 2]
    rng = np.random.default_rng(7)
    chosen = []
    for tau, seed in zip(rng.uniform(300.0, 5000.0, 40), rng.integers(10**6, size=40), strict=True):
        inputs = made_inputs(int(seed))
        _, one = outputs(inputs, (tau,), int(seed))
        fits = [fit(inputs, one, np.ones_like(one), s, BLOCKS, LARGE) for s in CONTINUOUS[:5:2]]
        chosen.append(_choice(fits)[0])
    assert min(chosen) == 1
    assert np.mean(np.array(chosen) > 1) <= 0.05


def test_equation_error_is_biased_by_noise_and_output_error_is_not():
    """A first-order lag sampled every 120 s has its pole at exp(-120 / tau)."""
    inputs = made_inputs(3)
    pole = np.exp(-STEP / 900.0)
    u = inputs.values[0][inputs.epoch] - 20.0
    y = lfilter([1.0 - pole], [1.0, -pole], u, zi=[pole * u[0]])[0]
    z = np.outer(y, [3.0, -2.0, 1.0])
    z += np.random.default_rng(2).normal(size=z.shape)
    z -= z.mean(axis=0)
    own = inputs.only(("ambient_degC",))
    poles = {}
    for kind in ("ARX", "output error"):
        found = fit_difference(own, z, np.ones_like(z), Orders(kind, 1, 1), BLOCKS, LARGE).model
        poles[kind] = -found.a[0]
    assert abs(poles["output error"] - pole) < 0.004
    assert poles["ARX"] < pole - 0.02


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(0, 10**6))
def test_models_are_stable_whatever_the_data(order, seed):
    inputs = made_inputs(seed % 7)
    rng = np.random.default_rng(seed)
    z = np.cumsum(rng.normal(size=(301, 3)), axis=0) * np.linspace(0.1, 10.0, 301)[:, None]
    z -= z.mean(axis=0)
    for kind in ("ARX", "output error"):
        found = fit_difference(inputs, z, np.ones_like(z), Orders(kind, order, 2), BLOCKS, LARGE)
        assert np.all(np.abs(np.roots(np.append(1.0, found.model.a))) < 1.0)
        assert np.all(np.isfinite(found.model.response(inputs)))


def test_the_table_of_forgotten_lags():
    """MATHEMATICS 1.5: a static model leaves wt / sqrt(1 + w^2 t^2) of the response."""
    table = {86400.0: (0.022, 0.044, 0.087, 0.172, 0.366),
             21600.0: (0.087, 0.172, 0.330, 0.572, 0.844),
             3600.0: (0.464, 0.723, 0.902, 0.973, 0.994)}  # fmt: skip
    for period, shares in table.items():
        epochs = np.linspace(0.0, 4.0 * period, 801)[:-1]
        log = np.concatenate([np.linspace(-12.0 * 5400.0, -1.0, 4000), epochs])
        x = np.sin(2.0 * np.pi * log / period)[None]
        inputs = Inputs(("ambient_degC",), log, x, np.arange(4000, 4800))
        for minutes, share in zip((5, 10, 20, 40, 90), shares, strict=True):
            one = np.array([60.0 * minutes])
            y = regressors(inputs, np.zeros(1), Structure(1), one, 0.0)[:, 1]
            static = np.linalg.lstsq(np.stack([x[0, 4000:], np.ones(800)]).T, y, rcond=None)[1]
            left = np.sqrt(static[0] / np.sum((y - y.mean()) ** 2))
            assert left == pytest.approx(share, abs=6e-4)


# --- recordings ----------------------------------------------------------------------------------


def a_recording(effects=(), seed: int = 1, hours: float = 10.0, noise: int = 0) -> Recording:
    """A camera that watches a tilted plate while the air changes; images by the chain."""
    time, sigma = np.arange(0.0, 3600.0 * hours, 180.0), 0.03
    log = np.arange(-3600.0, time[-1] + 61.0, 60.0)
    names = tuple(f"{r}/{c}" for r in range(4) for c in range(5))
    points = np.array([[0.1 * c, 0.1 * r, 0.0] for r in range(4) for c in range(5)])
    camera = Camera("left", "pillar", (2448, 2048), "opencv4", np.array([5000.0, 5000.0]),
                    np.array([1223.5, 1023.5]), np.array([-0.08, 0.02, 0.0, 0.0]), STILL,
                    powered_on_s=(900.0,))  # fmt: skip
    pose = np.array([0.4, 0.3, 0.0, -0.15, -0.12, 1.6])
    model = Model(
        "",
        (camera,),
        (Station("pillar", pose=STILL),),
        (Target("plate", names, points, pose=pose, free=frozenset({"pose"})),),
        pixel_sigma=sigma,
    )
    epoch, point = (a.ravel() for a in np.indices((len(time), len(names))))
    none = np.zeros(len(epoch), int)
    empty = Observations(epoch, none, none, point, np.zeros((len(epoch), 2)),
                         np.full(len(epoch), sigma))  # fmt: skip
    recording = Recording(model, np.arange(len(time)), time, {}, empty,
                          Drivers(log, {"ambient_degC": weather(log, seed)}))  # fmt: skip
    scene = build(recording, tuple(effects))
    pixel = predicted(scene)
    pixel += sigma * np.random.default_rng([seed, noise]).normal(size=pixel.shape)
    return replace(recording, observations=replace(empty, pixel=pixel))


SCOPE = Scope(camera=("left",))
DRIFT = (
    Effect("focal", (Term("sensor.focal"), Term("mount.turn_x")), "ambient_degC", "lag", (1500.0,),
           20.0, SCOPE, (30e-6, 10e-6)),
    Effect("mount", (Term("mount.turn_y"),), "time since power-on of left", "onset", (1500.0,), 0.0,
           SCOPE, (2e-4,)),
)  # fmt: skip


@pytest.fixture(scope="module")
def identified():
    return identify(a_recording(DRIFT), CONTINUOUS[:3])


def test_a_camera_is_identified_through_the_residual(identified):
    (own,) = identified.cameras
    assert own.fit.model.structure.name == "1 time constant"
    assert abs(own.drift.dynamics.tau[0] - 1500.0) < 4.0 * own.drift.dynamics.tau_sigma[0] < 100.0
    lasting = own.drift.lasting()
    # Focal length and distortion look alike here; what they do to the image together is sure.
    assert lasting["sensor.focal"]["ambient_degC"] == pytest.approx(30e-6, rel=0.1)
    assert "held: " in own.trajectories.gauge()
    assert own.drift.held_out_px < 0.1 * own.drift.drift_px


def test_two_steps_agree_with_one(identified):
    two = identify(a_recording(DRIFT), CONTINUOUS[:3], one_step=False)
    a, b = (one.cameras[0].drift.dynamics for one in (two, identified))
    assert abs(a.tau[0] - b.tau[0]) < 2.0 * b.tau_sigma[0]
    other = a_recording(DRIFT, seed=4)
    first, second = (compensate(other, one.model).correction for one in (two, identified))
    assert np.std(first - second) < 0.02 * np.std(second)


def test_a_camera_that_does_not_drift_is_left_alone():
    found = identify(a_recording())
    (own,) = found.cameras
    assert own.fit.model.structure.name == "no drift"
    other = a_recording(seed=4)
    assert not compensate(other, found.model).correction.any()
    assert "no drift that the inputs explain" in found.summary()


def test_compensation_of_another_day(identified):
    other = a_recording(DRIFT, seed=8)
    still = a_recording((), seed=8)  # the same noise, no drift
    done = compensate(other, identified.model)
    before = other.observations.pixel - still.observations.pixel
    after = done.recording.observations.pixel - still.observations.pixel

    def about_mean(x):
        """Of every mark, from its mean state."""
        return x.reshape(200, 20, 2) - x.reshape(200, 20, 2).mean(axis=0)

    assert np.std(about_mean(after)) < 0.02 * np.std(about_mean(before))
    poses = [image_poses(r) for r in (still, other, done.recording)]
    depth = [table["shift_z"].to_numpy() for table in poses]
    assert np.std(depth[2] - depth[0]) < 0.2 * np.std(depth[1] - depth[0])
    assert list(poses[0]["camera"].unique()) == ["left"]


def test_a_study_of_compensation_under_noise():
    """Models learnt from images that are noisier each time take the drift of another day off."""
    drifts = []
    for seed in (1, 8):
        moved, still = a_recording(DRIFT, seed), a_recording((), seed)
        drifts.append((moved.observations.pixel - still.observations.pixel).reshape(200, 20, 2))
    # A model compensates to the mean state of its training.
    drift = (drifts[1] - drifts[0].mean(axis=0)).reshape(-1, 2)
    days = a_recording(DRIFT, 1), a_recording(DRIFT, 8)
    study = compensation_study(*days, drift, structures=CONTINUOUS[:3])
    found = run(study, 0, 2)
    assert found.failed == 0 and found.names == ("mean_px[0]", "mean_px[1]", "rms_px[0]")
    before, left = found.columns["before_px"], found.columns["error.rms_px[0]"]
    assert (left < 0.1 * before).all() and left[0] != left[1]
    with pytest.raises(ValueError, match="drifts do not fit"):
        compensation_study(*days, drift[:-1])
    # The same noise, learnt by the one adjustment that ends the identification, in batches.
    together = run(structure_study(*days, drift, CONTINUOUS[2]), 0, 20)
    assert together.failed == 0 and together.names == found.names
    for name, column in together.columns.items():
        if name in found.columns and name.startswith(("error", "before")):
            np.testing.assert_allclose(column[:2], found.columns[name], rtol=0.02, atol=1e-5)
    with pytest.raises(ValueError, match="static, parabola.* compensation_study"):
        structure_study(*days, drift, CONTINUOUS[1])
    with pytest.raises(ValueError, match="drifts do not fit"):
        structure_study(*days, drift[:-1], CONTINUOUS[2])
    model = replace(days[1].model, cameras=(replace(days[1].model.cameras[0], name="other"),))
    with pytest.raises(ValueError, match="has no camera left"):
        structure_study(days[0], replace(days[1], model=model), drift, CONTINUOUS[0])


def test_drift_models_are_learnt_in_single_precision_too():
    days, drift = (a_recording(DRIFT, 1), a_recording(DRIFT, 8)), np.zeros((4000, 2))

    def noise(key, shape):
        """The same numbers in both precisions."""
        return jax.random.normal(key, shape, np.float32)

    damped = LevenbergMarquardt(rtol=1e-6, damping=1e-6)
    study = structure_study(*days, drift, CONTINUOUS[2], noise, damped)
    double, single = (run(own, 0, 4) for own in (study, study.in_single_precision()))
    assert double.failed == single.failed == 0
    for name in double.columns:
        if name.startswith("error"):
            one, other = double.columns[name], single.columns[name]
            # What rounding does is little beside what noise does.
            assert np.abs(one - other).max() < 0.3 * np.std(one), name
            assert other.dtype == np.float32


def test_a_model_survives_its_file(identified, tmp_path):
    file = tmp_path / "drift.toml"
    file.write_text(identified.model.text())
    again = read_drift_model(file)
    other = a_recording(DRIFT, seed=8)
    np.testing.assert_array_equal(
        compensate(other, again).correction, compensate(other, identified.model).correction
    )
    file.write_text(file.read_text().replace("tau_s", "tua_s"))
    with pytest.raises(ValueError, match="drift.toml: camera .left.: .tau_s. is missing"):
        read_drift_model(file)
    file.write_text("format = 1")
    with pytest.raises(ValueError, match="no drift model"):
        read_drift_model(file)


@pytest.mark.parametrize("structure", [*CONTINUOUS[1:4], CONTINUOUS[-1], DISCRETE[0], DISCRETE[2]])
def test_a_stream_of_frames_is_the_recording(structure):
    recording = a_recording(DRIFT)
    found = identify(recording, [structure], one_step=False)
    other = a_recording(DRIFT, seed=8)
    batch = compensate(other, found.model).recording.observations
    inputs, obs = inputs_of(other), other.observations
    drift = found.model.cameras[0]
    if drift.dynamics.structure.name.endswith("delayed"):
        drift = replace(drift, dynamics=replace(drift.dynamics, delay=250.0))
        batch = compensate(other, DriftModel((drift,))).recording.observations
    stream = Compensator(other.model.cameras[0], drift)
    start = inputs.time[inputs.epoch[0]]
    step = getattr(drift.dynamics, "step", None)
    for k, time in enumerate(inputs.time):
        if step and time < start - int((start - inputs.time[0]) / step) * step - 1e-9:
            continue  # the first reading of a difference equation is one of its steps
        readings = dict(zip(inputs.names, inputs.values[:, k], strict=True))
        stream.read(float(time), readings)
        for epoch in np.flatnonzero(inputs.epoch == k):
            own = obs.epoch == epoch
            np.testing.assert_allclose(
                stream.correct(obs.pixel[own]), batch.pixel[own], rtol=0, atol=1e-9
            )


def test_extrapolation_is_flagged(identified):
    other = a_recording(DRIFT, seed=8)
    assert other.drivers is not None
    hot = {name: values + 15.0 for name, values in other.drivers.channels.items()}
    done = compensate(replace(other, drivers=Drivers(other.drivers.time, hot)), identified.model)
    assert done.outside.mean() > 0.3
    assert any("outside the range" in text for text in done.warnings)
    assert not compensate(a_recording(DRIFT), identified.model).outside.any()


def test_another_camera_of_the_same_name_is_told(identified):
    recording = a_recording(DRIFT)
    (camera,) = recording.model.cameras
    (drift,) = identified.model.cameras
    assert drift.focal_px == pytest.approx(np.mean(camera.focal_px), rel=1e-3)
    assert not any(
        "same camera" in text for text in compensate(recording, identified.model).warnings
    )
    longer = replace(camera, focal_px=1.01 * camera.focal_px)
    other = replace(recording, model=replace(recording.model, cameras=(longer,)))
    assert any("same camera" in text for text in compensate(other, identified.model).warnings)
    # A model of an earlier version does not tell.
    silent = DriftModel((replace(drift, focal_px=0.0),))
    assert not any("same camera" in text for text in compensate(other, silent).warnings)


def test_trajectories_are_the_changes_that_were_made():
    """Against the truth of the simulation, in the deviations that theory gives."""
    a, b = (trajectories(adjust(build(a_recording(DRIFT, noise=n), ())), "left") for n in (0, 1))
    assert a.ports == b.ports
    noise = (a.port - b.port) / np.sqrt(2.0)
    spread = np.sqrt(np.sum(a.ports_from_mode**2, axis=1))
    assert np.all(np.abs(np.std(noise, axis=0) / spread - 1.0) < 0.25)
    focal = a.port[:, a.ports.index("sensor.focal")]
    log = inputs_of(a_recording(DRIFT))
    truth = 30e-6 * regressors(log.only(("ambient_degC",)), [20.0], Structure(1), [1500.0], 0.0)
    wrong = focal - (truth[:, 1] - truth[:, 1].mean())
    assert np.std(wrong) < 1.2 * spread[a.ports.index("sensor.focal")]


def test_a_map_shows_what_every_mark_does_and_the_time_of_rest(identified):
    recording = a_recording(DRIFT)
    (own,) = identified.cameras
    time = recording.time
    place, move = drift_map(recording, "left", time < 600.0, time > 30000.0)
    obs = recording.observations
    for mark in (0, 13, 19):
        own_marks = obs.point == mark
        early, late = (obs.pixel[own_marks][chosen] for chosen in (time < 600.0, time > 30000.0))
        np.testing.assert_allclose(place[mark], early.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(move[mark], late.mean(axis=0) - early.mean(axis=0), atol=1e-9)
    with pytest.raises(ValueError, match="no mark is seen in both"):
        drift_map(recording, "left", time < 0.0, time > 0.0)
    # A lag of 25 min after a power-on at 15 min, of 1 px, noise 0.03 px.
    warm = identify(a_recording(DRIFT[1:], hours=6.0), CONTINUOUS[2:3], one_step=False)
    amplitude = 5000.0 * 2e-4 * (np.exp(600.0 / 1500.0) - 1.0)
    expected = 900.0 + 1500.0 * np.log(amplitude / 0.03) - 600.0
    assert settled_after(warm.cameras[0]) == pytest.approx(expected, abs=360.0)
    assert settled_after(own) is None or settled_after(own) > 900.0


def test_effects_that_share_their_constants_move_together():
    """The time constant of a body is one unknown, whatever is driven by it."""
    shared = replace(DRIFT[1], shares="focal")
    scene = build(a_recording(DRIFT), (DRIFT[0], shared))
    slots = scene.network.layout.all("constant")
    assert scene.unknowns.column[slots[0]] == scene.unknowns.column[slots[1]]
    apart = build(a_recording(DRIFT), DRIFT)
    assert apart.unknowns.column[slots[0]] != apart.unknowns.column[slots[1]]
    started = [replace(effect, constants=(1000.0,)) for effect in (DRIFT[0], shared)]
    found = adjust(build(a_recording(DRIFT), tuple(started)))
    tau = [effect.constants[0] for effect in found.scene.fitted_effects()]
    assert tau[0] == tau[1] == pytest.approx(1500.0, abs=20.0)


@pytest.fixture(scope="module")
def drift_world():
    file = Path(__file__).parent.parent / "benchmarks" / "drift" / "world.py"
    spec = importlib.util.spec_from_file_location("drift_world", file)
    module = importlib.util.module_from_spec(spec)
    sys.modules["drift_world"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["drift_world"]


@pytest.mark.parametrize("family, seed, least", [("one node", 12, 0.95), ("two nodes", 11, 0.95),
                                                 ("four nodes", 13, 0.85)])  # fmt: skip
def test_a_thermal_network_that_is_no_model_of_ours(drift_world, tmp_path, family, seed, least):
    """From the command line: train on one history, compensate another, against the truth."""
    train, test = drift_world.pair(seed, family)
    train.write(tmp_path / "monday")
    test.write(tmp_path / "friday")
    model, fixed = tmp_path / "drift.toml", tmp_path / "fixed"
    assert main(["identify", str(tmp_path / "monday"), "--out", str(model), "--quiet"]) == 0
    arguments = ["compensate", str(tmp_path / "friday"), "--model", str(model)]
    assert main([*arguments, "--out", str(fixed), "--quiet"]) == 0
    truth = drift_world.relative(train, test)
    before, after = (read_recording(tmp_path / name).observations for name in ("friday", "fixed"))
    left = truth + (after.pixel - before.pixel).reshape(truth.shape)
    assert np.sqrt(np.mean(left**2)) < (1.0 - least) * np.sqrt(np.mean(truth**2))
    assert (fixed / "poses.csv").is_file() and (fixed / "poses-before.csv").is_file()
    # What is there is not written over.
    assert main([*arguments, "--out", str(fixed), "--quiet"]) == 2


# --- bad input -----------------------------------------------------------------------------------


def test_what_cannot_be_identified_is_said():
    recording = a_recording()
    with pytest.raises(ValueError, match="there are 10 epochs; record at least 24"):
        identify(recording.select_epochs(np.arange(200) < 10))
    assert recording.drivers is not None
    camera = replace(recording.model.cameras[0], powered_on_s=())
    dark = replace(recording, model=replace(recording.model, cameras=(camera,)))
    with pytest.raises(ValueError, match="no drivers and no power-on; add drivers.csv"):
        identify(replace(dark, drivers=None))
    still = {"ambient_degC": np.full(len(recording.drivers.time), 21.0)}
    with pytest.raises(ValueError, match="no temperature changes"):
        identify(replace(dark, drivers=Drivers(recording.drivers.time, still)))
    with pytest.raises(ValueError, match="have no times"):
        identify(replace(recording, timed=False))


def test_gaps_and_sensors_that_hang_are_told():
    recording = a_recording()
    assert recording.drivers is not None
    time, air = recording.drivers.time, recording.drivers.channels["ambient_degC"]
    kept = (time < 8000.0) | (time > 12000.0)
    gap = replace(recording, drivers=Drivers(time[kept], {"ambient_degC": air[kept]}))
    assert any("gap from 7980 s to 12060 s" in text for text in inputs_of(gap).warnings)
    stuck = np.where(time > 15000.0, air[np.argmax(time > 15000.0)], air)
    channels = {"ambient_degC": air, "body_left_degC": stuck}
    hangs = replace(recording, drivers=Drivers(time, channels))
    assert any("body_left_degC stays" in text for text in inputs_of(hangs).warnings)
    assert not inputs_of(recording).warnings


def test_a_clock_that_is_wrong_is_told():
    """Temperatures that are logged twenty minutes late: images seem to be ahead of them."""
    recording = a_recording(DRIFT)
    assert recording.drivers is not None
    drivers = recording.drivers
    late = Drivers(drivers.time, {"ambient_degC": np.interp(drivers.time - 1200.0, drivers.time,
                                                          weather(drivers.time, 1))})  # fmt: skip
    found = identify(replace(recording, drivers=late), CONTINUOUS[:4])
    (own,) = found.cameras
    assert any("ahead of the log" in text for text in own.warnings), own.warnings
    with pytest.raises(ValueError, match="set the clock of the log"):
        Compensator(recording.model.cameras[0], own.drift)


def test_a_foreign_camera_or_a_missing_input_is_told(identified):
    other = a_recording()
    (drift,) = identified.model.cameras
    foreign = DriftModel((replace(drift, camera="right"),))
    with pytest.raises(ValueError, match="the model is of right; the recording has left"):
        compensate(other, foreign)
    with pytest.raises(ValueError, match='driven by "ambient_degC", which this recording'):
        compensate(replace(other, drivers=None), identified.model)
    own = CameraDrift(drift.camera, drift.ports, drift.held, drift.dynamics, 1.0,
                      {"ambient_degC": Trained(0.0, 1.0)}, 0.0, 1.0)  # fmt: skip
    stream = Compensator(other.model.cameras[0], own)
    with pytest.raises(ValueError, match="no reading of the inputs yet"):
        stream.correct(np.zeros((1, 2)))
    with pytest.raises(ValueError, match='has no "ambient_degC"'):
        stream.read(0.0, {})


def test_cameras_that_share_a_moving_target_are_told_apart():
    """Against one dense least-squares problem: ports of all cameras and the pose of each epoch."""
    known = stereo_recording(with_ranges=False, right_lens="opencv4")
    model = known.recording.model
    fixed = tuple(replace(camera, free=frozenset()) for camera in model.cameras)
    held = tuple(replace(station, free=frozenset()) for station in model.stations)
    recording = replace(known.recording, model=replace(model, cameras=fixed, stations=held))
    found = adjust(known.true_scene(recording))
    names, sizes = list(CAMERA_PORTS), np.array(list(CAMERA_PORTS.values()))
    (rows,) = found.scene.tables
    obs = found.scene.recording.observations
    chosen = obs.epoch[rows] == 2

    def residuals(own) -> np.ndarray:
        return np.asarray(residual(own.state, own.network).pixels[0])[: len(rows)][chosen].ravel()

    columns = []
    for camera in ("left", "right"):
        for name, size in zip(names, sizes, strict=True):
            both = []
            for step in (1e-3 * size, -1e-3 * size):
                effect = Effect(
                    "", (Term(name),), scope=Scope(camera=(camera,)), amplitudes=(step,)
                )
                both.append(residuals(found.scene.with_effects((effect,))))
            columns.append((both[0] - both[1]) / 2e-3)
    state, row = found.scene.state, found.scene.target_row[1, 2]
    for k in range(6):
        both = []
        for step in (1e-5, -1e-5):
            poses = state.carrier_from_target.at[row, k].add(step)
            moved = eqx.tree_at(lambda s: s.carrier_from_target, state, poses)
            both.append(residuals(found.scene.with_state(moved)))
        columns.append((both[0] - both[1]) / 2e-5)
    a, p = np.array(columns).T, len(names)
    normal, right = a.T @ a, -a.T @ residuals(found.scene)
    rest = np.arange(p, 2 * p + 6)
    free = normal[np.ix_(rest, rest)] + np.diag([1.0] * p + [0.0] * 6)  # a large drift of the other
    away = np.linalg.solve(free, normal[rest, :p]).T
    expected = normal[:p, :p] - away @ normal[rest, :p]
    arranged = arrange(found)
    tangent = arranged.cells.tangent[[PORT_INDEX[n] for n in names]] * sizes[:, None, None]
    cameras = _camera_of_cells(found.scene, arranged.rows)
    information, pull = _of_epochs(arranged.cells, tangent, cameras, 0)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(information[2], expected, atol=1e-6 * scale)
    wanted = right[:p] - away @ right[rest]
    np.testing.assert_allclose(pull[2], wanted, atol=1e-5 * np.abs(wanted).max())


def test_where_everything_is_known_there_is_still_drift():
    recording = a_recording(DRIFT)
    (plate,) = recording.model.targets
    held = replace(recording.model, targets=(replace(plate, free=frozenset()),))
    found = identify(replace(recording, model=held), CONTINUOUS[2:3])
    tau = found.cameras[0].drift.dynamics
    assert abs(tau.tau[0] - 1500.0) < 4.0 * tau.tau_sigma[0] < 100.0
