"""Recordings: the engineer's model and the measurements, read, written and imported.

A recording is a folder with `recording.toml` (cameras, stations, targets, what is free) and tables
(`observations`, `epochs`, and if there are any `drivers`, `ranges`, `links`) as csv or parquet.
"""

from jaxvm.recording.convert import convert, describe
from jaxvm.recording.datasets import DATASETS, find_data, open_recording
from jaxvm.recording.errors import RecordingError
from jaxvm.recording.hints import hints
from jaxvm.recording.importers import (
    board_recording,
    import_cameramodel,
    import_corner_table,
    import_corners_vnl,
    import_opencv_calibration,
)
from jaxvm.recording.join import join
from jaxvm.recording.model import (
    Camera,
    Closure,
    Model,
    Prior,
    Rangefinder,
    Station,
    Target,
)
from jaxvm.recording.read import read_model, read_recording
from jaxvm.recording.recording import (
    Drivers,
    Links,
    Observations,
    Ranges,
    Recording,
    no_observations,
    uncorrelated,
)
from jaxvm.recording.write import model_text, write_recording

__all__ = [
    "Camera",
    "Closure",
    "DATASETS",
    "Drivers",
    "Links",
    "Model",
    "Observations",
    "Prior",
    "Rangefinder",
    "Ranges",
    "Recording",
    "RecordingError",
    "Station",
    "Target",
    "board_recording",
    "convert",
    "describe",
    "find_data",
    "hints",
    "import_cameramodel",
    "import_corner_table",
    "import_corners_vnl",
    "import_opencv_calibration",
    "join",
    "model_text",
    "no_observations",
    "open_recording",
    "read_model",
    "read_recording",
    "uncorrelated",
    "write_recording",
]
