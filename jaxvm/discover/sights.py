"""Where cameras stand, where marks are seen from them, and what is beside a line of sight."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxvm.network.scene import Scene


def unit(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def across(
    sight: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Unit vectors to the side of lines of sight and upward across them.

    For a sight along `up` any side will do.
    """
    steep = np.abs(unit(sight) @ up) > 0.99
    other = np.roll(up, 1) if abs(up @ np.roll(up, 1)) < 0.9 else np.array([1.0, 0.0, 0.0])
    reference = np.where(steep[:, None], other, up)
    side = unit(np.cross(sight, reference))
    return side, unit(np.cross(side, sight))


def world_from_cameras(scene: Scene) -> tuple[Rotation, Float[np.ndarray, "cameras 3"]]:
    """Attitudes and places (m) of all cameras at the first epoch."""
    at = [scene.station_places[camera.station] for camera in scene.model.cameras]
    station = np.array(scene.state.world_from_station)[scene.station_row[at, 0]]
    mounted = np.array(scene.state.station_from_camera)
    carried = Rotation.from_rotvec(station[:, :3])
    place = carried.apply(mounted[:, 3:]) + station[:, 3:]
    return carried * Rotation.from_rotvec(mounted[:, :3]), place


def middle_of_cameras(scene: Scene) -> Float[np.ndarray, "3"]:
    """The middle of all cameras in the world (m), at the first epoch."""
    return np.mean(world_from_cameras(scene)[1], axis=0)


def marks_in_world(scene: Scene, rows: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Marks of observations in the world (m)."""
    obs = scene.recording.observations
    target, epoch = obs.target[rows], obs.epoch[rows]
    point = np.asarray(scene.state.point)[scene.first_point[target] + obs.point[rows]]
    pose = scene.world_from_targets(target, epoch)
    return Rotation.from_rotvec(pose[:, :3]).apply(point) + pose[:, 3:]


def marks_in_camera(scene: Scene, rows: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Marks of observations in camera coordinates (m)."""
    obs, state = scene.recording.observations, scene.state
    point = marks_in_world(scene, rows)
    camera, epoch = obs.camera[rows], obs.epoch[rows]
    station = np.array([scene.station_places[c.station] for c in scene.model.cameras])
    for pose in (
        np.array(state.world_from_station)[scene.station_row[station[camera], epoch]],
        np.array(state.station_from_camera)[camera],
    ):
        point = Rotation.from_rotvec(pose[:, :3]).inv().apply(point - pose[:, 3:])
    return point
