"""Recordings: the engineer's model and the measurements, read, written and imported.

A recording is a folder with `recording.toml` (cameras, stations, targets, what is free) and tables
(`observations`, `epochs`, and if there are any `drivers`, `ranges`, `links`) as csv or parquet.
"""

from jaxvm.recording.errors import RecordingError
from jaxvm.recording.model import (
    Camera,
    Closure,
    Model,
    Prior,
    Rangefinder,
    Station,
    Target,
)
from jaxvm.recording.recording import Drivers, Links, Observations, Ranges, Recording

__all__ = [
    "Camera",
    "Closure",
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
]
