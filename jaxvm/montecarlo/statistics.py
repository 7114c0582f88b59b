"""Statistics of trials that are seen once and forgotten: mean, covariance, quantiles, coverage.

They do not depend on how trials were divided into batches, but for rounding (quantiles and counts
not even for that), so that trials of several runs add up.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtri, ndtri

LEVELS = (0.5, 0.6827, 0.9, 0.95, 0.99)
"""Levels of the two-sided intervals whose coverage is counted."""

_DEVIATIONS = ndtri(0.5 + 0.5 * np.array(LEVELS))

_WAITING = 1 << 18
"""Numbers that are kept until they are counted in bins."""

_ACCURACY = 0.002
_GROWTH = np.log((1.0 + _ACCURACY) / (1.0 - _ACCURACY))
_SMALLEST = 1e-30
_BINS = 1 << 20


class Statistics:
    """Statistics of m numbers over trials.

    Means and covariances are updated as by Chan, Golub & LeVeque (1983). Quantiles come from counts
    in bins that grow with their distance from zero (Masson, Rim & Lee 2019): a quantile is right
    to 0.2 % of itself, in memory that does not grow with the number of trials.
    """

    def __init__(self, m: int):
        self.count = 0
        self.mean = np.zeros(m)
        self._scatter = np.zeros((m, m))
        self.least, self.largest = np.full(m, np.inf), np.full(m, -np.inf)
        self._codes, self._times = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._waiting: list[Int[np.ndarray, " codes"]] = []
        self._inside = np.zeros((len(LEVELS), m), int)
        self._judged = np.zeros(m, int)

    def add(self, values: Float[np.ndarray, "t m"], sigma: Float[np.ndarray, "t m"] | None = None):
        """Count errors of trials, and the standard deviations that were foretold (NaN: none)."""
        n = len(values)
        if not n:
            return
        mean = values.mean(axis=0)
        centred = values - mean
        off = mean - self.mean
        total = self.count + n
        self._scatter += centred.T @ centred + np.outer(off, off) * (self.count * n / total)
        self.mean = self.mean + off * (n / total)
        self.count = total
        self.least = np.minimum(self.least, values.min(axis=0))
        self.largest = np.maximum(self.largest, values.max(axis=0))
        self._waiting.append(_codes(values))
        if sum(map(len, self._waiting)) > max(_WAITING, 4 * len(self._codes)):
            self._sort()
        if sigma is not None:
            told = np.isfinite(sigma)
            self._judged += told.sum(axis=0)
            for k, deviations in enumerate(_DEVIATIONS):
                inside = np.abs(values) <= deviations * sigma
                self._inside[k] += (inside & told).sum(axis=0)

    @property
    def covariance(self) -> Float[np.ndarray, "m m"]:
        """About the mean, of n - 1 degrees of freedom; NaN for fewer than two trials."""
        return self._scatter / (self.count - 1) if self.count > 1 else self._scatter * np.nan

    @property
    def deviation(self) -> Float[np.ndarray, " m"]:
        """Standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def rms(self) -> Float[np.ndarray, " m"]:
        """Root mean square: about zero; NaN without trials."""
        if not self.count:
            return np.full(len(self.mean), np.nan)
        return np.sqrt(np.diagonal(self._scatter) / self.count + self.mean**2)

    def interval(self, level: float = 0.95) -> Float[np.ndarray, "2 m"]:
        """Interval of the true root mean squares (chi-square, for normal errors)."""
        n = max(self.count, 1)
        bounds = chdtri(n, [0.5 - 0.5 * level, 0.5 + 0.5 * level])
        return self.rms * np.sqrt(n / bounds)[:, None]

    def quantile(self, share: float) -> Float[np.ndarray, " m"]:
        """Quantile of each number, right to 0.2 % of itself; NaN without trials."""
        result = np.full(len(self.mean), np.nan)
        self._sort()
        codes, times = self._codes, self._times
        owner = codes // (2 * _BINS)
        for k in np.unique(owner):
            own = owner == k
            running = np.cumsum(times[own])
            at = np.searchsorted(running, share * (running[-1] - 1), side="right")
            result[k] = _value(int(codes[own][at]) % (2 * _BINS))
        # The ends are known exactly.
        return np.clip(result, self.least, self.largest)

    def _sort(self) -> None:
        """Count the codes that wait."""
        codes = np.concatenate([self._codes, *self._waiting])
        times = np.ones(len(codes), np.int64)
        times[: len(self._times)] = self._times
        self._codes, place = np.unique(codes, return_inverse=True)
        # Sums of whole numbers below 2^53 are exact in float64.
        counted = np.bincount(place, times, len(self._codes))
        self._times = counted.astype(np.int64)
        self._waiting = []

    def coverage(self, level: float) -> Float[np.ndarray, " m"]:
        """Share of trials whose error was within the interval of a level that was foretold.

        Raises:
            ValueError: a level that is not counted (`LEVELS`).
        """
        if level not in LEVELS:
            raise ValueError(f"coverage is counted at {', '.join(map(str, LEVELS))}, not {level}")
        judged = np.where(self._judged > 0, self._judged, np.nan)
        return self._inside[LEVELS.index(level)] / judged


def _codes(values: Float[np.ndarray, "t m"]) -> Int[np.ndarray, " codes"]:
    """Number and bin of every value in one integer; bins ascend with the values."""
    size = np.abs(values)
    exponent = np.round(np.log(np.maximum(size, _SMALLEST) / _SMALLEST) / _GROWTH).astype(np.int64)
    signed = np.where(size < _SMALLEST, 0, np.sign(values).astype(np.int64) * (1 + exponent))
    return (np.arange(values.shape[1]) * 2 * _BINS + _BINS + signed).ravel()


def _value(code: int) -> float:
    """Middle of a bin."""
    signed = code - _BINS
    return float(np.sign(signed) * _SMALLEST * np.exp((abs(signed) - 1) * _GROWTH))
