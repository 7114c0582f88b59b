"""The truth of a simulated recording, kept apart from it."""

from dataclasses import dataclass
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd
import tomli_w
from jaxtyping import Float

from jaxvm.network.scene import Scene
from jaxvm.network.state import State
from jaxvm.physics.effects import Effect
from jaxvm.recording.files import check_place, new_folder
from jaxvm.recording.recording import Recording
from jaxvm.recording.write import write_recording


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated recording does not say.

    Attributes:
        stations, cameras: names.
        world_from_station, station_from_camera: true poses (rad, m).
        effects: all effects with their true sizes.
        hidden: names of those that are not in the recording's model.
    """

    stations: tuple[str, ...]
    world_from_station: Float[np.ndarray, "stations epochs 6"]
    cameras: tuple[str, ...] = ()
    station_from_camera: Float[np.ndarray, "cameras 6"] | None = None
    effects: tuple[Effect, ...] = ()
    hidden: tuple[str, ...] = ()

    def state(self, scene: Scene) -> State:
        """The state of a scene of the recording, with the true values in it."""
        model, state = scene.model, scene.state
        world, mounted = np.array(state.world_from_station), np.array(state.station_from_camera)
        place = {name: i for i, name in enumerate(self.stations)}
        if model.stations:
            order = [place[station.name] for station in model.stations]
            world[scene.station_row] = self.world_from_station[order]
        place = {name: i for i, name in enumerate(self.cameras)}
        if self.station_from_camera is not None and model.cameras:
            mounted[:] = self.station_from_camera[[place[c.name] for c in model.cameras]]
        amplitude, constant = np.array(state.amplitude), np.array(state.constant)
        true = {effect.name: effect for effect in self.effects}
        for effect, (columns, constants) in zip(scene.effects, scene.places(), strict=True):
            if effect.name in true:
                amplitude[columns] = true[effect.name].amplitudes
                constant[constants] = true[effect.name].constants
        return eqx.tree_at(
            lambda s: (s.world_from_station, s.station_from_camera, s.amplitude, s.constant),
            state,
            tuple(map(jnp.asarray, (world, mounted, amplitude, constant))),
        )

    def files(self) -> dict[str, str]:
        """stations.csv, cameras.csv (where there are cameras) and effects.toml."""
        columns = [f"{part}_{axis}" for part in ("turn", "shift") for axis in "xyz"]
        n, epochs, _ = self.world_from_station.shape
        stations = pd.DataFrame(self.world_from_station.reshape(-1, 6), columns=columns)
        stations.insert(0, "station", np.repeat(np.array(self.stations, object), epochs))
        stations.insert(1, "epoch", np.tile(np.arange(epochs), n))
        files = {"stations.csv": stations.to_csv(index=False, lineterminator="\n")}
        if self.station_from_camera is not None:
            cameras = pd.DataFrame(self.station_from_camera, columns=columns)
            cameras.insert(0, "camera", np.array(self.cameras, object))
            files["cameras.csv"] = cameras.to_csv(index=False, lineterminator="\n")
        effects = [effect.as_dict() for effect in self.effects]
        files["effects.toml"] = tomli_w.dumps({"hidden": list(self.hidden), "effects": effects})
        return files


@dataclass(frozen=True, eq=False)
class Simulated:
    """A recording of a network, and what is true of it."""

    recording: Recording
    truth: Truth

    def write(self, folder: str | Path, truth: str | Path | None = None) -> Path:
        """Write the recording into a new folder and the truth into another; returns the latter.

        Raises:
            OSError: one of the folders is already there and not empty, or can't be written.
            ValueError: one folder would be inside the other.
        """
        beside = truth_folder(folder, truth)
        with new_folder(beside) as staging:
            for name, text in self.truth.files().items():
                (staging / name).write_text(text, encoding="utf-8")
            write_recording(self.recording, folder)
        return beside


def truth_folder(folder: str | Path, truth: str | Path | None = None) -> Path:
    """Where the truth of a recording is written: by default beside it, with "-truth" in its name.

    Raises:
        OSError: it is already there and not empty, or can't be written.
        ValueError: one folder would be inside the other.
    """
    folder = Path(folder)
    beside = folder.with_name(f"{folder.name}-truth") if truth is None else Path(truth)
    ours, theirs = folder.resolve(), beside.resolve()
    if ours == theirs or ours in theirs.parents or theirs in ours.parents:
        raise ValueError(
            f"of the truth in {beside} and the recording in {folder} one would be in the "
            "other; give the truth a folder of its own"
        )
    check_place(beside, "new")
    return beside
