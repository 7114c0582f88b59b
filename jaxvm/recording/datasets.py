"""Public recordings by name: from a local copy where there is one, else fetched into a cache."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pooch

from jaxvm.recording.errors import RecordingError
from jaxvm.recording.importers import import_cameramodel, import_corner_table
from jaxvm.recording.read import check_same_bodies, read_model
from jaxvm.recording.recording import Recording

_MRCAL = (
    "https://raw.githubusercontent.com/dkogan/mrcal/c47576ea206f3cbd1ff86ee748c1b00bdd93361b/"
    "doc/data/figueroa-overpass-looking-S/"
)


@dataclass(frozen=True)
class Dataset:
    """A public recording.

    Attributes:
        origin: who made it, and its licence.
        local: file below the folder of local data.
        url, sha256: where it is published.
        read_local, read_published: make a recording of the one or the other.
    """

    origin: str
    local: str
    url: str
    sha256: str
    read_local: Callable[[Path], Recording]
    read_published: Callable[[Path], Recording]


DATASETS: dict[str, Dataset] = {
    "sony-board": Dataset(
        origin="186 views of a chessboard by one wide-angle camera; dkogan/mrcal, Apache-2.0",
        local="sony-board/corners.csv",
        url=_MRCAL + "opencv8-0.cameramodel",
        sha256="4338b08b5681db7b90f66fa365ec1a411e617b2dca96de6889d3fa03f4f87b38",
        read_local=lambda file: import_corner_table(file, (6016, 4016), 0.077),
        read_published=import_cameramodel,
    ),
}
"""Recordings that `open_recording` knows."""


def find_data(name: str) -> Path | None:
    """A file or folder of local data: below JAXVM_DATA, or ../shared/data from here; else None."""
    places = [os.environ.get("JAXVM_DATA"), "../shared/data"]
    root = Path(__file__).resolve().parents[2]
    for place in places:
        for base in (Path.cwd(), root):
            if place and (found := base / place / name).exists():
                return found
    return None


def open_recording(name: str, model: str | Path | None = None) -> Recording:
    """A public recording by name, fetched when there is no local copy.

    `model` is a file in the form of recording.toml to take instead of the plain model.

    Raises:
        RecordingError: the name is not known, or it can't be fetched.
    """
    if name not in DATASETS:
        known = ", ".join(DATASETS)
        raise RecordingError(f'there is no public recording "{name}"; known here: {known}')
    recording = _open(name)
    if model is None:
        return recording
    parsed, _ = read_model(model)
    check_same_bodies(recording.model, parsed, str(model))
    return replace(recording, model=parsed)


def _open(name: str) -> Recording:
    dataset = DATASETS[name]
    if (local := find_data(dataset.local)) is not None:
        return dataset.read_local(local)
    try:
        file = pooch.retrieve(
            dataset.url, known_hash=f"sha256:{dataset.sha256}", path=pooch.os_cache("jaxvm")
        )
    except Exception as problem:
        raise RecordingError(
            f"{name} can't be fetched ({type(problem).__name__}); connect to the network, or put "
            f"{dataset.local} into a folder and name that folder in JAXVM_DATA"
        ) from None
    return dataset.read_published(Path(file))
