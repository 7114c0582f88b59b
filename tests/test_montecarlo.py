"""Monte Carlo: statistics against NumPy, any batch and device, stopped and killed and resumed."""

import importlib
import json
import signal
import time
import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pose_networks import network
from processes import EIGHT, answer, apart, together
from scipy.stats import chi2, kurtosis, norm

from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.montecarlo import (
    GaussNewton,
    LevenbergMarquardt,
    OneByOne,
    Spgd,
    Spread,
    Statistics,
    Traced,
    Trial,
    montecarlo,
    network_study,
    run,
    station_trials,
)
from jaxvm.montecarlo.noise import KINDS, noise_by_name
from jaxvm.montecarlo.pace import Pace
from jaxvm.montecarlo.poses import pose_study
from jaxvm.montecarlo.scores import score_study
from jaxvm.montecarlo.statistics import LEVELS
from jaxvm.network.draw import drawn
from jaxvm.network.scene import build
from jaxvm.physics.effects import Effect, Term
from jaxvm.pose.precision import Setup
from jaxvm.recording.model import Prior
from jaxvm.recording.parse import parse_model
from jaxvm.scenes import parse_description, simulate_network
from jaxvm.solve.adjust import adjust


@pytest.fixture(scope="module")
def known():
    return network()


@pytest.fixture(scope="module")
def scene(known):
    """At the true state."""
    scene = build(known.recording)
    return scene.with_state(
        eqx.tree_at(lambda s: s.world_from_station, scene.state, jnp.asarray(known.truth))
    )


def last(state):
    return state.world_from_station[-1]


# --- statistics ---------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.lists(st.integers(1, 400), min_size=1, max_size=8))
def test_statistics_are_those_of_all_trials_at_once(seed, sizes):
    rng = np.random.default_rng(seed)
    scale, offset = 10.0 ** rng.uniform(-9, 6, 3), rng.normal(size=3)
    values = (rng.standard_t(3, (sum(sizes), 3)) + offset) * scale
    sigma = scale * rng.uniform(0.5, 2.0, values.shape)
    found = Statistics(3)
    for part, own in zip(
        *(np.split(x, np.cumsum(sizes)[:-1]) for x in (values, sigma)), strict=True
    ):
        found.add(part, own)
    assert found.count == len(values)
    assert np.allclose(found.mean, values.mean(axis=0), rtol=1e-10, atol=1e-12 * scale)
    assert np.allclose(found.rms, np.sqrt(np.mean(values**2, axis=0)), rtol=1e-10)
    if len(values) > 1:
        expected = np.cov(values.T)
        size = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
        assert np.allclose(found.covariance, expected, rtol=0, atol=1e-10 * size.max(initial=0))
        assert np.allclose(found.covariance / size, expected / size, atol=1e-9)
    for share in (0.0, 0.05, 0.5, 0.9, 1.0):
        exact = np.quantile(values, share, axis=0, method="lower")
        assert np.allclose(found.quantile(share), exact, rtol=0.0021, atol=0.0)
    for level in (0.5, 0.9):
        # Not rounded: one draw in thousands lies within a last digit.
        inside = np.abs(values) <= norm.ppf(0.5 + 0.5 * level) * sigma
        assert np.allclose(found.coverage(level), inside.mean(axis=0))


def test_coverage_without_sigmas_is_none():
    found = Statistics(1)
    found.add(np.ones((4, 1)))
    assert np.isnan(found.coverage(LEVELS[0])).all()
    with pytest.raises(ValueError, match="coverage is counted at 0.5, 0.6827"):
        found.coverage(0.8)


def test_quantiles_and_sizes_of_nothing_are_none():
    found = Statistics(2)
    assert np.isnan(found.quantile(0.5)).all()
    assert np.isnan(found.rms).all() and np.isnan(found.interval()).all()


# --- noise --------------------------------------------------------------------------------------


NUMBERED = {"student-t": "student-t:6", "outliers": "outliers:0.05:5"}


@pytest.mark.parametrize("name", [NUMBERED.get(name, name) for name in KINDS])
def test_noise_has_no_mean_and_unit_variance(name):
    values = np.asarray(noise_by_name(name)(jax.random.key(0), (200_000,)))
    spread = np.sqrt((kurtosis(values) + 2.0) / len(values))
    assert abs(values.mean()) < 5.0 / np.sqrt(len(values))
    assert values.var() == pytest.approx(1.0, abs=5.0 * spread)


@pytest.mark.parametrize(
    "text, said",
    [
        ("pink", 'no noise "pink".*student-t:4'),
        ("student-t:2", "no variance: more than 2 degrees"),
        ("normal:3", "numbers that it does not take"),
        ("outliers:x", "numbers that it does not take"),
        ("outliers:1.5", "a share from 0 to 1"),
    ],
)
def test_bad_noise_is_named(text, said):
    with pytest.raises(ValueError, match=said):
        noise_by_name(text)


def test_heavy_tails_spread_gauss_newton_as_theory_says(scene):
    """Least squares has the variance of the noise, whatever its distribution."""
    found = montecarlo(scene, last, 5, 600, noise=noise_by_name("student-t:5"))
    assert found.chi_square == pytest.approx(1.0, abs=0.15)


# --- networks -----------------------------------------------------------------------------------


def test_monte_carlo_agrees_with_theory(scene):
    found = montecarlo(scene, lambda s: s.world_from_station[1:], jax.random.key(0), 1000, 250)
    assert not found.failed.any()
    assert np.allclose(found.measured, np.sqrt(np.mean(found.errors**2, axis=0)), rtol=1e-10)
    low, high = found.interval(0.9999)
    assert (low < found.predicted).all() and (found.predicted < high).all()
    n = found.errors.size
    assert found.chi_square == pytest.approx(1.0, abs=4 * np.sqrt(2 / n))
    squares = 2.0 * found.cost
    spread = 4 * np.sqrt(2 * found.degrees_of_freedom / len(squares))
    assert np.mean(squares) == pytest.approx(found.degrees_of_freedom, abs=spread)
    several = montecarlo(
        scene,
        lambda s: {"turn": s.world_from_station[1:, :3], "place": s.world_from_station[1:, 3:]},
        jax.random.key(0),
        50,
    )
    sigma = several.results.frame().filter(like="sigma.").iloc[0].to_numpy()
    assert np.allclose(sigma, several.predicted)
    assert several.chi_square == pytest.approx(1.0, abs=4 * np.sqrt(2 / several.errors.size))
    covered = found.results.statistics.coverage(0.9)
    assert covered.mean() == pytest.approx(0.9, abs=0.03)


def test_trials_do_not_depend_on_the_batch_nor_on_their_number(scene):
    some = [montecarlo(scene, last, 1, n, batch).errors for n, batch in ((40, 7), (40, 40), (9, 4))]
    assert np.allclose(some[0], some[1], rtol=1e-9, atol=1e-13)
    assert np.allclose(some[2], some[0][:9], rtol=1e-9, atol=1e-13)


def test_estimators_reach_the_same_minimum(scene):
    quick, careful, blind = (
        montecarlo(scene, last, 2, 6, estimator=own)
        for own in (GaussNewton(), LevenbergMarquardt(), Spgd(max_evaluations=60_000, rtol=1e-5))
    )
    assert np.allclose(careful.errors, quick.errors, atol=1e-4 * quick.predicted)
    assert (quick.cost <= blind.cost * (1 + 1e-9)).all()
    assert (blind.cost < 1.02 * quick.cost).all()


def test_trials_that_do_not_converge_are_counted_and_kept(scene):
    found = montecarlo(scene, last, 2, 12, estimator=GaussNewton(most=1))
    assert found.failed.all() and found.results.failed == 12
    assert found.results.statistics.count == 0
    assert list(found.results.failures) == list(range(12))
    frame = found.results.frame()
    assert len(frame) == 12 and np.isfinite(frame["error.error[0]"]).all()


def test_truths_may_be_drawn_too(scene):
    """An estimate from a start that is off is as good as one from the truth."""
    spread = Spread.of(scene, 1e-3, 1e-2)
    truths = jax.vmap(lambda key: spread(key, scene.state).world_from_station)(
        jax.random.split(jax.random.key(0), 500)
    )
    off = np.asarray(truths - scene.state.world_from_station)
    assert (off[:, 0] == 0.0).all()
    assert off[:, 1:, :3].std() == pytest.approx(1e-3, rel=0.03)
    found = montecarlo(scene, last, 3, 400, truth=spread, estimator=LevenbergMarquardt())
    assert not found.failed.any()
    assert found.chi_square == pytest.approx(1.0, abs=0.15)


def test_priors_are_drawn_about_the_state_too(known):
    """What is known beforehand is an observation: its error counts in the predicted covariance."""
    from dataclasses import replace

    sigma = np.repeat([1e-3, 2e-2], 3)
    prior = Prior("stations.s3.pose", known.truth[3] + 7.0 * sigma, sigma)
    recording = replace(known.recording, model=replace(known.recording.model, priors=(prior,)))
    scene = build(recording)
    state = eqx.tree_at(lambda s: s.world_from_station, scene.state, jnp.asarray(known.truth))
    keys = jax.random.split(jax.random.key(0), 400)
    drawing = jax.jit(jax.vmap(lambda key: drawn(scene.network, state, key).priors.expected))
    expected = np.asarray(drawing(keys))
    off = (expected - known.truth[3]) / sigma
    assert np.abs(off.mean(axis=0)).max() < 4.0 / np.sqrt(400)
    assert np.abs(off.std(axis=0) - 1.0).max() < 4.0 / np.sqrt(800)


def test_hidden_physics_shows():
    """Measurements drawn from a world with a longer lens than the model believes."""
    description = parse_description('layout = "chain"\nstations = 4')
    made = simulate_network(description, noise=0.0)
    scene = build(made.recording)
    scene = scene.with_state(made.truth.state(scene))
    effect = Effect("longer", (Term("sensor.focal"),), amplitudes=(5e-4,))
    world = build(made.recording, (effect,))
    true = made.truth.state(world)
    world = world.with_state(eqx.tree_at(lambda s: s.amplitude, true, jnp.full(1, 5e-4)))
    key = jax.random.key(3)
    plain, frame = station_trials(scene, key, 200, 100)
    hidden, _ = station_trials(scene, key, 200, 100, world=world)
    assert list(frame.columns[:3]) == ["station", "epoch", "part"]
    assert len(frame) == 6 * 3
    assert plain.chi_square == pytest.approx(1.0, abs=0.15)
    assert hidden.chi_square > 1.5 * plain.chi_square
    # A longer lens brings everything nearer: the error is no noise.
    bias = np.abs(hidden.errors.mean(axis=0)) / (hidden.predicted / np.sqrt(200))
    assert bias.max() > 10.0


# --- other estimators ---------------------------------------------------------------------------


def test_poses_are_covered_as_foretold():
    """Each trial has a target and a sigma of its own."""
    grid = jnp.stack(jnp.meshgrid(jnp.linspace(-0.5, 0.5, 4), jnp.linspace(-0.5, 0.5, 4)), -1)
    points = jnp.concatenate([grid.reshape(-1, 2), 0.2 * jnp.sin(jnp.arange(16.0))[:, None]], 1)

    def setup(key):
        turn = 0.3 * jax.random.normal(key, (3,))
        pose = jnp.concatenate([turn, jnp.array([0.1, -0.2, 8.0])])
        return Setup(points, pose, jnp.asarray(2000.0), jnp.asarray(0.2))

    found = run(pose_study(setup), 1, 1500)
    assert found.failed == 0 and found.names[2:4] == ("shift[2]", "turn[0]")
    error = 4.0 * np.sqrt(0.1 * 0.9 / 1500)
    assert np.abs(found.statistics.coverage(0.9) - 0.9).max() < error


def test_single_precision_is_enough_for_poses():
    """Rounding a pixel of 2,000 by 1e-4 adds nothing to a noise of 0.2: errors are as foretold."""
    rng = np.random.default_rng(0)
    points = jnp.asarray(rng.uniform(-1.0, 1.0, (20, 3)))
    pose = jnp.array([0.3, 0.2, -0.1, 0.0, 0.0, 10.0])
    study = pose_study(Setup(points, pose, jnp.asarray(2000.0), jnp.asarray(0.2)))
    double, single = (run(own, 1, 1000) for own in (study, study.in_single_precision()))
    assert single.columns["error.shift[0]"].dtype == np.float32
    assert double.columns["error.shift[0]"].dtype == np.float64
    assert single.failed == 0 and single.about["study"]["precision"] == "float32"
    sigma = np.array([double.columns[f"sigma.{name}"][0] for name in double.names])
    own = np.array([single.columns[f"sigma.{name}"][0] for name in single.names])
    assert np.allclose(own, sigma, rtol=1e-3)
    for found in (double, single):
        assert np.abs(found.statistics.rms / sigma - 1.0).max() < 4.0 / np.sqrt(2 * 1000)


def test_single_precision_multiplies_all_its_digits():
    """Accelerators multiply float32 as TF32 unless told not to: 3 % of some chains failed."""
    told = []

    def trial(key):
        a = jax.random.normal(key, (3, 3))
        told.append(str(jax.make_jaxpr(jnp.matmul)(a, a)))
        return a @ a[0]

    study = Traced(trial)
    for one in (study, study.in_single_precision()):
        run(one, 0, 4)
    assert ["HIGHEST" in text for text in (told[0], told[-1])] == [False, True]


def test_scores_of_noise_are_chi_square(tmp_path):
    from networks import stereo_recording

    known = stereo_recording()
    fit = adjust(known.true_scene(known.recording))
    every = enumerate_hypotheses(fit.scene)
    one = next(f for f in every if f.n_terms * f.n_bases == 1)
    found = run(score_study(fit, (one,)), 0, 300, folder=tmp_path / "noise", batch=50)
    n = found.columns["hypothesis"].max() + 1
    drops = found.errors[:, 0]
    # The largest of n chi-squares that may depend on each other: no more than n independent ones,
    # no less than a single one.
    assert np.mean(drops) <= chi2.ppf(1.0 - 0.3 / n, 1) + 3.0
    assert np.mean(drops > chi2.isf(0.1, 1)) >= 0.1 - 3.0 * np.sqrt(0.09 / 300)
    other = next(f for f in every if f.n_terms * f.n_bases == 1 and f is not one)
    with pytest.raises(FileExistsError):
        run(score_study(fit, (other,)), 0, 301, folder=tmp_path / "noise")
    shape = (len(fit.scene.recording.observations.pixel), 2)
    with pytest.raises(ValueError, match="does not fit"):
        score_study(fit, (one,), np.zeros((shape[0] + 1, 2)))


def test_any_function_of_a_key_is_a_study(tmp_path):
    def trial(key):
        value = float(jax.random.normal(key))
        if value > 1.5:
            raise ArithmeticError("too large")
        return Trial({"x": np.array([value])}, sigma={"x": np.array([1.0])})

    found = run(OneByOne(trial, {"kind": "mine"}), 0, 200, folder=tmp_path / "mine")
    assert 0 < found.failed < 40
    assert (found.errors <= 1.5).all() and len(found.errors) == 200 - found.failed
    key = jax.random.key(0)
    for number in found.failures:
        assert float(jax.random.normal(jax.random.fold_in(key, int(number)))) > 1.5


def test_a_function_that_jax_traces_is_one_too():
    found = run(Traced(lambda key: jax.random.normal(key, (2,))), 0, 5000)
    assert found.names == ("error[0]", "error[1]")
    assert found.statistics.rms == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize(
    "found, said",
    [
        (Trial({"x": jnp.zeros(2)}, sigma={"y": jnp.zeros(2)}), 'sigmas of "y"'),
        (Trial({"x": jnp.zeros(2)}, noted={"cost": jnp.zeros(3)}), '"cost" of a trial is an array'),
    ],
)
def test_trials_that_do_not_fit_are_named(found, said):
    with pytest.raises(ValueError, match=said):
        run(Traced(lambda key: found), 0, 3)


# --- folders, stops, kills ----------------------------------------------------------------------


def test_a_stopped_run_goes_on(tmp_path, scene):
    whole = montecarlo(scene, last, 4, 60, 10)
    study = network_study(scene, last)
    asked = []
    part = run(
        study,
        4,
        60,
        folder=tmp_path,
        batch=10,
        stop=lambda: bool(asked.append(1)) or len(asked) == 2,
    )
    assert part.done == part.ran == 20 and not part.complete
    told = []
    rest = run(study, 4, 60, folder=tmp_path, batch=16, progress=told.append)
    assert rest.complete and rest.ran == 40 and rest.statistics.count == 60
    assert told[-1].done == 60 and told[0].done == 36 and told[-1].remaining == 0.0
    assert "60 of 60 trials" in str(told[-1])
    assert np.allclose(rest.errors, whole.errors, rtol=1e-9, atol=1e-13)
    assert np.allclose(rest.statistics.covariance, np.cov(whole.errors.T), rtol=1e-6)
    again = run(study, 4, 60, folder=tmp_path, batch=16)
    assert again.ran == 0 and again.statistics.count == 60
    fewer = run(study, 4, 30, folder=tmp_path)
    assert fewer.ran == 0 and fewer.statistics.count == len(fewer.errors) == 30
    said = fewer.summary()
    assert said.endswith(", of which failed 0; all of them were there already, none was run")


def test_an_interrupted_run_keeps_what_is_done(tmp_path, scene):
    def interrupt(progress):
        if progress.done >= 20:
            raise KeyboardInterrupt

    study = network_study(scene, last)
    part = run(study, 4, 60, folder=tmp_path, batch=10, progress=interrupt)
    assert part.done == 20
    assert pd.read_parquet(tmp_path / "trials-0000.parquet")["trial"].tolist() == list(range(20))


def test_a_folder_of_another_study_is_refused(tmp_path, scene):
    study = network_study(scene, last)
    run(study, 4, 5, folder=tmp_path / "own")
    with pytest.raises(FileExistsError, match="another study \\(another seed: 4, not 5\\)"):
        run(study, 5, 5, folder=tmp_path / "own")
    others = [{"noise": noise_by_name(name)} for name in ("student-t:5", "laplace")]
    for other in (*others, {"estimator": LevenbergMarquardt()}):
        with pytest.raises(FileExistsError, match=f"another study \\(another {min(other)}: "):
            run(network_study(scene, last, **other), 4, 5, folder=tmp_path / "own")
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "mine.txt").write_text("mine")
    with pytest.raises(FileExistsError, match="other files"):
        run(study, 4, 5, folder=tmp_path / "files")


def test_a_part_that_cannot_be_read_is_named(tmp_path, scene):
    study = network_study(scene, last)
    run(study, 4, 5, folder=tmp_path)
    (tmp_path / "trials-0000.parquet").write_bytes(b"PAR1")
    with pytest.raises(ValueError, match="trials-0000.parquet can't be read.*remove it"):
        run(study, 4, 5, folder=tmp_path)


def test_trials_go_to_one_file(tmp_path, scene):
    found = montecarlo(scene, last, 4, 6).results
    frame = pd.read_parquet(found.save(tmp_path / "all.parquet"))
    assert frame["error.error[5]"].to_numpy() == pytest.approx(found.errors[:, 5])
    told = json.loads(pq.read_schema(tmp_path / "all.parquet").metadata[b"study"])
    model = parse_model(tomllib.loads(told["study"]["model"]))
    assert [c.name for c in model.cameras] == [c.name for c in scene.model.cameras]
    assert {"jaxvm", "jax", "jaxlib", "equinox"} <= told["versions"].keys()
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with xarray.open_dataset(found.save(tmp_path / "all.nc"), engine="h5netcdf") as data:
        assert np.allclose(data["error_error"], found.errors)
        assert json.loads(data.attrs["study"]) == told
    with pytest.raises(ValueError, match="parquet or .nc"):
        found.save(tmp_path / "all.csv")
    assert "6 of 6, of which failed 0" in found.summary()


def test_fewer_than_one_trial_is_refused(scene):
    with pytest.raises(ValueError, match="at least one trial"):
        run(network_study(scene, last), 0, 0)


def test_the_size_of_batches_is_found_once(scene, monkeypatch):
    """The next run of a study begins with the size that was found, a short one does not."""
    sizes = importlib.import_module("jaxvm.montecarlo.run")._SIZES
    sizes.clear()
    study = network_study(scene, last)
    first = run(study, 1, 600)
    (asked,) = sizes
    assert sizes[asked] == first.batch
    sizes[asked] = 100
    told = []
    run(study, 1, 600, progress=told.append)
    assert {progress.batch for progress in told} == {100}
    assert run(study, 1, 50).batch == 50


def test_the_pace_grows_while_that_pays():
    pace, rate = Pace(None), {64: 100.0, 256: 300.0, 1024: 310.0}
    for _ in range(10):
        pace.note(pace.batch / rate[pace.batch], 0.0, 10**7)
    assert pace.batch == 256
    fixed = Pace(100, devices=8)
    assert fixed.batch == 104
    short = Pace(None)
    short.note(1.0, 0.9, 640)
    short.note(0.1, 0.0, 576)
    assert short.batch == 64 and short.found


def test_trials_with_many_numbers_begin_with_few():
    assert Pace(None, own_bytes=50_000).batch == 64
    assert Pace(None, own_bytes=4_000_000).batch == 4
    assert Pace(None, own_bytes=10**15).batch == 1
    assert Pace(100, own_bytes=4_000_000).batch == 100


def test_a_batch_on_an_accelerator_is_large_at_once(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert Pace(None, trials=100_000).batch == 4096
    assert Pace(None, trials=300).batch == 300


def test_a_killed_run_loses_nothing_that_was_written(tmp_path):
    killed = apart("trials", tmp_path / "trials", 400, 10, 0.4)
    deadline = time.monotonic() + 120.0
    while not list((tmp_path / "trials").glob("trials-0001.parquet")):
        assert killed.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    there = pd.concat(map(pd.read_parquet, sorted((tmp_path / "trials").glob("*.parquet"))))
    assert there["trial"].is_unique and 0 < len(there) < 400
    _, ran, good, *rms = answer(apart("trials", tmp_path / "trials", 400, 100, 0))
    assert int(ran) == 400 - len(there) and int(good) == 400
    frame = pd.concat(map(pd.read_parquet, sorted((tmp_path / "trials").glob("*.parquet"))))
    assert sorted(frame["trial"]) == list(range(400))
    errors = frame.filter(like="error.").to_numpy()
    assert np.allclose(np.sqrt(np.mean(errors**2, axis=0)), np.array(rms, float))


def test_eight_devices_and_two_processes_give_the_numbers_of_one(tmp_path):
    """Shared out over devices with JAX's own mesh, and over processes on loopback."""
    two = together("trials", tmp_path / "two", 50, 20, 0)[-1]
    one = answer(apart("trials", tmp_path / "one", 50, 50, 0))
    many = answer(apart("trials", tmp_path / "eight", 50, 16, 0, XLA_FLAGS=EIGHT))
    assert [one[0], many[0], two[0]] == ["1", "8", "2"]
    frames = [
        pd.concat(map(pd.read_parquet, (tmp_path / name).glob("*.parquet"))).sort_values("trial")
        for name in ("one", "eight", "two")
    ]
    for frame in frames:
        assert len(frame) == 50 and frame["converged"].all()
        assert np.allclose(
            frame.filter(like="error."), frames[0].filter(like="error."), rtol=1e-9, atol=1e-13
        )
