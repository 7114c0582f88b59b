"""The engineer's model with estimated values: what an adjusted scene knows, as a model again."""

from dataclasses import replace

import numpy as np
import pandas as pd

from jaxvm.geometry.lenses import lens_family
from jaxvm.network.scene import Scene
from jaxvm.network.state import State
from jaxvm.recording.model import Model


def estimated_model(scene: Scene) -> Model:
    """The model of a scene with its present values and effects; what was free stays free.

    Poses of single epochs are not part of a model; they come from the data again.
    """
    model, state = scene.model, scene.state

    def pose_of(bodies, rows, table):
        values = np.asarray(table)
        return tuple(
            body if body.motion == "per-epoch" else replace(body, pose=values[rows[i, 0]])
            for i, body in enumerate(bodies)
        )

    cameras = []
    for i, camera in enumerate(model.cameras):
        n = lens_family(camera.lens).n_coefficients
        cameras.append(
            replace(
                camera,
                focal_px=np.asarray(state.focal[i]),
                centre_px=np.asarray(state.centre[i]),
                distortion=np.asarray(state.distortion[i, :n]),
                pose=np.asarray(state.station_from_camera[i]),
            )
        )
    stations = pose_of(model.stations, scene.station_row, state.world_from_station)
    targets = pose_of(model.targets, scene.target_row, state.carrier_from_target)
    point = np.asarray(state.point)
    targets = tuple(
        replace(target, points=point[scene.first_point[i] : scene.first_point[i + 1]])
        for i, target in enumerate(targets)
    )
    finders = tuple(
        replace(finder, pose=np.asarray(state.station_from_rangefinder[i]))
        for i, finder in enumerate(model.rangefinders)
    )
    return replace(
        model,
        cameras=tuple(cameras),
        stations=stations,
        targets=targets,
        rangefinders=finders,
        effects=scene.fitted_effects(),
    )


def pose_table(scene: Scene, deviations: State) -> pd.DataFrame:
    """Poses of stations and targets: kind, name, frame, epoch, turn (rad), shift (m), deviations.

    Frame is what the pose leads to: the world, or the station that carries the target. A static
    body has one row without an epoch. `deviations` come from `standard_deviations`.
    """
    rows = []
    for kind, bodies, row_of, table in (
        ("station", scene.model.stations, scene.station_row, "world_from_station"),
        ("target", scene.model.targets, scene.target_row, "carrier_from_target"),
    ):
        values = np.asarray(getattr(scene.state, table))
        spread = np.asarray(getattr(deviations, table))
        for i, body in enumerate(bodies):
            moving = body.motion == "per-epoch"
            frame = getattr(body, "station", "") or "world"
            for epoch in range(len(scene.recording.time)) if moving else (0,):
                own = row_of[i, epoch]
                when = str(scene.recording.epoch_ids[epoch]) if moving else ""
                rows.append((kind, body.name, frame, when, *values[own], *spread[own]))
    numbers = [f"{part}_{axis}" for part in ("turn", "shift") for axis in "xyz"]
    columns = ["kind", "name", "frame", "epoch", *numbers, *(f"std_{name}" for name in numbers)]
    return pd.DataFrame(rows, columns=columns)
