"""Checks across the tables: units, repeated rows, and whether there is enough of everything."""

import numpy as np

from jaxvm.recording.errors import RecordingError
from jaxvm.recording.recording import Recording
from jaxvm.recording.tables import Table

_NUMBERS = {"focal": 2, "centre": 2, "aspect-locked-focal": 1}


def check_recording(recording: Recording, table: Table) -> None:
    """Check a read recording as a whole; `table` is its table of observations.

    Raises:
        RecordingError: pixels outside the image, an observation twice, a target or camera that is
            never used, too few points.
    """
    _pixels(recording, table)
    _repeats(recording, table)
    _unused(recording, table)
    _too_few(recording, table)
    _effects(recording)
    _poses(recording)


def _pixels(recording: Recording, table: Table) -> None:
    obs, model = recording.observations, recording.model
    size = np.array([c.image_size for c in model.cameras], float)
    largest, count = np.zeros(len(model.cameras)), np.bincount(obs.camera, minlength=len(size))
    np.maximum.at(largest, obs.camera, np.abs(obs.pixel).max(axis=1))
    for i, camera in enumerate(model.cameras):
        if count[i] > 3 and largest[i] <= 2.0:
            raise table.error(
                int(np.flatnonzero(obs.camera == i)[0]),
                f'u and v of camera "{camera.name}" are all below 2, which look like normalised '
                "coordinates; give pixels",
            )
    # Detectors extrapolate a little beyond the border; farther out the size or unit is wrong.
    margin = 0.05 * size[obs.camera]
    inside = (obs.pixel > -margin) & (obs.pixel < size[obs.camera] + margin)
    table.check(
        np.all(inside, axis=1),
        lambda row: (
            f"({obs.pixel[row, 0]:.6g}, {obs.pixel[row, 1]:.6g}) px is outside the image "
            f'of camera "{model.cameras[obs.camera[row]].name}" '
            f"({size[obs.camera[row], 0]:g} x {size[obs.camera[row], 1]:g} px); "
            "mend it or image_size"
        ),
    )


def _repeats(recording: Recording, table: Table) -> None:
    obs = recording.observations
    key = np.stack([obs.epoch, obs.camera, obs.target, obs.point], axis=1)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    first_of = first[np.ravel(inverse)]
    table.check(
        first_of == np.arange(len(key)),
        lambda row: (
            "this camera has the same point in the same epoch in "
            f"{table.word} {table.line[first_of[row]]} already; keep one"
        ),
    )


def _unused(recording: Recording, table: Table) -> None:
    obs, model = recording.observations, recording.model
    ranged = set() if recording.ranges is None else set(recording.ranges.target.tolist())
    linked = set()
    if recording.links is not None:
        linked = {*recording.links.from_node, *recording.links.to_node}
    seen = set(np.unique(obs.target).tolist())
    for i, target in enumerate(model.targets):
        if i not in seen and i not in ranged and ("target", i) not in linked:
            raise table.error(
                None,
                f'target "{target.name}" is never seen; add its observations or drop '
                f"[targets.{target.name}] from recording.toml",
            )
    using = set(np.unique(obs.camera).tolist())
    for i, camera in enumerate(model.cameras):
        if i not in using and ("camera", i) not in linked:
            raise table.error(
                None,
                f'camera "{camera.name}" has no observation; add some or drop '
                f"[cameras.{camera.name}] from recording.toml",
            )


def _too_few(recording: Recording, table: Table) -> None:
    """Poses that fewer than three marks determine, cameras with more unknowns than numbers."""
    obs, model = recording.observations, recording.model
    if recording.links is None and recording.ranges is None:
        for i, target in enumerate(model.targets):
            if "pose" not in target.free:
                continue
            own = np.flatnonzero(obs.target == i)
            moving = target.motion == "per-epoch"
            epoch = obs.epoch[own] if moving else np.zeros(len(own), int)
            pairs = np.unique(np.stack([epoch, obs.point[own]], axis=1), axis=0)
            marks = np.bincount(pairs[:, 0], minlength=int(epoch.max(initial=0)) + 1)
            scarce = np.flatnonzero((marks > 0) & (marks < 3))
            if len(scarce):
                row = own[np.flatnonzero(epoch == scarce[0])[0]]
                when = f" at epoch {recording.epoch_ids[scarce[0]]}" if moving else ""
                raise table.error(
                    int(row),
                    f'target "{target.name}" shows {marks[scarce[0]]} of its points{when}, '
                    "but its pose needs at least 3; add points or drop these rows",
                )
    count = np.bincount(obs.camera, minlength=len(model.cameras))
    for i, camera in enumerate(model.cameras):
        width = sum(_NUMBERS.get(name, 0) for name in camera.free)
        if count[i] and 2 * count[i] < width:
            raise table.error(
                int(np.flatnonzero(obs.camera == i)[0]),
                f'camera "{camera.name}" has {count[i]} observations for {width} free numbers; '
                "add observations or take fewer names into free",
            )


def _effects(recording: Recording) -> None:
    known = recording.channels().names
    for effect in recording.model.effects:
        if effect.driver not in known:
            raise RecordingError(
                f'recording.toml: effect "{effect.name}" depends on "{effect.driver}", which is '
                f"not recorded (there is: {', '.join(sorted(known))}); add it to the drivers"
            )


def _poses(recording: Recording) -> None:
    """Poses that are given in each epoch are as many as there are epochs."""
    model, n = recording.model, len(recording.time)
    for kind, bodies in (("stations", model.stations), ("targets", model.targets)):
        for body in bodies:
            if body.pose is not None and body.pose.ndim > 1 and len(body.pose) != n:
                raise RecordingError(
                    f"recording.toml: {kind}.{body.name}.pose has {len(body.pose)} rows, but there "
                    f"are {n} epochs; give one row for each, or a single pose"
                )
