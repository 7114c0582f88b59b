"""Write a recording as a folder: the inverse of `read_recording`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import tomli_w

from jaxvm.recording.files import new_folder
from jaxvm.recording.model import Model, model_to_toml
from jaxvm.recording.recording import Recording, uncorrelated

RATES = ("vx", "vy", "vz", "wx", "wy", "wz")
"""Columns of a target's velocity (m/s) and angular rate (rad/s) in epochs."""


COVARIANCES = {f"c{i + 1}{j + 1}": (i, j) for i in range(6) for j in range(i, 6)}
"""Columns of a link's covariance: turn x, y, z (rad), then shift x, y, z (m)."""


def write_recording(
    recording: Recording,
    folder: str | Path,
    table: Literal["csv", "parquet"] = "csv",
    beside: Mapping[str, str] | None = None,
) -> Path:
    """Write a recording into a new folder, which appears when it is complete.

    Args:
        table: form of the tables.
        beside: further texts by their file names, which are no part of the recording.

    Raises:
        FileExistsError: the folder is already there and not empty.
    """
    with new_folder(folder) as staging:
        text = model_text(recording.model)
        (staging / "recording.toml").write_text(text, encoding="utf-8")
        for name, frame in tables_of(recording).items():
            if table == "parquet":
                frame.to_parquet(staging / f"{name}.parquet", index=False)
            else:
                frame.to_csv(staging / f"{name}.csv", index=False, lineterminator="\n")
        for name, text in (beside or {}).items():
            (staging / name).write_text(text, encoding="utf-8")
    return Path(folder)


def model_text(model: Model) -> str:
    """Content of recording.toml for a model."""
    return tomli_w.dumps(model_to_toml(model))


def tables_of(recording: Recording) -> dict[str, pd.DataFrame]:
    """The tables of a recording, names in place of indices."""
    model, obs = recording.model, recording.observations
    epochs: dict = {"epoch": recording.epoch_ids}
    if recording.timed:
        epochs["t"] = recording.time
    for target, values in recording.velocities.items():
        epochs |= {f"{target}.{rate}": values[:, k] for k, rate in enumerate(RATES)}
    tables = {
        "observations": pd.DataFrame(
            {
                "epoch": recording.epoch_ids[obs.epoch],
                "camera": _names(model.cameras, obs.camera),
                "target": _names(model.targets, obs.target),
                "point": _points(model, obs.target, obs.point),
                "u": obs.pixel[:, 0],
                "v": obs.pixel[:, 1],
                "sigma": obs.sigma,
            }
        ),
        "epochs": pd.DataFrame(epochs),
    }
    if recording.drivers is not None:
        drivers = recording.drivers
        tables["drivers"] = pd.DataFrame({"t": drivers.time, **drivers.channels})
    if recording.ranges is not None:
        ranges = recording.ranges
        tables["ranges"] = pd.DataFrame(
            {
                "epoch": recording.epoch_ids[ranges.epoch],
                "rangefinder": _names(model.rangefinders, ranges.rangefinder),
                "target": _names(model.targets, ranges.target),
                "point": _points(model, ranges.target, ranges.point),
                "range_m": ranges.distance,
                "sigma": ranges.sigma,
            }
        )
    if recording.links is not None:
        tables["links"] = _links(recording)
    return tables


def _links(recording: Recording) -> pd.DataFrame:
    links, model = recording.links, recording.model
    assert links is not None
    bodies = {"camera": model.cameras, "station": model.stations, "target": model.targets}
    frame: dict[str, list[str] | np.ndarray] = {
        "link": list(links.name),
        "from": [f"{kind}:{bodies[kind][i].name}" for kind, i in links.from_node],
        "to": [f"{kind}:{bodies[kind][i].name}" for kind, i in links.to_node],
    }
    for k, column in enumerate(("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z")):
        frame[column] = links.pose[:, k]
    sigma = links.sigma
    alike = uncorrelated(sigma[:, 0], sigma[:, 3])
    if np.array_equal(alike, links.covariance):
        frame |= {"sigma_rad": sigma[:, 0], "sigma_m": sigma[:, 3]}
    else:
        frame |= {name: links.covariance[:, i, j] for name, (i, j) in COVARIANCES.items()}
    frame["epoch"] = ["" if e < 0 else str(recording.epoch_ids[e]) for e in links.epoch]
    return pd.DataFrame(frame)


def _names(bodies, index: np.ndarray) -> np.ndarray:
    return np.array([body.name for body in bodies], object)[index]


def _points(model: Model, target: np.ndarray, point: np.ndarray) -> list[str]:
    names = [t.point_names for t in model.targets]
    return [
        names[t][p] if p >= 0 else "" for t, p in zip(target.tolist(), point.tolist(), strict=True)
    ]
