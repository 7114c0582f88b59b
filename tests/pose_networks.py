"""Networks of stations that links alone join, with known truth."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxvm.recording.model import Model, Station
from jaxvm.recording.recording import Links, Recording, no_observations

N = 12
GRID = [(a, b) for a in range(N) for b in range(a + 1, N) if b - a in (1, 4)]


@dataclass(frozen=True)
class KnownNetwork:
    """A recording of links alone, and the true poses of its stations."""

    recording: Recording
    truth: np.ndarray


def matrix(vector) -> np.ndarray:
    """4 x 4 matrix of (turn, shift)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(np.array(vector[:3])).as_matrix()
    pose[:3, 3] = vector[3:]
    return pose


def vector(pose) -> np.ndarray:
    """(turn, shift) of a 4 x 4 matrix."""
    return np.append(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3])


def exponential(twist) -> np.ndarray:
    """4 x 4 matrix of a twist, by the matrix exponential."""
    x, y, z = twist[:3]
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    generator[:3, 3] = twist[3:]
    return expm(generator)


def network(edges=GRID, n=N, noise=1.0, seed=0, spread=4.0, turn=1.2) -> KnownNetwork:
    """Stations at random poses; the first is held, the others start near their true poses."""
    rng = np.random.default_rng(seed)
    truth = np.hstack([rng.uniform(-turn, turn, (n, 3)), rng.normal(0.0, spread, (n, 3))])
    poses, covariances = [], []
    for a, b in edges:
        root = rng.normal(size=(6, 6)) * np.repeat([3e-4, 3e-3], 3)[:, None]
        covariance = root @ root.T + np.diag(np.repeat([1e-4, 1e-3], 3) ** 2)
        twist = noise * np.linalg.cholesky(covariance) @ rng.standard_normal(6)
        true = np.linalg.inv(matrix(truth[a])) @ matrix(truth[b])
        poses.append(vector(true @ exponential(-twist)))
        covariances.append(covariance)
    free = frozenset({"pose"})
    start = truth + rng.normal(0.0, 0.05, truth.shape)
    start[0] = truth[0]
    stations = tuple(
        Station(f"s{i}", "static", start[i], free if i else frozenset()) for i in range(n)
    )
    links = Links(
        name=tuple(f"{a}-{b}" for a, b in edges),
        from_node=[("station", a) for a, _ in edges],
        to_node=[("station", b) for _, b in edges],
        pose=np.array(poses),
        covariance=np.array(covariances),
        epoch=np.full(len(edges), -1),
    )
    recording = Recording(
        Model("network", (), stations, ()), np.zeros(1, int), np.zeros(1), {}, no_observations(),
        links=links, timed=False,
    )  # fmt: skip
    return KnownNetwork(recording, truth)
