"""How physics goes with time: courses that follow temperatures, the sun, the clock, or chance.

A `Course` gives one number for every row of a view. Those of temperature are in kelvin (from a
reference), of humidity in percent, of pressure in hPa; the others are of the order of 1.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .heat import STEP, lagged, play


@dataclass
class Course:
    """Values over time.

    Attributes:
        at: values [n] for a view.
        driver: the logged channel it follows, "time", "constant", "power-on", "random" ...
        when: "always", "from", "with driver", "periodic", "handling".
        plain: whether amplitude times this is what a catalogue would call its amplitude.
    """

    at: Callable
    driver: str
    when: str
    t0: float | None = None
    constants: dict = field(default_factory=dict)
    plain: bool = True


def constant():
    return Course(lambda v: np.ones(len(v.t)), "constant", "always")


def _grid(view, make, owner):
    """A course made on the weather's grid, for each row's own camera or target, or for one."""
    if owner == "camera":
        return view.course(make, view.rows.camera, 0)
    if owner == "target":
        return view.course(make, view.rows.target, 0)
    weather = view.scene.weather
    return np.interp(view.t, weather.time, make(weather, owner or 0))


def channel_name(site, series, owner):
    """Name of the logged channel that a series of the weather is read by."""
    if series in ("board", "housing", "lens", "mount"):
        k = owner if isinstance(owner, int) else site.cameras[0]
        return f"body_{site.scene.cameras[k].name}_degC"
    return "ambient_degC" if series == "target" else series


def follow(site, series, owner=None, change=None, when="with driver", constants=None, plain=True,
           driver=None):  # fmt: skip
    """A course that follows a series of the weather, from its mean in the plain recording.

    Args:
        series: a channel of the air, a node of a camera ("housing" ...), "target" or "since".
        owner: "camera" or "target" (each row's own), or the place of one of them.
        change: function of the values on the grid (lag, play ...) with the reference off.
    """
    weather, end = site.scene.weather, site.scene.t[-1]
    inside = (weather.time >= 0.0) & (weather.time <= end)
    first = owner if isinstance(owner, int) else (site.cameras or [0])[0]
    first = site.target if owner == "target" else first
    reference = float(np.mean(weather.series(series, first)[inside]))

    def make(weather, k):
        values = weather.series(series, k) - reference
        return values if change is None else change(values)

    told = {"reference": reference} | (constants or {})
    name = driver or channel_name(site, series, owner)
    return Course(lambda v: _grid(v, make, owner), name, when, None, told, plain)


def lag(site, series, owner=None, tau=None):
    """First-order lag; its time constant is drawn as a share of the recording's length."""
    tau = tau or site.between(0.03, 0.25) * site.length
    return follow(site, series, owner, lambda x: lagged(x, tau), constants={"tau_s": tau})


def two_lags(site, series, owner=None):
    """Two time constants, one fast and one slow, of equal sign."""
    fast, slow = site.between(0.005, 0.03) * site.length, site.between(0.1, 0.35) * site.length
    share = site.even(0.25, 0.75)
    return follow(
        site, series, owner,
        lambda x: share * lagged(x, fast) + (1.0 - share) * lagged(x, slow),
        constants={"tau_s": fast, "tau2_s": slow, "share": share}, plain=False,
    )  # fmt: skip


def dead_time(site, series, owner=None):
    """The same as the channel, later."""
    delay = min(600.0, site.between(0.03, 0.1) * site.length)

    def change(values):
        back = max(1, int(round(delay / STEP)))
        return np.concatenate([np.full(back, values[0]), values[:-back]])

    return follow(site, series, owner, change, constants={"delay_s": delay})


def square(site, series, owner=None):
    """Quadratic in the temperature's distance from the reference (K^2)."""
    return follow(site, series, owner, lambda x: x * x, plain=True)


def backlash(site, series, owner=None):
    """Play: follows only after the temperature has turned by twice the half width."""
    weather, k = site.scene.weather, owner if isinstance(owner, int) else site.cameras[0]
    inside = (weather.time >= 0.0) & (weather.time <= site.length)
    width = site.even(0.15, 0.35) * float(np.ptp(weather.series(series, k)[inside]))
    return follow(
        site, series, owner, lambda x: play(x, width), constants={"play": width}, plain=False
    )


def rate(site, series, owner=None):
    """Rate of change, in kelvin per hour."""
    smooth = max(60.0, 0.01 * site.length)
    return follow(
        site, series, owner,
        lambda x: np.gradient(lagged(x, smooth), STEP) * 3600.0,
        constants={"tau_s": smooth, "rate_s": 3600.0},
    )  # fmt: skip


def difference(site, series, owner="camera"):
    """A node's temperature against the air's (K)."""
    reference = 10.0

    def make(weather, k):
        return weather.series(series, k) - weather.air["ambient_degC"] - reference

    name = channel_name(site, series, owner)
    return Course(lambda v: _grid(v, make, owner), f"{name} - ambient_degC", "with driver", None,
                  {"reference": reference}, False)  # fmt: skip


def sun(site, tau=None):
    """Irradiance through a lag, in units of 500 W/m2."""
    tau = tau or site.between(0.02, 0.12) * site.length
    return follow(
        site, "irradiance_W_m2", None, lambda x: lagged(x, tau) / 500.0,
        constants={"tau_s": tau, "unit": 500.0}, plain=False,
    )  # fmt: skip


def gusts(site):
    """Wind pressure: square of the wind speed over 10 m2/s2."""

    def make(weather, k):
        return weather.air["wind_m_s"] ** 2 / 10.0

    return Course(lambda v: _grid(v, make, None), "wind_m_s", "with driver", None, {}, False)


def windy_gain(site, series="housing"):
    """Temperature whose effect is damped by wind (bilinear)."""
    reference = follow(site, series, "camera").constants["reference"]

    def make(weather, k):
        return (weather.series(series, k) - reference) / (1.0 + 0.3 * weather.air["wind_m_s"])

    return Course(lambda v: _grid(v, make, "camera"), channel_name(site, series, "camera"),
                  "with driver", None, {"reference": reference}, False)  # fmt: skip


def power_on(site):
    """Two exponentials of the time since the last power-on, going to zero."""
    fast, slow = site.between(0.02, 0.06) * site.length, site.between(0.15, 0.4) * site.length
    share = site.even(0.2, 0.6)

    def make(weather, k):
        s = weather.since[k]
        return share * np.exp(-s / fast) + (1.0 - share) * np.exp(-s / slow)

    told = {"tau_s": slow, "tau2_s": fast, "share": share}
    return Course(lambda v: _grid(v, make, "camera"), "power-on", "always", None, told, False)


def warm_up(site):
    """One exponential 1 - exp(-s / tau) of the time s since the last power-on."""
    tau = site.between(0.08, 0.4) * site.length

    def make(weather, k):
        return 1.0 - np.exp(-weather.since[k] / tau)

    return Course(lambda v: _grid(v, make, "camera"), "power-on", "always", None, {"tau_s": tau})


def _of_time(function, when, t0=None, constants=None, driver="time", plain=True):
    return Course(
        lambda v: function(v.t + v.scene.began_s), driver, when, t0, constants or {}, plain
    )


def onset(site, start=None):
    """Exponential settling from an instant (0: from set-up)."""
    t0 = site.even(0.15, 0.6) * site.length if start is None else start
    tau = site.between(0.05, 0.3) * site.length
    return _of_time(
        lambda t: 1.0 - np.exp(-np.clip(t - t0, 0.0, None) / tau),
        "always" if start == 0.0 else "from", t0, {"tau_s": tau, "t0_s": t0},
    )  # fmt: skip


def logarithm(site):
    """log(1 + t / tau) from set-up."""
    tau = site.between(0.02, 0.1) * site.length
    return _of_time(
        lambda t: np.log1p(np.clip(t, 0.0, None) / tau), "always", 0.0, {"tau_s": tau}, plain=False
    )


def step(site):
    """0 before an instant, 1 after it."""
    t0 = site.even(0.2, 0.8) * site.length
    return _of_time(lambda t: (t >= t0).astype(float), "from", t0, {"t0_s": t0})


def ramp(site):
    """0 before an instant, then straight to 1 at the end of the plain recording."""
    t0, end = site.even(0.1, 0.6) * site.length, site.length
    return _of_time(
        lambda t: np.clip(t - t0, 0.0, None) / (end - t0), "from", t0, {"t0_s": t0, "end_s": end}
    )


def steady(site):
    """Straight in time, 1 at the end of the plain recording."""
    end = site.length
    return _of_time(lambda t: t / end, "always", None, {"length_s": end})


def periodic(site, shortest=0.08, longest=0.4):
    """A sine; the period as a share of the recording."""
    period, phase = site.between(shortest, longest) * site.length, site.even(0.0, 2.0 * np.pi)
    return _of_time(
        lambda t: np.sin(2.0 * np.pi * t / period + phase), "periodic", None,
        {"period_s": period, "phase_rad": phase},
    )  # fmt: skip


def handling(site, jumps=3):
    """Constant between a few instants, jumping to random values at each."""
    at = np.sort(site.rng.uniform(0.1, 0.9, jumps)) * site.length
    to = np.concatenate([[0.0], site.rng.normal(size=jumps)])
    return _of_time(
        lambda t: to[np.searchsorted(at, t)], "handling", float(at[0]),
        {"t0_s": float(at[0])}, "random", False,
    )  # fmt: skip


def each_image(site):
    """A new random number at every exposure, from a hash of the time."""
    salt = site.even(1.0, 2.0)

    def function(t):
        x = np.sin(np.round(t, 3) * 12.9898 * salt + salt) * 43758.5453
        y = np.sin(np.round(t, 3) * 78.233 * salt + 2.0 * salt) * 24634.6345
        flat = np.clip(x - np.floor(x), 1e-9, 1.0)
        return np.sqrt(-2.0 * np.log(flat)) * np.cos(2.0 * np.pi * (y - np.floor(y)))

    return _of_time(function, "always", None, {}, "random", False)
