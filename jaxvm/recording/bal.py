"""Bundle adjustment problems in the text format of Bundle Adjustment in the Large, in and out.

Agarwal, Snavely, Seitz & Szeliski 2010. A line with the numbers of cameras, points and
observations; an observation a line (camera, point, u, v); then one number a line, nine for each
camera (rotation vector, translation, focal length, k1, k2) and three for each point. There the
camera looks along -z and v points up: both are turned about x here, which leaves every residual as
long as it was.
"""

import gzip
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxvm.recording.errors import RecordingError
from jaxvm.recording.model import Camera, Model, Station, Target
from jaxvm.recording.recording import Observations, Recording

_FLIP = np.array([1.0, -1.0, -1.0])


def import_bal(file: str | Path) -> Recording:
    """A recording of cameras, each on a station of its own, and one target with free points.

    Everything is free: poses, focal lengths (one for both axes), two radial coefficients, points.
    Nothing is held, so seven unknowns (where it is, how it is turned, how large) are not
    determined: adjust with damping and without the check of the gauge, as the other programs do.

    Args:
        file: text, gzipped if it ends in .gz.

    Raises:
        RecordingError: the file is cut off, holds something else, or names what is not in it.
    """
    file = Path(file)
    cameras, points, observations = _numbers(file)
    camera, point = observations[:, 0].astype(int), observations[:, 1].astype(int)
    for kind, index, count in (("camera", camera, len(cameras)), ("point", point, len(points))):
        wrong = np.flatnonzero((index < 0) | (index >= count))
        if len(wrong):
            raise RecordingError(
                f"{file.name} line {wrong[0] + 2}: {kind} {index[wrong[0]]} is not among the "
                f"{count} of the file; mend the line"
            )
    pixel = observations[:, 2:] * [1.0, -1.0]
    half = np.ceil(np.abs(pixel).max(axis=0)) + 1.0
    width, height = (int(2 * n) for n in half)
    turns = Rotation.from_rotvec(cameras[:, :3])
    # camera_from_world of the file, its y and z turned round; stations stand where cameras do.
    station_from_world = Rotation.from_matrix(np.diag(_FLIP)) * turns
    world_from_station = station_from_world.inv()
    place = -world_from_station.apply(cameras[:, 3:6] * _FLIP)
    name = [f"c{i}" for i in range(len(cameras))]
    model = Model(
        file.name.removesuffix(".gz").removesuffix(".txt"),
        cameras=tuple(
            Camera(
                name[i], name[i], (width, height), "radial", np.full(2, row[6]), half.copy(),
                row[7:], np.zeros(6), frozenset({"aspect-locked-focal", "distortion"}),
            )
            for i, row in enumerate(cameras)
        ),
        stations=tuple(
            Station(name[i], "static", np.append(turn, place[i]), frozenset({"pose"}))
            for i, turn in enumerate(world_from_station.as_rotvec())
        ),
        targets=(
            Target(
                "points", tuple(map(str, range(len(points)))), points, "static", np.zeros(6),
                frozenset({"points"}),
            ),
        ),
    )  # fmt: skip
    n = len(pixel)
    return Recording(
        model,
        np.zeros(1, int),
        np.zeros(1),
        {},
        Observations(np.zeros(n, int), camera, np.zeros(n, int), point, pixel + half, np.ones(n)),
        timed=False,
    )


def write_bal(
    file: str | Path,
    camera: Int[np.ndarray, " n"],
    point: Int[np.ndarray, " n"],
    pixel: Float[np.ndarray, "n 2"],
    cameras: Float[np.ndarray, "cameras 9"],
    points: Float[np.ndarray, "points 3"],
) -> None:
    """Write a problem, in the conventions of the format (the camera looks along -z, v points up).

    Args:
        camera, point: of each observation.
        pixel: u, v (px) from the principal point.
        cameras: rotation vector, translation, focal length (px), k1, k2.
        points: in the world (m).
    """
    rows = [f"{c} {p} {u:.17g} {v:.17g}" for c, p, (u, v) in zip(camera, point, pixel, strict=True)]
    numbers = [f"{value:.17g}" for value in np.concatenate([np.ravel(cameras), np.ravel(points)])]
    head = f"{len(cameras)} {len(points)} {len(rows)}"
    text = "\n".join([head, *rows, *numbers]) + "\n"
    file = Path(file)
    packed = gzip.compress(text.encode(), mtime=0) if file.suffix == ".gz" else text.encode()
    file.write_bytes(packed)


def _numbers(file: Path):
    """Cameras [c, 9], points [p, 3] and observations [n, 4]."""
    if not file.is_file():
        raise RecordingError(f"{file}: there is no such file; mend the name")
    try:
        with gzip.open(file, "rt") if file.suffix == ".gz" else open(file) as stream:
            words = stream.read().split()
        values = np.array(words, float)
    except (OSError, EOFError, ValueError) as problem:
        raise RecordingError(
            f"{file.name}: it is no bundle adjustment problem ({problem})"
        ) from None
    counts = values[:3]
    if len(counts) < 3 or (counts < 1).any() or (counts % 1).any():
        raise RecordingError(
            f"{file.name} line 1: give the numbers of cameras, points and observations"
        )
    c, p, n = counts.astype(int)
    expected = 3 + 4 * n + 9 * c + 3 * p
    if len(values) != expected or not np.isfinite(values).all():
        raise RecordingError(
            f"{file.name}: {c} cameras, {p} points and {n} observations are {expected} finite "
            f"numbers, but there are {int(np.isfinite(values).sum())}; is the file whole?"
        )
    ends = 3 + np.cumsum([4 * n, 9 * c])
    return (
        values[ends[0] : ends[1]].reshape(c, 9),
        values[ends[1] :].reshape(p, 3),
        values[3 : ends[0]].reshape(n, 4),
    )
