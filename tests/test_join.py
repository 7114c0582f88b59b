"""Joined recordings: nothing is lost, clocks and sessions go on, shared unknowns are shared."""

from dataclasses import replace

import numpy as np
import pytest
from networks import Known, at_values, stereo_recording

from jaxvm.discover.courses import enumerate_courses, longest_session
from jaxvm.network.scene import build
from jaxvm.physics.drivers import SESSION, build_channels
from jaxvm.recording import (
    Drivers,
    RecordingError,
    Target,
    join,
    model_text,
    read_model,
    read_recording,
    write_recording,
)
from jaxvm.recording.join import PAUSE_S
from jaxvm.solve.adjust import adjust

N = 6
"""Epochs of each recording."""


def equipped(known: Known, begins: float = 0.0, powered_on: tuple[float, ...] = (-400.0,)):
    """The recording with drivers, a velocity and a camera that was switched on."""
    time = begins + known.recording.time
    model = known.recording.model
    left = replace(model.cameras[0], powered_on_s=powered_on)
    drivers = Drivers(
        np.linspace(time[0] - 5.0, time[-1] + 5.0, 9),
        {"body_degC": 20.0 + np.arange(9.0), "ambient_degC": np.full(9, 20.0)},
    )
    return replace(
        known.recording,
        time=time,
        drivers=drivers,
        model=replace(model, cameras=(left, *model.cameras[1:])),
        velocities={"plate": np.arange(6.0 * N).reshape(N, 6)},
    )


@pytest.fixture(scope="module")
def pair():
    """Two recordings of the same bodies with other noise, on one clock that starts at zero."""
    return stereo_recording(seed=0), stereo_recording(seed=1)


def test_all_that_was_measured_is_there(pair):
    first, second = (equipped(known) for known in pair)
    both = join(first, second)
    assert len(both.time) == 2 * N and both.starts == (0, N)
    assert len(set(both.epoch_ids)) == 2 * N
    for part, columns in (
        ("observations", ("camera", "target", "point", "pixel", "sigma")),
        ("ranges", ("rangefinder", "target", "point", "distance", "sigma")),
    ):
        one, two, all_ = (getattr(r, part) for r in (first, second, both))
        n = len(one.epoch)
        assert len(all_.epoch) == n + len(two.epoch)
        assert np.array_equal(all_.epoch[:n], one.epoch)
        assert np.array_equal(all_.epoch[n:], two.epoch + N)
        for column in columns:
            expected = np.concatenate([getattr(one, column), getattr(two, column)])
            assert np.array_equal(getattr(all_, column), expected), (part, column)
    assert np.array_equal(both.velocities["plate"][N:], second.velocities["plate"])
    assert both.drivers is not None and len(both.drivers.time) == 18
    assert (np.diff(both.drivers.time) > 0).all()


def test_a_later_clock_is_kept(pair):
    first, second = equipped(pair[0]), equipped(pair[1], 5000.0, (4900.0,))
    both = join(first, second)
    assert np.array_equal(both.time, np.concatenate([first.time, second.time]))
    assert both.model.cameras[0].powered_on_s == (-400.0, 4900.0)


def test_an_overlapping_clock_follows_after_a_pause(pair):
    first, second = (equipped(known) for known in pair)
    both = join(first, second)
    assert (np.diff(both.time) > 0).all()
    assert first.drivers is not None and second.drivers is not None and both.drivers is not None
    # The pause is from the last sample of the one to the first sample of the other.
    assert both.drivers.time[9] - both.drivers.time[8] == pytest.approx(PAUSE_S)
    later = both.time[N] - second.time[0]
    np.testing.assert_allclose(both.time[N:], second.time + later, rtol=1e-15)
    np.testing.assert_allclose(both.drivers.time[9:], second.drivers.time + later, rtol=1e-15)
    assert both.model.cameras[0].powered_on_s == (-400.0, -400.0 + later)


def test_only_drivers_and_velocities_of_both_go_on(pair):
    first, second = (equipped(known) for known in pair)
    assert second.drivers is not None
    poorer = replace(
        second,
        velocities={},
        drivers=replace(second.drivers, channels={"body_degC": np.zeros(9)}),
    )
    both = join(first, poorer)
    assert both.drivers is not None and set(both.drivers.channels) == {"body_degC"}
    assert np.array_equal(both.velocities["plate"][N:], np.zeros((N, 6)))
    assert join(first, replace(second, drivers=None)).drivers is None


def test_three_recordings_make_three_sessions(pair):
    first, second = (equipped(known) for known in pair)
    assert join(join(first, second), first).starts == (0, N, 2 * N)
    mask = np.arange(2 * N) >= 2
    assert join(first, second).select_epochs(mask).starts == (0, N - 2)


def channel(scene, name: str) -> np.ndarray:
    """A channel read at the epochs."""
    channels = scene.network.channels
    row = channels.values[channels.index(name)]
    return np.interp(channels.epoch_time, channels.time, row)


def test_clocks_of_sessions_and_of_power_restart(pair):
    """At the samples of the drivers, and at the epochs, which are on the grid."""
    first, second = (equipped(known) for known in pair)
    scene = build(join(first, second))
    channels = scene.network.channels
    samples = np.asarray(channels.time)
    session = np.asarray(channels.values[channels.index("time since the session's start")])
    power = np.asarray(channels.values[channels.index("time since power-on of left")])
    assert channels.kinds[channels.index("time since the session's start")] == "time"
    # Drivers begin 5 s before the first epoch. Before its first epoch the second session has not
    # begun; by then it is switched on.
    own = samples <= first.drivers.time[-1]
    np.testing.assert_allclose(session[own], samples[own] - first.time[0], atol=1e-6)
    begun = samples >= scene.recording.time[N]
    np.testing.assert_allclose(
        session[begun], samples[begun] - scene.recording.time[N], rtol=1e-9, atol=1e-6
    )
    np.testing.assert_allclose(power[own], samples[own] + 400.0, rtol=1e-12)
    np.testing.assert_allclose(power[~own], power[own], atol=1e-5)
    # Only one session: no such channel.
    assert "time since the session's start" not in build(first).network.channels.names


def test_epochs_read_the_time_since_their_own_session(pair):
    """Also where the clock restarts between two samples of the drivers."""
    first, second = (equipped(known) for known in pair)
    scene = build(join(first, second))
    expected = np.concatenate([first.time, second.time])
    np.testing.assert_allclose(
        channel(scene, "time since the session's start"), expected, atol=1e-6
    )


@pytest.mark.parametrize("beyond", [-3e-7, 0.0, 3e-7])
def test_a_session_begins_with_its_first_epoch_whatever_the_clocks_last_digits(beyond):
    """The grid of the channels is round, the clock need not be."""
    pause, spacing = 86_400.0, 30.0
    own = spacing * np.arange(5)
    start = own[-1] + pause + beyond
    time = np.concatenate([own, start + own])
    channels = build_channels(time, {}, None, {"left": (0.0, start)}, starts=time[[0, 5]])
    for name in (SESSION, "time since power-on of left"):
        row = channels.values[channels.index(name)]
        read = np.interp(channels.epoch_time, channels.time, row)
        np.testing.assert_allclose(read, np.concatenate([own, own]), atol=2e-3)
    assert longest_session(channels) == pytest.approx(own[-1], abs=2e-3)


def test_time_since_power_on_restarts_at_each_moment():
    time = np.arange(0.0, 1000.0, 50.0)
    moments = (-100.0, 300.0, 620.0)
    channels = build_channels(time, {}, None, {"left": moments, "right": (200.0,)})
    left, right = (
        np.asarray(channels.values[channels.index(f"time since power-on of {name}")])
        for name in ("left", "right")
    )
    expected = [t - max(m for m in moments if m <= t) for t in time]
    np.testing.assert_allclose(left, expected, rtol=1e-14)
    # A camera that is not yet on counts backwards.
    np.testing.assert_allclose(right, time - 200.0, rtol=1e-14)


def test_moments_are_written_and_read_again(pair, tmp_path):
    for k, moments in enumerate([(-400.0,), (-400.0, 10.0, 2e5)]):
        recording = equipped(pair[0], powered_on=moments)
        again = read_recording(write_recording(recording, tmp_path / str(k)))
        assert again.model.cameras[0].powered_on_s == moments
        assert again.model.cameras[1].powered_on_s == ()
        assert model_text(again.model) == model_text(recording.model)


@pytest.mark.parametrize(
    "moments", ["[10.0, -400.0]", "[10.0, 10.0]", '[10.0, "noon"]', "[1.0, nan]", "true"]
)
def test_moments_that_do_not_increase_are_refused(pair, tmp_path, moments):
    folder = write_recording(equipped(pair[0]), tmp_path / "r")
    path = folder / "recording.toml"
    text = path.read_text()
    assert "powered_on_s = -400.0" in text
    path.write_text(text.replace("powered_on_s = -400.0", f"powered_on_s = {moments}"))
    with pytest.raises(
        RecordingError, match=r"cameras\.left\.powered_on_s .*a number, or a list of increasing"
    ):
        read_model(path)


def test_the_same_moment_twice_is_one_moment(pair, tmp_path):
    """One power-on that both recordings name, on one clock, stays one."""
    first, second = equipped(pair[0]), equipped(pair[1], 5000.0)
    both = join(first, second)
    again = read_recording(write_recording(both, tmp_path / "both"))
    assert again.model.cameras[0].powered_on_s == (-400.0,)


def test_other_bodies_are_refused_by_name(pair):
    first, second = (known.recording for known in pair)
    model = second.model
    other = replace(model.cameras[1], name="middle")
    with pytest.raises(ValueError, match="its cameras are left, middle, not left, right; .*same"):
        join(first, replace(second, model=replace(model, cameras=(model.cameras[0], other))))
    with pytest.raises(ValueError, match="its rangefinders are none, not lidar"):
        join(first, replace(second, model=replace(model, rangefinders=())))
    reference, plate = model.targets
    fewer = Target("plate", plate.point_names[:-1], plate.points[:-1], "per-epoch", None)
    with pytest.raises(ValueError, match='"plate" has other points'):
        join(first, replace(second, model=replace(model, targets=(reference, fewer))))


def test_shared_unknowns_cost_something(pair):
    """Apart, every recording has its own cameras: the joint cost is at least the sum.

    Under the true model the increase is chi-square with as many degrees of freedom as unknowns
    are shared.
    """
    apart = [adjust(known.true_scene()) for known in pair]
    both = join(pair[0].recording, pair[1].recording)
    truth = pair[0].truth
    reference, moving = truth["carrier_from_target"][:1], truth["carrier_from_target"][1:]
    targets = np.concatenate([reference, moving, pair[1].truth["carrier_from_target"][1:]])
    scene = at_values(build(both), truth | {"carrier_from_target": targets})
    together = adjust(scene)
    assert together.converged, together.why
    shared = scene.unknowns.n_shared
    assert together.degrees_of_freedom == sum(a.degrees_of_freedom for a in apart) + shared
    increase = 2.0 * (together.cost - sum(a.cost for a in apart))
    assert 0.0 < increase < shared + 4.0 * np.sqrt(2.0 * shared)
    assert together.variance_factor == pytest.approx(1.0, abs=0.15)


def test_courses_are_asked_on_the_scale_of_a_session(pair):
    """Not of the pause between; and what is centred counts from the mean of the first recording."""
    first, second = (equipped(known) for known in pair)
    warmer = {name: values + 10.0 for name, values in second.drivers.channels.items()}
    second = replace(second, drivers=replace(second.drivers, channels=warmer))
    alone, both = (enumerate_courses(build(r)) for r in (first, join(first, second)))

    def asked(courses, form: str):
        return [(c.constants, c.reference) for c in courses
                if (c.driver, c.form) == ("body_degC", form)]  # fmt: skip

    for form in ("lag", "linear", "two lags"):
        (taus, references), (expected, reference) = (
            zip(*asked(courses, form), strict=True) for courses in (both, alone)
        )
        np.testing.assert_allclose(taus, expected, rtol=1e-9)
        np.testing.assert_allclose(references, reference, rtol=1e-9)
    periods = {c.constants[0] for c in both if c.driver == "time" and c.form == "periodic"}
    assert max(periods) <= first.time[-1] - first.time[0] + 1e-9
    ramps = [c.constants[0] for c in both if c.driver == SESSION and c.form == "ramp"]
    assert ramps and max(ramps) <= first.time[-1] - first.time[0]
