"""Weather and the temperatures inside cameras and targets: small thermal networks solved in time.

A camera has four nodes (sensor board, housing, lens, mount) with heat capacities (J/K), conducted
heat between them (W/K), convection to the air that grows with wind, the sun on the housing and the
board's own power. The network is linear with coefficients that change with the wind; it is stepped
by the implicit midpoint rule.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

STEP = 10.0
NODES = ("board", "housing", "lens", "mount")


@dataclass
class Weather:
    """Conditions on a regular grid of times (s).

    Attributes:
        air: ambient_degC, humidity_pct, pressure_hPa, irradiance_W_m2, wind_m_s, gradient_K_per_m.
        nodes: temperature (degC) of each camera's nodes, [cameras, 4, times].
        targets: temperature (degC) of each target, [targets, times].
        on: power of each camera on (1) or off (0), [cameras, times].
        since: seconds since the last power-on, [cameras, times].
        reference: mean of every channel in the recording without a plan, by name.
    """

    time: np.ndarray
    air: dict[str, np.ndarray]
    nodes: np.ndarray
    targets: np.ndarray
    on: np.ndarray
    since: np.ndarray
    logged: tuple[str, ...]
    logs: dict[str, float]

    def series(self, name, index=0):
        """A channel on the grid: of the air, a node ("housing"), "target" or "since"."""
        if name in self.air:
            return self.air[name]
        if name == "target":
            return self.targets[index]
        if name == "since":
            return self.since[index]
        return self.nodes[index, NODES.index(name)]


def smooth_noise(rng, count, memory):
    """Unit random process [count] with a memory of so many steps."""
    a = np.exp(-1.0 / memory)
    white = rng.normal(size=count + int(6 * memory))
    return lfilter([np.sqrt(1.0 - a * a)], [1.0, -a], white)[-count:]


def make_air(rng, time, length, style, plan):
    """Courses of the air's channels over `time`; `length` is the recording's (s).

    style: "day" (outdoors, hours), "hall" (a heated hall) or "room" (minutes on a bench).
    """
    n = len(time)
    hours = time / 3600.0
    day = rng.uniform(7.0, 13.0) + hours
    base, swing = rng.uniform(8.0, 24.0), rng.uniform(3.0, 9.0)
    sun_top = rng.uniform(350.0, 900.0)
    cloud = 1.0 / (1.0 + np.exp(-2.0 * (smooth_noise(rng, n, 60.0) + rng.uniform(0.0, 1.5))))
    high = np.clip(np.sin(np.pi * (day - 5.5) / 14.0), 0.0, None)
    sun = sun_top * high * (0.25 + 0.75 * cloud)
    breeze = np.abs(rng.uniform(1.0, 4.0) + 1.2 * smooth_noise(rng, n, 25.0))
    wobble = smooth_noise(rng, n, 90.0)
    period, phase = rng.uniform(2400.0, 7200.0), rng.uniform(0.0, 6.28)
    step_at, step_by = rng.uniform(0.25, 0.75) * length, rng.uniform(-5.0, 5.0)
    drift = rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 6.0)
    if style == "day":
        ambient = base + swing * np.sin(2.0 * np.pi * (day - 9.0) / 24.0) + 0.5 * wobble
    elif style == "hall":
        ambient = base + 0.5 * swing * np.sin(2.0 * np.pi * time / period + phase) + 0.2 * wobble
        ambient = ambient + step_by * (1.0 - np.exp(-np.clip(time - step_at, 0.0, None) / 600.0))
        sun, breeze = sun * 0.15, breeze * 0.1
    else:
        ambient = 21.0 + drift * np.clip(time, 0.0, None) / length + 0.1 * wobble
        sun, breeze = sun * 0.02, breeze * 0.05
    if plan == "cycle":
        # What was asked for: up by twice the span seen, and back again.
        seen = ambient[(time >= 0.0) & (time <= length)]
        share = np.clip(time / length, 0.0, 1.0)
        up = np.clip(np.minimum(share / 0.3, (0.8 - share) / 0.3), 0.0, 1.0)
        ambient = seen.mean() + 2.0 * np.ptp(seen) * up
    humidity = np.clip(
        rng.uniform(40.0, 60.0)
        - 2.0 * (ambient - ambient.mean())
        + rng.uniform(4.0, 9.0) * smooth_noise(rng, n, 0.12 * length / STEP),
        8.0,
        97.0,
    )
    trend = rng.uniform(-1.0, 1.0)
    pressure = 1008.0 + trend * hours + 2.5 * smooth_noise(rng, n, 0.2 * length / STEP)
    scale = 0.8 if style == "day" else 0.25
    gradient = scale * (high * cloud - 0.25) + 0.12 * scale * smooth_noise(rng, n, 45.0)
    return {
        "ambient_degC": ambient,
        "humidity_pct": humidity,
        "pressure_hPa": pressure,
        "irradiance_W_m2": sun,
        "wind_m_s": breeze,
        "gradient_K_per_m": gradient,
    }


def camera_nodes(rng, time, air, on):
    """Temperatures [cameras, 4, times] of the nodes; `on` is each camera's power state."""
    cameras = len(on)

    def vary(value):
        return value * np.exp(rng.uniform(-0.3, 0.3, cameras))

    capacity = np.stack([vary(15.0), vary(90.0), vary(70.0), vary(300.0)], axis=1)
    board_housing, housing_lens, housing_mount = vary(0.25), vary(0.12), vary(0.15)
    air_housing, air_lens, air_mount = vary(0.10), vary(0.05), vary(0.25)
    power, sunlit = vary(3.0), vary(0.006)
    conduct = np.zeros((cameras, 4, 4))
    for i, j, g in ((0, 1, board_housing), (1, 2, housing_lens), (1, 3, housing_mount)):
        conduct[:, i, j] += g
        conduct[:, j, i] += g
        conduct[:, i, i] -= g
        conduct[:, j, j] -= g
    loss = np.stack([0.0 * air_housing, air_housing, air_lens, air_mount], axis=1)
    blow = 1.0 + 0.12 * air["wind_m_s"]
    eye = np.eye(4)
    ambient, sun = air["ambient_degC"], air["irradiance_W_m2"]
    heated = np.stack([power, 0 * power, 0 * power, 0 * power], axis=1)
    lit = np.stack([0 * sunlit, sunlit, 0.2 * sunlit, 0.1 * sunlit], axis=1)
    out = np.empty((cameras, 4, len(time)))
    state = np.full((cameras, 4), ambient[0])
    out[:, :, 0] = state
    for k in range(1, len(time)):
        cool = loss * blow[k]
        rate = (conduct - cool[:, :, None] * eye) / capacity[:, :, None]
        gain = (cool * ambient[k] + heated * on[:, k, None] + lit * sun[k]) / capacity
        left = eye - 0.5 * STEP * rate
        right = state + STEP * (0.5 * np.einsum("cij,cj->ci", rate, state) + gain)
        state = np.linalg.solve(left, right[..., None])[..., 0]
        out[:, :, k] = state
    return out


def body_temperatures(rng, time, air, count):
    """Temperatures [count, times] of targets: air and sun through one lag each."""
    out = []
    for _ in range(count):
        lag = rng.uniform(300.0, 3600.0)
        warm = air["ambient_degC"] + rng.uniform(0.0, 0.008) * air["irradiance_W_m2"]
        out.append(lagged(warm, lag))
    return np.array(out)


def lagged(values, tau):
    """First-order lag (s) of a course that is linear between grid points, settled at its start."""
    a = np.exp(-STEP / tau)
    now = 1.0 - (1.0 - a) * tau / STEP
    return lfilter([now, 1.0 - a - now], [1.0, -a], values, zi=[(1.0 - now) * values[0]])[0]


def play(values, width):
    """Backlash of a half width: the output follows only once the input has crossed the gap."""
    out = np.empty_like(values)
    at = values[0]
    for k, value in enumerate(values):
        at = min(max(at, value - width), value + width)
        out[k] = at
    return out


def make_weather(rng, cameras, targets, length, style, plan, logged, break_s=None):
    """Weather of a scene; with `break_s` = (off, on) all cameras are without power between."""
    first = min([camera.on_s for camera in cameras] + [-600.0]) - 600.0
    time = np.arange(np.floor(first / STEP) * STEP, length + 10 * STEP, STEP)
    shared = np.random.default_rng(rng.integers(2**62))
    inner = np.random.default_rng(rng.integers(2**62))
    bodies = np.random.default_rng(rng.integers(2**62))
    logs = {
        "interval_s": float(rng.choice([30.0, 60.0, 120.0])),
        "noise_K": float(rng.uniform(0.005, 0.02)),
        "step_K": float(rng.choice([0.01, 0.02, 0.0625])),
    }
    air = make_air(shared, time, length, style, plan)
    on = np.array([(time >= camera.on_s).astype(float) for camera in cameras])
    since = np.array([np.clip(time - camera.on_s, 0.0, None) for camera in cameras])
    if break_s is not None:
        off = (time >= break_s[0]) & (time < break_s[1])
        on[:, off] = 0.0
        later = time >= break_s[1]
        since[:, later] = time[later] - break_s[1]
    return Weather(
        time=time,
        air=air,
        nodes=camera_nodes(inner, time, air, on),
        targets=body_temperatures(bodies, time, air, len(targets)),
        on=on,
        since=since,
        logged=logged,
        logs=logs,
    )
