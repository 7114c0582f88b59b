"""Importers: chessboard corners and calibrations as other programs write them."""

import ast
import base64
import fnmatch
import io
import re
from collections.abc import Mapping
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxvm.geometry.poses import pose_from_vector, vector_from_pose
from jaxvm.geometry.targets import grid_points
from jaxvm.recording.errors import RecordingError, has
from jaxvm.recording.model import LENSES, Camera, Model, Station, Target, grid_names
from jaxvm.recording.recording import Observations, Recording
from jaxvm.recording.tables import read_csv
from jaxvm.recording.texts import read_text

_CORNERS = ("frame", "row", "col", "u", "v", "weight")


def board_recording(
    corners: pd.DataFrame,
    rows: int,
    columns: int,
    spacing_m: float,
    image_sizes: Mapping[str, tuple[int, int]],
    lens: str = "opencv8",
    name: str = "",
) -> Recording:
    """Recording of one chessboard that was moved before cameras on one rig.

    Everything is estimated from the data: intrinsics, the cameras' poses on the rig (the first one
    is the rig), one pose of the board for each frame. Frames have an order but no times.

    Args:
        corners: columns camera, frame, row, col, u, v (px), sigma (px).
        rows, columns, spacing_m: the board's inner corners.
        image_sizes: width and height (px), by camera.
        lens: lens of all cameras.

    Raises:
        ValueError: an unknown lens, or a corner that is not on the board.
    """
    if lens not in LENSES:
        raise ValueError(f'there is no lens "{lens}"; take one of {", ".join(LENSES)}')
    row, col = corners["row"].to_numpy(int), corners["col"].to_numpy(int)
    outside = (row < 0) | (row >= rows) | (col < 0) | (col >= columns)
    if outside.any():
        k = int(np.flatnonzero(outside)[0])
        raise ValueError(
            f"corner ({row[k]}, {col[k]}) is not on a board of {rows} x {columns} corners; "
            "mend the numbers of rows and columns"
        )
    intrinsics = frozenset(("focal", "centre", "distortion"))
    names = list(image_sizes)
    cameras = tuple(
        Camera(
            name=camera,
            station="rig",
            image_size=(int(size[0]), int(size[1])),
            lens=lens,
            pose=np.zeros(6) if i == 0 else None,
            free=intrinsics if i == 0 else intrinsics | {"pose"},
        )
        for i, (camera, size) in enumerate(image_sizes.items())
    )
    board = Target(
        "board",
        grid_names(rows, columns),
        grid_points(rows, columns, spacing_m),
        motion="per-epoch",
        free=frozenset(("pose",)),
    )
    epoch_ids, epoch = np.unique(corners["frame"].to_numpy(int), return_inverse=True)
    return Recording(
        model=Model(name, cameras, (Station("rig", pose=np.zeros(6)),), (board,)),
        epoch_ids=epoch_ids,
        time=np.arange(len(epoch_ids), dtype=float),
        velocities={},
        observations=Observations(
            epoch=np.ravel(epoch),
            camera=np.array([names.index(c) for c in corners["camera"]], int),
            target=np.zeros(len(corners), int),
            point=row * columns + col,
            pixel=corners[["u", "v"]].to_numpy(float),
            sigma=corners["sigma"].to_numpy(float),
        ),
        timed=False,
    )


def import_corner_table(
    file: str | Path, image_size: tuple[int, int], spacing_m: float, lens: str = "opencv8"
) -> Recording:
    """Recording from a table of corners: csv with frame, row, col, u, v, weight.

    The standard deviation of a coordinate is 1/weight px; corners with weight <= 0, which the
    detector's program had rejected, are left out.

    Raises:
        RecordingError: the table is absent or something in it is wrong.
    """
    file = Path(file)
    if not file.is_file():
        raise RecordingError(f"{file}: there is no such file; give the table of corners")
    table = read_csv(file)
    table.needs(_CORNERS)
    columns = {name: table.whole(name, "a whole number from 0") for name in _CORNERS[:3]}
    columns |= {name: table.numbers(name, "a number") for name in _CORNERS[3:]}
    corners = pd.DataFrame({"camera": "camera", **columns})
    corners = corners[corners.weight > 0.0].assign(sigma=lambda c: 1.0 / c.weight)
    if corners.empty:
        raise table.error(None, "no corner has a weight above 0; a weight is 1/sigma")
    return board_recording(
        corners,
        int(corners.row.max()) + 1,
        int(corners.col.max()) + 1,
        spacing_m,
        {"camera": image_size},
        lens,
        file.parent.name,
    )


def import_corners_vnl(
    file: str | Path,
    rows: int,
    columns: int,
    spacing_m: float,
    image_sizes: Mapping[str, tuple[int, int]],
    patterns: Mapping[str, str] | None = None,
    lens: str = "opencv8",
) -> Recording:
    """Recording from mrcal's corners.vnl: filename x y level (or weight), row by row of the board.

    Args:
        rows, columns, spacing_m: the board's inner corners.
        image_sizes: width and height (px), by camera.
        patterns: file names of each camera's images, such as {"left": "left*.jpg"}; what the star
            stands for is the frame. One camera needs none: its images are the frames.
        lens: lens of all cameras.

    A corner found at pyramid level k has a standard deviation of 2^k px; "-" is a corner that was
    not found.

    Raises:
        RecordingError: a line is wrong, or an image has another number of corners than the board.
    """
    file = Path(file)
    if not file.is_file():
        raise RecordingError(f"{file}: there is no such file; give mrcal's corners.vnl")
    images: dict[str, list[tuple[int, list[str]]]] = {}
    legend = ["filename", "x", "y", "level"]
    for number, line in enumerate(read_text(file, file.name).splitlines(), start=1):
        if line.startswith("##") or line.startswith("#!") or not line.strip():
            continue
        fields = line.split()
        if line.startswith("#"):
            legend = line.lstrip("# ").split()
            continue
        images.setdefault(fields[0], []).append((number, fields))
    image_names = list(image_sizes)
    if patterns is None:
        if len(image_names) != 1:
            raise RecordingError(
                f"{file.name}: {len(image_names)} cameras need patterns, such as "
                '{"left": "left*.jpg"}'
            )
        patterns = {image_names[0]: "*"}
    parts = []
    for order, (image, lines) in enumerate(images.items()):
        if len(lines) == 1 and "-" in lines[0][1][1:3]:
            continue  # mrcal's mark for an image without a board
        if len(lines) != rows * columns:
            raise RecordingError(
                f"{file.name} line {lines[0][0]}: image {image} has {len(lines)} corners, the "
                f"board {rows} x {columns} = {rows * columns}; mend the board's size"
            )
        camera, frame = _frame_of(file.name, image, lines[0][0], patterns, order)
        for k, (number, fields) in enumerate(lines):
            if "-" in fields[1:]:
                continue
            try:
                x, y = float(fields[1]), float(fields[2])
                last = float(fields[3]) if len(fields) > 3 else 0.0
            except (ValueError, IndexError):
                raise RecordingError(
                    f'{file.name} line {number}: "{" ".join(fields)}" is not "filename x y level"'
                ) from None
            weight = last if "weight" in legend[3:4] else 0.5**last
            if last < 0.0 or weight <= 0.0:
                continue
            parts.append((camera, frame, k // columns, k % columns, x, y, 1.0 / weight))
    if not parts:
        raise RecordingError(f"{file.name}: there is no corner in it; give mrcal's corners.vnl")
    frame = pd.DataFrame(parts, columns=["camera", "frame", "row", "col", "u", "v", "sigma"])
    return board_recording(frame, rows, columns, spacing_m, image_sizes, lens, file.stem)


def _frame_of(file: str, image: str, line: int, patterns: Mapping[str, str], order: int):
    """Camera and frame of an image; frames are numbered by digits in the name where it has them."""
    name = image.rsplit("/", 1)[-1]
    for camera, pattern in patterns.items():
        if fnmatch.fnmatchcase(name, pattern):
            if pattern == "*":
                return camera, order
            matched = re.fullmatch(re.escape(pattern).replace(r"\*", "(.*)"), name)
            digits = re.findall(r"\d+", matched[1] if matched else "")
            if digits:
                return camera, int(digits[-1])
            break
    raise RecordingError(
        f"{file} line {line}: image {name} fits no camera with a frame number "
        f"{has(f'{c}: {p}' for c, p in patterns.items())}; mend the patterns"
    )


def import_cameramodel(file: str | Path) -> Recording:
    """Recording from the optimisation inputs that mrcal stores in a .cameramodel.

    The calibration that mrcal found is not taken over, only its observations and the kind of lens.

    Raises:
        RecordingError: the file is absent, has no optimisation inputs, or a lens that is not known.
    """
    file = Path(file)
    if not file.is_file():
        raise RecordingError(f"{file}: there is no such file; give a .cameramodel of mrcal")
    text = read_text(file, file.name)
    try:
        table = ast.literal_eval("\n".join(x for x in text.splitlines() if x.lstrip()[:1] != "#"))
        packed = table["optimization_inputs"]
        packed = packed if isinstance(packed, bytes) else packed.encode()
        inputs = np.load(io.BytesIO(base64.b85decode(packed)), allow_pickle=False)
    except (SyntaxError, ValueError, KeyError, TypeError):
        raise RecordingError(
            f"{file.name}: it has no optimization_inputs; write it with mrcal-calibrate-cameras"
        ) from None
    model = str(inputs["lensmodel"])
    lens = model.removeprefix("LENSMODEL_").lower()
    if lens not in LENSES:
        # A richer lens of mrcal's own (splined, CAHVOR): the data are the same.
        lens = "opencv8"
    corners = inputs["observations_board"]
    view, row, col = (a.ravel() for a in np.indices(corners.shape[:3]))
    u, v, weight = corners.reshape(-1, 3).T
    index = inputs["indices_frame_camintrinsics_camextrinsics"][view]
    camera = np.array([f"camera{i}" for i in range(len(inputs["imagersizes"]))], object)
    frame = pd.DataFrame(
        {"camera": camera[index[:, 1]], "frame": index[:, 0], "row": row, "col": col, "u": u,
         "v": v, "weight": weight}
    )  # fmt: skip
    frame = frame[frame.weight > 0.0].assign(sigma=lambda c: 1.0 / c.weight)
    sizes = {
        str(name): (int(size[0]), int(size[1]))
        for name, size in zip(camera, inputs["imagersizes"], strict=True)
    }
    if len(sizes) == 1:
        frame, sizes = frame.assign(camera="camera"), {"camera": next(iter(sizes.values()))}
    spacing = float(inputs["calibration_object_spacing"])
    rows, columns = corners.shape[1:3]
    return board_recording(frame, rows, columns, spacing, sizes, lens, file.stem)


def import_opencv_calibration(
    file: str | Path,
    image_size: tuple[int, int] | None = None,
    extrinsics: str | Path | None = None,
) -> tuple[Camera, ...]:
    """Cameras from OpenCV's calibration YAML (or XML), held at the calibrated values.

    Reads camera_matrix and distortion_coefficients of a mono calibration, or M1, D1, M2, D2 of a
    stereo one with R, T (right_from_left) from `extrinsics` or the same file.

    Raises:
        RecordingError: the file is absent or lacks what is needed.
    """
    file = Path(file)
    nodes = _opencv_nodes(file)
    if extrinsics is not None:
        nodes |= _opencv_nodes(Path(extrinsics))
    if image_size is None:
        if "image_width" not in nodes or "image_height" not in nodes:
            raise RecordingError(
                f"{file.name}: it has no image_width and image_height; give them with --image-size"
            )
        image_size = int(nodes["image_width"]), int(nodes["image_height"])
    if "camera_matrix" in nodes:
        matrices = {"camera": (nodes["camera_matrix"], nodes.get("distortion_coefficients"))}
    elif "M1" in nodes and "M2" in nodes:
        matrices = {"left": (nodes["M1"], nodes.get("D1")), "right": (nodes["M2"], nodes.get("D2"))}
    else:
        raise RecordingError(
            f"{file.name}: it has neither camera_matrix nor M1 and M2 {has(nodes)}; "
            "give the file that OpenCV's calibration sample writes"
        )
    pose = {name: np.zeros(6) for name in matrices}
    free: frozenset[str] = frozenset()
    if len(matrices) == 2:
        if "R" in nodes and "T" in nodes:
            turn = cv2.Rodrigues(nodes["R"])[0].ravel()
            vector = jnp.asarray(np.concatenate([turn, nodes["T"].ravel()]))
            right_from_left = pose_from_vector(vector)
            pose["right"] = np.asarray(vector_from_pose(right_from_left.inverse()))
        else:
            free = frozenset(("pose",))
    return tuple(
        _opencv_camera(file.name, name, k, d, image_size, pose[name], free if i else frozenset())
        for i, (name, (k, d)) in enumerate(matrices.items())
    )


def _opencv_camera(file, name, matrix, distortion, image_size, pose, free) -> Camera:
    lens = {LENSES[key]: key for key in LENSES if key != "fisheye"}
    coefficients = np.zeros(0) if distortion is None else np.asarray(distortion, float).ravel()
    if len(coefficients) not in lens:
        raise RecordingError(
            f"{file}: camera {name} has {len(coefficients)} distortion coefficients; "
            "OpenCV has 4, 5, 8, 12 or 14"
        )
    return Camera(
        name=name,
        station="rig",
        image_size=image_size,
        lens=lens[len(coefficients)],
        focal_px=np.array([matrix[0, 0], matrix[1, 1]]),
        centre_px=np.array([matrix[0, 2], matrix[1, 2]]),
        distortion=coefficients,
        pose=None if "pose" in free else pose,
        free=free,
    )


def _opencv_nodes(file: Path) -> dict:
    if not file.is_file():
        raise RecordingError(f"{file}: there is no such file; give OpenCV's calibration file")
    try:
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        root = storage.root()
        nodes = {}
        for key in root.keys():
            node = root.getNode(key)
            nodes[key] = node.mat() if node.isMap() else node.real()
    except cv2.error as problem:
        reason = str(problem).strip().splitlines()[0]
        raise RecordingError(f"{file.name}: OpenCV can't read it: {reason}") from None
    return nodes
