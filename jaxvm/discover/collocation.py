"""Least-squares collocation: what neighbouring marks of one image share at random, as haze does.

No course takes such a signal away: every image has its own. It is known by its covariance, which
falls with the distance of the marks, and by that covariance the nearest marks of the image foretell
the error of one among them (Moritz 1972; Mikhail 1976, ch. 17):

    foretold = c^T (C + 1)^-1 r,      C_ij = q exp(-(d_ij / l)^(5/3)),

in units of the noise. The power of 5/3 is that of the structure function of turbulent air
(Kolmogorov 1941). Two numbers describe a camera, q and l: what they foretell in epochs that were
never fitted is the proof.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from jaxvm.discover.heldout import Gain, HeldOut, Split, gain
from jaxvm.discover.scatter import ALIKE, Neighbours, clipped, likeness, neighbours
from jaxvm.network.residual import residual
from jaxvm.network.scene import Scene
from jaxvm.solve.adjust import Adjustment, reference_sigma

LASTING = 0.5
"""Share of the signal that the next epoch still has, from which it is no accident of one image."""

_NEAREST = 16
"""Marks of the image that foretell one; what is farther adds next to nothing."""

_RATIOS = np.geomspace(0.03, 1000.0, 19)
_LENGTHS = 8
_SURE, _ALSO = 3.0, 2.0
"""Standard deviations by which the signal of one camera must differ from none, and of others."""

_WHOLE, _CLEARLY = 1e9, 2.0
"""Length (px) of what moves images as a whole; standard deviations by which it must be worse."""

_BINS = 8

_MOST = 0.999
"""Share of the squares of the errors that can be signal."""


@dataclass(frozen=True)
class Signal:
    """What the marks of an image share at random.

    Attributes:
        cameras: numbers of the cameras that show it.
        ratio: for each camera of the model, variance of the signal over that of the noise.
        length_px: distance of marks (px) over which the covariance falls to 1/e; infinite where
            images move as a whole.
        size_rad: its standard deviation as a tilt of the rays, for each of these cameras.
        size_stds_rad: standard deviations of these, from the scatter among images.
        length_rad: the distance as an angle, of the first camera that shows it; or infinite.
        lasting: share that the next epoch still has.
        p_value: that neighbours which share nothing are so much alike.
        drop: of chi-square in the fitted epochs, by the stated sigmas.
        by_distance: mean distance of marks (px), and the mean product of their errors (whitened)
            before and after, by distance.
        gain: on held-out epochs.
        heldout: squares of the held-out epochs that are left.
    """

    cameras: tuple[int, ...]
    ratio: np.ndarray
    length_px: float
    size_rad: np.ndarray
    size_stds_rad: np.ndarray
    length_rad: float
    lasting: float
    p_value: float
    drop: float
    by_distance: np.ndarray
    gain: Gain
    heldout: HeldOut

    @property
    def whole(self) -> bool:
        """Whether images move as a whole: what each stabiliser does, too."""
        return not np.isfinite(self.length_px)


def collocate(fitted: Adjustment, heldout: HeldOut, parts: Split, seed: int = 0) -> Signal | None:
    """The signal that neighbouring marks share at random, if held-out epochs prove it.

    None where neighbours are alike by chance; where what they share lasts from one epoch to the
    next, which a deformation does that is not modelled; and where fewer than two cameras show it:
    what one has for itself is no signal of the air, and has an amount for every image. It falls off
    with distance where that foretells clearly better than images that move as a whole; those that
    do so a little (`ALIKE`) have noise in common.

    Args:
        fitted: the last fit, to the fitted epochs.
        heldout: its errors on the held-out epochs, whose scene has their poses.
        parts: what is fitted and what is held out.
        seed: of the bootstrap.
    """
    scene = fitted.scene
    n_cameras = len(scene.model.cameras)
    whitened = parts.residuals(fitted)
    alike = likeness(scene, whitened)
    if n_cameras < 2 or not alike:
        return None
    marks = _Marks.of(scene, whitened)
    common, length = _covariance(marks, _lengths(marks))
    shown = _Shown.of(marks, np.full(n_cameras, common), length)
    whole, far = _covariance(marks, np.array([_WHOLE]))
    as_a_whole = _Shown.of(marks, np.full(n_cameras, whole), far)
    if not shown.better(as_a_whole, scene):
        if alike <= ALIKE:
            return None
        shown, length = as_a_whole, far
    variances, stds = shown.variances(scene)
    cameras = tuple(np.flatnonzero(variances > _ALSO * stds).tolist())
    sure = (variances > _SURE * stds).any()
    if not sure or len(cameras) < 2 or abs(shown.lasting(scene, cameras)) > LASTING:
        return None
    squares = np.array([np.mean(marks.error[marks.camera == c] ** 2) for c in cameras])
    signal = np.minimum(variances[[*cameras]], _MOST * squares)
    ratio = np.zeros(n_cameras)
    ratio[[*cameras]] = signal / (squares - signal)
    left = marks.error - _Shown.of(marks, ratio, length).foretold
    after = _on_heldout(heldout, parts, ratio, length)
    proof = gain(heldout, after, seed)
    reach = np.inf if length == _WHOLE else length
    focal = np.asarray(scene.state.focal).mean(axis=1)[[*cameras]]
    sizes = np.sqrt(variances[[*cameras]])
    unit = reference_sigma(scene) / focal
    found = Signal(
        cameras=cameras,
        ratio=ratio,
        length_px=reach,
        size_rad=sizes * unit,
        size_stds_rad=0.5 * stds[[*cameras]] / sizes * unit,
        length_rad=float(reach / focal[0]),
        lasting=shown.lasting(scene, cameras),
        p_value=float(min(n_cameras * ndtr(-(variances / stds)[[*cameras]].max()), 1.0)),
        drop=float(np.sum(marks.error**2) - np.sum(left**2)),
        by_distance=_by_distance(marks, left, cameras),
        gain=proof,
        heldout=after,
    )
    return found if proof.proven else None


@dataclass(frozen=True)
class _Marks:
    """Marks with their errors and those around them.

    Attributes:
        near: the marks and their neighbours.
        camera: of each mark.
        error: whitened residuals [marks, 2]; gross ones are cut.
    """

    near: Neighbours
    camera: np.ndarray
    error: np.ndarray

    @classmethod
    def of(cls, scene: Scene, whitened: np.ndarray) -> "_Marks":
        """Of whitened residuals [observations, 2], NaN where there is none."""
        near = neighbours(scene, whitened, _NEAREST)
        camera = scene.recording.observations.camera[near.rows]
        return cls(near, camera, clipped(whitened[near.rows]))

    def correlations(self, length: float) -> tuple[np.ndarray, np.ndarray]:
        """Of the signal among the neighbours of each mark, and of these with the mark."""
        places = self.near.at[self.near.nearest]
        among = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
        known = self.near.known
        both = known[:, :, None] & known[:, None]
        return _fall(among / length) * both, _fall(self.near.distance / length) * known


def _fall(distance: np.ndarray) -> np.ndarray:
    return np.exp(-(distance ** (5.0 / 3.0)))


def _lengths(marks: _Marks) -> np.ndarray:
    """Lengths (px) to be tried."""
    distance = marks.near.distance[marks.near.known]
    return np.geomspace(np.median(distance) / 4.0, 8.0 * distance.max(), _LENGTHS)


def _covariance(marks: _Marks, lengths: np.ndarray) -> tuple[float, float]:
    """Ratio, common to all cameras, and length (px) that foretell best."""
    error, around = marks.error, marks.error[marks.near.nearest]
    left = np.empty((len(lengths), len(_RATIOS)))
    for k, length in enumerate(lengths):
        among, to = marks.correlations(length)
        # Along the axes of the neighbours' correlation another ratio costs a product of vectors.
        values, axes = np.linalg.eigh(among)
        along = np.einsum("nkj,nkc->njc", axes, around)
        seen = np.einsum("nkj,nk->nj", axes, to)
        for q, ratio in enumerate(_RATIOS):
            weights = ratio * seen / (1.0 + ratio * values)
            left[k, q] = np.sum((error - np.einsum("nj,njc->nc", weights, along)) ** 2)
    k, q = np.unravel_index(np.argmin(left), left.shape)
    return float(_RATIOS[q]), float(lengths[k])


def _by_distance(marks: _Marks, left: np.ndarray, cameras: tuple[int, ...]) -> np.ndarray:
    """Distances of marks, and means of the products of their errors before and after, in bins."""
    used = marks.near.known & np.isin(marks.camera, cameras)[:, None]
    apart = marks.near.distance[used]
    edges = np.quantile(apart, np.linspace(0.0, 1.0, _BINS + 1)[1:-1])
    which = np.digitize(apart, edges)
    columns = [apart]
    for error in (marks.error, left):
        columns.append(0.5 * np.einsum("nc,nkc->nk", error, error[marks.near.nearest])[used])
    count = np.maximum(np.bincount(which, minlength=_BINS), 1)
    return np.stack([np.bincount(which, c, _BINS) / count for c in columns], axis=1)


@dataclass(frozen=True)
class _Shown:
    """What the nearest marks of the image say of each mark.

    What the mark has in common with them is the signal alone: the product of its error with what
    they foretell gives the signal's variance without a model of the noise.

    Attributes:
        marks: the marks.
        foretold: errors [marks, 2].
        per_variance: expected product for a signal of variance 1.
    """

    marks: _Marks
    foretold: np.ndarray
    per_variance: np.ndarray

    @classmethod
    def of(cls, marks: _Marks, ratio: np.ndarray, length: float) -> "_Shown":
        """With the ratio of each camera and the length (px)."""
        among, to = marks.correlations(length)
        own = ratio[marks.camera][:, None]
        matrix = own[:, :, None] * among + np.eye(among.shape[1])
        weights = np.linalg.solve(matrix, (own * to)[:, :, None])[:, :, 0]
        foretold = np.einsum("nk,nkc->nc", weights, marks.error[marks.near.nearest])
        return cls(marks, foretold, 2.0 * np.sum(weights * to, axis=1))

    def better(self, other: "_Shown", scene: Scene) -> bool:
        """Whether it foretells clearly better than another does, image by image."""
        obs, rows = scene.recording.observations, self.marks.near.rows
        image = obs.epoch[rows] * len(scene.model.cameras) + obs.camera[rows]
        theirs, own = (
            np.bincount(image, np.sum((self.marks.error - one.foretold) ** 2, axis=1))
            for one in (other, self)
        )
        won = theirs - own
        return float(won.sum()) > _CLEARLY * float(np.sqrt(np.sum(won**2)))

    def variances(self, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
        """Of the signal of each camera (whitened), and their standard deviations.

        The images are independent of each other: their scatter tells how well it is known.
        """
        n = len(scene.recording.time)
        epoch = scene.recording.observations.epoch[self.marks.near.rows]
        product = np.sum(self.marks.error * self.foretold, axis=1)
        variances, stds = np.zeros((2, len(scene.model.cameras)))
        for c in set(self.marks.camera):
            mine = self.marks.camera == c
            products = np.bincount(epoch[mine], product[mine], n)
            expected = np.bincount(epoch[mine], self.per_variance[mine], n)
            if expected.sum() > 0.0:
                variances[c] = products.sum() / expected.sum()
                left = products - variances[c] * expected
                stds[c] = np.sqrt(np.sum(left**2)) / expected.sum()
        return variances, stds

    def lasting(self, scene: Scene, cameras: tuple[int, ...]) -> float:
        """Share of the signal of some cameras that the same mark still has in the next epoch."""
        obs, rows = scene.recording.observations, self.marks.near.rows
        mark = scene.first_point[obs.target[rows]] + obs.point[rows]
        series = mark * len(scene.model.cameras) + obs.camera[rows]
        key = series * (len(scene.recording.time) + 1) + obs.epoch[rows]
        order = np.argsort(key)
        after = np.minimum(np.searchsorted(key[order], key + 1), len(key) - 1)
        has_next = (key[order][after] == key + 1) & np.isin(self.marks.camera, cameras)
        foretold = self.foretold[has_next]
        now = np.sum(foretold * self.marks.error[has_next])
        then = np.sum(foretold * self.marks.error[order[after[has_next]]])
        return float(then / now) if now > 0.0 else 0.0


def _on_heldout(heldout: HeldOut, parts: Split, ratio: np.ndarray, length: float) -> HeldOut:
    """Errors on the held-out epochs less what the marks around foretell."""
    scene = heldout.scene
    whitened = np.full((len(scene.recording.observations.epoch), 2), np.nan)
    blocks = residual(scene.state, scene.network).pixels
    for rows, sound, block in zip(scene.tables, parts.sound, blocks, strict=True):
        held = parts.judged[scene.recording.observations.epoch[rows]] & (sound > 0.0)
        whitened[rows[held]] = np.asarray(block)[: len(rows)][held]
    marks = _Marks.of(scene, whitened)
    foretold = _Shown.of(marks, ratio, length).foretold
    epoch = scene.recording.observations.epoch[marks.near.rows]
    errors = whitened[marks.near.rows]
    before, after = (
        np.bincount(epoch, np.sum(e**2, axis=1), len(parts.judged))[parts.judged]
        for e in (errors, errors - foretold)
    )
    square = heldout.square * after / np.maximum(before, 1e-300)
    rms = np.sqrt(square.sum() / max(heldout.count.sum(), 1.0)) * reference_sigma(scene)
    return replace(heldout, rms_px=float(rms), square=square)
