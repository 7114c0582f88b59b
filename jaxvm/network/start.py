"""Start values from the data alone: intrinsics, poses of views, chaining, triangulation.

The user writes no guesses. What the recording's model gives is kept; everything else follows from
the views: each tells camera_from_target, and a pose that three known neighbours enclose is known.
"""

from collections import defaultdict
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxvm.geometry.lenses import lens_family
from jaxvm.geometry.matrices import matrix, vector
from jaxvm.network.chordal import chordal_poses
from jaxvm.network.graph import UnconnectedNetwork, check_connected
from jaxvm.network.relations import (
    Key,
    Relation,
    held_poses,
    link_relations,
    name_of,
    pose_graph,
    view_relations,
)
from jaxvm.network.residual import residual
from jaxvm.network.scene import Scene
from jaxvm.network.views import View, collect_views, guess_intrinsics, rays_of_pixels


class StartError(ValueError):
    """The data don't give start values; the message says for what and why."""


Start = Literal["auto", "given", "chordal", "best"]


def start(scene: Scene, poses: Start = "auto") -> Scene:
    """The scene at start values computed from its data.

    Args:
        scene: as built.
        poses: "given" keeps the poses that the model gives and finds the others along chains of
            views and links; "chordal" finds all free poses from all views and links together
            (`jaxvm.network.chordal`), whatever the model gives; "best" tries both, and the latter
            with and without weights against gross errors, and keeps what fits best. "auto" is
            "given" but for relay networks (links, or targets on stations): there it is "best"
            where the model gives start values, and "chordal" where it doesn't.

    Raises:
        StartError: a camera without known intrinsics sees no target well enough, or a body can't
            be reached from the others through any view or link. ("best" needs one way that can.)
    """
    views = collect_views(scene.recording)
    scene = _start_intrinsics(scene, views)
    relations = view_relations(scene, views) + link_relations(scene)
    if poses == "auto":
        poses = _usual(scene)
    if poses == "given":
        return _placed(scene, _chain(scene, relations, held_poses(scene)))
    if poses == "chordal":
        return _placed(scene, _chain(scene, relations, _chordal(scene, relations)))
    found, refused = [], []
    for way in (
        lambda: _chordal(scene, relations),
        lambda: _chordal(scene, relations, _ROUNDS),
        lambda: held_poses(scene),
    ):
        try:
            found.append(_placed(scene, _chain(scene, relations, way())))
        except (StartError, UnconnectedNetwork) as error:
            refused.append(error)
    if not found:
        raise refused[0]
    return min(found, key=_misfit)


def is_network(scene: Scene) -> bool:
    """Whether stations are joined by links, or by targets that they carry."""
    linked = scene.recording.links is not None
    return linked or any(target.station for target in scene.model.targets)


def _usual(scene: Scene) -> Start:
    """What suits a scene: errors pile up along the chains of a relay network."""
    model = scene.model
    if not is_network(scene):
        return "given"
    bodies = (*model.stations, *model.targets, *model.cameras)
    guessed = any("pose" in body.free and body.pose is not None for body in bodies)
    return "best" if guessed else "chordal"


def _placed(scene: Scene, known: dict[Key, np.ndarray]) -> Scene:
    return _triangulated(_with_poses(scene, known))


_ROUNDS = 10
"""Repetitions of a chordal start with weights against gross errors."""


def _chordal(scene: Scene, relations: list[Relation], rounds: int = 0) -> dict[Key, np.ndarray]:
    """Held poses, and those that relations give all together."""
    known = _with_origin(scene, relations, held_poses(scene, given=False))
    graph, keys = pose_graph(scene, relations, known)
    check_connected(graph)
    if len(graph.edges) == 0:
        return known
    found = chordal_poses(graph, np.zeros((1, 6)), rounds)
    return known | {key: matrix(pose) for key, pose in zip(keys[1:], found[1:], strict=True)}


def _misfit(scene: Scene) -> float:
    """Sum of squared whitened residuals in which gross errors count little (Cauchy)."""
    blocks = jax.tree.leaves(residual(scene.state, scene.network))
    total = sum(float(jnp.sum(jnp.log1p(jnp.sum(block**2, axis=1) / 9.0))) for block in blocks)
    return total if np.isfinite(total) else np.inf


def _start_intrinsics(scene: Scene, views: list[View]) -> Scene:
    focal, centre = np.array(scene.state.focal), np.array(scene.state.centre)
    distortion = np.array(scene.state.distortion)
    for i, camera in enumerate(scene.model.cameras):
        if camera.focal_px is not None:
            continue
        own = [view for view in views if view.camera == i]
        try:
            focal[i], guess, coefficients = guess_intrinsics(own, camera.image_size, camera.lens)
        except ValueError as error:
            raise StartError(
                f'no start value for the focal length of camera "{camera.name}": {error}; '
                "give focal_px in recording.toml or record a known target"
            ) from error
        if camera.centre_px is None:
            centre[i] = guess
        if camera.distortion is None:
            distortion[i, : len(coefficients)] = coefficients
    state = eqx.tree_at(
        lambda s: (s.focal, s.centre, s.distortion),
        scene.state,
        tuple(map(jnp.asarray, (focal, centre, distortion))),
    )
    return replace(scene, state=state)


def _with_origin(scene: Scene, relations, known: dict[Key, np.ndarray]) -> dict[Key, np.ndarray]:
    """Known poses; where nothing stands in the world, the first body seen is at its origin."""
    if relations and not any(_stands_in_world(scene, key) for key in known):
        return known | {relations[0].a[0]: np.eye(4)}
    return known


def _chain(scene: Scene, relations: list[Relation], known: dict[Key, np.ndarray]):
    """Propagate known poses through the relations, best ones first."""
    known = dict(_with_origin(scene, relations, known))
    of_key = defaultdict(list)
    missing = []
    for k, relation in enumerate(relations):
        missing.append({key for key in (*relation.a, *relation.b) if key not in known})
        for key in missing[k]:
            of_key[key].append(k)
    ready = [k for k, keys in enumerate(missing) if len(keys) == 1]
    # Round by round, so that a pose that several relations give is chosen among all of them.
    while ready:
        candidates = defaultdict(list)
        for k in ready:
            (key,) = missing[k]
            candidates[key].append((relations[k].error, _solve(relations[k], key, known)))
        touched = set()
        for key, options in candidates.items():
            known[key] = _consensus(options)
            for k in of_key[key]:
                missing[k].discard(key)
                touched.add(k)
        ready = sorted(k for k in touched if len(missing[k]) == 1)
    _check_reached(scene, known, [relations[k] for k, keys in enumerate(missing) if keys])
    return known


def _stands_in_world(scene: Scene, key: tuple[str, int]) -> bool:
    """Whether a pose says where a body is in the world, not on what it is mounted."""
    kind, row = key
    if kind == "target":
        return not scene.model.targets[int(np.argmax((scene.target_row == row).any(1)))].station
    return kind == "station"


def _solve(relation: Relation, key: Key, known) -> np.ndarray:
    """The one missing pose of product(a) @ a_from_b = product(b)."""
    a, b, a_from_b = relation.a, relation.b, relation.pose

    def product(chain):
        result = np.eye(4)
        for member in chain:
            result = result @ known[member]
        return result

    if key in a:
        at = a.index(key)
        before, behind = product(a[:at]), product(a[at + 1 :])
        return np.linalg.inv(before) @ product(b) @ np.linalg.inv(behind @ a_from_b)
    at = b.index(key)
    before, behind = product(b[:at]), product(b[at + 1 :])
    return np.linalg.inv(before) @ product(a) @ a_from_b @ np.linalg.inv(behind)


def _consensus(options) -> np.ndarray:
    """The pose among several that is nearest to the others: robust against wrong views."""
    if len(options) <= 2:
        return min(options, key=lambda option: option[0])[1]
    poses = np.stack([pose for _, pose in options])
    if len(poses) > 200:
        poses = poses[np.linspace(0, len(poses) - 1, 200).astype(int)]
    turns = Rotation.from_matrix(poses[:, :3, :3])
    apart = np.stack([(turns * turn.inv()).magnitude() for turn in turns])
    spread = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    score = np.median(apart / max(np.median(apart), 1e-12), axis=1)
    score += np.median(spread / max(np.median(spread), 1e-12), axis=1)
    return poses[int(np.argmin(score))]


def _check_reached(scene: Scene, known, waiting) -> None:
    missing = {key for r in waiting for key in (*r.a, *r.b) if key not in known}
    missing |= _observed(scene) - known.keys()
    if not missing:
        return
    names = {name_of(scene, key) for key in missing}
    raise StartError(
        f"no chain of views or links reaches {', '.join(sorted(names))} from the bodies with a "
        "known pose; give a pose in recording.toml or record a view that joins the parts"
    )


def _observed(scene: Scene) -> set[Key]:
    """Keys of all bodies that an image point depends on."""
    obs, model = scene.recording.observations, scene.model
    places = scene.station_places
    station_of = np.array([places[c.station] for c in model.cameras], int)
    rows = np.append(
        scene.station_row[station_of[obs.camera], obs.epoch],
        scene.carrier_rows(obs.target, obs.epoch),
    )
    keys = {("camera", int(i)) for i in np.unique(obs.camera)}
    keys |= {("station", int(row)) for row in np.unique(rows[rows >= 0])}
    return keys | {
        ("target", int(row)) for row in np.unique(scene.target_row[obs.target, obs.epoch])
    }


def _with_poses(scene: Scene, known) -> Scene:
    tables = {
        "camera": np.array(scene.state.station_from_camera),
        "station": np.array(scene.state.world_from_station),
        "target": np.array(scene.state.carrier_from_target),
    }
    reached = {kind: np.zeros(len(table), bool) for kind, table in tables.items()}
    for (kind, row), pose in known.items():
        tables[kind][row] = vector(pose)
        reached[kind][row] = True
    for kind, bodies, rows in (
        ("station", scene.model.stations, scene.station_row),
        ("target", scene.model.targets, scene.target_row),
    ):
        for i in range(len(bodies)):
            _fill_gaps(tables[kind], reached[kind], rows[i])
            _shorten(tables[kind], rows[i])
    state = eqx.tree_at(
        lambda s: (s.station_from_camera, s.world_from_station, s.carrier_from_target),
        scene.state,
        tuple(jnp.asarray(tables[kind]) for kind in ("camera", "station", "target")),
    )
    return replace(scene, state=state)


def _fill_gaps(table: np.ndarray, reached: np.ndarray, rows: np.ndarray) -> None:
    """Epochs without a usable view start at the nearest epoch that has one."""
    have = rows[reached[rows]]
    if len(have) and len(rows) > 1:
        for row in rows[~reached[rows]]:
            table[row] = table[have[np.argmin(np.abs(have - row))]]


def _shorten(table: np.ndarray, rows: np.ndarray) -> None:
    """Rotation vectors have length at most pi; the zero of their far double is never used."""
    turns = table[rows, :3]
    table[rows, :3] = Rotation.from_rotvec(turns).as_rotvec()


def _triangulated(scene: Scene) -> Scene:
    """Points without coordinates, from the rays that see them (linear least squares)."""
    points = np.array(scene.state.point)
    unknown = ~np.all(np.isfinite(points), axis=1)
    if not unknown.any():
        return scene
    obs, model, state = scene.recording.observations, scene.model, scene.state
    names = [s.name for s in model.stations]
    row = scene.first_point[obs.target] + obs.point
    world_from_target = scene.world_from_targets(obs.target, obs.epoch)
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    count = np.zeros(len(points), int)
    for i, camera in enumerate(model.cameras):
        own = np.flatnonzero((obs.camera == i) & unknown[row])
        if len(own) == 0:
            continue
        focal, centre, distortion = (
            np.asarray(values[i]) for values in (state.focal, state.centre, state.distortion)
        )
        rays = rays_of_pixels(lens_family(camera.lens), focal, centre, distortion, obs.pixel[own])
        mounted = matrix(np.asarray(state.station_from_camera[i]))
        station = names.index(camera.station)
        for ray, k in zip(rays, own, strict=True):
            carrier = matrix(
                np.asarray(state.world_from_station[scene.station_row[station, obs.epoch[k]]])
            )
            pose = np.linalg.inv(matrix(world_from_target[k])) @ carrier @ mounted
            direction = pose[:3, :3] @ (ray / np.linalg.norm(ray))
            across = np.eye(3) - np.outer(direction, direction)
            normal[row[k]] += across
            right[row[k]] += across @ pose[:3, 3]
            count[row[k]] += 1
    weak = unknown & (count < 2)
    if weak.any():
        k = int(np.flatnonzero(weak)[0])
        target = int(np.searchsorted(scene.first_point, k, side="right") - 1)
        name = model.targets[target].point_names[k - scene.first_point[target]]
        raise StartError(
            f'point "{name}" of target "{model.targets[target].name}" has no coordinates and is '
            f"seen {count[k]} times; two rays from different places are needed"
        )
    points[unknown] = np.linalg.solve(normal[unknown], right[unknown][:, :, None])[:, :, 0]
    return replace(scene, state=eqx.tree_at(lambda s: s.point, state, jnp.asarray(points)))
