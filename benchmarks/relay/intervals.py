"""Root mean squares of many trials, their ratios, and 95 % intervals of both by bootstrap.

Trials are resampled whole (Efron 1979), so that estimates made of the same draws stay paired; no
distribution is assumed, which matters where first-order theory fails and errors are not normal.
"""

from functools import cache

import numpy as np
from jaxtyping import Float

RESAMPLES, SEED = 1000, 20260


@cache
def _counts(trials: int) -> np.ndarray:
    """How often each trial is taken, by resample; the same for all values of as many trials."""
    rng = np.random.default_rng(SEED)
    return rng.multinomial(trials, np.full(trials, 1.0 / trials), RESAMPLES) / trials


def _interval(value, resampled) -> dict:
    low, high = np.percentile(resampled, [2.5, 97.5], axis=0)
    names = ("value", "low", "high")
    return {n: np.asarray(x).tolist() for n, x in zip(names, (value, low, high), strict=True)}


def rms(squares: Float[np.ndarray, "trials *more"]) -> dict:
    """Root mean square over the trials: value, low and high."""
    flat = squares.reshape(len(squares), -1)
    shape = squares.shape[1:]
    again = np.sqrt(_counts(len(flat)) @ flat).reshape(-1, *shape)
    return _interval(np.sqrt(squares.mean(axis=0)), again)


def gain(before: Float[np.ndarray, " trials"], after: Float[np.ndarray, " trials"]) -> dict:
    """Root mean square before over that after, of squares from the same draws."""
    counts = _counts(len(before))
    again = np.sqrt((counts @ before) / (counts @ after))
    return _interval(np.sqrt(before.mean() / after.mean()), again)


def divided(interval: dict, by) -> dict:
    """Value, low and high over something known."""
    return {name: (np.asarray(x) / by).tolist() for name, x in interval.items()}


def words(interval: dict, most: int = 4) -> str:
    """Value and interval for a table: two digits of the interval's width, at most some decimals."""
    value, low, high = (interval[name] for name in ("value", "low", "high"))
    width = max(high - low, 10.0**-most)
    after = int(np.clip(1 - np.floor(np.log10(width)), 0, most))
    return f"{value:.{after}f} [{low:.{after}f}, {high:.{after}f}]"


def bars(interval: dict) -> np.ndarray:
    """Distances from the value down and up, as matplotlib's error bars want them."""
    value, low, high = (np.asarray(interval[name]) for name in ("value", "low", "high"))
    return np.stack([value - low, high - value])
