"""What a hidden effect is, and the truth that it leaves behind.

An effect is written as what happens to a body (a plate grows, a mount slips), never as a change of
pixels. Nominal values (a plate's spacing, a rangefinder's index) hold at the mean temperature or
humidity of the recording: the instruments were calibrated on site. Sizes are drawn from ranges that
such instruments really show.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from zlib import crc32

import numpy as np
from jaxtyping import Float

from jaxvm.simulate.bodies import Site, Times
from jaxvm.simulate.thermal import Signal

MINUTE = 60.0


@dataclass(frozen=True)
class Truth:
    """What was hidden in a recording.

    Attributes:
        effect: key in `jaxvm.simulate.HIDEABLE`.
        sentence: what happens, in plain English.
        place: where, e.g. {"camera": ["left"]}.
        driver: the quantity that it follows.
        parameters: name -> (value, unit).
        rms_px: RMS of its change of a pixel coordinate over all observations.
        rms_affected_px: the same over the observations that it changes at all.
        rms_range_m: RMS of its change of a measured distance.
    """

    effect: str
    sentence: str
    place: dict[str, list[str]]
    driver: str
    parameters: dict[str, tuple[float, str]] = field(default_factory=dict)
    rms_px: float = 0.0
    rms_affected_px: float = 0.0
    rms_range_m: float = 0.0


Hide = Callable[[Site, np.random.Generator, float], Truth]


@dataclass(frozen=True)
class HiddenEffect:
    """One effect that the scene can hide: `hide(site, rng, strength)` changes the site."""

    key: str
    description: str
    hide: Hide

    def into(self, site: Site, seed: int, strength: float) -> Truth:
        """Hide it in a site; the draw of its size depends on the seed and on this effect only."""
        told = self.hide(site, np.random.default_rng([seed, crc32(self.key.encode())]), strength)
        plain = {name: (float(value), unit) for name, (value, unit) in told.parameters.items()}
        return replace(told, parameters=plain)


def hidden(key: str, description: str) -> Callable[[Hide], HiddenEffect]:
    """Make an effect of a function that hides it."""
    return lambda hide: HiddenEffect(key, description, hide)


def usual(site: Site, signal: Signal) -> float:
    """The level at which nominal values hold: the mean over the epochs of the recording."""
    return float(signal(site.epoch_t).mean())


def either_sign(rng: np.random.Generator, low: float, high: float) -> float:
    """A size between two bounds, of either sign."""
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


def onset(since: Times, tau: float) -> Float[np.ndarray, " n"]:
    """1 - exp(-t/tau) from t = 0 on."""
    return np.where(since > 0.0, -np.expm1(-np.maximum(since, 0.0) / tau), 0.0)


def moment(site: Site, rng: np.random.Generator) -> float:
    """A moment in the middle half of the recording, half-way between two epochs."""
    k = int(rng.integers(site.epoch_t.size // 4, 3 * site.epoch_t.size // 4))
    return float(0.5 * (site.epoch_t[k] + site.epoch_t[k + 1]))
