"""Noise: how far residuals remember, and random multipliers that remember as far.

The null distribution of the scores multiplies the residuals of every epoch by a random number of
mean zero and variance one. Independent signs are right for noise that is independent from epoch to
epoch. Where it is not, the multipliers must be as dependent as the noise (dependent wild bootstrap,
Shao 2010): Gaussian, with a correlation that falls linearly to zero over the window.
"""

import numpy as np

from jaxvm.network.scene import Scene

REMEMBERED = 0.04
"""Autocorrelation of residuals at one epoch's distance from which noise counts as correlated."""

LONGEST = 0.3
"""Longest memory that noise may have, as a share of the recording."""


def memory(scene: Scene, residual: np.ndarray) -> int:
    """Epochs over which the residuals of a mark, or the mean residuals of a view, remember.

    The first distance at which the pooled autocorrelation is below `REMEMBERED`; 1 for noise that
    is independent from epoch to epoch, and where they never forget.

    Args:
        scene: the fitted scene.
        residual: whitened residuals [observations, 2] in the order of the recording, NaN where not
            fitted.
    """
    obs = scene.recording.observations
    n_epochs = len(scene.recording.time)
    mark = obs.camera * scene.first_point[-1] + scene.first_point[obs.target] + obs.point
    view = obs.camera * len(scene.model.targets) + obs.target
    found = 1
    for label in (mark, view):
        series = _series(label, obs.epoch, residual, n_epochs)
        distances = range(1, max(int(LONGEST * n_epochs), 2))
        faded = [d for d in distances if _autocorrelation(series, d) < REMEMBERED]
        # What never fades is no noise but physics that is not in the model yet.
        if faded:
            found = max(found, faded[0])
    return found


def multipliers(n_epochs: int, window: int, repetitions: int, seed: int) -> np.ndarray:
    """Random multipliers [epochs, repetitions]: signs, or Gaussian ones with a triangular memory.

    Args:
        n_epochs: number of epochs.
        window: epochs over which they remember; 1 for independent signs.
        repetitions: number of columns.
        seed: of the random numbers.
    """
    rng = np.random.default_rng(seed)
    if window <= 1:
        return rng.choice([-1.0, 1.0], (n_epochs, repetitions))
    # A moving sum of white noise has a triangular autocorrelation.
    white = rng.standard_normal((n_epochs + window - 1, repetitions))
    total = np.cumsum(np.concatenate([np.zeros((1, repetitions)), white]), axis=0)
    return (total[window:] - total[:-window]) / np.sqrt(window)


def _series(label, epoch, residual, n_epochs: int) -> np.ndarray:
    """Mean residuals [labels, epochs, 2] without each label's own mean; NaN where there is none."""
    used = np.isfinite(residual).all(axis=1)
    _, place = np.unique(label, return_inverse=True)
    total = np.zeros((int(place.max()) + 1, n_epochs, 2))
    count = np.zeros(total.shape[:2])
    np.add.at(total, (place[used], epoch[used]), residual[used])
    np.add.at(count, (place[used], epoch[used]), 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(count[:, :, None] > 0, total / count[:, :, None], np.nan)
    many = count.astype(bool).sum(axis=1) >= 6
    mean = mean[many]
    return mean - np.nanmean(mean, axis=1, keepdims=True) if len(mean) else mean


def _autocorrelation(series: np.ndarray, distance: int) -> float:
    """Pooled autocorrelation; what a series loses with its own mean is added back.

    Without its mean a series of n epochs is biased by -1/n, and by (1 + r) / (1 - r) times that
    where neighbours are correlated by r.
    """
    if not len(series):
        return 0.0
    product = series[:, distance:] * series[:, :-distance]
    pairs = np.isfinite(product)
    if pairs.sum() < 20:
        return 0.0
    variance = np.nanmean(series**2)
    length = np.isfinite(series[:, :, 0]).sum(axis=1).mean()
    deviation = 1.0 / np.sqrt(pairs.sum())
    raw = float(np.nanmean(product) / max(variance, 1e-300))
    near = float(np.nanmean(series[:, 1:] * series[:, :-1]) / max(variance, 1e-300))
    near = min(max(near + 1.0 / length, 0.0), 0.9)
    value = raw + (1.0 + near) / (1.0 - near) / length
    return value if value > 3.0 * deviation else 0.0
