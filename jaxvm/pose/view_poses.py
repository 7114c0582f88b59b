"""The pose of every view by itself: one target in one image, by maximum likelihood.

Marks of all cameras are laid out view by view and refined together; where the present poses don't
explain a view it starts anew, and free intrinsics are unknowns of each view for itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtri

from jaxvm.geometry import LensFamily, pose_from_vector, so3_exp
from jaxvm.network.residual import parts_of, predict_pixels
from jaxvm.network.scene import Scene
from jaxvm.network.state import N_DISTORTION
from jaxvm.network.views import MIN_POINTS
from jaxvm.physics.blocks import by_blocks, rounded
from jaxvm.pose.monocular import locate
from jaxvm.pose.refine import Refined, refine_many
from jaxvm.pose.sighting import Sighting, sighting

_BY_CHANCE = 1e-6
"""Chance of a chi-square beyond which another start of a view is tried."""

_SINGULAR = 1e-13
"""Eigenvalue of a unit-diagonal normal matrix below which marks give no pose."""

_STEPS, _SETTLED = 30, 1e-6
"""Most steps of a view's own intrinsics, and the step in standard deviations that ends them."""

_N_INTRINSICS = 4 + N_DISTORTION


def view_poses(scene: Scene) -> tuple["Views", "ViewPoses"]:
    """Poses camera_from_target of all views that their own marks determine.

    As for `jaxvm.pose.view_links.view_links`, which says what is held and what is free.

    Raises:
        ValueError: the marks of a view don't determine the free intrinsics; it is named.
    """
    marks = _marks(scene)
    views = _views(scene, marks)
    if len(views.camera) == 0:
        return views, ViewPoses(np.zeros((0, 6)), np.zeros((0, 6, 6)))
    intrinsics = np.concatenate(
        [np.asarray(t) for t in (scene.state.focal, scene.state.centre, scene.state.distortion)],
        axis=1,
    )[views.camera]
    starts = scene.camera_from_targets(views.camera, views.target, views.epoch)
    seen = _sightings(marks, views, intrinsics)
    found = _best(seen, starts)
    basis, prior = _freedom(scene, views.camera)
    if basis.any():
        found = _self_calibrated(scene, marks, views, intrinsics, basis, prior, found)
    sound = np.isfinite(found.covariance).all(axis=(1, 2)) & _regular(found.covariance)
    return views.only(sound), ViewPoses(*(part[sound] for part in found))


class _Table(NamedTuple):
    """Marks of all cameras with one family of lenses; those that count, in the factor's order."""

    family: LensFamily
    row: Int[np.ndarray, " n"]  # of the recording's observations
    point: Float[np.ndarray, "n 3"]
    pixel: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, "n 2"]


def _marks(scene: Scene) -> list[_Table]:
    flat, found = scene.state.flatten(), []
    for factor, rows, off in zip(scene.network.pixels, scene.tables, _effects(scene), strict=True):
        n = len(rows)
        point = np.asarray(parts_of(factor, flat)[-1])[:n]
        weight = np.asarray(factor.weight)[:n]
        used = (weight > 0.0) & np.isfinite(point).all(axis=1)
        pixel = np.asarray(factor.circumstances.pixel)[:n] - off[:n]
        sigma = np.asarray(factor.sigma)[:n] / np.where(used, weight, 1.0)[:, None]
        found.append(_Table(factor.family, rows[used], point[used], pixel[used], sigma[used]))
    return found


def _effects(scene: Scene) -> list[np.ndarray]:
    """What the effects of the model do to every pixel at present (px)."""
    if not scene.effects:
        return [np.zeros((factor.slots.shape[0], 2)) for factor in scene.network.pixels]
    plain = scene.with_effects(())
    return [
        np.asarray(own) - np.asarray(bare)
        for own, bare in zip(
            predict_pixels(scene.state, scene.network),
            predict_pixels(plain.state, plain.network),
            strict=True,
        )
    ]


@dataclass(frozen=True, eq=False)
class Views:
    """Which mark is seen in which view, and where it stands in there.

    Attributes:
        camera, target, epoch: of each view.
        count: marks of each view.
        view, rank: of each mark of each table; view -1: of no view.
    """

    camera: Int[np.ndarray, " views"]
    target: Int[np.ndarray, " views"]
    epoch: Int[np.ndarray, " views"]
    count: Int[np.ndarray, " views"]
    view: list[Int[np.ndarray, " n"]]
    rank: list[Int[np.ndarray, " n"]]

    @property
    def width(self) -> int:
        """Marks of a view with room for all: few sizes mean few compiled programs."""
        return rounded(int(self.count.max()))

    def only(self, chosen: Bool[np.ndarray, " views"]) -> "Views":
        """Some of the views; marks of the others belong to none."""
        number = np.append(np.where(chosen, np.cumsum(chosen) - 1, -1), -1)
        return Views(
            self.camera[chosen],
            self.target[chosen],
            self.epoch[chosen],
            self.count[chosen],
            [number[view] for view in self.view],
            self.rank,
        )

    def laid(self, parts: list[np.ndarray]) -> np.ndarray:
        """Values of marks, table by table, as [views, width, ...]; zero where there is none."""
        out = np.zeros((len(self.camera), self.width, *parts[0].shape[1:]))
        for own, view, rank in zip(parts, self.view, self.rank, strict=True):
            used = view >= 0
            out[view[used], rank[used]] = own[used]
        return out


def _views(scene: Scene, marks: list[_Table]) -> Views:
    obs = scene.recording.observations
    rows = np.concatenate([np.zeros(0, int), *(table.row for table in marks)])
    key = np.stack([obs.camera[rows], obs.target[rows], obs.epoch[rows]], axis=1)
    distinct, view, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    view = view.ravel()
    order = np.argsort(view, kind="stable")
    rank = np.zeros(len(view), int)
    rank[order] = np.arange(len(view)) - np.repeat(np.cumsum(count) - count, count)
    enough = count >= MIN_POINTS
    camera, target, epoch = distinct[enough].T
    number = np.where(enough, np.cumsum(enough) - 1, -1)
    cuts = np.cumsum([len(table.row) for table in marks])[:-1]
    return Views(
        camera,
        target,
        epoch,
        count[enough],
        np.split(number[view], cuts),
        np.split(rank, cuts),
    )


def _per_mark(function: Callable, marks: list[_Table], views: Views, intrinsics, *others):
    """A function of (family, point, pixel, sigma, intrinsics, ...) of every mark, laid out by view.

    Args:
        function: compiled, of one table; returns a tuple of arrays that lead with the marks.
        intrinsics: of each view: focal, centre, distortion.
        others: further values of each view.
    """
    parts = []
    for table, view in zip(marks, views.view, strict=True):
        own = [np.asarray(values)[view] for values in (intrinsics, *others)]
        data = (table.point, table.pixel, table.sigma, *own)
        parts.append(by_blocks(eqx.Partial(function, table.family), data))
    return [views.laid([np.asarray(p) for p in each]) for each in zip(*parts, strict=True)]


def _sightings(marks: list[_Table], views: Views, intrinsics) -> Sighting:
    return Sighting(*map(jnp.asarray, _per_mark(_sight, marks, views, intrinsics)))


@eqx.filter_jit
def _sight(family: LensFamily, data):
    def one(point, pixel, sigma, p):
        coefficients = p[4 : 4 + family.n_coefficients]
        own = sighting(point[None], pixel[None], p[:2], p[2:4], family, coefficients)
        return own.points[0], own.image[0], own.whitener[0] / sigma[:, None]

    return jax.vmap(one)(*data)


class ViewPoses(NamedTuple):
    """Poses of views, and covariances of a turn and a shift as the camera sees them."""

    camera_from_target: Float[np.ndarray, "views 6"]
    covariance: Float[np.ndarray, "views 6 6"]


def _best(seen: Sighting, starts: Float[np.ndarray, "views 6"]) -> ViewPoses:
    """Maximum likelihood from the starts; where that is bad, from the pixels of the view alone."""
    found = refine_many(seen, jnp.asarray(starts))
    cost, pose = np.array(found.cost), np.array(found.observer_from_target)
    covariance = np.array(found.covariance)
    used = np.any(np.asarray(seen.whitener) != 0.0, axis=(2, 3))
    limit = chdtri(np.maximum(2 * used.sum(axis=1) - 6, 1), _BY_CHANCE)
    again = np.flatnonzero(~(cost <= limit))
    if len(again):
        second = by_blocks(_located, jax.tree.map(lambda leaf: np.asarray(leaf)[again], seen))
        better = ~(cost[again] <= np.asarray(second.cost))
        pose[again[better]] = np.asarray(second.observer_from_target)[better]
        covariance[again[better]] = np.asarray(second.covariance)[better]
    return ViewPoses(pose, covariance)


@jax.jit
@jax.vmap
def _located(seen: Sighting) -> Refined:
    return locate(seen).best


def _regular(covariance: Float[np.ndarray, "views 6 6"]) -> np.ndarray:
    """Whether normal equations have full rank, from their inverse."""
    scale = np.sqrt(np.abs(np.diagonal(covariance, axis1=1, axis2=2)))
    unit = covariance / np.maximum(scale[:, :, None] * scale[:, None, :], 1e-300)
    unit = np.where(np.isfinite(unit), unit, 0.0)
    return (scale > 0.0).all(axis=1) & (np.linalg.eigvalsh(unit).min(axis=1) > _SINGULAR)


def _freedom(scene: Scene, camera: Int[np.ndarray, " views"]):
    """Free intrinsics of each view: directions [views, 18, 18], and what priors say of them.

    Unused directions are zero. Priors: information [views, 18] and expected values [views, 18].
    """
    unknowns, layout = scene.unknowns, scene.network.layout
    n = len(scene.model.cameras)
    basis = np.zeros((n, _N_INTRINSICS, _N_INTRINSICS))
    information, expected = np.zeros((2, n, _N_INTRINSICS))
    priors = scene.network.priors
    for i in range(n):
        own = np.array([i])
        slots = np.concatenate(
            [layout.slots(name, own)[0] for name in ("focal", "centre", "distortion")]
        )
        column = unknowns.column[slots]
        free = np.flatnonzero(column < unknowns.n)
        basis[i, free, np.unique(column[free], return_inverse=True)[1].ravel()] = unknowns.factor[
            slots[free]
        ]
        if priors is not None and len(free):
            mine = np.asarray(priors.slots)[:, 0][:, None] == slots
            weight = (np.asarray(priors.weight) / np.asarray(priors.sigma)[:, 0]) ** 2
            information[i] = weight @ mine
            pull = (weight * np.asarray(priors.expected)) @ mine
            expected[i] = pull / np.where(information[i] > 0.0, information[i], 1.0)
    return basis[camera], (information[camera], expected[camera])


def _self_calibrated(
    scene: Scene, marks, views: Views, intrinsics, basis, prior, found: ViewPoses
) -> ViewPoses:
    """Poses with the free intrinsics of each view: Gauss-Newton steps of these, poses refined.

    The steps are those of the cost that is least over the pose, so poses follow by themselves.
    """
    own = basis.any(axis=(1, 2))
    before, length = np.inf, np.zeros(len(own))
    for _ in range(_STEPS):
        slopes = _per_mark(_slopes, marks, views, intrinsics, found.camera_from_target)
        change, covariance, length, least = map(
            np.asarray, _reduced(*slopes, intrinsics, basis, *prior)
        )
        if not least[own].min() > _SINGULAR:
            raise ValueError(_undetermined(scene, views, int(np.argmin(np.where(own, least, 1.0)))))
        step = length[own].max()
        # The second rule ends at the rounding of the residuals, where steps no longer shorten.
        if step < _SETTLED or 0.5 * before < step < 1e-3:
            return found._replace(
                covariance=np.where(own[:, None, None], covariance, found.covariance)
            )
        before, intrinsics = step, intrinsics + change
        seen = _sightings(marks, views, intrinsics)
        again = refine_many(seen, jnp.asarray(found.camera_from_target))
        found = ViewPoses(np.array(again.observer_from_target), np.array(again.covariance))
    raise ValueError(_undetermined(scene, views, int(np.argmax(np.where(own, length, 0.0)))))


@eqx.filter_jit
def _slopes(family: LensFamily, data):
    """Whitened residuals of marks, and their derivatives by the pose and by all intrinsics."""

    def one(point, pixel, sigma, p, camera_from_target):
        pose = pose_from_vector(camera_from_target)

        def off(twist, p):
            seen = so3_exp(twist[:3]) @ pose.apply(point) + twist[3:]
            at = family.distort(p[4 : 4 + family.n_coefficients], seen)
            return (at * p[:2] + p[2:4] - pixel) / sigma

        still = jnp.zeros(6)
        by_pose, by_own = jax.jacfwd(off, argnums=(0, 1))(still, p)
        return by_pose, by_own, off(still, p)

    return jax.vmap(one)(*data)


@jax.jit
@jax.vmap
def _reduced(by_pose, by_own, value, intrinsics, basis, information, expected):
    """Step of the intrinsics, covariance of the pose, length of the step in standard deviations,
    and the least eigenvalue of the normal equations scaled to a unit diagonal."""
    slope = jnp.concatenate([by_pose, by_own @ basis], axis=2).reshape(-1, 6 + _N_INTRINSICS)
    normal, pull = slope.T @ slope, slope.T @ value.ravel()
    normal = normal.at[6:, 6:].add(basis.T @ (information[:, None] * basis))
    pull = pull.at[6:].add(basis.T @ (information * (intrinsics - expected)))
    # Directions that are not free get a unit diagonal: they stay where they are.
    normal = normal + jnp.diag(jnp.where(jnp.diagonal(normal) == 0.0, 1.0, 0.0))
    scale = 1.0 / jnp.sqrt(jnp.diagonal(normal))
    unit = scale[:, None] * normal * scale
    inverse = scale[:, None] * jnp.linalg.inv(unit) * scale
    change = -inverse @ pull
    length = jnp.sqrt(jnp.maximum(-change @ pull, 0.0))
    return basis @ change[6:], inverse[:6, :6], length, jnp.linalg.eigvalsh(unit)[0]


def _undetermined(scene: Scene, views: Views, k: int) -> str:
    camera = scene.model.cameras[views.camera[k]]
    name = scene.view_name(views.camera[k], views.target[k], views.epoch[k])
    free = ", ".join(sorted(camera.free - {"pose"}))
    return (
        f"{name}: the marks of this view alone don't determine the free "
        f'{free} of camera "{camera.name}"; hold it, give it a prior, or adjust the pixels'
    )
