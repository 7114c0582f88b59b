"""Temperature of a scene: a day of readings, and what they do to the cameras as effects."""

from dataclasses import replace

import numpy as np

from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.recording.recording import Drivers
from jaxvm.scenes.describe import Temperature, ThermalEffect

AMBIENT = "ambient_degC"

_BEFORE_S = 3600.0
"""Cameras are switched on, and the log begins, an hour before the first epoch."""

_DAY_S = 86400.0


def body_of(camera: str) -> str:
    """Channel of the temperature of a camera's body."""
    return f"body_{camera}_degC"


def weather(
    temperature: Temperature, cameras: tuple[str, ...], end: float, rng: np.random.Generator
) -> Drivers:
    """True temperatures (degC) from an hour before the first epoch to after the last (at `end`, s).

    The air follows the day. A body follows the air with a lag, warms up after it is switched on,
    and has its own share of the sun; no two are alike.
    """
    step = temperature.every_s
    time = step * np.arange(-np.ceil(_BEFORE_S / step), np.ceil(end / step) + 1.0)
    day = 2.0 * np.pi * time / _DAY_S
    air = temperature.mean_degC + temperature.swing_K * np.sin(day)
    channels = {AMBIENT: air}
    if temperature.bodies:
        unlike = rng.uniform(-1.0, 1.0, (3, len(cameras), 1))
        lag = temperature.body_lag_s * (1.0 + 0.2 * unlike[0])
        warm = temperature.rise_K * (1.0 + 0.2 * unlike[1]) * -np.expm1((time[0] - time) / lag)
        sun = 0.2 * temperature.swing_K * np.sin(day - np.pi * unlike[2])
        behind = 2.0 * np.pi * lag / _DAY_S
        # A sine through a first-order lag: smaller by cos, later by atan of the lag's phase.
        late = np.arctan(behind)
        body = temperature.swing_K * np.cos(late) * np.sin(day - late) + temperature.mean_degC
        channels |= dict(zip(map(body_of, cameras), body + warm + sun, strict=True))
    return Drivers(time, channels)


def read(drivers: Drivers, noise: float, rng: np.random.Generator) -> Drivers:
    """The channels as a logger has them: with noise (K)."""
    return replace(
        drivers,
        channels={
            name: values + noise * rng.standard_normal(len(values))
            for name, values in drivers.channels.items()
        },
    )


def reference_of(driver: str, temperature: Temperature) -> float:
    """Temperature (degC) at which the cameras are as the model says."""
    warm = temperature.rise_K if driver == "body" else 0.0
    return temperature.mean_degC + warm


def effects_of(
    planned: ThermalEffect, temperature: Temperature, cameras: tuple[str, ...], number: int
) -> tuple[Effect, ...]:
    """A described effect on the given cameras: one that follows the air, or one for each body."""
    lag = planned.lag_s > 0.0
    common = Effect(
        name=f"{planned.port} with {AMBIENT} ({number})",
        terms=(Term(planned.port),),
        driver=AMBIENT,
        form="lag" if lag else "linear",
        constants=(planned.lag_s,) if lag else (),
        reference=reference_of(planned.driver, temperature),
        scope=Scope(camera=cameras if planned.camera else ()),
        amplitudes=(planned.per_K,),
    )
    if planned.driver == "ambient":
        return (common,)
    return tuple(
        replace(
            common,
            name=f"{planned.port} of {camera} with its body ({number})",
            driver=body_of(camera),
            scope=Scope(camera=(camera,)),
        )
        for camera in cameras
    )
