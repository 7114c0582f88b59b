"""Bundle adjustment problems of libmv and Blender: one camera that moves, binary.

The format is that of Ceres' example `libmv_bundle_adjuster` (Mierle & Sharybin 2013). Two letters:
v or V for numbers that begin with their least or most significant byte, P or N for markers in
pixels or on the plane z = 1. Eight floats: focal length, principal point, k1, k2, k3, p1, p2. Then
three lists, each after its length: cameras (image, camera_from_world as a rotation by columns and
a shift), points (track, place), markers (image, track, u, v). Numbers have 32 bits.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxvm.recording.errors import RecordingError
from jaxvm.recording.model import Camera, Model, Station, Target
from jaxvm.recording.recording import Observations, Recording

_CORNER = 0.5
"""Pixels are counted from the corner of the image in the file, from a pixel's centre here."""

_UNIT = 1000.0
"""Pixels to a principal distance of 1, where the file has no pixels."""

_LISTS = {
    "cameras": [("image", "i4"), ("turn", "f4", (3, 3)), ("shift", "f4", 3)],
    "points": [("track", "i4"), ("place", "f4", 3)],
    "markers": [("image", "i4"), ("track", "i4"), ("pixel", "f4", 2)],
}


def import_libmv(file: str | Path, refine: bool | None = None) -> Recording:
    """A recording of one camera, whose station stands elsewhere in every image, and free points.

    Every image is an epoch, with its number. The poses in the file are not part of a recording:
    `start` finds them in the images, `libmv_poses` gives those of the file. Free are the poses, the
    points, and the focal length with the coefficients of the lens. The lens has the fewest
    coefficients that hold those of the file, k1 and k2 at least. Nothing is held, so seven unknowns
    (where it is, how it is turned, how large) are not determined: adjust with damping and without
    the check of the gauge.

    The image size is not in the file: it is twice the principal point, or more where a marker lies
    beyond. Markers without a camera or a point are left out. Those on the plane z = 1 become pixels
    of a thousandth each.

    Args:
        file: to read.
        refine: whether focal length and lens are free; by default they are where markers are
            pixels.

    Raises:
        RecordingError: the file is cut off, holds something else, or has something twice.
    """
    problem = _read(Path(file))
    cameras, points, markers = problem.cameras, problem.points, problem.markers
    focal, centre, (k1, k2, k3, p1, p2) = problem.focal, problem.centre, problem.distortion
    pixel = markers["pixel"].astype(float)
    if problem.in_pixels:
        size = np.maximum(np.round(2.0 * centre), np.ceil(pixel.max(axis=0)))
        pixel, centre = pixel - _CORNER, centre - _CORNER
    else:
        focal, pixel = _UNIT * focal, _UNIT * (pixel - centre)
        centre = np.ceil(np.abs(pixel).max(axis=0)) + 1.0
        pixel, size = pixel + centre, 2.0 * centre
    width, height = (max(int(n), 1) for n in size)
    lens, coefficients = "opencv5", [k1, k2, p1, p2, k3]
    if k3 == 0.0:
        lens, coefficients = "opencv4", coefficients[:4]
        if p1 == 0.0 and p2 == 0.0:
            lens, coefficients = "radial", coefficients[:2]
    refine = problem.in_pixels if refine is None else refine
    free = frozenset({"aspect-locked-focal", "distortion"} if refine else ())
    model = Model(
        problem.name,
        cameras=(
            Camera(
                "camera", "camera", (width, height), lens, np.full(2, focal), centre,
                np.array(coefficients), np.zeros(6), free,
            ),
        ),
        stations=(Station("camera", "per-epoch", None, frozenset({"pose"})),),
        targets=(
            Target(
                "points", tuple(map(str, points["track"])), points["place"].astype(float),
                "static", np.zeros(6), frozenset({"points"}),
            ),
        ),
    )  # fmt: skip
    none = np.zeros(len(markers), int)
    epoch = np.searchsorted(cameras["image"], markers["image"])
    point = np.searchsorted(points["track"], markers["track"])
    return Recording(
        model,
        cameras["image"].astype(int),
        np.arange(len(cameras), dtype=float),
        {},
        Observations(epoch, none, none, point, pixel, np.ones(len(markers))),
        timed=False,
    )


def libmv_poses(file: str | Path) -> Float[np.ndarray, "epochs 6"]:
    """The poses world_from_station of the file, in the order of the epochs of its recording.

    Raises:
        RecordingError: as `import_libmv`.
    """
    cameras = _read(Path(file)).cameras
    world_from_camera = _turns(cameras).inv()
    place = -world_from_camera.apply(cameras["shift"].astype(float))
    return np.concatenate([world_from_camera.as_rotvec(), place], axis=1)


@dataclass(frozen=True)
class _Problem:
    """A file: cameras and points in the order of their numbers, markers that have both."""

    name: str
    in_pixels: bool
    focal: float
    centre: np.ndarray
    distortion: np.ndarray  # k1, k2, k3, p1, p2
    cameras: np.ndarray
    points: np.ndarray
    markers: np.ndarray


def _turns(cameras: np.ndarray) -> Rotation:
    """camera_from_world; the file has its columns."""
    return Rotation.from_matrix(cameras["turn"].astype(float).transpose(0, 2, 1))


def _read(file: Path) -> _Problem:
    if not file.is_file():
        raise RecordingError(f"{file}: there is no such file; mend the name")
    data = file.read_bytes()
    order: Literal["<", ">"] = "<" if data[:1] == b"v" else ">"
    if data[:1] not in (b"v", b"V") or data[1:2] not in (b"P", b"N"):
        raise RecordingError(
            f"{file.name}: it begins with {data[:2]!r}, not with v or V and P or N; "
            "is it a problem of libmv?"
        )
    at = 2

    def take(what: str, fields, count: int) -> np.ndarray:
        nonlocal at
        kind = np.dtype(fields).newbyteorder(order)
        if at + count * kind.itemsize > len(data):
            raise RecordingError(
                f"{file.name}: it ends at byte {len(data)}, but its {what} go to byte "
                f"{at + count * kind.itemsize}; is the file whole?"
            )
        found = np.frombuffer(data, kind, count, at)
        at += count * kind.itemsize
        return found.astype(kind.newbyteorder("="))

    intrinsics = take("intrinsics", "f4", 8).astype(float)
    lists = {}
    for what, fields in _LISTS.items():
        count = int(take(f"counts of {what}", "i4", 1)[0])
        if count < 1:
            raise RecordingError(f"{file.name}: it has {count} {what}; is the file whole?")
        lists[what] = take(f"{count} {what}", fields, count)
    if at != len(data):
        raise RecordingError(
            f"{file.name}: its markers end at byte {at}, but the file at byte {len(data)}; "
            "is it a problem of libmv?"
        )
    if not np.isfinite(intrinsics).all() or intrinsics[0] <= 0.0:
        raise RecordingError(
            f"{file.name}: the focal length, principal point and distortion are "
            f"{', '.join(f'{x:g}' for x in intrinsics)}; give finite ones, the first positive"
        )
    for what, rows in lists.items():
        _check_rows(file.name, what, rows)
    cameras, points, markers = lists.values()
    known = np.isin(markers["image"], cameras["image"])
    known &= np.isin(markers["track"], points["track"])
    if not known.any():
        raise RecordingError(f"{file.name}: no marker has a camera and a point; add some")
    return _Problem(
        file.stem,
        data[1:2] == b"P",
        float(intrinsics[0]),
        intrinsics[1:3],
        intrinsics[3:],
        np.sort(cameras, order="image"),
        np.sort(points, order="track"),
        markers[known],
    )


def _check_rows(name: str, what: str, rows: np.ndarray) -> None:
    """Every row has finite values and numbers of its own that are not negative."""
    names = [field for field in rows.dtype.names or () if rows[field].dtype.kind == "i"]
    numbers = np.stack([rows[field] for field in names], axis=1)
    one = what.removesuffix("s")

    def check(wrong: Int[np.ndarray, " n"], problem: str) -> None:
        if len(wrong):
            k = int(wrong[0])
            of = ", ".join(f"{field} {n}" for field, n in zip(names, numbers[k], strict=True))
            raise RecordingError(f"{name}: {one} {k + 1} ({of}) {problem}")

    check(np.flatnonzero((numbers < 0).any(axis=1)), "has a negative number; mend it")
    _, first, where = np.unique(numbers, axis=0, return_index=True, return_inverse=True)
    check(
        np.flatnonzero(first[where.ravel()] != np.arange(len(rows))), "is there already; keep one"
    )
    for field in set(rows.dtype.names or ()) - set(names):
        values = rows[field].reshape(len(rows), -1)
        lost = np.flatnonzero(~np.isfinite(values).all(axis=1))
        check(lost, f"has a {field} that is no number; drop it")
    if what == "cameras":
        turns = rows["turn"].astype(float)
        off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        mirrored = np.linalg.det(turns) < 0.0
        check(np.flatnonzero((off > 1e-3) | mirrored), "has a turn that is no rotation; mend it")
