"""Heat and weather of the simulated site: signals in time, thermal lag, play, camera bodies.

Everything here is computed on a fine grid of times and read between its points by straight lines.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.signal import lfilter, lfilter_zi, lsim

STEP_S = 10.0
"""Spacing of the fine grid of times (s)."""


@dataclass(frozen=True)
class Signal:
    """A quantity in time: values on an even grid of times (s), straight lines between them."""

    t: Float[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]

    def __call__(self, t: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
        return np.interp(t, self.t, self.value)

    def lagged(self, tau: float) -> "Signal":
        """The state p of tau dp/dt + p = value, at rest at the first grid time. tau in s.

        Exact for a piecewise linear input: p' = a p + (1-a) x + (x'-x)(1 - (1-a) tau/dt),
        a = exp(-dt/tau).
        """
        dt = self.t[1] - self.t[0]
        decay = np.exp(-dt / tau)
        ahead = 1.0 - (1.0 - decay) * tau / dt
        b, a = [ahead, 1.0 - decay - ahead], [1.0, -decay]
        state, _ = lfilter(b, a, self.value, zi=lfilter_zi(b, a) * self.value[0])
        return Signal(self.t, state)

    def with_play(self, width: float) -> "Signal":
        """What follows this signal through a coupling with play (backlash) of a total width.

        The follower rests until the driver has crossed the gap: each step moves it just enough to
        stay within half a width of the driver. It starts in the middle.
        """
        follower = np.empty_like(self.value)
        at = self.value[0]
        for i, driver in enumerate(self.value):
            at = min(max(at, driver - width / 2), driver + width / 2)
            follower[i] = at
        return Signal(self.t, follower)

    def above(self, level: float) -> "Signal":
        """How much this signal exceeds a fixed level."""
        return Signal(self.t, self.value - level)

    def span(self, t: Float[np.ndarray, " m"]) -> float:
        """Largest minus smallest value over the given times."""
        return float(np.ptp(self(t)))


@dataclass(frozen=True)
class CameraBody:
    """Two lumps of heat: sensor board inside, housing outside (where the logged sensor sits).

    C1 dT1/dt = P - G (T1-T2);  C2 dT2/dt = G (T1-T2) - hA (T2-Ta) + sunlit * irradiance.
    """

    power_w: float
    powered_on_s: float
    sunlit_m2: float  # absorbing area turned to the sun
    board_j_per_k: float = 15.0
    housing_j_per_k: float = 90.0
    between_w_per_k: float = 0.25
    to_air_w_per_k: float = 0.12

    def housing(self, ambient: Signal, irradiance: Signal) -> Signal:
        """Temperature of the housing (degC), at rest with the air until the sun or power acts."""
        c1, c2, g, h = (
            self.board_j_per_k,
            self.housing_j_per_k,
            self.between_w_per_k,
            self.to_air_w_per_k,
        )
        system = (
            np.array([[-g / c1, g / c1], [g / c2, -(g + h) / c2]]),
            np.array([[1.0 / c1, 0.0, 0.0], [0.0, h / c2, self.sunlit_m2 / c2]]),
            np.array([[0.0, 1.0]]),
            np.zeros((1, 3)),
        )
        power = self.power_w * (ambient.t >= self.powered_on_s)
        inputs = np.column_stack([power, ambient.value, irradiance.value])
        _, housing, _ = lsim(
            system, inputs, ambient.t - ambient.t[0], X0=[ambient.value[0], ambient.value[0]]
        )
        return Signal(ambient.t, np.ravel(housing))


@dataclass(frozen=True)
class Weather:
    """What the air does at the site, as it truly is (not as logged)."""

    ambient: Signal  # degC
    humidity: Signal  # % RH
    gradient: Signal  # K/m, positive where it is warmer above
    irradiance: Signal  # W/m2


def make_weather(rng: np.random.Generator, start_s: float, end_s: float) -> Weather:
    """A working day in a hall: slow warming, air conditioning, doors, clouds, a humidifier."""
    t = np.arange(start_s, end_s + STEP_S, STEP_S)
    hours = t / 3600.0

    clouds = np.zeros_like(t)
    for middle in rng.uniform(-2.0, 9.0, 9):
        clouds += rng.uniform(0.3, 0.9) * _bump(hours, middle, rng.uniform(0.10, 0.35))
    sun = np.clip(np.sin(np.pi * (hours + 3.5) / 14.0), 0.0, None)
    irradiance = 620.0 * sun * np.exp(-1.3 * clouds)

    ambient = 19.0 + 3.0 * np.sin(2 * np.pi * (hours - rng.uniform(1.0, 2.0)) / 24.0)
    middles = np.arange(0.4, 8.4, 1.6) + rng.uniform(-0.4, 0.4, 5)
    for middle, sign in zip(middles, (1, -1, 1, -1, 1), strict=True):
        ambient += sign * rng.uniform(3.0, 5.0) * _bump(hours, middle, rng.uniform(0.4, 0.75))
    ambient += 0.45 * np.tanh(2.5 * np.sin(2 * np.pi * hours / rng.uniform(0.55, 0.68)))
    ambient += _visits(rng, hours, count=7, size=(-3.0, -1.2), decay_h=0.16)
    ambient += _wander(rng, t, sd=0.12, tau=700.0)

    humidity = 48.0 - 1.6 * (ambient - 19.0) + _wander(rng, t, sd=1.2, tau=1800.0)
    humidity += _visits(rng, hours, count=5, size=(6.0, 15.0), decay_h=0.55)

    gradient = 0.4 + 2.2 * Signal(t, irradiance).lagged(900.0).value / 400.0
    for middle in rng.uniform(-0.5, 8.5, 6):
        gradient += rng.uniform(-2.5, 2.5) * _bump(hours, middle, rng.uniform(0.25, 0.6))
    gradient += _wander(rng, t, sd=0.25, tau=900.0)

    # Doors and fans do not act at once: the air itself needs two minutes.
    return Weather(
        ambient=Signal(t, ambient).lagged(120.0),
        humidity=Signal(t, np.clip(humidity, 15.0, 95.0)).lagged(120.0),
        gradient=Signal(t, gradient).lagged(120.0),
        irradiance=Signal(t, irradiance).lagged(30.0),
    )


def _bump(x: Float[np.ndarray, " n"], middle: float, width: float) -> Float[np.ndarray, " n"]:
    return np.exp(-0.5 * ((x - middle) / width) ** 2)


def _visits(
    rng: np.random.Generator,
    hours: Float[np.ndarray, " n"],
    count: int,
    size: tuple[float, float],
    decay_h: float,
) -> Float[np.ndarray, " n"]:
    """Sudden changes that die away: a door that opens, a humidifier that blows."""
    total = np.zeros_like(hours)
    for at in rng.uniform(-1.5, 8.5, count):
        since = hours - at
        total += rng.uniform(*size) * np.where(since > 0, np.exp(-np.abs(since) / decay_h), 0.0)
    return total


def _wander(
    rng: np.random.Generator, t: Float[np.ndarray, " n"], sd: float, tau: float
) -> Float[np.ndarray, " n"]:
    """Ornstein-Uhlenbeck noise: standard deviation sd, correlation time tau (s)."""
    a = np.exp(-(t[1] - t[0]) / tau)
    kicks = sd * np.sqrt(1.0 - a * a) * rng.standard_normal(t.size)
    return np.asarray(lfilter([1.0], [1.0, -a], kicks))
