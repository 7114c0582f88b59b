"""Hidden effects of mounts: cameras turn and move."""

from collections.abc import Callable

import numpy as np

from jaxvm.simulate.bodies import Camera, Site, Times, along, plus
from jaxvm.simulate.hidden import (
    MINUTE,
    Truth,
    either_sign,
    hidden,
    moment,
    onset,
    usual,
)


@hidden("mount-slip", "the right camera turns suddenly in its mount")
def mount_slip(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    t0 = moment(site, rng)
    turn = strength * either_sign(rng, 30e-6, 150e-6)
    _turn(site.cameras["right"], "y", lambda t: turn * (t >= t0))
    return Truth(
        "mount-slip",
        "The camera right slipped in its mount: from one moment on it looks elsewhere.",
        {"camera": ["right"]},
        "time",
        {"turn about y": (turn, "rad"), "moment": (t0, "s")},
    )


@hidden("mount-creep", "the left camera's mount settles for hours after set-up")
def mount_creep(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    turn = strength * either_sign(rng, 60e-6, 160e-6)
    tau = rng.uniform(80.0, 180.0) * MINUTE
    _turn(site.cameras["left"], "x", lambda t: turn * onset(t, tau))
    return Truth(
        "mount-creep",
        "The mount of the camera left creeps: it tilts quickly at first, then ever more slowly.",
        {"camera": ["left"]},
        "time",
        {"turn about x": (turn, "rad"), "time constant": (tau, "s")},
    )


@hidden("vibration", "the left camera nods with the rhythm of a machine")
def vibration(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    turn = strength * rng.uniform(15e-6, 50e-6)
    period = rng.uniform(45.0, 90.0) * MINUTE
    phase = rng.uniform(0.0, 2 * np.pi)
    _turn(site.cameras["left"], "x", lambda t: turn * np.sin(2 * np.pi * t / period + phase))
    return Truth(
        "vibration",
        f"The mount of the camera left nods to and fro every {period / MINUTE:.0f} minutes.",
        {"camera": ["left"]},
        "time",
        {"amplitude about x": (turn, "rad"), "period": (period, "s"), "phase": (phase, "rad")},
    )


@hidden("hysteresis", "the right camera turns with temperature through a joint with play")
def hysteresis(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    rate = strength * either_sign(rng, 15e-6, 35e-6)
    ambient = site.weather.ambient
    width = rng.uniform(0.3, 0.5) * ambient.span(site.epoch_t)
    follower = ambient.with_play(width).above(usual(site, ambient))
    _turn(site.cameras["right"], "y", lambda t: rate * follower(t))
    return Truth(
        "hysteresis",
        "The camera right turns with the air temperature, but through a joint with play: "
        "after each turn of the temperature it first stays where it is.",
        {"camera": ["right"]},
        "ambient_degC",
        {"turn about y": (rate, "rad/K"), "play": (width, "K")},
    )


@hidden("bracket-growth", "the right camera's bracket grows with temperature and carries it away")
def bracket_growth(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["right"]
    axis = str(rng.choice(["x", "z"]))
    # Along z the pictures change less: a longer arm is needed to show it.
    growth = strength * (rng.uniform(20e-6, 40e-6) if axis == "x" else rng.uniform(60e-6, 90e-6))
    warmth = site.weather.ambient.above(usual(site, site.weather.ambient))
    camera.shift = plus(camera.shift, along(axis, lambda t: growth * warmth(t)))
    return Truth(
        "bracket-growth",
        f"The bracket of the camera right grows with the air temperature along {axis}.",
        {"camera": ["right"]},
        "ambient_degC",
        {f"growth along {axis}": (growth, "m/K")},
    )


def _turn(camera: Camera, axis: str, angle: Callable[[Times], Times]) -> None:
    camera.turn = plus(camera.turn, along(axis, angle))


MOUNT_EFFECTS = (
    mount_slip,
    mount_creep,
    vibration,
    hysteresis,
    bracket_growth,
)
