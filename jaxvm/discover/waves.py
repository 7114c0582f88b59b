"""Waves over the image that stand or run: fringes of a window, patterns that wander.

No tile is as small and no course as quick as a wave may be. The periodogram of what is left over
finds it: for every wave vector and frequency the least-squares amplitude of one complex wave
(Lomb 1976, in two dimensions of the image and one of time). What the model's unknowns take of a
wave is neglected until it is refitted.
"""

import itertools

import numpy as np
from jaxtyping import Complex, Float
from scipy.optimize import minimize

from jaxvm.discover.courses import Course
from jaxvm.discover.groups import Group
from jaxvm.discover.hypotheses import Hypothesis
from jaxvm.discover.ranking import surprise
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Scope, Term

SHORTEST, LONGEST = 16.0, 1.5
"""Wavelengths: from the image's width over the first to its width over the second."""

_FASTEST = 6.0
"""Cycles of time in one recording."""

_STEP = 0.4
"""Distance of neighbours in the grid, in cycles over the image or the recording: a wave between two
of them loses less than a third of its power."""

_FLIPS = 199


def strongest_wave(
    scene: Scene, residual: Float[np.ndarray, "observations 2"], seed: int
) -> tuple[Hypothesis, float, float]:
    """The wave over one camera's image that explains most: (hypothesis, p-value, drop).

    The p-value counts all waves that were tried. The noise that it is held against is that of the
    same wave when the residuals of whole epochs change sign at random: what neighbouring marks of
    one image share counts as noise there.

    Args:
        scene: the fitted scene.
        residual: whitened residuals in the order of the recording, NaN where not fitted.
        seed: of the random signs.
    """
    obs = scene.recording.observations
    time = np.asarray(scene.network.channels.epoch_time)
    span = float(time[-1] - time[0]) if scene.recording.timed and len(time) > 12 else 0.0
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (len(time), _FLIPS))
    best: tuple[float, np.ndarray, str] = (-np.inf, np.zeros(3), "")
    tried = 0
    drop = 0.0
    for c, camera in enumerate(scene.model.cameras):
        own = (obs.camera == c) & np.isfinite(residual).all(axis=1)
        if own.sum() < 50:
            continue
        size = np.asarray(camera.image_size, float)
        when = (time[obs.epoch[own]] - time[0]) / (span or 1.0)
        at = np.column_stack([obs.pixel[own] / size, when])
        values = residual[own] @ np.array([1.0, 1j])
        cycles, n = _peak(at, values, obs.epoch[own], span > 0.0)
        tried += n
        z, explained = _surprise(at, residual[own], cycles, obs.epoch[own], signs)
        if z > best[0]:
            best, drop = (z, cycles / np.append(size, span or 1.0), camera.name), explained
    z, rates, camera = best
    p = float(min(tried * np.exp(-0.5 * z), 1.0)) if camera else 1.0
    return _hypothesis(rates, camera), p, drop


def _hypothesis(rates: Float[np.ndarray, "3"], camera: str) -> Hypothesis:
    """A wave of given cycles per pixel, and per second, of both components of one camera."""
    terms = tuple(
        Term(f"detect.{axis}", "pixels", basis, (float(rates[0]), float(rates[1])))
        for axis in "uv"
        for basis in ("sine", "cosine")
    )
    course = Course("constant", "constant")
    if rates[2] != 0.0:
        course = Course("time", "periodic", (float(1.0 / abs(rates[2])),))
    return Hypothesis(Group(terms, "camera"), course, Scope(camera=(camera,)), ())


def _peak(at, values, epoch, timed: bool) -> tuple[Float[np.ndarray, "3"], int]:
    """Cycles over the image's width, its height, and the recording at the largest power.

    `values` are u + iv; the powers of both components are added.
    """
    grid = np.arange(-SHORTEST, SHORTEST + 1e-9, _STEP)
    half = grid[grid >= 0.0]  # a wave and its opposite are one
    length = np.hypot(grid[:, None], half)
    allowed = (length >= LONGEST) & (length <= SHORTEST)
    rates = np.arange(-_FASTEST, _FASTEST + 1e-9, _STEP) if timed else np.zeros(1)
    # Within an epoch time stands still: its marks are summed once for all rates.
    found, first = np.unique(epoch, return_index=True)
    sums = np.empty((2, len(found), len(grid) * len(half)), complex)
    for k, own in enumerate(epoch == e for e in found):
        along_x, along_y = _wave(at[own, 0], grid), _wave(at[own, 1], half)
        for axis, part in enumerate((values[own].real, values[own].imag)):
            sums[axis, k] = ((along_x * part[:, None]).T @ along_y).ravel()
    moved = _wave(at[first, 2], rates)
    power = sum(np.abs(moved.T @ part) ** 2 for part in sums)
    power = np.where(allowed.ravel(), power, -1.0)
    rate, place = np.unravel_index(int(np.argmax(power)), power.shape)
    x, y = np.unravel_index(place, allowed.shape)
    start = np.array([grid[x], half[y], rates[rate]])
    n = int(allowed.sum()) * len(rates)
    if not timed:
        return _refined(at, values, start, 2), n
    refined = _refined(at, values, start, 3)
    # A wave that does not run within the recording is a constant one.
    if abs(refined[2]) < _STEP:
        refined = _refined(at, values, np.append(refined[:2], 0.0), 2)
    return refined, n


def _refined(at, values, start: Float[np.ndarray, "3"], free: int) -> Float[np.ndarray, "3"]:
    """The maximum of the periodogram beside a place of the grid."""

    def loss(x: np.ndarray) -> float:
        wave = np.exp(-2j * np.pi * (at @ np.append(x, start[free:])))
        return -float(abs(values.real @ wave) ** 2 + abs(values.imag @ wave) ** 2)

    simplex = start[:free] + np.vstack([np.zeros(free), 0.5 * _STEP * np.eye(free)])
    found = minimize(loss, start[:free], method="Nelder-Mead",
                     options={"initial_simplex": simplex, "xatol": 1e-3, "fatol": 0.0,
                              "maxiter": 200})  # fmt: skip
    return np.append(found.x, start[free:])


def _wave(
    x: Float[np.ndarray, " n"], cycles: Float[np.ndarray, " k"]
) -> Complex[np.ndarray, "n k"]:
    return np.exp(-2j * np.pi * np.multiply.outer(x, cycles))


def _surprise(at, residual, cycles, epoch, signs) -> tuple[float, float]:
    """Surprise of the sines and cosines of a wave in both components, and their drop.

    Studentised by the drops that random signs of whole epochs give.
    """
    phase = 2.0 * np.pi * (at @ cycles)
    columns = np.column_stack([np.cos(phase), np.sin(phase)])
    root = np.linalg.inv(np.linalg.cholesky(columns.T @ columns))
    own = np.zeros((len(signs), 2, 2))
    for axis, basis in itertools.product(range(2), range(2)):
        product = residual[:, axis] * (columns @ root[basis])
        np.add.at(own[:, axis, basis], epoch, product)
    parts = own.reshape(len(signs), 4)
    drop = float(np.sum(parts.sum(axis=0) ** 2))
    noise = float(np.mean(np.sum((parts.T @ signs) ** 2, axis=0))) / 4.0
    return float(surprise(np.array(drop / noise), 4.0)), drop
