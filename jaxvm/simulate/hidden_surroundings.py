"""Hidden effects of the air and of the rangefinder."""

import numpy as np

from jaxvm.simulate.bodies import Site, plus
from jaxvm.simulate.hidden import (
    Truth,
    either_sign,
    hidden,
    usual,
)

AIR_INDEX_PER_KELVIN = 0.95e-6
"""Fall of the refractive index of air per kelvin (20 degC, 1013 hPa, green light)."""


@hidden("air-bending", "warm air above cool air bends the lines of sight")
def air_bending(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    per_kelvin = strength * AIR_INDEX_PER_KELVIN * rng.uniform(0.8, 1.5)
    gradient = site.weather.gradient
    site.index_slope = plus(site.index_slope, lambda t: -per_kelvin * gradient(t))
    return Truth(
        "air-bending",
        "Lines of sight are curved by the vertical gradient of the air temperature.",
        {"camera": list(site.cameras)},
        "gradient_K_per_m",
        {"curvature": (per_kelvin, "rad/m per K/m")},
    )


@hidden("range-drift", "the rangefinder's index point drifts with temperature")
def range_drift(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    disto = site.rangefinder
    rate = strength * either_sign(rng, 0.15e-3, 0.3e-3)
    warmth = site.weather.ambient.above(usual(site, site.weather.ambient))
    disto.index = plus(disto.index, lambda t: rate * warmth(t))
    return Truth(
        "range-drift",
        f"The distances of the rangefinder {disto.name} drift with the air temperature.",
        {"rangefinder": [disto.name]},
        "ambient_degC",
        {"drift": (rate, "m/K")},
    )


SURROUNDING_EFFECTS = (
    air_bending,
    range_drift,
)
