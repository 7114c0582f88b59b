"""From the pixel level to the pose level: every view as a measured relative pose.

A view is one target in one image. Alone it gives the pose of the target before the camera, by
maximum likelihood, with the covariance of its own pixels; known mounts carry that to the stations.
A network of known cameras loses nothing by it, to first order. What several views have in common it
does lose: free intrinsics of one camera, and effects of a temperature. Each view then has to find
its own, for a link can't say that another link errs alike.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.stats import chi2

from jaxvm.geometry import (
    LensFamily,
    pose_from_vector,
    se3_adjoint,
    so3_exp,
    vector_from_pose,
)
from jaxvm.network.factors import rounded
from jaxvm.network.residual import parts_of, predict_pixels
from jaxvm.network.scene import Scene
from jaxvm.network.state import N_DISTORTION
from jaxvm.network.views import MIN_POINTS
from jaxvm.physics.blocks import by_blocks
from jaxvm.pose.monocular import locate
from jaxvm.pose.refine import Refined, refine_many
from jaxvm.pose.sighting import Sighting, sighting
from jaxvm.recording.model import Camera, Prior
from jaxvm.recording.recording import Links, Recording, no_observations

_BY_CHANCE = 1e-6
"""Chance of a chi-square beyond which another start of a view is tried."""

_SINGULAR = 1e-13
"""Eigenvalue of a unit-diagonal normal matrix below which marks give no pose."""

_STEPS, _SETTLED = 30, 1e-6
"""Most steps of a view's own intrinsics, and the step in standard deviations that ends them."""

_N_INTRINSICS = 4 + N_DISTORTION


def view_links(scene: Scene) -> Links:
    """Every view as a measured relative pose with its full covariance.

    A link leads from the camera's station to the target's station. Where the camera's mount is free
    it begins at the camera itself; where the target's is, or the target stands in the world, it
    ends at the target itself. Its pose has the maximum likelihood of the pixels of that view alone.
    Points, and intrinsics that are held, are taken as they are at present. Intrinsics that are free
    are unknowns of each view for itself, with the priors of the model. Effects are taken off the
    pixels at their present size.

    Views with fewer than four marks of known coordinates, and with marks on one line, give no link.

    Args:
        scene: at start values or adjusted; intrinsics that are held must be known. Rays must have
            z > 0. Poses need not be near: a view that they don't explain starts anew.

    Raises:
        ValueError: the marks of a view don't determine the free intrinsics; it is named.
    """
    marks = _marks(scene)
    views = _views(scene, marks)
    if len(views.camera) == 0:
        return _no_links()
    intrinsics = np.concatenate(
        [np.asarray(t) for t in (scene.state.focal, scene.state.centre, scene.state.distortion)],
        axis=1,
    )[views.camera]
    starts = _present(scene, views)
    seen = _sightings(marks, views, intrinsics)
    found = _best(seen, starts)
    basis, prior = _freedom(scene, views.camera)
    if basis.any():
        found = _self_calibrated(scene, marks, views, intrinsics, basis, prior, found)
    sound = np.isfinite(found.covariance).all(axis=(1, 2)) & _regular(found.covariance)
    return _links(scene, views, found, np.flatnonzero(sound))


def pose_level(scene: Scene) -> Recording:
    """The recording of stations and relative poses alone: `view_links`, and the links it had.

    What was held or free stays so. Cameras and targets are gone but for those that links begin or
    end at; of these the poses stay free, intrinsics and points are held at present values. Ranges,
    drivers, effects and priors of what is gone go with the pixels.
    """
    model, own, state = scene.model, scene.recording.links, scene.state
    links = view_links(scene)
    if own is not None:
        links = _joined(own, links)
    nodes = {*links.from_node, *links.to_node}
    kept = {
        kind: [i for i in range(len(bodies)) if (kind, i) in nodes]
        for kind, bodies in (("camera", model.cameras), ("target", model.targets))
    }
    place = {(kind, i): (kind, k) for kind, rows in kept.items() for k, i in enumerate(rows)}

    def bare(i: int) -> Camera:
        camera = model.cameras[i]
        count = len(np.trim_zeros(np.asarray(state.distortion[i]), "b"))
        count = max(count, 0 if camera.distortion is None else len(camera.distortion))
        return replace(
            camera,
            focal_px=np.array(state.focal[i]),
            centre_px=np.array(state.centre[i]),
            distortion=np.array(state.distortion[i, :count]) if count else None,
            free=camera.free & {"pose"},
        )

    def stays(prior: Prior) -> bool:
        kind, name, quantity = prior.parameter.split(".")
        bodies = {"cameras": kept["camera"], "targets": kept["target"]}
        of_kind = getattr(model, kind)
        named = [body.name for body in of_kind].index(name)
        return quantity == "pose" and (kind == "stations" or named in bodies.get(kind, ()))

    return replace(
        scene.recording,
        model=replace(
            model,
            cameras=tuple(map(bare, kept["camera"])),
            targets=tuple(
                replace(model.targets[i], free=model.targets[i].free & {"pose"})
                for i in kept["target"]
            ),
            rangefinders=(),
            drivers={},
            priors=tuple(filter(stays, model.priors)),
            effects=(),
        ),
        velocities={},
        observations=no_observations(),
        drivers=None,
        ranges=None,
        links=replace(
            links,
            from_node=[place.get(node, node) for node in links.from_node],
            to_node=[place.get(node, node) for node in links.to_node],
        ),
    )


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
class _Views:
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

    def laid(self, parts: list[np.ndarray]) -> np.ndarray:
        """Values of marks, table by table, as [views, width, ...]; zero where there is none."""
        out = np.zeros((len(self.camera), self.width, *parts[0].shape[1:]))
        for own, view, rank in zip(parts, self.view, self.rank, strict=True):
            used = view >= 0
            out[view[used], rank[used]] = own[used]
        return out


def _views(scene: Scene, marks: list[_Table]) -> _Views:
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
    return _Views(
        camera,
        target,
        epoch,
        count[enough],
        np.split(number[view], cuts),
        np.split(rank, cuts),
    )


def _present(scene: Scene, views: _Views) -> Float[np.ndarray, "views 6"]:
    """Present camera_from_target."""
    state, stations = scene.state, scene.station_places
    of_camera = np.array([stations[c.station] for c in scene.model.cameras], int)
    station = scene.station_row[of_camera[views.camera], views.epoch]
    return np.asarray(
        _relative(
            np.asarray(state.world_from_station)[station],
            np.asarray(state.station_from_camera)[views.camera],
            scene.world_from_targets(views.target, views.epoch),
        )
    )


@jax.jit
@jax.vmap
def _relative(world_from_station, station_from_camera, world_from_target):
    station, camera, target = map(
        pose_from_vector, (world_from_station, station_from_camera, world_from_target)
    )
    return vector_from_pose((station @ camera).inverse() @ target)


def _per_mark(function: Callable, marks: list[_Table], views: _Views, intrinsics, *others):
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


def _sightings(marks: list[_Table], views: _Views, intrinsics) -> Sighting:
    return Sighting(*map(jnp.asarray, _per_mark(_sight, marks, views, intrinsics)))


@eqx.filter_jit
def _sight(family: LensFamily, data):
    def one(point, pixel, sigma, p):
        coefficients = p[4 : 4 + family.n_coefficients]
        own = sighting(point[None], pixel[None], p[:2], p[2:4], family, coefficients)
        return own.points[0], own.image[0], own.whitener[0] / sigma[:, None]

    return jax.vmap(one)(*data)


class _Found(NamedTuple):
    """Poses of views, and covariances of a turn and a shift as the camera sees them."""

    camera_from_target: Float[np.ndarray, "views 6"]
    covariance: Float[np.ndarray, "views 6 6"]


def _best(seen: Sighting, starts: Float[np.ndarray, "views 6"]) -> _Found:
    """Maximum likelihood from the starts; where that is bad, from the pixels of the view alone."""
    found = refine_many(seen, jnp.asarray(starts))
    cost, pose = np.array(found.cost), np.array(found.observer_from_target)
    covariance = np.array(found.covariance)
    used = np.any(np.asarray(seen.whitener) != 0.0, axis=(2, 3))
    limit = chi2.isf(_BY_CHANCE, np.maximum(2 * used.sum(axis=1) - 6, 1))
    again = np.flatnonzero(~(cost <= limit))
    if len(again):
        second = by_blocks(_located, jax.tree.map(lambda leaf: np.asarray(leaf)[again], seen))
        better = ~(cost[again] <= np.asarray(second.cost))
        pose[again[better]] = np.asarray(second.observer_from_target)[better]
        covariance[again[better]] = np.asarray(second.covariance)[better]
    return _Found(pose, covariance)


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
    scene: Scene, marks, views: _Views, intrinsics, basis, prior, found: _Found
) -> _Found:
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
        found = _Found(np.array(again.observer_from_target), np.array(again.covariance))
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


def _undetermined(scene: Scene, views: _Views, k: int) -> str:
    camera = scene.model.cameras[views.camera[k]]
    free = ", ".join(sorted(camera.free - {"pose"}))
    return (
        f"{_name(scene, views, k)}: the marks of this view alone don't determine the free {free} "
        f'of camera "{camera.name}"; hold it, give it a prior, or adjust the pixels'
    )


def _name(scene: Scene, views: _Views, k: int) -> str:
    name = f"{scene.model.cameras[views.camera[k]].name} sees "
    name += scene.model.targets[views.target[k]].name
    several = len(scene.recording.epoch_ids) > 1
    return f"{name}, epoch {scene.recording.epoch_ids[views.epoch[k]]}" if several else name


def _links(scene: Scene, views: _Views, found: _Found, kept: Int[np.ndarray, " links"]) -> Links:
    model, places, state = scene.model, scene.station_places, scene.state
    camera, target, epoch = views.camera[kept], views.target[kept], views.epoch[kept]
    mounted = np.array([("pose" not in c.free) for c in model.cameras], bool)
    carried = np.array([bool(t.station) and "pose" not in t.free for t in model.targets], bool)
    from_node = [
        ("station", places[model.cameras[c].station]) if mounted[c] else ("camera", int(c))
        for c in camera
    ]
    to_node = [
        ("station", places[model.targets[t].station]) if carried[t] else ("target", int(t))
        for t in target
    ]
    before = np.asarray(state.station_from_camera)[camera] * mounted[camera, None]
    row = scene.target_row[target, epoch]
    behind = np.asarray(state.carrier_from_target)[row] * carried[target, None]
    pose, covariance = _carried(
        before, found.camera_from_target[kept], found.covariance[kept], behind
    )
    # A station with known mounts that sees its own marks measures nothing.
    apart = np.array([a != b for a, b in zip(from_node, to_node, strict=True)], bool)
    chosen = np.flatnonzero(apart)
    return Links(
        name=tuple(_name(scene, views, int(kept[k])) for k in chosen),
        from_node=[from_node[k] for k in chosen],
        to_node=[to_node[k] for k in chosen],
        pose=np.asarray(pose)[chosen],
        covariance=np.asarray(covariance)[chosen],
        epoch=epoch[chosen],
    )


@jax.jit
@jax.vmap
def _carried(before, camera_from_target, covariance, behind) -> tuple[Array, Array]:
    """a_from_b = before @ camera_from_target @ behind^-1, and the covariance of its twist.

    With E the small turn and shift as the camera sees them, true = before E T behind^-1, so
    measured^-1 . true = exp(Ad(behind T^-1) (turn, shift)) to first order.
    """
    pose, outer = pose_from_vector(camera_from_target), pose_from_vector(behind)
    carry = se3_adjoint(outer @ pose.inverse())
    spread = carry @ covariance @ carry.T
    found = pose_from_vector(before) @ pose @ outer.inverse()
    return vector_from_pose(found), 0.5 * (spread + spread.T)


def _no_links() -> Links:
    return Links((), [], [], np.zeros((0, 6)), np.zeros((0, 6, 6)), np.zeros(0, int))


def _joined(a: Links, b: Links) -> Links:
    return Links(
        a.name + b.name,
        [*a.from_node, *b.from_node],
        [*a.to_node, *b.to_node],
        np.concatenate([a.pose, b.pose]),
        np.concatenate([a.covariance, b.covariance]),
        np.concatenate([a.epoch, b.epoch]),
    )
