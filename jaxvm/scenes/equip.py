"""Equipment of stations: cameras that look where they have to, marks, and what cameras may find.

Cameras stand a hand's breadth from the middle of their station, towards what they look at; marks
stand above them. Everything is a table over sight lines; no loop runs over observations.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxvm.geometry.targets import grid_points
from jaxvm.recording.model import grid_names
from jaxvm.scenes.describe import Cameras, Marks
from jaxvm.scenes.layouts import Structure, numbered
from jaxvm.scenes.placement import Placement

ARM_M = 0.15
"""From the middle of a station to its cameras."""


@dataclass(frozen=True, eq=False)
class Equipment:
    """Cameras and targets on stations, and which camera looks at which target.

    Attributes:
        camera_names, target_names: one name each.
        camera_station, target_station: the station that carries it.
        station_from_camera, station_from_target: poses (rad, m).
        point_names, points: marks of every target (m); all targets are alike.
        plate: whether marks are seen from the front only (from where z points away).
        camera, target: of each sight line.
    """

    camera_names: tuple[str, ...]
    camera_station: Int[np.ndarray, " cameras"]
    station_from_camera: Float[np.ndarray, "cameras 6"]
    target_names: tuple[str, ...]
    target_station: Int[np.ndarray, " targets"]
    station_from_target: Float[np.ndarray, "targets 6"]
    point_names: tuple[str, ...]
    points: Float[np.ndarray, "marks 3"]
    plate: bool
    camera: Int[np.ndarray, " lines"]
    target: Int[np.ndarray, " lines"]


def looking(direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Rotations whose z axis points along a direction, x level to the right, y down."""
    z = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    steep = np.abs(z[:, 2:]) > 0.999
    x = np.cross(z, np.where(steep, [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def equip(structure: Structure, placement: Placement, cameras: Cameras, marks: Marks) -> Equipment:
    """Cameras and marks for the lines of a structure, aimed where the stations are at first."""
    lines = structure.lines
    watcher, seen = lines.T
    own = structure.marks_at is not None or marks.kind == "plates"
    target = np.arange(len(lines)) if own else np.unique(seen, return_inverse=True)[1]
    carrier = seen if own else np.unique(seen)
    names = structure.names
    if structure.marks_at is not None:
        target_names = numbered("marks-", len(lines))
        centre = structure.marks_at
    else:
        target_names = tuple(names[j] for j in carrier)
        if own:
            target_names = tuple(f"{names[j]}-for-{names[i]}" for i, j in lines)
        above = np.where(np.isin(carrier, watcher), ARM_M + 0.6 * marks.size_m, 0.0)
        centre = above[:, None] * [0.0, 0.0, 1.0]
    rotation, middle = placement.rotation[:, 0], placement.shift[:, 0]
    if marks.kind == "plates" and structure.marks_at is None:
        # Plates stand around their station, each towards the one that sees it.
        towards = _in_station(rotation, middle, seen, middle[watcher])
        distance = np.linalg.norm(towards, axis=1, keepdims=True)
        centre = centre + 0.6 * marks.size_m * towards / distance
    in_world = middle[carrier] + np.einsum("nij,nj->ni", rotation[carrier], centre)
    aim = _in_station(rotation, middle, watcher, in_world[target])
    camera, turn, arm, station = _cameras(structure, aim, cameras)
    points, point_names, facing = _marks(marks)
    if marks.kind == "body":
        turned = np.tile(np.eye(3), (len(carrier), 1, 1))
    else:
        # A plate turns its back to where those who see it look, on average.
        eye = middle[watcher] + np.einsum("nij,nj->ni", rotation[watcher], arm[camera])
        away = centre[target] - _in_station(rotation, middle, seen, eye)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        mean = np.zeros((len(carrier), 3))
        np.add.at(mean, target, away)
        mean[np.linalg.norm(mean, axis=1) < 1e-6] = [1.0, 0.0, 0.0]
        turned = looking(mean) @ Rotation.from_rotvec([marks.tilt, 0.0, 0.0]).as_matrix()
    if structure.marks_at is not None:
        camera_names = numbered("camera-", len(station))
    elif cameras.each == "sector":
        camera_names = tuple(f"{names[s]}-{k % cameras.count + 1}" for k, s in enumerate(station))
    else:
        camera_names = tuple(f"{names[i]}-to-{names[j]}" for i, j in lines)
    return Equipment(
        camera_names=camera_names,
        camera_station=station,
        station_from_camera=_vectors(turn, arm),
        target_names=target_names,
        target_station=carrier,
        station_from_target=_vectors(turned, centre - turned @ facing),
        point_names=point_names,
        points=points,
        plate=marks.kind != "body",
        camera=camera,
        target=target,
    )


def _in_station(rotation, middle, station, place):
    """Places in the world as stations see them."""
    return np.einsum("nji,nj->ni", rotation[station], place - middle[station])


def _cameras(structure: Structure, aim: Float[np.ndarray, "lines 3"], cameras: Cameras):
    """Camera of each line; rotation, place and station of each camera."""
    watcher = structure.lines[:, 0]
    if cameras.each == "sight" or structure.marks_at is not None:
        level = aim * [1.0, 1.0, 0.0]
        arm = ARM_M * level / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
        return np.arange(len(aim)), looking(aim - arm), arm, watcher
    stations, place = np.unique(watcher, return_inverse=True)
    azimuth = 2.0 * np.pi * np.arange(cameras.count) / cameras.count
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=1)
    sector = np.argmax(aim @ ahead.T, axis=1)
    turn = np.tile(looking(ahead), (len(stations), 1, 1))
    arm = np.tile(ARM_M * ahead, (len(stations), 1))
    return place * cameras.count + sector, turn, arm, np.repeat(stations, cameras.count)


def _marks(marks: Marks):
    """Marks of a target (m), their names, and its middle."""
    if marks.kind == "body":
        # Fibonacci's lattice on a sphere: even, of any number, and with relief from everywhere.
        k = np.arange(marks.count) + 0.5
        z = 1.0 - 2.0 * k / marks.count
        angle = np.pi * (1.0 + np.sqrt(5.0)) * k
        flat = np.sqrt(1.0 - z**2)
        points = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
        names = tuple(str(number + 1) for number in range(marks.count))
        return np.round(0.5 * marks.size_m * points, 5), names, np.zeros(3)
    spacing = marks.size_m / (marks.count - 1)
    points = grid_points(marks.count, marks.count, spacing)
    return points, grid_names(marks.count, marks.count), points.mean(axis=0)


def _vectors(rotation: Float[np.ndarray, "n 3 3"], shift) -> Float[np.ndarray, "n 6"]:
    return np.concatenate([Rotation.from_matrix(rotation).as_rotvec(), shift], axis=1)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Marks that cameras may find: in front of them, about in the image, seen from the front.

    Attributes:
        epoch, line, mark: of each.
        pixel: where a camera without distortion has them (px).
    """

    epoch: Int[np.ndarray, " n"]
    line: Int[np.ndarray, " n"]
    mark: Int[np.ndarray, " n"]
    pixel: Float[np.ndarray, "n 2"]


def candidates(
    equipment: Equipment, placement: Placement, cameras: Cameras, incidence: float
) -> Candidates:
    """Marks that the cameras of the lines may find at each epoch.

    `incidence` is the steepest view (rad) in which marks of a plate are found.
    """
    camera, target = equipment.camera, equipment.target
    own, body = equipment.station_from_camera[camera], equipment.station_from_target[target]
    watcher, seen = equipment.camera_station[camera], equipment.target_station[target]
    mounted = Rotation.from_rotvec(own[:, :3]).as_matrix()[:, None]
    turned = Rotation.from_rotvec(body[:, :3]).as_matrix()[:, None]
    eye, eye_at = placement.rotation[watcher], placement.shift[watcher]
    far, far_at = placement.rotation[seen], placement.shift[seen]
    # camera_from_station, station_from_world, world_from_carrier, carrier_from_target
    towards = np.swapaxes(eye @ mounted, 2, 3)
    turn = towards @ far @ turned
    world = np.einsum("leij,lj->lei", far, body[:, 3:]) + far_at
    origin = np.einsum("leij,lj->lei", eye, own[:, 3:]) + eye_at
    shift = np.einsum("leij,lej->lei", towards, world - origin)
    place = np.einsum("leij,mj->lemi", turn, equipment.points) + shift[:, :, None]
    distance = np.linalg.norm(place, axis=3)
    good = place[..., 2] > 0.1 * distance
    if equipment.plate:
        cosine = np.einsum("lemi,lei->lem", place, turn[..., 2])
        good &= cosine > np.cos(incidence) * distance
    line, epoch, mark = np.nonzero(good)
    place = place[good]
    size = np.array(cameras.image_size)
    pixel = cameras.focal_px * place[:, :2] / place[:, 2:] + 0.5 * (size - 1.0)
    # Distortion may bring in what is a little outside.
    near = np.all(np.abs(pixel - 0.5 * size) < 0.6 * size, axis=1)
    return Candidates(epoch[near], line[near], mark[near], pixel[near])
