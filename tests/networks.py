"""Small networks with a known truth, for tests of the residual and of the solvers.

Pixels come from OpenCV, distances and relative poses from matrices: nothing in these recordings is
predicted by jaxvm. (Effects are added on top of them: `predicted`.) Every recording carries the
truth as its start values; `without_starts` takes them away.
"""

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxvm.geometry.targets import grid_points
from jaxvm.network.residual import predict_pixels
from jaxvm.network.scene import Scene, build
from jaxvm.network.state import State
from jaxvm.recording.model import (
    Camera,
    Closure,
    Model,
    Prior,
    Rangefinder,
    Station,
    Target,
    grid_names,
)
from jaxvm.recording.recording import Links, Observations, Ranges, Recording, uncorrelated
from jaxvm.solve.adjust import Adjustment, adjust

IMAGE = (1280, 960)
HELD = np.zeros(6)


@dataclass(frozen=True)
class Known:
    """A recording, and the true values of fields of its state."""

    recording: Recording
    truth: dict[str, np.ndarray]

    def true_scene(self, recording: Recording | None = None) -> Scene:
        """Scene at the truth, of this recording or of a variant of it."""
        return at_values(build(recording or self.recording), self.truth)

    def with_model(self, **changes) -> Recording:
        """The recording with other entries of its model."""
        return replace(self.recording, model=replace(self.recording.model, **changes))


def at_values(scene: Scene, values: dict[str, np.ndarray]) -> Scene:
    """The scene with some fields of its state replaced."""
    state = {name: getattr(scene.state, name) for name in State.__dataclass_fields__}
    for name, value in values.items():
        if name in ("point", "world_from_station", "carrier_from_target"):
            # The table has spare rows.
            value = np.concatenate([value, np.asarray(state[name])[len(value) :]])
        assert state[name].shape == np.shape(value), name
        state[name] = np.asarray(value, float)
    return scene.with_state(State(**{name: np.asarray(v) for name, v in state.items()}))


def predicted(scene: Scene) -> np.ndarray:
    """The pixels [observations, 2] that a scene predicts, in the order of its recording."""
    pixel = np.zeros(scene.recording.observations.pixel.shape)
    for rows, own in zip(scene.tables, predict_pixels(scene.state, scene.network), strict=True):
        pixel[rows] = np.asarray(own)[: len(rows)]
    return pixel


def matrix(pose) -> np.ndarray:
    """4x4 matrix of (turn, shift)."""
    pose, result = np.array(pose, float), np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(pose[:3]).as_matrix()
    result[:3, 3] = pose[3:]
    return result


def vector(pose: np.ndarray) -> np.ndarray:
    """(turn, shift) of a 4x4 matrix."""
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])


def twist_matrix(twist) -> np.ndarray:
    """Exponential of a twist (omega, rho) by the series of matrices."""
    omega = np.asarray(twist, float)[:3]
    generator = np.zeros((4, 4))
    generator[:3, :3] = [
        [0, -omega[2], omega[1]],
        [omega[2], 0, -omega[0]],
        [-omega[1], omega[0], 0],
    ]
    generator[:3, 3] = np.asarray(twist, float)[3:]
    return expm(generator)


def opencv_pixels(camera: Camera, world_from_camera, world_from_target, points) -> np.ndarray:
    """Image points (px) of marks, by OpenCV."""
    camera_from_target = np.linalg.inv(world_from_camera) @ world_from_target
    turn = cv2.Rodrigues(camera_from_target[:3, :3])[0]
    k = np.eye(3)
    k[0, 0], k[1, 1] = camera.focal_px
    k[:2, 2] = camera.centre_px
    d = np.zeros(4) if camera.distortion is None else np.asarray(camera.distortion, float)
    cloud = np.asarray(points, float).reshape(-1, 1, 3)
    if camera.lens == "fisheye":
        pixels = cv2.fisheye.projectPoints(cloud, turn, camera_from_target[:3, 3], k, d)[0]
    else:
        pixels = cv2.projectPoints(cloud, turn, camera_from_target[:3, 3], k, d)[0]
    return pixels.reshape(-1, 2)


def looking_at(eye, at, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Pose vector world_from_camera of a camera that looks at a place, image y downwards."""
    z = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = eye
    return vector(pose)


def photographs(
    model: Model, n_epochs: int, stations, targets, points, rng, noise: float, lost: float = 0.05
) -> Observations:
    """What all cameras see of all targets, with noise, a share of the marks lost.

    Args:
        model: cameras with their true intrinsics and poses.
        n_epochs: number of epochs.
        stations, targets: true pose vectors, [body][epoch].
        points: true coordinates of every target.
        rng: source of the noise; which marks are lost does not depend on it.
        noise: factor on the noise; 0 for exact pixels.
        lost: share of the marks that are not found.
    """
    names = [s.name for s in model.stations]
    missing = np.random.default_rng(99)
    rows, pixels = [], []
    for epoch in range(n_epochs):
        for c, camera in enumerate(model.cameras):
            station = names.index(camera.station)
            world_from_camera = matrix(stations[station][epoch]) @ matrix(camera.pose)
            for t, marks in enumerate(points):
                seen = opencv_pixels(camera, world_from_camera, matrix(targets[t][epoch]), marks)
                for p in np.flatnonzero(missing.random(len(marks)) >= lost):
                    assert (seen[p] > 0).all() and (seen[p] < camera.image_size).all()
                    rows.append((epoch, c, t, p))
                    pixels.append(seen[p])
    rows = np.array(rows)
    sigma = np.where(rows[:, 3] % 2 == 0, 0.1, 0.2)
    pixels = np.array(pixels) + noise * sigma[:, None] * rng.standard_normal((len(rows), 2))
    # The order of the rows of a recording means nothing.
    order = missing.permutation(len(rows))
    return Observations(*rows[order].T, pixels[order], sigma[order])


def _recording(model: Model, observations: Observations, n_epochs: int, **tables) -> Recording:
    return Recording(
        model, np.arange(n_epochs) + 10, 0.5 * np.arange(n_epochs), {}, observations, **tables
    )


def _of_cameras(cameras) -> dict[str, np.ndarray]:
    distortion = np.zeros((len(cameras), 14))
    for i, camera in enumerate(cameras):
        if camera.distortion is not None:
            distortion[i, : len(camera.distortion)] = camera.distortion
    return {
        "focal": np.array([c.focal_px for c in cameras]),
        "centre": np.array([c.centre_px for c in cameras]),
        "distortion": distortion,
        "station_from_camera": np.array([c.pose for c in cameras]),
    }


def board_recording(
    seed: int = 0,
    noise: float = 1.0,
    n_epochs: int = 8,
    free: frozenset[str] = frozenset({"focal", "centre", "distortion"}),
) -> Known:
    """One camera whose intrinsics are free, and a plane grid with another pose in each epoch.

    A prior on the centre is so wide that it says nothing.
    """
    rng = np.random.default_rng(seed)
    place = np.random.default_rng(7)
    camera = Camera(
        "cam",
        "desk",
        IMAGE,
        "opencv4",
        np.array([1000.0, 1012.0]),
        np.array([650.0, 470.0]),
        np.array([-0.12, 0.05, 1e-3, -5e-4]),
        HELD,
        free,
    )
    marks = grid_points(5, 6, 0.08)
    poses = []
    for _ in range(n_epochs):
        turn = place.uniform(-0.45, 0.45, 3)
        middle = np.append(place.uniform(-0.06, 0.06, 2), place.uniform(0.55, 0.75))
        poses.append(
            np.append(turn, middle - Rotation.from_rotvec(turn).as_matrix() @ marks.mean(0))
        )
    poses = np.array(poses)
    model = Model(
        "board",
        (camera,),
        (Station("desk", "static", HELD),),
        (Target("board", grid_names(5, 6), marks, "per-epoch", None, frozenset({"pose"})),),
        priors=(Prior("cameras.cam.centre", camera.centre_px, np.full(2, 1e9)),),
    )
    seen = photographs(model, n_epochs, [[HELD] * n_epochs], [poses], [marks], rng, noise)
    truth = _of_cameras(model.cameras) | {"carrier_from_target": poses}
    return Known(_recording(model, seen, n_epochs), truth)


def stereo_recording(
    seed: int = 0, noise: float = 1.0, with_ranges: bool = True, right_lens: str = "opencv4"
) -> Known:
    """Two cameras on a bar, a static reference, a plate that moves, and a rangefinder."""
    rng, place, n_epochs = np.random.default_rng(seed), np.random.default_rng(8), 6
    left = Camera(
        "left",
        "bar",
        IMAGE,
        "opencv4",
        np.array([1100.0, 1104.0]),
        np.array([640.0, 482.0]),
        np.array([-0.1, 0.04, 5e-4, 3e-4]),
        HELD,
        frozenset({"focal", "centre", "distortion"}),
    )
    right = Camera(
        "right",
        "bar",
        IMAGE,
        right_lens,
        np.array([950.0, 950.0]),
        np.array([633.0, 475.0]),
        np.array([-0.02, 0.004, 1e-3, -1e-3]),
        np.array([0.02, -0.25, 0.01, 0.5, 0.01, -0.02]),
        frozenset({"aspect-locked-focal", "centre", "pose"}),
    )
    reference, plate = grid_points(4, 5, 0.2), grid_points(3, 4, 0.12)
    reference[:, 2] = 0.05 * (np.arange(20) % 3)
    bar = looking_at((0.15, 0.25, 1.7), (0.38, 0.3, 0.0), up=(0.0, -1.0, 0.2))
    moving = []
    for _ in range(n_epochs):
        turn = place.uniform(-0.35, 0.35, 3)
        shift = np.array([0.2, 0.15, 0.35]) + place.uniform(-0.1, 0.1, 3)
        moving.append(np.append(turn, shift))
    moving = np.array(moving)
    lidar = Rangefinder("lidar", "bar", np.array([0.03, -0.05, 0.0, 0.1, -0.05, 0.02]))
    model = Model(
        "stereo",
        (left, right),
        (Station("bar", "static", bar, frozenset({"pose"})),),
        (
            Target("reference", grid_names(4, 5), reference, "static", HELD),
            Target("plate", grid_names(3, 4), plate, "per-epoch", None, frozenset({"pose"})),
        ),
        (lidar,) if with_ranges else (),
    )
    targets = [[HELD] * n_epochs, moving]
    seen = photographs(model, n_epochs, [[bar] * n_epochs], targets, [reference, plate], rng, noise)
    truth = _of_cameras(model.cameras) | {
        "world_from_station": bar[None],
        "carrier_from_target": np.concatenate([HELD[None], moving]),
    }
    ranges = None
    if with_ranges:
        epoch = np.append(np.arange(n_epochs), [0, 2])
        target = np.array([1] * n_epochs + [0, 1])
        point = np.array([-1] * n_epochs + [7, 5])
        beam = matrix(bar) @ matrix(lidar.pose)
        distance = []
        for e, t, p in zip(epoch, target, point, strict=True):
            pose = matrix(targets[t][e])
            distance.append(
                to_plane(beam, pose) if p < 0 else to_point(beam, pose, (reference, plate)[t][p])
            )
        sigma = np.full(len(epoch), 2e-4)
        distance = np.array(distance) + noise * sigma * rng.standard_normal(len(epoch))
        ranges = Ranges(epoch, np.zeros(len(epoch), int), target, point, distance, sigma)
    return Known(_recording(model, seen, n_epochs, ranges=ranges), truth)


def to_plane(beam: np.ndarray, target: np.ndarray) -> float:
    """Distance along the z axis of a pose to the plane z = 0 of another."""
    normal, origin = target[:3, 2], target[:3, 3]
    return float(normal @ (origin - beam[:3, 3]) / (normal @ beam[:3, 2]))


def to_point(beam: np.ndarray, target: np.ndarray, mark: np.ndarray) -> float:
    """Distance from the origin of a pose to a mark on a target."""
    return float(np.linalg.norm(target[:3, :3] @ mark + target[:3, 3] - beam[:3, 3]))


def free_points_recording(seed: int = 0, noise: float = 1.0, n_epochs: int = 2) -> Known:
    """Four cameras with free poses around a cloud of free points and a known frame."""
    rng, place = np.random.default_rng(seed), np.random.default_rng(9)
    eyes = [(2.4, 0.3, 0.5), (-0.2, 2.6, 1.1), (-2.3, -0.4, 0.2), (0.5, -2.2, 1.6)]
    stations = [looking_at(eye, place.uniform(-0.1, 0.1, 3)) for eye in eyes]
    cameras = tuple(
        Camera(
            f"cam{i}",
            f"tripod{i}",
            IMAGE,
            "pinhole",
            np.array([1250.0, 1250.0]) + (10.0 * i, 13.0 * i),
            np.array([640.0 + i, 480.0 - i]),
            None,
            HELD,
            frozenset({"focal" if i < 3 else "aspect-locked-focal"}),
        )
        for i in range(4)
    )
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.4
    cloud = place.uniform(-0.5, 0.5, (12, 3))
    model = Model(
        "points",
        cameras,
        tuple(
            Station(f"tripod{i}", "static", pose, frozenset({"pose"}))
            for i, pose in enumerate(stations)
        ),
        (
            Target("frame", tuple(f"f{i}" for i in range(8)), corners, "static", HELD),
            Target(
                "cloud",
                tuple(f"p{i}" for i in range(12)),
                cloud,
                "static",
                HELD,
                frozenset({"points"}),
            ),
        ),
    )
    held = [HELD] * n_epochs
    standing = [[pose] * n_epochs for pose in stations]
    seen = photographs(model, n_epochs, standing, [held, held], [corners, cloud], rng, noise)
    truth = _of_cameras(cameras) | {
        "world_from_station": np.array(stations),
        "carrier_from_target": np.zeros((2, 6)),
        "point": np.concatenate([corners, cloud]),
    }
    return Known(_recording(model, seen, n_epochs), truth)


def relay_recording(seed: int = 0, noise: float = 1.0) -> Known:
    """Three stations, each with a camera and a target of its own, joined by links only.

    Two links join the stations; three more, between the cameras, form a loop.
    """
    rng, place = np.random.default_rng(seed), np.random.default_rng(10)
    stations = np.array(
        [
            [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.1, 0.6, -0.2, 2.0, 0.1, 0.3],
            [-0.2, 1.4, 0.3, 3.0, -0.4, 2.2],
        ]
    )
    mounts = np.array([place.uniform(-0.2, 0.2, 6) for _ in range(3)])
    cameras = tuple(
        Camera(
            f"cam{i}",
            f"s{i}",
            IMAGE,
            "pinhole",
            np.array([1100.0, 1100.0]),
            np.array([640.0, 480.0]),
            None,
            mounts[i],
        )
        for i in range(3)
    )
    marks = grid_points(3, 4, 0.1)
    targets = np.array(
        [
            vector(
                matrix(stations[i])
                @ matrix(mounts[i])
                @ matrix(np.append(place.uniform(-0.4, 0.4, 3), [-0.1, -0.1, 0.9]))
            )
            for i in range(3)
        ]
    )
    free = frozenset({"pose"})
    in_world = {("station", i): matrix(stations[i]) for i in range(3)}
    in_world |= {("camera", i): matrix(stations[i]) @ matrix(mounts[i]) for i in range(3)}
    in_world |= {("target", i): matrix(targets[i]) for i in range(3)}
    ends = {
        "first": (("station", 0), ("station", 1)),
        "second": (("camera", 1), ("target", 2)),
        "c01": (("camera", 0), ("camera", 1)),
        "c21": (("camera", 2), ("camera", 1)),
        "c20": (("camera", 2), ("camera", 0)),
    }
    sigma_rad, sigma_m = np.full(5, 2e-4), np.array([5e-4, 5e-4, 1e-3, 2e-3, 1e-3])
    true = [np.linalg.inv(in_world[a]) @ in_world[b] for a, b in ends.values()]
    measured = []
    for k, pose in enumerate(true):
        sigma = np.repeat([sigma_rad[k], sigma_m[k]], 3)
        # log(measured^-1 . true) is the noise.
        measured.append(
            vector(pose @ np.linalg.inv(twist_matrix(noise * sigma * rng.standard_normal(6))))
        )
    links = Links(
        tuple(ends),
        [a for a, _ in ends.values()],
        [b for _, b in ends.values()],
        np.array(measured),
        uncorrelated(sigma_rad, sigma_m),
        np.full(5, -1),
    )
    model = Model(
        "relay",
        cameras,
        tuple(
            Station(f"s{i}", "static", stations[i], free if i else frozenset()) for i in range(3)
        ),
        tuple(
            Target(f"t{i}", grid_names(3, 4), marks, "static", targets[i], free) for i in range(3)
        ),
        closures=(Closure((("c01", 1), ("c21", -1), ("c20", 1)), 1e-5, 1e-5),),
    )
    seen = photographs_of_pairs(model, stations, targets, marks, rng, noise)
    truth = _of_cameras(cameras) | {
        "world_from_station": stations,
        "carrier_from_target": targets,
        "link": np.array([vector(pose) for pose in true[2:]]),
    }
    return Known(_recording(model, seen, 2, links=links), truth)


def photographs_of_pairs(model, stations, targets, marks, rng, noise) -> Observations:
    """Camera i sees target i."""
    rows, pixels = [], []
    for i, camera in enumerate(model.cameras):
        pose = matrix(stations[i]) @ matrix(camera.pose)
        pixels.append(opencv_pixels(camera, pose, matrix(targets[i]), marks))
        rows += [(p % 2, i, i, p) for p in range(len(marks))]
    rows, pixels = np.array(rows), np.concatenate(pixels)
    sigma = np.full(len(rows), 0.1)
    pixels = pixels + noise * sigma[:, None] * rng.standard_normal(pixels.shape)
    return Observations(*rows.T, pixels, sigma)


def scale_recording(seed: int = 0, noise: float = 1.0, with_ranges: bool = True) -> Known:
    """Two cameras see nothing but free points: only ranges give the scale."""
    rng, place = np.random.default_rng(seed), np.random.default_rng(11)
    left = Camera(
        "left",
        "bar",
        IMAGE,
        "pinhole",
        np.array([1200.0, 1200.0]),
        np.array([640.0, 480.0]),
        None,
        HELD,
    )
    right = replace(
        left,
        name="right",
        pose=np.array([0.01, -0.3, 0.02, 0.6, 0.02, 0.05]),
        free=frozenset({"pose"}),
    )
    cloud = place.uniform(-0.5, 0.5, (12, 3)) + [0.2, 0.0, 2.2]
    free = frozenset({"points"})
    model = Model(
        "scale",
        (left, right),
        (Station("bar", "static", HELD),),
        (Target("cloud", tuple(f"p{i}" for i in range(12)), cloud, "static", HELD, free),),
        (Rangefinder("lidar", "bar", np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])),),
    )
    seen = photographs(model, 2, [[HELD] * 2], [[HELD] * 2], [cloud], rng, noise, lost=0.0)
    n = 3
    distance = [to_point(matrix(model.rangefinders[0].pose), np.eye(4), p) for p in cloud[:n]]
    sigma = np.full(n, 1e-4)
    ranges = Ranges(
        np.zeros(n, int),
        np.zeros(n, int),
        np.zeros(n, int),
        np.arange(n),
        np.array(distance) + noise * sigma * rng.standard_normal(n),
        sigma,
    )
    truth = _of_cameras(model.cameras) | {"point": cloud}
    return Known(_recording(model, seen, 2, ranges=ranges if with_ranges else None), truth)


RECORDINGS = {
    "board": board_recording,
    "stereo": stereo_recording,
    "points": free_points_recording,
    "relay": relay_recording,
    "scale": scale_recording,
}


@cache
def adjusted(name: str, seed: int = 0) -> tuple[Known, Adjustment]:
    """A network adjusted from the truth, once for all tests."""
    known = RECORDINGS[name](seed)
    return known, adjust(known.true_scene())


def without_starts(recording: Recording) -> Recording:
    """The recording with every value that is free left to the data."""
    model = recording.model

    def open_pose(body):
        return replace(body, pose=None) if "pose" in body.free else body

    def open_camera(camera: Camera) -> Camera:
        camera = open_pose(camera)
        if "focal" in camera.free:
            camera = replace(camera, focal_px=None)
        elif "aspect-locked-focal" in camera.free:
            # A ratio other than 1 has to be given.
            own = None if np.ptp(camera.focal_px) == 0 else 1.05 * camera.focal_px
            camera = replace(camera, focal_px=own)
        if "centre" in camera.free:
            camera = replace(camera, centre_px=None)
        if "distortion" in camera.free:
            camera = replace(camera, distortion=None)
        return camera

    def open_target(target: Target) -> Target:
        target = open_pose(target)
        if "points" in target.free:
            target = replace(target, points=np.full_like(target.points, np.nan))
        return target

    model = replace(
        model,
        cameras=tuple(map(open_camera, model.cameras)),
        stations=tuple(map(open_pose, model.stations)),
        targets=tuple(map(open_target, model.targets)),
    )
    return replace(recording, model=model)


def dense_residuals(blocks) -> np.ndarray:
    """All whitened residuals in one vector."""
    parts = [*blocks.pixels, blocks.ranges, blocks.links, blocks.edges, blocks.closures]
    return np.concatenate([np.ravel(p) for p in (*parts, blocks.priors) if p is not None])


def nudged(known: Known, scene: Scene, size: float, seed: int = 3) -> Scene:
    """The scene with its free parameters moved off the truth, `size` in units natural to each."""
    rng = np.random.default_rng(seed)
    unit = {"focal": 1000.0, "centre": 500.0}
    flat = np.array(scene.state.flatten())
    free = scene.unknowns.column < scene.unknowns.n
    for name, _ in scene.network.layout.fields:
        own = scene.network.layout.all(name)
        own = own[free[own]]
        flat[own] += size * unit.get(name, 1.0) * rng.uniform(-1.0, 1.0, len(own))
    state = scene.network.layout.restore(flat)
    return scene.with_state(state)
