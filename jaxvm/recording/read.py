"""Read and check a recording: whatever is wrong is said with file, line and mend."""

from pathlib import Path

import numpy as np

from jaxvm.recording.check import check_recording
from jaxvm.recording.errors import RecordingError, has_not, in_file
from jaxvm.recording.model import Model, other_bodies
from jaxvm.recording.parse import known_link, parse_model
from jaxvm.recording.recording import (
    Drivers,
    Links,
    Observations,
    Ranges,
    Recording,
    no_observations,
    uncorrelated,
)
from jaxvm.recording.tables import Table, read_table
from jaxvm.recording.texts import parse_toml, read_text
from jaxvm.recording.write import COVARIANCES, RATES

_MODEL = "recording.toml"
_POSE = ("turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z")


def read_recording(folder: str | Path, model: str | Path | None = None) -> Recording:
    """Read a recording from its folder.

    Args:
        folder: with recording.toml and the tables.
        model: another file in the form of recording.toml to take instead of the folder's, such as
            the model.toml of an earlier diagnosis.

    Raises:
        RecordingError: anything is missing, unknown, impossible or out of order; one sentence that
            names the file, the line and the mend.
    """
    folder = Path(folder)
    if folder.is_file():
        beside = f": {folder.parent}" if (folder.parent / _MODEL).is_file() else f" with {_MODEL}"
        raise RecordingError(f"{folder} is a file; a recording is a folder, give that{beside}")
    if not folder.is_dir():
        raise RecordingError(f"{folder}: there is no such folder; give the folder of a recording")
    if model is None:
        return _recording(folder, *read_model(folder / _MODEL))
    given, text = read_model(model)
    try:
        return _recording(folder, given, text)
    except RecordingError as problem:
        if (folder / _MODEL).is_file():
            check_same_bodies(read_model(folder / _MODEL)[0], given, str(model))
        raise in_file(problem, str(model)) from None


def _recording(folder: Path, parsed: Model, text: str) -> Recording:
    """The recording in a folder, with a model (whose text tells lines) that is read already."""
    if parsed.cameras:
        ids, time, timed, velocities = _epochs(_required(folder, "epochs"), parsed)
        observed = _required(folder, "observations")
        observations = _observations(observed, parsed, ids)
    else:
        ids, time, timed, velocities = np.zeros(1, int), np.zeros(1), False, {}
        observed, observations = None, no_observations()
    recording = Recording(
        model=parsed,
        epoch_ids=ids,
        time=time,
        velocities=velocities,
        observations=observations,
        drivers=_drivers(read_table(folder, "drivers", False), parsed, time, timed),
        ranges=_ranges(read_table(folder, "ranges", False), parsed, ids),
        links=_links(read_table(folder, "links", False), parsed, ids),
        timed=timed,
    )
    names = () if recording.links is None else recording.links.name
    known_link(text, parsed, list(names))
    if observed is not None:
        check_recording(recording, observed)
    elif recording.links is None:
        raise RecordingError(
            f"{folder}: there are neither cameras nor links; add [cameras.NAME] to "
            "recording.toml, or links.csv"
        )
    return recording


def read_model(file: str | Path) -> tuple[Model, str]:
    """The engineer's model in a file like recording.toml, and the text of the file.

    Raises:
        RecordingError: the file is absent, not TOML, or something in it is wrong.
    """
    file = Path(file)
    if not file.is_file():
        raise RecordingError(_no_model(file))
    name = _MODEL if file.name == _MODEL else str(file)
    text = read_text(file, name)
    table = parse_toml(text, name)
    try:
        return parse_model(table, text), text
    except RecordingError as problem:
        raise in_file(problem, name) from None


def _no_model(file: Path) -> str:
    """What to say of a model that is not there; the one of a folder the engineer has to write."""
    if file.is_dir():
        return f"{file} is a folder; give the model.toml in it"
    if file.name == _MODEL:
        return (
            f"{file.name}: there is no such file in {file.parent}; write one with the cameras and "
            "targets (the README shows an example)"
        )
    return f"{file}: there is no such file; give the model.toml that adjust or diagnose wrote"


def check_same_bodies(own: Model, given: Model, file: str) -> None:
    """Check that a model that was given in place of a recording's own is of the same bodies.

    Raises:
        RecordingError: names of cameras, targets or points differ, or their order, by which the
            measurements know them; `file` is where they stand.
    """
    if other := other_bodies(own, given, ("cameras", "targets")):
        raise RecordingError(f"{file}: {other}; give a model of this recording")


def _required(folder: Path, name: str) -> Table:
    table = read_table(folder, name, True)
    assert table is not None
    if len(table) == 0:
        raise table.error(None, "there is no row below the header; add the measurements")
    return table


def _epochs(table: Table, model: Model):
    rates = {f"{t.name}.{rate}": (t.name, k) for t in model.targets for k, rate in enumerate(RATES)}
    table.needs(("epoch",), ("t", *rates))
    ids = table.whole("epoch", "a whole number")
    table.check(
        np.unique(ids, return_index=True)[1][np.unique(ids, return_inverse=True)[1].ravel()]
        == np.arange(len(ids)),
        lambda row: f"epoch {ids[row]} is there twice; number every epoch once",
    )
    timed = "t" in table.frame
    if timed:
        time = table.numbers("t", "a time in seconds")
        later = np.append(True, np.diff(time) > 0.0)
        table.check(
            later,
            lambda row: (
                f"t = {time[row]:.12g} s is not after {time[row - 1]:.12g} s; "
                "sort the epochs by time, each with a time of its own"
            ),
        )
        if len(time) > 1 and np.median(np.diff(time)) > 3e5 and time[0] > 1e10:
            raise table.error(
                0, f"t = {time[0]:.12g} looks like milliseconds since 1970; give seconds"
            )
    else:
        time = np.arange(len(ids), dtype=float)
    velocities = {}
    for target in model.targets:
        given = [f"{target.name}.{r}" for r in RATES if f"{target.name}.{r}" in table.frame]
        if not given:
            continue
        if len(given) < 6:
            missing = next(r for r in RATES if f"{target.name}.{r}" not in given)
            raise table.error(
                None,
                f'column "{target.name}.{missing}" is missing; a velocity has all of '
                f"{', '.join(RATES)} (m/s and rad/s)",
            )
        columns = [table.numbers(name, "a velocity in m/s or rad/s") for name in given]
        velocities[target.name] = np.stack(columns, axis=1)
    return ids, time, timed, velocities


def _epoch_rows(table: Table, ids: np.ndarray) -> np.ndarray:
    epoch = table.whole("epoch", "the number of an epoch")
    place = {number: row for row, number in enumerate(ids.tolist())}
    rows = np.array([place.get(number, -1) for number in epoch.tolist()], int)
    table.check(
        rows >= 0,
        lambda row: (
            f"epoch {epoch[row]} is not in the epochs ({ids[0]} to {ids[-1]}); "
            "add it there or drop the row"
        ),
    )
    return rows


def _point_rows(table: Table, model: Model, target: np.ndarray, plane: bool) -> np.ndarray:
    known = [{name: i for i, name in enumerate(t.point_names)} for t in model.targets]
    names = table.texts("point")
    point = np.array(
        [
            -1 if plane and name == "" else known[t].get(name, -2)
            for t, name in zip(target.tolist(), names, strict=True)
        ],
        int,
    )
    table.check(
        point > -2,
        lambda row: (
            f'point "{names[row]}" is not on target "{model.targets[target[row]].name}" '
            f"{has_not(str(names[row]), known[target[row]])}"
        ),
    )
    return point


def _sigma(table: Table, default: float, unit: str) -> np.ndarray:
    if "sigma" not in table.frame:
        return np.full(len(table), default)
    sigma = table.numbers("sigma", f"a standard deviation in {unit}")
    table.check(
        sigma > 0.0,
        lambda row: (
            f"sigma is {sigma[row]:g}; it must be above 0 ({unit}), "
            "drop the row if the measurement is no good"
        ),
    )
    return sigma


def _observations(table: Table, model: Model, ids: np.ndarray) -> Observations:
    table.needs(("epoch", "camera", "target", "point", "u", "v"), ("sigma",))
    epoch = _epoch_rows(table, ids)
    camera = table.places("camera", [c.name for c in model.cameras], "recording.toml")
    target = table.places("target", [t.name for t in model.targets], "recording.toml")
    point = _point_rows(table, model, target, plane=False)
    pixel = np.stack([table.numbers(c, "a number of px") for c in ("u", "v")], axis=1)
    return Observations(epoch, camera, target, point, pixel, _sigma(table, model.pixel_sigma, "px"))


def _drivers(table: Table | None, model: Model, time: np.ndarray, timed: bool) -> Drivers | None:
    if table is None or len(table) == 0:
        if model.drivers:
            name = next(iter(model.drivers))
            raise RecordingError(
                f'drivers.csv: recording.toml describes the driver "{name}", but there are no '
                "drivers; add the file or drop the description"
            )
        return None
    table.needs(("t",), tuple(table.frame.columns))
    if not timed:
        raise table.error(None, "there are drivers, but epochs have no times; add t to the epochs")
    t = table.numbers("t", "a time in seconds")
    table.check(
        np.append(True, np.diff(t) > 0.0),
        lambda row: f"t = {t[row]:.12g} s is not after {t[row - 1]:.12g} s; sort by time",
    )
    channels = {
        str(name): table.numbers(name, f"a reading of {name}")
        for name in table.frame.columns
        if name != "t"
    }
    for name in model.drivers:
        if name not in channels:
            raise table.error(
                None,
                f'column "{name}" is missing, which recording.toml describes '
                f"{has_not(name, channels)}",
            )
    for name in ("constant", "time"):
        if name in channels:
            raise table.error(None, f'a driver can\'t be called "{name}"; rename the column')
    for name, values in channels.items():
        if name.lower().endswith("degc"):
            table.check(
                (values > -80.0) & (values < 150.0),
                lambda row, v=values, n=name: (
                    f"{n} is {v[row]:g}, which is no temperature in "
                    f"degrees Celsius{' (kelvin?)' if v[row] > 200 else ''}; convert the column"
                ),
            )
    spacing = float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    if time[0] < t[0] - spacing or time[-1] > t[-1] + spacing:
        raise table.error(
            0 if time[0] < t[0] - spacing else len(t) - 1,
            f"drivers run from {t[0]:.6g} s to {t[-1]:.6g} s, epochs from {time[0]:.6g} s to "
            f"{time[-1]:.6g} s; both need one clock, and drivers for the whole time",
        )
    return Drivers(t, channels)


def _ranges(table: Table | None, model: Model, ids: np.ndarray) -> Ranges | None:
    if table is None or len(table) == 0:
        return None
    table.needs(("epoch", "rangefinder", "target", "point", "range_m"), ("sigma",))
    epoch = _epoch_rows(table, ids)
    finder = table.places("rangefinder", [r.name for r in model.rangefinders], "recording.toml")
    target = table.places("target", [t.name for t in model.targets], "recording.toml")
    point = _point_rows(table, model, target, plane=True)
    distance = table.numbers("range_m", "a distance in m")
    table.check(
        (distance > 0.0) & (distance < 5000.0),
        lambda row: (
            f"range_m is {distance[row]:g}"
            + ("; a distance is above 0" if distance[row] <= 0 else ", which looks like mm; give m")
        ),
    )
    return Ranges(epoch, finder, target, point, distance, _sigma(table, model.range_sigma, "m"))


def _links(table: Table | None, model: Model, ids: np.ndarray) -> Links | None:
    if table is None or len(table) == 0:
        return None
    full = next(iter(COVARIANCES)) in table.frame
    spread = tuple(COVARIANCES) if full else ("sigma_rad", "sigma_m")
    table.needs(("link", "from", "to", *_POSE, *spread), ("epoch",))
    bodies = {
        "camera": [c.name for c in model.cameras],
        "station": [s.name for s in model.stations],
        "target": [t.name for t in model.targets],
    }
    place = {kind: {name: i for i, name in enumerate(names)} for kind, names in bodies.items()}
    nodes = {}
    for column in ("from", "to"):
        nodes[column] = []
        for row, text in enumerate(table.texts(column)):
            kind, _, name = text.partition(":")
            if kind not in bodies:
                raise table.error(
                    row, f'{column} is "{text}"; write camera:NAME, station:NAME or target:NAME'
                )
            if name not in place[kind]:
                raise table.error(
                    row,
                    f'{column}: there is no {kind} "{name}" {has_not(name, bodies[kind])}',
                )
            nodes[column].append((kind, place[kind][name]))
    covariance = _covariances(table) if full else _of_sigmas(table)
    pose = np.stack([table.numbers(c, "a number (rad or m)") for c in _POSE], axis=1)
    turn = np.linalg.norm(pose[:, :3], axis=1)
    table.check(
        turn <= 2.0 * np.pi,
        lambda row: f"the turn has length {turn[row]:.4g}, more than 2 pi; give rad, not degrees",
    )
    epoch = np.full(len(table), -1)
    if "epoch" in table.frame:
        texts = table.texts("epoch")
        dated = np.array([text not in ("", "nan", "None") for text in texts])
        if dated.any():
            rows = np.flatnonzero(dated)
            part = Table(table.file, table.frame.loc[dated], table.line[dated], table.word)
            epoch[rows] = _epoch_rows(part, ids)
    found = Links(tuple(table.texts("link")), nodes["from"], nodes["to"], pose, covariance, epoch)
    _check_links(table, model, found, len(ids))
    return found


def _check_links(table: Table, model: Model, links: Links, n_epochs: int) -> None:
    """Links join two bodies, at an epoch where they move against each other."""
    stations = {station.name: station for station in model.stations}

    def moving(node: tuple[str, int]) -> set[str]:
        """What moves of a node: itself, or the station that carries it."""
        kind, number = node
        if kind == "station":
            own, carrier = model.stations[number], model.stations[number]
        else:
            own = model.cameras[number] if kind == "camera" else model.targets[number]
            carrier = stations.get(own.station)
        found = {carrier.name} if carrier and carrier.motion == "per-epoch" else set()
        return found | ({own.name} if getattr(own, "motion", "") == "per-epoch" else set())

    for row, (a, b, epoch) in enumerate(
        zip(links.from_node, links.to_node, links.epoch, strict=True)
    ):
        if a == b:
            text = table.texts("from")[row]
            raise table.error(row, f"the link joins {text} with itself; drop it")
        apart = moving(a) ^ moving(b)
        if epoch < 0 and apart and n_epochs > 1:
            raise table.error(
                row, f'the link has no epoch, but "{min(apart)}" moves; write when it was measured'
            )


def _of_sigmas(table: Table) -> np.ndarray:
    """Covariances of links that give one standard deviation of turns and one of shifts."""
    sigmas = {}
    for column, unit in (("sigma_rad", "rad"), ("sigma_m", "m")):
        sigmas[column] = table.numbers(column, f"a standard deviation in {unit}")
        table.check(
            sigmas[column] > 0.0,
            lambda row, c=column: f"{c} is {sigmas[c][row]:g}; it must be above 0",
        )
    return uncorrelated(sigmas["sigma_rad"], sigmas["sigma_m"])


def _covariances(table: Table) -> np.ndarray:
    """Full covariances of links."""
    found = np.zeros((len(table), 6, 6))
    for column, (i, j) in COVARIANCES.items():
        found[:, i, j] = found[:, j, i] = table.numbers(column, "a (co)variance in rad and m")
    smallest = np.linalg.eigvalsh(found)[:, 0]
    table.check(
        smallest > 0.0,
        lambda row: (
            f"the covariance is not positive definite (smallest eigenvalue {smallest[row]:.3g}); "
            "mend it, or give sigma_rad and sigma_m in its place"
        ),
    )
    return found
