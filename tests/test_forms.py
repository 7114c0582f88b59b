"""Forms of effects against analytic responses, and tables of effects against sums by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import BSpline

from jaxvm.physics.drivers import build_channels
from jaxvm.physics.effects import Effect, Scope, Term, capacity, courses, tabulate
from jaxvm.physics.forms import (
    BASES,
    BASIS_INDEX,
    FORMS,
    N_KNOTS,
    bump,
    delayed,
    evaluate_basis,
    first_order_lag,
    play,
    rate,
)
from jaxvm.physics.ports import N_PORTS, PORT_INDEX

lag = jax.jit(first_order_lag)
pick = jax.jit(evaluate_basis)


def irregular_times(n=400, end=7200.0, seed=0):
    """Samples with gaps between 0.01 and 10 times the usual one."""
    gaps = np.random.default_rng(seed).lognormal(0.0, 1.0, n)
    return np.concatenate([[0.0], np.cumsum(gaps) / np.sum(gaps) * end])


# --- lag ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tau", [0.5, 300.0, 5e5])
def test_lag_of_a_ramp(tau):
    """x = s t from equilibrium at 0: y = s (t - tau (1 - exp(-t/tau))), whatever the sampling."""
    t = irregular_times()
    expected = 2e-3 * (t + tau * np.expm1(-t / tau))
    # For t << tau the formula itself loses digits.
    atol = 1e-13 * 2e-3 * max(tau, 7200.0)
    np.testing.assert_allclose(lag(5.0 + 2e-3 * t, t, tau), 5.0 + expected, rtol=1e-13, atol=atol)


def test_lag_of_a_step():
    """A jump at t = 1000 s within 1 ms, then 1 - exp(-(t - 1000)/tau)."""
    t = np.sort(np.concatenate([irregular_times(), [1000.0, 1000.001]]))
    x = np.where(t > 1000.0005, 3.0, 1.0)
    since = np.maximum(t - 1000.0005, 0.0)
    expected = 1.0 - 2.0 * np.expm1(-since / 600.0)
    # The jump's shape matters to the second order of 1 ms / 600 s, while it lasts to the first.
    np.testing.assert_allclose(lag(x, t, 600.0), expected, atol=2e-6)


def test_lag_of_a_broken_line_equals_numerical_integration():
    """Exact for a driver that is linear between samples: solve_ivp from sample to sample."""
    t = irregular_times(30)
    x = np.random.default_rng(1).normal(size=len(t))
    y = [x[0]]
    for k in range(len(t) - 1):
        dt = t[k + 1] - t[k]
        run = solve_ivp(
            lambda s, y, k=k, dt=dt: (x[k] + (x[k + 1] - x[k]) * s / dt - y) / 500.0,
            (0.0, dt),
            y[-1:],
            rtol=1e-11,
            atol=1e-13,
        )
        y.append(run.y[0, -1])
    np.testing.assert_allclose(lag(x, t, 500.0), y, atol=1e-9)


def test_lag_of_a_smooth_driver_equals_numerical_integration():
    """A day's swing, sampled irregularly; what is left is the chord under the curve."""

    def driver(t):
        return 20.0 + 4.0 * np.sin(2 * np.pi * t / 7200.0) + np.cos(2 * np.pi * t / 2500.0)

    t = irregular_times(1500)
    tau = 900.0
    run = solve_ivp(
        lambda s, y: (driver(s) - y) / tau, (0.0, t[-1]), [21.0], t_eval=t, rtol=1e-10, atol=1e-11
    )
    gap = np.max(np.diff(t))
    chord = gap**2 / 8.0 * (4.0 * (2 * np.pi / 7200.0) ** 2 + (2 * np.pi / 2500.0) ** 2)
    error = np.abs(np.asarray(lag(driver(t), t, tau)) - run.y[0])
    assert error.max() < chord
    assert error.max() < 2e-4


def test_lag_keeps_a_constant_and_is_linear():
    t = irregular_times(50)
    np.testing.assert_allclose(lag(np.full(51, 7.0), t, 100.0), 7.0, rtol=1e-14)
    a, b = np.random.default_rng(2).normal(size=(2, 51))
    both = lag(2.0 * a - b, t, 100.0)
    np.testing.assert_allclose(both, 2.0 * lag(a, t, 100.0) - lag(b, t, 100.0), atol=1e-13)


def test_lag_between_following_at_once_and_standing_still():
    t = irregular_times(50)
    x = np.random.default_rng(3).normal(size=51)
    np.testing.assert_allclose(lag(x, t, 1e-6), x, atol=1e-4)
    np.testing.assert_allclose(lag(x, t, 1e12), x[0], atol=1e-7)


def test_derivative_of_lag_in_its_time_constant():
    t = irregular_times(50)
    x = np.random.default_rng(4).normal(size=51)
    slope = jax.jit(jax.jacfwd(first_order_lag, argnums=2))(x, t, 500.0)
    difference = (lag(x, t, 500.05) - lag(x, t, 499.95)) / 0.1
    np.testing.assert_allclose(slope, difference, atol=1e-9)


# --- play -----------------------------------------------------------------------------------------


def triangle(amplitude, cycles, n=200):
    """0 -> A -> -A -> 0, several times, n samples to a quarter."""
    quarter = np.linspace(0.0, amplitude, n + 1)[1:]
    cycle = np.concatenate([quarter, amplitude - quarter, -quarter, quarter - amplitude])
    return np.concatenate([[0.0], np.tile(cycle, cycles)])


@pytest.mark.parametrize(("amplitude", "r"), [(1.0, 0.3), (5.0, 2.0), (2.0, 0.05)])
def test_area_of_the_hysteresis_loop(amplitude, r):
    """A parallelogram of height 2 (A - r) and width 2 r: area 4 r (A - r) in each cycle."""
    n = 200
    x = triangle(amplitude, 3, n)
    y = np.asarray(jax.jit(play)(x, r))
    last = slice(len(x) - 4 * n - 1, None)  # the first cycle begins in the middle of the travel
    x, y = x[last], y[last]
    # Work per cycle, the integral of x dy, by the trapezium rule; the corners need not be samples,
    # which costs at most half a sample's step times r.
    area = abs(np.sum(0.5 * (x[1:] + x[:-1]) * np.diff(y)))
    assert area == pytest.approx(4 * r * (amplitude - r), rel=2.0 / n)
    assert y.max() == pytest.approx(amplitude - r)
    assert y.min() == pytest.approx(r - amplitude)


def test_play_within_its_travel_does_not_move():
    x = 4.0 + np.concatenate([[0.0], np.random.default_rng(5).uniform(-0.99, 0.99, 99)])
    assert np.all(play(x, 1.0) == 4.0)
    assert np.array_equal(play(x, 0.0), x)


def test_play_depends_on_the_order_and_not_on_the_rate():
    x = triangle(2.0, 1, 50)
    held = np.repeat(x, 3)
    np.testing.assert_array_equal(np.asarray(play(held, 0.5))[::3], play(x, 0.5))


@pytest.mark.parametrize("earlier", [-6.0, 6.0])
def test_first_contact_is_what_was_before_the_recording(earlier):
    """The contact that an earlier course has led to the end of its travel stays there."""
    rng = np.random.default_rng(6)
    x = np.concatenate([np.linspace(earlier, 0.0, 40), np.cumsum(rng.normal(size=200))])
    whole = np.asarray(play(x, 1.5))[40:]
    first = 0.0 if earlier < 0.0 else 2.0  # x was rising, or falling
    start = np.concatenate([[0.0], x[40:]])
    np.testing.assert_allclose(play(start, 1.5, first)[1:], whole, atol=1e-12)
    assert np.abs(np.asarray(play(start, 1.5))[1:] - whole).max() > 0.3


def test_no_refit_moves_a_first_contact():
    slope = jax.jacfwd(play, argnums=2)(triangle(2.0, 1, 20), 0.5, 0.3)
    assert not np.any(slope)


# --- dead time ------------------------------------------------------------------------------------


def test_dead_time_shifts_a_course():
    t = irregular_times(300)
    dead = 700.0

    def signal(s):
        return 3e-4 * s + 1.0

    expected = np.where(t >= t[0] + dead, signal(t - dead), signal(t[0]))
    np.testing.assert_allclose(delayed(signal(t), t, dead), expected, rtol=1e-12)
    slope = jax.jacfwd(delayed, argnums=2)(signal(t), t, dead)
    np.testing.assert_allclose(slope[t > t[0] + dead], -3e-4, rtol=1e-9)


# --- memoryless bases -----------------------------------------------------------------------------


def test_rate_is_per_hour():
    t = irregular_times(100)
    np.testing.assert_allclose(rate(20.0 + t / 1800.0, t), 2.0, rtol=1e-9)
    # Second order on a parabola with irregular samples, except at the two ends.
    curved = rate((t / 3600.0) ** 2, t)
    np.testing.assert_allclose(curved[1:-1], 2 * t[1:-1] / 3600.0, rtol=1e-9)


def test_bumps_sum_to_one_and_so_do_their_moments():
    """Cubic B-splines on a regular grid: a partition of unity that also reproduces x."""
    x = np.linspace(-1.0, 1.0, 101)
    width = 0.25
    centres = np.arange(-8, 9) * width
    rows = np.asarray(jax.vmap(lambda c: bump(x, c, width))(centres))
    np.testing.assert_allclose(rows.sum(axis=0), 1.0, rtol=1e-14)
    np.testing.assert_allclose(centres @ rows, x, atol=1e-14)
    assert np.all(rows >= 0.0)
    np.testing.assert_allclose(
        bump(np.array([0.0, 0.25, 0.5, 9.0]), 0.0, 0.25), [2 / 3, 1 / 6, 0, 0]
    )


def spline_about(centre, spacing, x):
    """The cubic B-spline of a regular grid, by SciPy."""
    knots = centre + spacing * np.arange(-2, 3)
    return np.nan_to_num(BSpline.basis_element(knots, extrapolate=False)(x))


X = np.array([-3.0, -0.5, 0.0, 0.7, 2.0, 4.0])
T = np.array([0.0, 600.0, 1800.0, 2400.0, 3600.0, 7200.0])


def lagged_by_hand(x, t, tau):
    """tau y' + y = x with x straight between its samples: x - m tau, and a rest that dies away."""
    y = [x[0]]
    for dt, start, slope in zip(np.diff(t), x, np.diff(x) / np.diff(t), strict=False):
        rest = (y[-1] - start + slope * tau) * np.exp(-dt / tau)
        y.append(start + slope * dt - slope * tau + rest)
    return np.array(y)


EXPECTED = {  # with the constants 2 and 0.5, written without the package
    "one": np.ones(6),
    "late onset": np.where(X > 2.0, 1.0 - np.exp(-(X - 2.0) / 0.5), 0.0),
    "linear": X,
    "square": X * X,
    "cube": X * X * X,
    "fourth": X**2 * X**2,
    "sixth": X**3 * X**3,
    "onset": np.where(X > 0, 1 - np.exp(-X / 2), 0.0),
    "log": np.where(X > 0, np.log(1 + np.abs(X) / 2), 0.0),
    "step": np.array([0, 0, 0, 0, 1, 1.0]),  # from the instant itself on
    "ramp": np.array([0, 0, 0, 0, 0, 2.0]),
    "sine": np.sin(np.pi * X),
    "cosine": np.cos(np.pi * X),
    "direction": np.tanh(np.gradient(lagged_by_hand(X, T, 0.5), T / 3600.0) / 2.0),
    "doubling": 2.0 ** (X / 2.0),
    "turned": lagged_by_hand(X, T, 0.5) * np.cos(np.pi * T),
    "turned aside": lagged_by_hand(X, T, 0.5) * np.sin(np.pi * T),
    "aged": X * np.array([0, 1 / 6, 1 / 2, 2 / 3, 1, 2]),  # hours
    "first state": np.exp(-(T - T[0]) / 2),
    "decay": np.exp(-np.maximum(X, 0.0) / 2),
    "staircase": np.array([-3, -1, 1, 1, 1, 5]),  # steps of 2, half a step off zero
    "rate": np.gradient(X, T / 3600.0),
    "play": np.array([-4, -2.5, -2, -1.3, 0, 2]) - X,  # half way to the lower end at first
    "delayed": np.concatenate([X[:1], X[1:] - 2.0 * np.diff(X) / np.diff(T)]),
    "bump": np.array([0, 0, 0, 0, 2 / 3, 0]),  # about 2, knots 0.5 apart
    **{f"knot {k}": spline_about(2.0 + 0.5 * k, 0.5, X) for k in range(max(N_KNOTS.values()))},
}


@pytest.mark.parametrize("name", EXPECTED)
def test_basis_by_hand(name):
    constants = jnp.array([2.0, 0.5])
    got = BASES[name](jnp.asarray(X), jnp.asarray(T), constants)
    np.testing.assert_allclose(got, EXPECTED[name], rtol=1e-13, atol=1e-14)


def test_two_lags_read_their_own_constants():
    constants = jnp.array([800.0, 4000.0])
    ahead = BASES["transient"](X, T, constants)
    np.testing.assert_allclose(ahead, X - lag(X, T, 800.0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(BASES["lag"](X, T, constants), lag(X, T, 800.0), rtol=1e-13)


def test_a_lag_that_began_earlier_is_a_lag_with_a_state_of_its_own():
    rng = np.random.default_rng(8)
    time = np.cumsum(rng.uniform(5.0, 60.0, 400))
    driver = np.cumsum(rng.normal(size=400))
    constants = jnp.array([700.0, 1.0])
    whole = lag(driver, time, 700.0)[150:]
    later = BASES["lag"](jnp.asarray(driver[150:]), jnp.asarray(time[150:]), constants)
    state = BASES["first state"](jnp.asarray(driver[150:]), jnp.asarray(time[150:]), constants)
    expected = later + (whole[0] - driver[150]) * state
    assert abs(whole[0] - driver[150]) > 1.0
    np.testing.assert_allclose(whole, expected, rtol=0, atol=1e-10)


def test_every_basis_is_checked_here():
    assert set(EXPECTED) | {"lag", "transient"} == set(BASES)


@pytest.mark.parametrize("name", BASES)
def test_picking_by_number_is_calling_by_name(name):
    x = np.random.default_rng(6).normal(size=41)
    t = irregular_times(40)
    constants = jnp.array([1.7, 0.6])
    np.testing.assert_allclose(
        pick(BASIS_INDEX[name], x, t, constants),
        jax.jit(BASES[name])(x, t, constants),
        rtol=1e-12,
        atol=1e-13,
    )


slope_in_constants = jax.jit(
    jax.jacrev(lambda c, basis, x, t: jnp.sum(evaluate_basis(basis, x, t, c) * jnp.cos(x)))
)


@pytest.mark.parametrize(
    ("name", "constants"),
    [
        ("lag", (300.0, 1.0)),
        ("onset", (900.0, 1.0)),
        ("log", (900.0, 1.0)),
        ("sine", (2000.0, 1.0)),
        ("ramp", (1000.0, 1.0)),
        # A ramp may start with the recording, or before it: the other bases, which are computed
        # along with it and thrown away, must not poison its derivative by dividing by this.
        ("ramp", (0.0, 1.0)),
        ("ramp", (-5.0, 1.0)),
    ],
)
def test_derivative_in_the_constants_is_that_of_the_picked_basis(name, constants):
    t = np.linspace(1.0, 7200.0, 50)  # no sample on a kink
    x = t if name in ("onset", "log", "sine", "ramp") else np.sin(t / 1000.0)
    got = slope_in_constants(jnp.array(constants), BASIS_INDEX[name], x, t)
    ends = []
    for step in (1e-3, -1e-3):
        at = [jnp.asarray(constants) + step * e for e in np.eye(2)]
        ends.append([np.sum(BASES[name](x, t, c) * np.cos(x)) for c in at])
    expected = (np.array(ends[0]) - ends[1]) / 2e-3
    assert np.all(np.isfinite(got)), got
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-7)


# --- tables of effects ----------------------------------------------------------------------------

GRID = irregular_times(60, 7000.0, seed=7)
EPOCHS = np.linspace(100.0, 6900.0, 23)
CELSIUS = 20.0 + 3.0 * np.sin(GRID / 1500.0)
WIND = np.random.default_rng(8).normal(size=len(GRID))
CHANNELS = build_channels(
    EPOCHS, {"body": CELSIUS, "wind": WIND}, GRID, power_on={"left": (-400.0,)}
)

WARMING = Effect(
    name="body warms",
    terms=(Term("sensor.focal"), Term("sensor.cx", weight=-2.0)),
    driver="body",
    form="lag",
    constants=(700.0,),
    reference=20.5,
    amplitudes=(1e-4, 0.3),
)
SWAYING = Effect(
    name="mast sways",
    terms=(Term("station.turn_x"), Term("sensor.focal")),
    driver="wind",
    form="quadratic",
    reference=0.1,
    amplitudes=(1.0, 2.0, 3.0, 4.0),
)
SETTLING = Effect(
    name="settles",
    terms=(Term("structure.shift_y"),),
    driver="time since power-on of left",
    form="onset",
    constants=(1500.0,),
    amplitudes=(0.02,),
)


all_courses = jax.jit(lambda table, constants: courses(table, constants, CHANNELS))


def port_courses(*effects, columns=8, constants=4):
    """Port values at the epochs that a table of these effects gives, with all patterns one."""
    table, amplitudes, own = tabulate(effects, CHANNELS, columns, constants)
    on = np.asarray(all_courses(table, own))
    assert on.shape == (columns, len(EPOCHS))
    return np.asarray(table.ports).T @ (amplitudes[:, None] * on)


def test_channels_of_a_recording():
    assert CHANNELS.names == ("constant", "body", "wind", "time", "time since power-on of left")
    assert CHANNELS.kinds == ("constant", "quantity", "quantity", "time", "power-on")
    at = np.array([np.interp(EPOCHS, CHANNELS.time, course) for course in CHANNELS.values])
    np.testing.assert_allclose(at[0], 1.0)
    np.testing.assert_allclose(at[1], np.interp(EPOCHS, GRID, CELSIUS), rtol=1e-14)
    np.testing.assert_allclose(at[3], EPOCHS - EPOCHS[0], atol=1e-11)  # from the first epoch
    np.testing.assert_allclose(at[4], EPOCHS + 400.0, rtol=1e-13)
    with pytest.raises(KeyError, match="no driver .humidity.*body, wind, time"):
        CHANNELS.index("humidity")


def test_course_of_an_effect_by_hand():
    """amplitude x weight x lag of the centred channel, on its own port, and on no other."""
    got = port_courses(WARMING)
    # Exact for a driver that is linear between samples: in the epochs, too.
    at = np.unique(np.concatenate([GRID, EPOCHS]))
    follow = np.asarray(lag(np.interp(at, GRID, CELSIUS) - 20.5, at, 700.0))
    follow = follow[np.searchsorted(at, EPOCHS)]
    expected = np.zeros((N_PORTS, len(EPOCHS)))
    expected[PORT_INDEX["sensor.focal"]] = 1e-4 * follow
    expected[PORT_INDEX["sensor.cx"]] = 0.3 * -2.0 * follow
    np.testing.assert_allclose(got, expected, rtol=1e-7, atol=1e-12)


def test_amplitudes_are_ordered_term_by_term():
    """(1, 2) are the first term's linear and square amplitudes, (3, 4) the second's."""
    got = port_courses(SWAYING)
    x = np.interp(EPOCHS, GRID, WIND) - 0.1
    for port, linear, square in (("station.turn_x", 1.0, 2.0), ("sensor.focal", 3.0, 4.0)):
        np.testing.assert_allclose(got[PORT_INDEX[port]], linear * x + square * x**2, atol=1e-6)
    assert SWAYING.n_columns == 4


def test_a_form_that_is_not_centred_ignores_the_reference():
    moved = Effect(**{**SETTLING.__dict__, "reference": 500.0})
    assert np.array_equal(port_courses(moved), port_courses(SETTLING))
    expected = -0.02 * np.expm1(-(EPOCHS + 400.0) / 1500.0)
    # The course is curved between the samples of the log: the epochs are samples, too.
    got = port_courses(SETTLING)[PORT_INDEX["structure.shift_y"]]
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_an_epoch_between_two_samples_of_a_log_is_on_one_side_of_a_step():
    """Whatever else is logged, and however seldom."""
    before, after = EPOCHS[11] - 1.0, EPOCHS[11] + 1.0
    for instant, share in ((before, 1.0), (after, 0.0)):
        channels = build_channels(EPOCHS, {"body": CELSIUS[::20]}, GRID[::20], power_on={})
        terms = (Term("structure.shift_y"),)
        step = Effect("it slips", terms, "time", "step", (instant - EPOCHS[0],), amplitudes=(1.0,))
        table, _, own = tabulate((step,), channels, 4, 4)
        course = np.asarray(courses(table, jnp.asarray(own), channels))[0]
        np.testing.assert_allclose(course[11], share, atol=1e-12)
        np.testing.assert_array_equal(np.unique(course.round(12)), [0.0, 1.0])


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_effects_in_one_table_give_the_sum_of_their_own_courses(order):
    """Also where two feed the same port, and each finds its own constants and amplitudes."""
    effects = [(WARMING, SWAYING, SETTLING)[k] for k in order]
    together = port_courses(*effects)
    alone = sum(port_courses(effect) for effect in effects)
    np.testing.assert_allclose(together, alone, rtol=1e-13, atol=1e-17)


def test_two_equal_effects_count_twice():
    """Equal in all numbers, as two records; the amplitudes of each are found."""
    again = Effect(**WARMING.__dict__)
    np.testing.assert_allclose(
        port_courses(WARMING, again), 2.0 * port_courses(WARMING), rtol=1e-13
    )


def test_the_same_effect_listed_twice_counts_twice():
    got = port_courses(WARMING, WARMING)
    np.testing.assert_allclose(got, 2.0 * port_courses(WARMING), rtol=1e-13)


def test_unused_columns_feed_nothing():
    table, amplitudes, constants = tabulate((SETTLING,), CHANNELS, 8, 4)
    assert table.n_columns == 8
    assert not np.any(np.asarray(table.ports)[1:])
    assert not np.any(amplitudes[1:])
    assert constants.tolist() == [1500.0, 1.0, 1.0, 1.0]
    np.testing.assert_array_equal(table.constant_index[0], [0, 3])
    assert np.all(np.isfinite(all_courses(table, constants)))


def test_an_effect_without_amplitudes_starts_at_zero():
    bare = Effect("bare", (Term("sensor.cy"),), driver="body", form="linear")
    assert not np.any(port_courses(bare))
    assert bare.as_dict()["amplitudes"] == [0.0]


def test_courses_are_differentiable_in_the_constants():
    table, _, constants = tabulate((WARMING, SETTLING), CHANNELS, 8, 4)

    def function(c):
        return all_courses(table, c)

    slope = np.asarray(jax.jit(jax.jacrev(function))(jnp.asarray(constants)))
    assert np.all(np.isfinite(slope))
    for k in (0, 1):
        step = np.zeros(4)
        step[k] = 0.05
        difference = (function(constants + step) - function(constants - step)) / 0.1
        np.testing.assert_allclose(slope[..., k], difference, atol=1e-9)
        assert np.abs(slope[:3, :, k]).max() > 1e-5


def test_capacity_holds_the_effects_and_the_free_constant():
    assert capacity(()) == (0, 1)
    for effects in ((WARMING,), (WARMING, SWAYING), (WARMING,) * 3 + (SWAYING, SETTLING)):
        columns, constants = capacity(effects)
        assert columns >= sum(e.n_columns for e in effects)
        assert constants > sum(len(e.constants) for e in effects)
        assert columns % 4 == constants % 4 == 0


def test_forms_that_repeat_a_basis_give_each_a_constant_of_its_own():
    body, time = (np.asarray(CHANNELS.values[CHANNELS.index(name)]) for name in ("body", "time"))

    def decays(tau):
        return np.exp(-np.maximum(time, 0.0) / tau)

    known = {
        ("body", "two lags"): [(800.0, 4000.0), lambda tau: lag(body, CHANNELS.time, tau)],
        ("time", "two decays"): [(900.0, 300.0), decays],
        ("time", "3 jumps"): [(3000.0, 1000.0, 5000.0), lambda at: np.where(time >= at, 1.0, 0.0)],
    }
    for (driver, form), (constants, course) in known.items():
        effect = Effect("", (Term("sensor.focal"),), driver, form, constants)
        table, _, own = tabulate((effect,), CHANNELS, 4, 4)
        got = np.asarray(courses(table, own, CHANNELS))[: len(constants)]
        expected = [np.interp(EPOCHS, CHANNELS.time, course(c)) for c in constants]
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12, err_msg=form)
    assert FORMS["two lags"].labels == ("lag", "slow lag")
    assert FORMS["two decays"].labels == ("decay", "slow decay")
    assert FORMS["3 jumps"].labels == ("step", "second step", "third step")


def test_forms_name_bases_that_read_at_most_two_constants():
    for name, form in FORMS.items():
        assert form.name == name
        assert all(basis in BASES for basis in form.bases)
        read = [form.read_by(k, form.constants) for k in range(len(form.bases))]
        assert all(len(own) <= 2 for own in read)
        # None is for nothing, but for an instant that another basis reads along.
        assert {c.name for own in read for c in own} == {c.name for c in form.constants}
        assert len(set(form.labels)) == len(form.bases)


def test_new_values_leave_the_rest_of_an_effect():
    new = WARMING.with_values(np.array([5.0, 6.0]), np.array([800.0]))
    assert (new.amplitudes, new.constants) == ((5.0, 6.0), (800.0,))
    assert new.terms == WARMING.terms and new.reference == WARMING.reference
    table = new.as_dict()
    assert table["amplitudes"] == [5.0, 6.0]
    assert table["terms"][1] == {
        "port": "sensor.cx",
        "driver": "one",
        "basis": "one",
        "weight": -2.0,
    }


def test_scope_reads_in_a_sentence():
    assert Scope().words() == "everywhere"
    assert Scope().as_dict() == {}
    assert Scope(camera=("left",)).words() == "camera left"
    both = Scope(camera=("left", "right"), target=("plate 3",))
    assert both.words() == "camera left, right; target plate 3"
    assert both.as_dict() == {"camera": ["left", "right"], "target": ["plate 3"]}
