"""Start values from the data alone: intrinsics, poses of views, chaining, triangulation.

The user writes no guesses. What the recording's model gives is kept; everything else follows from
the views: each tells camera_from_target, and a pose that three known neighbours enclose is known.
"""

from collections import defaultdict
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxvm.geometry.lenses import lens_family
from jaxvm.network.scene import Scene
from jaxvm.network.views import View, collect_views, guess_intrinsics, pose_of_view, rays_of_pixels


class StartError(ValueError):
    """The data don't give start values; the message says for what and why."""


def start(scene: Scene) -> Scene:
    """The scene at start values computed from its data.

    Raises:
        StartError: a camera without known intrinsics sees no target well enough, or a body can't
            be reached from the others through any view or link.
    """
    views = collect_views(scene.recording)
    scene = _start_intrinsics(scene, views)
    relations = _view_relations(scene, views) + _link_relations(scene)
    known = _chain(scene, relations)
    scene = _with_poses(scene, known)
    return _triangulated(scene)


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


# A pose is a pair (rotation matrix, shift); a node's pose in the world is a product of up to two.
# Keys of unknown poses: ("camera", i), ("station", row), ("target", row).


def _matrix(vector) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.array(vector[:3])).as_matrix()
    pose[:3, 3] = vector[3:]
    return pose


def _vector(pose: np.ndarray) -> np.ndarray:
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])


def _view_relations(scene: Scene, views: list[View]):
    """Relations (chain of keys a, chain of keys b, a_from_b, error) of all views."""
    relations = []
    focal, centre = np.asarray(scene.state.focal), np.asarray(scene.state.centre)
    distortion = np.asarray(scene.state.distortion)
    families = [lens_family(camera.lens) for camera in scene.model.cameras]
    rays: dict[int, np.ndarray] = {}
    for camera, family in enumerate(families):
        own = [v.pixels for v in views if v.camera == camera]
        if own:
            rays[camera] = rays_of_pixels(
                family, focal[camera], centre[camera], distortion[camera], np.concatenate(own)
            )
    taken: dict[int, int] = defaultdict(int)
    for view in views:
        first = taken[view.camera]
        taken[view.camera] += len(view.pixels)
        of_view = rays[view.camera][first : taken[view.camera]]
        sound = np.isfinite(of_view).all(axis=1)
        if sound.sum() < 4:
            continue
        found = pose_of_view(view.points[sound], of_view[sound])
        if found is None:
            continue
        a = _keys(scene, "camera", view.camera, view.epoch)
        b = _keys(scene, "target", view.target, view.epoch)
        relations.append((a, b, _matrix(found[0]), found[1] / np.sqrt(len(of_view))))
    return relations


def _link_relations(scene: Scene):
    links = scene.recording.links
    if links is None:
        return []
    sigma = links.sigma[:, :3].max(axis=1)
    epoch = np.maximum(links.epoch, 0)
    return [
        (
            _keys(scene, *links.from_node[i], epoch[i]),
            _keys(scene, *links.to_node[i], epoch[i]),
            _matrix(links.pose[i]),
            float(sigma[i]),
        )
        for i in range(len(links.name))
    ]


def _keys(scene: Scene, kind: str, number: int, epoch: int) -> tuple[tuple[str, int], ...]:
    """Keys of the poses that make up the pose of a node in the world, carriers first."""
    if kind == "station":
        return (("station", int(scene.station_row[number, epoch])),)
    bodies = scene.model.cameras if kind == "camera" else scene.model.targets
    own = (kind, number if kind == "camera" else int(scene.target_row[number, epoch]))
    carrier = bodies[number].station
    if not carrier:
        return (own,)
    return (("station", int(scene.station_row[scene.station_places[carrier], epoch])), own)


def _given(scene: Scene) -> dict[tuple[str, int], np.ndarray]:
    """Poses that the model gives, or that it holds at the identity."""
    known = {}
    model = scene.model
    for i, camera in enumerate(model.cameras):
        if camera.pose is not None or "pose" not in camera.free:
            known["camera", i] = _matrix(np.asarray(scene.state.station_from_camera[i]))
    for kind, bodies, rows, table in (
        ("station", model.stations, scene.station_row, scene.state.world_from_station),
        ("target", model.targets, scene.target_row, scene.state.carrier_from_target),
    ):
        values = np.asarray(table)
        for i, body in enumerate(bodies):
            if body.pose is not None or "pose" not in body.free:
                for row in np.unique(rows[i]):
                    known[kind, row] = _matrix(values[row])
    return known


def _chain(scene: Scene, relations) -> dict[tuple[str, int], np.ndarray]:
    """Propagate known poses through the relations, best ones first."""
    known = _given(scene)
    in_world = {key for key in known if _stands_in_world(scene, key)}
    if not in_world and relations:
        known[relations[0][0][0]] = np.eye(4)
    of_key = defaultdict(list)
    missing = []
    for k, (a, b, _, _) in enumerate(relations):
        missing.append({key for key in (*a, *b) if key not in known})
        for key in missing[k]:
            of_key[key].append(k)
    ready = [k for k, keys in enumerate(missing) if len(keys) == 1]
    # Round by round, so that a pose that several relations give is chosen among all of them.
    while ready:
        candidates = defaultdict(list)
        for k in ready:
            a, b, a_from_b, error = relations[k]
            (key,) = missing[k]
            candidates[key].append((error, _solve(a, b, a_from_b, key, known)))
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


def _solve(a, b, a_from_b, key, known) -> np.ndarray:
    """The one missing pose of product(a) @ a_from_b = product(b)."""

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
    missing = {key for a, b, _, _ in waiting for key in (*a, *b) if key not in known}
    missing |= _observed(scene) - known.keys()
    if not missing:
        return
    names = set()
    for kind, row in missing:
        if kind == "camera":
            names.add(f'camera "{scene.model.cameras[row].name}"')
            continue
        rows = scene.station_row if kind == "station" else scene.target_row
        bodies = scene.model.stations if kind == "station" else scene.model.targets
        body = next(i for i in range(len(bodies)) if row in rows[i])
        names.add(f'{kind} "{bodies[body].name}"')
    raise StartError(
        f"no chain of views or links reaches {', '.join(sorted(names))} from the bodies with a "
        "known pose; give a pose in recording.toml or record a view that joins the parts"
    )


def _observed(scene: Scene) -> set[tuple[str, int]]:
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
        tables[kind][row] = _vector(pose)
        reached[kind][row] = True
    for kind, bodies, rows in (
        ("station", scene.model.stations, scene.station_row),
        ("target", scene.model.targets, scene.target_row),
    ):
        for i in range(len(bodies)):
            _fill_gaps(tables[kind], reached[kind], rows[i])
            _unwrap(tables[kind], rows[i])
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


def _unwrap(table: np.ndarray, rows: np.ndarray) -> None:
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
        mounted = _matrix(np.asarray(state.station_from_camera[i]))
        station = names.index(camera.station)
        for ray, k in zip(rays, own, strict=True):
            carrier = _matrix(
                np.asarray(state.world_from_station[scene.station_row[station, obs.epoch[k]]])
            )
            pose = np.linalg.inv(_matrix(world_from_target[k])) @ carrier @ mounted
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
