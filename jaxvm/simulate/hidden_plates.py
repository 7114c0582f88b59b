"""Hidden effects of plates: they grow, bend, lose a mark, are knocked."""

from collections.abc import Callable

import numpy as np

from jaxvm.simulate.bodies import Pixels, Placement, Plate, Points, Site, Times, along, plus
from jaxvm.simulate.hidden import (
    MINUTE,
    Truth,
    either_sign,
    hidden,
    moment,
    usual,
)


@hidden("plate-expansion", "the near reference plate, of aluminium, grows with the air's warmth")
def plate_expansion(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_near"]
    expansion = strength * rng.uniform(21e-6, 25e-6)
    tau = rng.uniform(10.0, 40.0) * MINUTE
    warmth = site.weather.ambient.lagged(tau).above(usual(site, site.weather.ambient))
    _grow(plate, lambda t: expansion * warmth(t)[:, None] * np.array([1.0, 1.0]))
    return Truth(
        "plate-expansion",
        f"The plate {plate.name} expands with the air temperature and lags behind it.",
        {"target": [plate.name]},
        "ambient_degC",
        {"expansion": (expansion, "1/K"), "lag": (tau, "s")},
    )


@hidden("humidity-growth", "the paper on the far reference plate swells, mostly in one direction")
def humidity_growth(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_far"]
    across = strength * rng.uniform(40e-6, 80e-6)
    along_grain = across * rng.uniform(0.15, 0.35)
    damp = site.weather.humidity.above(usual(site, site.weather.humidity))
    _grow(plate, lambda t: damp(t)[:, None] * np.array([across, along_grain]))
    return Truth(
        "humidity-growth",
        f"The paper of {plate.name} grows with humidity, more along x than along y.",
        {"target": [plate.name]},
        "humidity_pct",
        {"growth along x": (across, "1/%RH"), "growth along y": (along_grain, "1/%RH")},
    )


@hidden("plate-bow", "the deck's plate is bent out of its plane")
def plate_bow(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["deck"]
    bow = strength * either_sign(rng, 0.5e-3, 1.5e-3)
    axis = int(rng.integers(2))
    middle, half = plate.middle[axis], plate.half_m

    def lift(t: Times, nominal: Points) -> Points:
        height = bow * (1.0 - ((nominal[:, axis] - middle) / half) ** 2)
        return height[:, None] * np.array([0.0, 0.0, 1.0])

    plate.shape = plus(plate.shape, lift)
    return Truth(
        "plate-bow",
        f"The plate {plate.name} is bent along its {'xy'[axis]} axis: "
        f"the middle stands {1e3 * bow:+.2f} mm along +z against the edges.",
        {"target": [plate.name]},
        "constant",
        {"deflection": (bow, "m")},
    )


@hidden("mark-displaced", "one mark of a fixed plate was glued back in a slightly wrong place")
def mark_displaced(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_near"]
    which = int(rng.integers(plate.side**2))
    size, angle = strength * rng.uniform(0.2e-3, 0.5e-3), rng.uniform(0.0, 2 * np.pi)
    offset = size * np.array([np.cos(angle), np.sin(angle), 0.0])
    name, at = plate.mark_names[which], plate.nominal[which]

    def restuck(t: Times, nominal: Points) -> Points:
        here = np.isclose(nominal, at).all(axis=1, keepdims=True)
        return here * offset

    plate.shape = plus(plate.shape, restuck)
    return Truth(
        "mark-displaced",
        f"Mark {name} of {plate.name} is not where its coordinates say.",
        {"target": [plate.name], "point": [name]},
        "constant",
        {"displacement x": (offset[0], "m"), "displacement y": (offset[1], "m")},
    )


@hidden("reference-moved", "the far reference plate was knocked and stands elsewhere since")
def reference_moved(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_far"]
    t0 = moment(site, rng)
    axis = str(rng.choice(["x", "z"]))
    shift = strength * either_sign(rng, 1e-3, 3e-3)
    rest = plate.place
    knock = along(axis, lambda t: shift * (t >= t0))

    def place(t: Times) -> Placement:
        placed = rest(t)
        return Placement(placed.rotation, placed.shift + knock(t))

    plate.place = place
    return Truth(
        "reference-moved",
        f"The plate {plate.name} was knocked {1e3 * shift:+.2f} mm along the world's {axis} axis.",
        {"target": [plate.name]},
        "time",
        {"displacement": (shift, "m"), "moment": (t0, "s")},
    )


def _grow(plate: Plate, growth: Callable[[Times], Pixels]) -> None:
    """Let a plate grow about its middle by growth(t) along its x and y axes."""
    middle = plate.middle
    plate.shape = plus(
        plate.shape,
        lambda t, nominal: np.column_stack(
            [growth(t) * (nominal - middle)[:, :2], np.zeros(len(nominal))]
        ),
    )


PLATE_EFFECTS = (
    plate_expansion,
    humidity_growth,
    plate_bow,
    mark_displaced,
    reference_moved,
)
