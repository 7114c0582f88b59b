"""Simulated blocks of images in the format of Bundle Adjustment in the Large.

    python benchmarks/bundle_adjustment/simulated.py CAMERAS POINTS VIEWS FILE [--seed 0]

Cameras fly over ground with hills in a grid of strips, look down with some tilt, and see every
point in VIEWS images on average. Each has a focal length and a lens of its own. Pixels have noise
of half a pixel; the start is off by some tenths of a degree, by a metre, by one hundredth of the
focal length, and knows nothing of the lens.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxvm.recording.bal import write_bal

HEIGHT = 100.0  # m above the ground
FOCAL, HALF = 1000.0, np.array([1000.0, 750.0])  # px
FOUND = 0.8  # share of the images of a point in which it is found
NOISE = 0.5  # px


def ground(xy: np.ndarray) -> np.ndarray:
    """Height (m) of the ground: hills of some metres."""
    x, y = xy[..., 0], xy[..., 1]
    return 6.0 * np.sin(x / 90.0) * np.cos(y / 70.0) + 2.0 * np.sin(x / 17.0 + y / 23.0)


def seen(cameras: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels from the principal point and whether they lie in the image; cameras and points pair
    by pair. The camera looks along -z (Agarwal et al. 2010)."""
    local = Rotation.from_rotvec(cameras[:, :3]).apply(points) + cameras[:, 3:6]
    ahead = local[:, 2] < -1.0
    ideal = -local[:, :2] / np.where(ahead, local[:, 2], -1.0)[:, None]
    square = np.sum(ideal**2, axis=1)
    bent = 1.0 + cameras[:, 7] * square + cameras[:, 8] * square**2
    pixel = cameras[:, 6:7] * bent[:, None] * ideal
    return pixel, ahead & (np.abs(pixel) < HALF).all(axis=1)


def block(n_cameras: int, n_points: int, views: float, seed: int):
    """Camera, point and pixel of all observations; true cameras [n, 9] and points [n, 3]."""
    rng = np.random.default_rng(seed)
    across = int(np.ceil(np.sqrt(n_cameras)))
    footprint = np.prod(2.0 * HALF / FOCAL * HEIGHT)
    spacing = np.sqrt(FOUND * footprint / views)
    place = np.stack(np.divmod(np.arange(n_cameras), across), axis=1) * spacing
    place = place + rng.normal(0.0, 0.05 * spacing, place.shape)
    height = HEIGHT + rng.normal(0.0, 2.0, n_cameras)
    turn = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad([3.0, 3.0, 5.0]), (n_cameras, 3)))
    centre = np.column_stack([place, height])
    cameras = np.column_stack(
        [
            turn.as_rotvec(),
            -turn.apply(centre),
            FOCAL * (1.0 + rng.normal(0.0, 0.01, n_cameras)),
            rng.normal(-0.05, 0.01, n_cameras),
            rng.normal(0.01, 0.003, n_cameras),
        ]
    )
    reach = np.linalg.norm(HALF / FOCAL * HEIGHT) * 1.5
    kept, found, have = [], [], 0
    while have < n_points:
        xy = rng.uniform(place.min(axis=0), place.max(axis=0), (n_points, 2))
        points = np.column_stack([xy, ground(xy)])
        k, i = _near(place, xy, reach)
        _, inside = seen(cameras[i], points[k])
        inside &= rng.uniform(size=len(k)) < FOUND
        k, i = k[inside], i[inside]
        often = np.bincount(k, minlength=len(points)) >= 2
        number = have + np.cumsum(often) - 1
        own = often[k] & (number[k] < n_points)
        kept.append(points[often][: n_points - have])
        found.append(np.column_stack([i[own], number[k[own]]]))
        have += len(kept[-1])
    points = np.concatenate(kept)
    camera, point = np.concatenate(found).T
    pixel, _ = seen(cameras[camera], points[point])
    return camera, point, pixel + rng.normal(0.0, NOISE, pixel.shape), cameras, points


def _near(place: np.ndarray, xy: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of points and cameras not further apart than the corner of an image."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(xy).sparse_distance_matrix(cKDTree(place), reach, output_type="coo_matrix")
    return pairs.row, pairs.col


def start(cameras: np.ndarray, points: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Where an adjustment begins."""
    rng = np.random.default_rng([seed, 1])
    turn = Rotation.from_rotvec(cameras[:, :3])
    centre = -turn.inv().apply(cameras[:, 3:6]) + rng.normal(0.0, 1.0, (len(cameras), 3))
    turn = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(0.3), (len(cameras), 3))) * turn
    off = cameras.copy()
    off[:, :3], off[:, 3:6] = turn.as_rotvec(), -turn.apply(centre)
    off[:, 6] *= 1.0 + rng.normal(0.0, 0.01, len(cameras))
    off[:, 7:] = 0.0
    return off, points + rng.normal(0.0, 1.0, points.shape)


def write(file: Path, n_cameras: int, n_points: int, views: float, seed: int = 0) -> int:
    """Write a block as it stands before adjustment; the number of observations."""
    camera, point, pixel, cameras, points = block(n_cameras, n_points, views, seed)
    write_bal(file, camera, point, pixel, *start(cameras, points, seed))
    return len(camera)


def main() -> None:
    """One block."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, kind in (("cameras", int), ("points", int), ("views", float), ("file", Path)):
        asked.add_argument(name, type=kind)
    asked.add_argument("--seed", type=int, default=0)
    given = asked.parse_args()
    count = write(given.file, given.cameras, given.points, given.views, given.seed)
    print(f"{count} observations")


if __name__ == "__main__":
    main()
