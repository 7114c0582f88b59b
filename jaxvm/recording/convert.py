"""Convert files of other programs, or another kind of table, into the folder of a recording."""

from pathlib import Path
from typing import Literal

import tomli_w

from jaxvm.recording.bal import import_bal
from jaxvm.recording.datasets import DATASETS, open_recording
from jaxvm.recording.errors import RecordingError
from jaxvm.recording.files import new_folder
from jaxvm.recording.g2o import import_g2o, write_g2o
from jaxvm.recording.hints import unseen_epochs
from jaxvm.recording.importers import (
    import_cameramodel,
    import_corner_table,
    import_corners_vnl,
    import_opencv_calibration,
)
from jaxvm.recording.libmv import import_libmv
from jaxvm.recording.model import camera_table
from jaxvm.recording.read import read_recording
from jaxvm.recording.recording import Recording
from jaxvm.recording.write import write_recording

_SIZE = "the image size", "--image-size WxH"
_SPACING = "the spacing of its corners", "--spacing METRES"


def convert(
    source: str | Path,
    out: str | Path,
    table: Literal["csv", "parquet"] = "csv",
    image_size: tuple[int, int] | None = None,
    spacing_m: float | None = None,
    rows: int | None = None,
    columns: int | None = None,
    lens: str = "opencv8",
    mend: bool = False,
) -> str:
    """Write a recording made of `source`; returns a sentence that tells what is in it.

    What the source is follows from its name: .csv is a table of corners, .vnl mrcal's corners,
    .cameramodel mrcal's optimisation inputs, a folder a recording, and the name of a public
    recording that one. OpenCV's calibration (.yml, .yaml, .xml) has no observations: `out` gets a
    recording.toml with its cameras, to which targets and tables are to be added. A pose graph
    (.g2o, .g2o.gz) becomes stations and links, with `mend` where its information is not positive
    definite; where `out` is such a file, stations and links become a pose graph. A problem of
    bundle adjustment (.txt, .txt.gz) becomes cameras and one target whose points are free, one of
    libmv (.bin) one camera whose station moves.

    Raises:
        RecordingError: the source is wrong, or needs a number that was not given.
        FileExistsError: `out` is already there and not empty.
    """
    path = Path(source)
    kind = "folder" if path.is_dir() else path.suffix.lower()

    def needed(value, what: str, option: str):
        # Of a file that is not there nothing else is missing.
        if not path.is_file():
            raise RecordingError(f"{source}: there is no such file; mend the name")
        if value is None:
            raise RecordingError(f"{path.name}: it does not tell {what}; give it with {option}")
        return value

    if kind in (".yml", ".yaml", ".xml"):
        cameras = import_opencv_calibration(path, image_size)
        content = {"format": 1, "cameras": {c.name: camera_table(c) for c in cameras}}
        with new_folder(out) as staging:
            (staging / "recording.toml").write_text(tomli_w.dumps(content), encoding="utf-8")
        return f"{len(cameras)} calibrated cameras; add targets and tables"
    if str(source) in DATASETS and kind != "folder":
        recording = open_recording(str(source))
    elif kind == "folder":
        recording = read_recording(path)
    elif kind == ".csv":
        recording = import_corner_table(
            path, needed(image_size, *_SIZE), needed(spacing_m, *_SPACING), lens
        )
    elif kind == ".vnl":
        recording = import_corners_vnl(
            path,
            needed(rows, "the number of rows", "--rows"),
            needed(columns, "the number of columns", "--columns"),
            needed(spacing_m, *_SPACING),
            {"camera": needed(image_size, *_SIZE)},
            lens=lens,
        )
    elif path.name.endswith((".g2o", ".g2o.gz")):
        recording = import_g2o(path, mend)
    elif path.name.endswith((".txt", ".txt.gz")):
        recording = import_bal(path)
    elif kind == ".bin":
        recording = import_libmv(path)
    elif kind == ".cameramodel":
        recording = import_cameramodel(path)
    else:
        raise RecordingError(
            f"{source}: it is no folder, no public recording ({', '.join(DATASETS)}), and no .csv, "
            ".vnl, .cameramodel, .g2o, .txt, .bin (bundle adjustment), .yml, .xml; mend the name"
        )
    if Path(out).name.endswith((".g2o", ".g2o.gz")):
        if Path(out).exists():
            raise FileExistsError(f"{out} is already there; choose another name or remove it")
        write_g2o(recording, out)
        return describe(recording)
    write_recording(recording, out, table)
    return describe(recording)


def describe(recording: Recording) -> str:
    """What is in a recording, in one sentence."""
    model = recording.model
    parts = [
        f"{len(model.cameras)} camera(s) on {len(model.stations)} station(s)",
        f"{len(model.targets)} target(s)",
        f"{len(recording.time)} epochs",
        f"{len(recording.observations.epoch)} image points",
    ]
    if recording.timed and len(recording.time) > 1:
        parts[2] += f" over {(recording.time[-1] - recording.time[0]) / 3600.0:.2f} h"
    if model.cameras and (unseen := unseen_epochs(recording)):
        parts[2] += f", {unseen} of them without an image point"
    if recording.drivers is not None:
        parts.append(f"drivers {', '.join(recording.drivers.channels)}")
    if recording.ranges is not None:
        parts.append(f"{len(recording.ranges.epoch)} ranges")
    if recording.links is not None:
        parts.append(f"{len(recording.links.name)} links")
    if model.effects:
        parts.append("effects " + ", ".join(effect.name for effect in model.effects))
    return "; ".join(parts)
