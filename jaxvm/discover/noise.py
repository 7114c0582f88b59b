"""Correlation of noise: what marks remember, what the marks of an image share, and what it costs.

Noise is white, plus a first-order Gauss-Markov process of every mark, plus one that the marks of an
image share: in time series of positions a usual model (Williams 2003, J. Geodesy 76, 483-494).
Shares and memories are those that explain the mean products of residuals at all distances in time,
by the expectation of such products where every series lost its own mean. In a short recording that
takes away much of the noise at low frequencies, which is where most effects are.

An estimate that weights whitened noise by v has the variance v^T R v, not v^T v. Unlike an average
over the recording's own few slow swings, the correlation R of very many marks is well known.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxvm.discover.cells import local_rows
from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment
from jaxvm.solve.covariance import influence

LONGEST = 0.3
"""Longest distance in time that is looked at, as a share of the recording."""

_SHOWN, _SHOWN_OF_IMAGES = 9.2, 20.0
"""Chi-square with which a process must show: that of 1 % for two unknowns.

Images that share noise of which marks remember nothing must show it beyond doubt: an effect that is
not quite what was fitted leaves as much, and would then speak against what was found of it.
"""

_FELT = 1e-3
"""Share of the power of shifts of images that must be left in residuals for them to tell."""

_UNEQUAL, _OF_MEDIAN = 3.0, 1.17
"""Standard deviations by which a camera's noise must differ, and that of the logarithm of a median
absolute value, times the root of the number of values: 1 / (4 z phi(z)) at z = 0.6745."""

_BY_EPOCH = (0.0, *np.exp(-1.0 / np.geomspace(0.3, 50.0, 24)))
"""Correlations of neighbouring epochs that are tried."""


@dataclass(frozen=True)
class Correlation:
    """Correlation R of whitened noise of unit variance; all else of it is white.

    Attributes:
        mark, image: shares of the variance that a mark remembers, and that all marks of an image
            share.
        of_mark, of_image: their correlations from epoch to epoch.
    """

    mark: float = 0.0
    of_mark: float = 0.0
    image: float = 0.0
    of_image: float = 0.0

    @property
    def white(self) -> bool:
        """Whether nothing is remembered or shared."""
        return not self.mark + self.image > 0.0

    @classmethod
    def of(cls, fitted: Adjustment, residual: Float[np.ndarray, "observations 2"]) -> "Correlation":
        """The correlation that residuals show; white noise where they show none or have no clock.

        Args:
            fitted: the scene's adjustment.
            residual: its whitened residuals in the order of the recording, NaN where not fitted.
        """
        scene = fitted.scene
        epoch, n_epochs = scene.recording.observations.epoch, len(scene.recording.time)
        used = np.all(np.isfinite(residual), axis=1)
        n_lags = int(LONGEST * n_epochs)
        if not scene.recording.timed or n_lags < 3 or used.sum() < 50:
            return cls()
        mark, _ = _labels(scene)
        left = np.where(used[:, None], residual, 0.0)
        seen = _by_epoch(mark, epoch, 1.0 * used[:, None], n_epochs)
        each = _without_means(_by_epoch(mark, epoch, left, n_epochs), seen > 0.0)
        own, pairs = _products(each, n_lags), 2.0 * _products(seen, n_lags)
        if not own[0] > 0.0:
            return cls()
        own = own / np.maximum(pairs, 1.0) / (own[0] / pairs[0])
        at = np.any(seen > 0.0, axis=(0, 2))
        expected = _expected(at, n_lags)
        share, m = _process(own, pairs, expected, beside=expected[0])
        of_marks = (1.0 - share) * expected[0] + share * expected[m]
        shared, sure = _of_images(fitted, each[mark, epoch], used, at, of_marks)
        common, k = _process(shared, sure, expected, shown=_SHOWN_OF_IMAGES)
        if share > 0.0 and not common > 0.0:
            # What images share need not be shown where marks remember: likely they do, too.
            (common, _), k = _process(shared, sure, expected[m : m + 1], shown=0.0), m
        common = min(common, 1.0)
        share, m = _process(own - common * expected[k], pairs, expected, beside=expected[0])
        return cls(min(share, 1.0 - common), _BY_EPOCH[m], common, _BY_EPOCH[k])

    def between(
        self, scene: Scene, weights: Float[np.ndarray, "observations 2 k"]
    ) -> Float[np.ndarray, "k k"]:
        """Covariance W^T R W of estimates that weight whitened noise by the columns of W."""
        flat = weights.reshape(-1, weights.shape[2])
        found = (1.0 - self.mark - self.image) * (flat.T @ flat)
        epoch, n_epochs = scene.recording.observations.epoch, len(scene.recording.time)
        mark, image = _labels(scene)
        for share, by_epoch, label in (
            (self.mark, self.of_mark, mark),
            (self.image, self.of_image, image),
        ):
            if share > 0.0:
                found += share * _remembered(_by_epoch(label, epoch, weights, n_epochs), by_epoch)
        return found


@dataclass(frozen=True)
class Met:
    """What correlated noise does to the estimates of one effect.

    Attributes:
        ratio: of the variances of its amplitudes, then of its constants, to those in white noise of
            one level.
        inflation, freedom: its drop of chi-square under noise alone is about `inflation` times a
            chi-square with so many degrees of freedom (Satterthwaite 1946).
    """

    ratio: Float[np.ndarray, " parameters"]
    inflation: float
    freedom: float


def levels(
    fitted: Adjustment, residual: Float[np.ndarray, "observations 2"]
) -> Float[np.ndarray, " cameras"]:
    """Standard deviation of every camera's noise over that of all, by median absolute residuals.

    1 where the difference may be chance. Sigmas that a recording states may be right for one camera
    and wrong for another: what one of them shows is known by its own noise.

    Args:
        fitted: the scene's adjustment.
        residual: its whitened residuals in the order of the recording, NaN where not fitted.
    """
    scene = fitted.scene
    camera, found = scene.recording.observations.camera, np.ones(len(scene.model.cameras))
    size = np.abs(residual)
    overall = np.nanmedian(size) if np.isfinite(size).any() else 0.0
    for k in range(len(found)):
        own = size[camera == k]
        own = own[np.isfinite(own)]
        if overall > 0.0 and len(own) and np.median(own) > 0.0:
            ratio = float(np.median(own) / overall)
            if abs(np.log(ratio)) > _UNEQUAL * _OF_MEDIAN / np.sqrt(len(own)):
                found[k] = ratio
    return found


def met(
    fitted: Adjustment,
    noise: Correlation,
    levels: Float[np.ndarray, " cameras"] | None = None,
) -> list[Met]:
    """What noise of this correlation, and of a level for each camera, does to each effect."""
    scene, layout = fitted.scene, fitted.problem.network.layout
    amplitude, constant = layout.all("amplitude"), layout.all("constant")
    places = [
        np.concatenate([amplitude[columns], constant[constants]])
        for columns, constants in scene.places()
    ]
    sizes = [columns.stop - columns.start for columns, _ in scene.places()]
    level = np.ones(len(scene.model.cameras)) if levels is None else levels
    if not places or (noise.white and np.all(level == 1.0)):
        return [Met(np.ones(len(own)), 1.0, n) for own, n in zip(places, sizes, strict=True)]
    found = influence(fitted, np.concatenate(places))
    n_observations = len(scene.recording.observations.epoch)
    pixels = np.zeros((n_observations, *found.pixels[0].shape[1:]))
    for rows, block in zip(scene.tables, found.pixels, strict=True):
        pixels[rows] = block
    blocks = [np.reshape(block, (-1, block.shape[-1])) for block in jax.tree.leaves(found)]
    white = np.sum([block.T @ block for block in blocks], axis=0)
    flat = pixels.reshape(-1, pixels.shape[2])
    scaled = pixels * level[scene.recording.observations.camera][:, None, None]
    correlated = white - flat.T @ flat + noise.between(scene, scaled)
    ends = np.cumsum([len(own) for own in places])
    return [
        _met(white[own, own], correlated[own, own], n)
        for own, n in zip(map(slice, ends - [len(p) for p in places], ends), sizes, strict=True)
    ]


def _met(white: np.ndarray, correlated: np.ndarray, n: int) -> Met:
    """From the covariances of amplitudes, of which there are n, and constants."""
    usual = np.diagonal(white)
    ratio = np.where(usual > 0.0, np.diagonal(correlated) / np.where(usual > 0.0, usual, 1.0), 1.0)
    # A drop of chi-square is a^T C^-1 a of the amplitudes, with the C of white noise.
    relative = np.linalg.lstsq(white[:n, :n], correlated[:n, :n], rcond=1e-10)[0]
    mean, spread = np.trace(relative), np.trace(relative @ relative)
    return Met(ratio, float(spread / mean), float(mean**2 / spread))


def random_signs(
    n_epochs: int, repetitions: int, seed: int
) -> Float[np.ndarray, "epochs repetitions"]:
    """Random signs of whole epochs: white noise stays what it is, and an effect does not.

    What noise of another correlation gives is judged by what it is inflated (`Met`); as large as
    chi-square then is under white noise, it is as rare as there.
    """
    return np.random.default_rng(seed).choice([-1.0, 1.0], (n_epochs, repetitions))


def _labels(scene: Scene) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Of every observation: a mark as seen by a camera, and the camera."""
    obs = scene.recording.observations
    mark = obs.camera * scene.first_point[-1] + scene.first_point[obs.target] + obs.point
    return np.unique(mark, return_inverse=True)[1], obs.camera


def _by_epoch(label, epoch, values, n_epochs: int) -> Float[np.ndarray, "labels epochs ..."]:
    """Sums of values over the observations of a label and an epoch."""
    found = np.zeros((int(label.max()) + 1, n_epochs, *values.shape[1:]))
    np.add.at(found, (label, epoch), values)
    return found


def _without_means(series, seen) -> Float[np.ndarray, "labels epochs components"]:
    """Every series without its mean over the epochs where it is seen."""
    count = np.maximum(seen.sum(1, keepdims=True), 1)
    return series - seen * series.sum(1, keepdims=True) / count


def _of_images(fitted: Adjustment, left, used, at, of_marks) -> tuple[np.ndarray, np.ndarray]:
    """Mean products of what images share, of unit variance, and how sure each is; by distance.

    Of an image that moves as a whole an epoch's own unknowns leave little, and what marks have for
    themselves (`of_marks`, their mean products) moves it, too.
    """
    scene, n_lags = fitted.scene, len(of_marks)
    epoch, n_epochs = scene.recording.observations.epoch, len(at)
    shift = _shifts(fitted, used)
    by_mark = _by_epoch(_labels(scene)[0], epoch, shift, n_epochs)
    moved = np.zeros((1, n_epochs, shift.shape[2]))
    np.add.at(moved[0], epoch, np.einsum("ncs,nc->ns", shift, left))
    square = np.zeros((1, n_epochs, *2 * shift.shape[2:]))
    np.add.at(square[0], epoch, np.einsum("ncs,nct->nst", shift, shift))
    power = _products(square, n_lags)
    images = np.zeros((n_epochs, len(scene.model.cameras)))
    np.add.at(images, (epoch[used], scene.recording.observations.camera[used]), 1.0)
    if power[0] <= _FELT * 2.0 * np.sum(images**2):
        return np.zeros(n_lags), np.zeros(n_lags)
    found = _products(_without_means(moved, at[None, :, None]), n_lags) / fitted.variance_factor
    found -= of_marks * _products(by_mark, n_lags)
    # At no distance in time a product is a square, of twice the variance.
    return found / np.maximum(power, 1e-300), power / np.where(np.arange(n_lags) > 0, 1.0, 2.0)


def _shifts(fitted: Adjustment, used: np.ndarray) -> Float[np.ndarray, "observations 2 shifts"]:
    """What is left of a shift of every camera's image, in u and in v, in whitened residuals."""
    obs, scene = fitted.scene.recording.observations, fitted.scene
    n_cameras = len(scene.model.cameras)
    shift = np.zeros((len(obs.epoch), 2, n_cameras, 2))
    shift[:, 0, :, 0] = shift[:, 1, :, 1] = obs.camera[:, None] == np.arange(n_cameras)
    shift = used[:, None, None] * shift.reshape(len(obs.epoch), 2, -1)
    half, group = local_rows(fitted)
    along = np.zeros((int(group.max(initial=-1)) + 2, half.shape[2], shift.shape[2]))
    np.add.at(along, group, np.einsum("ncd,ncs->nds", half, shift, optimize=True))
    return shift - np.einsum("ncd,nds->ncs", half, along[group], optimize=True)


def _products(series, n_lags: int) -> Float[np.ndarray, " lags"]:
    """Sums of the products of a series with itself, at all distances in time."""
    n = series.shape[1]
    return np.array([np.sum(series[:, d:] * series[:, : n - d]) for d in range(n_lags)])


def _expected(fitted: np.ndarray, n_lags: int) -> Float[np.ndarray, "processes lags"]:
    """Mean products of each process in `_BY_EPOCH`, of unit variance but without its own mean."""
    n, distance = len(fitted), np.arange(len(fitted))
    count = np.correlate(1.0 * fitted, 1.0 * fitted, "full")[n - 1 :][:n_lags]
    found = []
    for by_epoch in _BY_EPOCH:
        kernel = by_epoch**distance
        both = np.concatenate([kernel[:0:-1], kernel])
        row = np.convolve(fitted, both)[n - 1 : 2 * n - 1]
        row = np.where(fitted, row / fitted.sum(), 0.0)
        rows = np.correlate(row, 1.0 * fitted, "full") + np.correlate(1.0 * fitted, row, "full")
        lost = rows[n - 1 :][:n_lags] / np.maximum(count, 1.0)
        found.append(kernel[:n_lags] - lost + row.sum() / fitted.sum())
    return np.array(found)


def _process(values, weight, expected, beside=0.0, shown=_SHOWN) -> tuple[float, int]:
    """Share of the process that explains mean products best, and its place in `_BY_EPOCH`.

    White noise, which has no memory, is left to what is `beside` it. Zero where it is no more than
    chance.
    """
    root = np.sqrt(weight)
    other = root * beside
    other = other / max(float(np.linalg.norm(other)), 1e-300)
    values = root * values
    values = values - other * (other @ values)
    best, found = shown, (0.0, 0)
    for k, basis in enumerate(root * expected):
        own = basis - other * (other @ basis)
        square, projection = float(own @ own), float(own @ values)
        if (
            projection > 0.0
            and square > 1e-9 * float(basis @ basis)
            and projection**2 > best * square
        ):
            best, found = projection**2 / square, (projection / square, k)
    return found


def _remembered(courses, by_epoch: float) -> Float[np.ndarray, "k k"]:
    """Sum over labels and components of W^T K W, with K the powers of `by_epoch`."""
    first = np.moveaxis(courses, 1, 0)
    filtered = first.copy()
    for e in range(1, len(first)):
        filtered[e] += by_epoch * filtered[e - 1]
    flat, own = (a.reshape(-1, a.shape[-1]) for a in (filtered, first))
    half = own.T @ flat
    return half + half.T - own.T @ own
