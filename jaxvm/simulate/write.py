"""A simulated recording: its tables, its recording.toml, and the truth that is kept apart."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tomli_w
from jaxtyping import Float

from jaxvm.simulate.bodies import Site
from jaxvm.simulate.hidden import Truth
from jaxvm.simulate.scene import BEFORE_S, velocity

PIXEL_NOISE_PX = 0.05
RANGE_NOISE_M = 0.0002
RATE_NOISE = np.array([2e-4, 2e-4, 2e-4, 2e-5, 2e-5, 2e-5])
"""Standard deviation of a recorded velocity (m/s) and angular rate (rad/s)."""

LOG_EVERY_S = 60.0

CHANNELS: dict[str, tuple[str, float, int]] = {
    "ambient_degC": ("air temperature at the mast", 0.02, 2),
    "body_left_degC": ("housing of the camera left", 0.02, 2),
    "body_right_degC": ("housing of the camera right", 0.02, 2),
    "humidity_pct": ("relative humidity of the air", 0.1, 1),
    "gradient_K_per_m": ("vertical gradient of the air temperature, warmer above", 0.02, 2),
    "irradiance_W_m2": ("sun on a level surface", 1.0, 0),
}
"""Logged channels: description, standard deviation of a reading, decimals logged."""


@dataclass(frozen=True)
class SimulatedRecording:
    """A recording and what is hidden in it.

    Attributes:
        recording_tables: "observations", "epochs", "drivers", "ranges" as data frames.
        toml: content of recording.toml, the engineer's model.
        truth: what was hidden; never written into the recording.
    """

    recording_tables: dict[str, pd.DataFrame]
    toml: dict[str, Any]
    truth: list[Truth]

    def write(self, folder: str | Path) -> Path:
        """Write the recording (without the truth) into a folder; returns the folder."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in self.files().items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder

    def files(self) -> dict[str, str]:
        """Content of the recording's files, by name."""
        files = {"recording.toml": tomli_w.dumps(self.toml)}
        for name, table in self.recording_tables.items():
            files[f"{name}.csv"] = table.to_csv(index=False, lineterminator="\n")
        return files


Photographs = dict[tuple[str, str], Float[np.ndarray, "epochs marks 2"]]
"""Pixels of all marks at all epochs, by camera and plate."""


def tables(
    site: Site,
    photographs: Photographs,
    distance_m: Float[np.ndarray, " epochs"],
    rng: np.random.Generator,
) -> dict[str, pd.DataFrame]:
    """The four tables as instruments deliver them: noisy, rounded, some marks missed."""
    return {
        "observations": _observations(site, photographs, rng),
        "epochs": _epochs(site, rng),
        "drivers": _drivers(site, rng),
        "ranges": pd.DataFrame(
            {
                "epoch": np.arange(site.epoch_t.size),
                "rangefinder": site.rangefinder.name,
                "target": "deck",
                "point": "",
                "range_m": np.round(
                    distance_m + rng.normal(0.0, RANGE_NOISE_M, distance_m.size), 5
                ),
            }
        ),
    }


def _observations(site: Site, photographs: Photographs, rng: np.random.Generator) -> pd.DataFrame:
    parts = []
    for (camera, plate), pixel in photographs.items():
        epochs, marks, _ = pixel.shape
        measured = pixel + rng.normal(0.0, PIXEL_NOISE_PX, pixel.shape)
        found = rng.random((epochs, marks)) > 0.01
        width, height = site.cameras[camera].image_size
        found &= ((pixel > 0.0) & (pixel < [width - 1, height - 1])).all(axis=2)
        epoch, mark = np.nonzero(found)
        u, v = np.round(measured[found], 4).T
        names = np.array(site.plates[plate].mark_names)[mark]
        parts.append(
            pd.DataFrame(
                {
                    "epoch": epoch,
                    "camera": camera,
                    "target": plate,
                    "point": names,
                    "u": u,
                    "v": v,
                }
            )
        )
    return pd.concat(parts).sort_values("epoch", kind="stable", ignore_index=True)


def _epochs(site: Site, rng: np.random.Generator) -> pd.DataFrame:
    columns = {"epoch": np.arange(site.epoch_t.size), "t": site.epoch_t}
    for plate in site.plates.values():
        if plate.moves:
            rates = velocity(plate, site.epoch_t)
            rates = rates + rng.normal(0.0, RATE_NOISE, rates.shape)
            for j, name in enumerate(("vx", "vy", "vz", "wx", "wy", "wz")):
                columns[f"{plate.name}.{name}"] = np.round(rates[:, j], 5) + 0.0
    return pd.DataFrame(columns)


def _drivers(site: Site, rng: np.random.Generator) -> pd.DataFrame:
    t = np.arange(-BEFORE_S, site.epoch_t[-1] + LOG_EVERY_S, LOG_EVERY_S)
    weather = site.weather
    true = {
        "ambient_degC": weather.ambient,
        **{f"body_{name}_degC": camera.housing for name, camera in site.cameras.items()},
        "humidity_pct": weather.humidity,
        "gradient_K_per_m": weather.gradient,
        "irradiance_W_m2": weather.irradiance,
    }
    logged = {"t": t}
    for name, (_, noise, decimals) in CHANNELS.items():
        reading = true[name](t) + rng.normal(0.0, noise, t.size)
        logged[name] = np.round(reading, decimals) + 0.0  # no -0.0 in the log
    return pd.DataFrame(logged)


def engineers_model(site: Site) -> dict[str, Any]:
    """recording.toml: what the engineer knows of the site and what the adjustment estimates."""
    cameras = {}
    for name, camera in site.cameras.items():
        width, height = camera.image_size
        entry = {
            "station": "mast",
            "image_size": [width, height],
            "lens": "opencv5",
            "focal_px": [3000.0, 3000.0],
            "centre_px": [(width - 1) / 2, (height - 1) / 2],
            "distortion": camera.distortion.tolist(),
            "free": ["focal", "centre"],
            "powered_on_s": camera.powered_on_s,
        }
        if name == "left":
            entry["pose"] = camera.rest.table()
        else:
            entry["free"].append("pose")
        cameras[name] = entry
    targets = {
        plate.name: {
            "grid": {"rows": plate.side, "columns": plate.side, "spacing_m": plate.spacing_m},
            "motion": "per-epoch" if plate.moves else "static",
            "free": ["pose"],
        }
        for plate in site.plates.values()
    }
    return {
        "format": 1,
        "name": "Deck monitored from a mast",
        "noise": {"pixel_px": PIXEL_NOISE_PX, "range_m": RANGE_NOISE_M},
        "cameras": cameras,
        "stations": {"mast": {"motion": "static", "pose": site.station.table(), "free": []}},
        "targets": targets,
        "rangefinders": {
            site.rangefinder.name: {
                "station": "mast",
                "pose": site.rangefinder.place.table(),
                "free": [],
            }
        },
        "drivers": {name: {"description": words} for name, (words, _, _) in CHANNELS.items()},
        "world": {"up": site.up.tolist()},
    }
