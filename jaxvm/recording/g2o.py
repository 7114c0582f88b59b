"""Pose graphs in g2o's text format, in and out (Kuemmerle et al. 2011).

VERTEX_SE3:QUAT id x y z qx qy qz qw, EDGE_SE3:QUAT from to x y z qx qy qz qw and the upper triangle
of the information matrix, shift before turn. FIX id holds a vertex.
"""

import gzip
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxvm.recording.errors import RecordingError
from jaxvm.recording.files import write_files
from jaxvm.recording.model import Model, Station
from jaxvm.recording.recording import Links, Recording, no_observations

_TURN_FIRST = np.array([3, 4, 5, 0, 1, 2])
_UPPER = np.triu_indices(6)


def import_g2o(file: str | Path, mend: bool = False) -> Recording:
    """A recording of stations and links from a g2o file (gzipped if it ends in .gz).

    The vertex that FIX names is held, else the first one. Vertices are start values. g2o counts the
    turn of an edge as the vector part of a quaternion, which is half a rotation vector; other
    programs (GTSAM) read the same matrix as one of the full logarithm. So does this one: the
    information of turns is taken as it is written.

    Args:
        file: to read.
        mend: replace information matrices that are not positive definite by the nearest ones that
            are: eigenvalues below 1e-6 of the largest one are raised to it.

    Raises:
        RecordingError: the file has no edges, an unknown vertex, one twice, a malformed line, or
            (without `mend`) information that is not positive definite.
    """
    file = Path(file)
    vertices, edges, held = _parse(file)
    if not edges:
        raise RecordingError(f"{file.name}: there is no EDGE_SE3:QUAT; is it a 3-D pose graph?")
    place = {number: i for i, number in enumerate(vertices)}
    for line, a, b, _ in edges:
        for number in (a, b):
            if number not in place:
                raise RecordingError(
                    f"{file.name} line {line}: vertex {number} is not in the file; "
                    "add its VERTEX_SE3:QUAT"
                )
    if unknown := held - vertices.keys():
        raise RecordingError(
            f"{file.name}: FIX {min(unknown)} names a vertex that is not in the file; mend the line"
        )
    values = np.array([row for *_, row in edges])
    information = np.zeros((len(edges), 6, 6))
    information[:, _UPPER[0], _UPPER[1]] = values[:, 7:]
    information[:, _UPPER[1], _UPPER[0]] = values[:, 7:]
    information = information[:, _TURN_FIRST][:, :, _TURN_FIRST]
    covariance = np.linalg.inv(_definite(file.name, [edge[0] for edge in edges], information, mend))
    poses = _vectors(np.array(list(vertices.values())))
    free = frozenset({"pose"})
    fixed = held or {next(iter(vertices))}
    stations = tuple(
        Station(str(number), "static", poses[i], frozenset() if number in fixed else free)
        for i, number in enumerate(vertices)
    )
    links = Links(
        name=tuple(f"{a}-{b}" for _, a, b, _ in edges),
        from_node=[("station", place[a]) for _, a, _, _ in edges],
        to_node=[("station", place[b]) for _, _, b, _ in edges],
        pose=_vectors(values[:, :7]),
        covariance=0.5 * (covariance + covariance.swapaxes(1, 2)),
        epoch=np.full(len(edges), -1),
    )
    name = file.name.removesuffix(".gz").removesuffix(".g2o")
    return Recording(
        Model(name, (), stations, ()), np.zeros(1, int), np.zeros(1), {}, no_observations(),
        links=links, timed=False,
    )  # fmt: skip


def write_g2o(recording: Recording, file: str | Path) -> None:
    """Write the stations (with their poses) and the links between stations as a g2o file.

    Vertices keep their numbers where all stations are called by one; else they are numbered as they
    come, with the names in comments. Links of other bodies have no place in the format.

    The file is there complete or as it was before.

    Raises:
        ValueError: a link joins something else than stations, a station has no pose or moves, or
            there are image points or ranges, which the format can't hold.
    """
    links, stations = recording.links, recording.model.stations
    lost = len(recording.observations.epoch) + len(
        () if recording.ranges is None else recording.ranges.epoch
    )
    if lost:
        raise ValueError(
            f"g2o knows relative poses alone: {lost} image points and ranges would be lost; make "
            "relative poses of them first (jaxvm.pose.pose_level)"
        )
    numbered = all(s.name.isdecimal() and str(int(s.name)) == s.name for s in stations)
    number = [int(s.name) if numbered else i for i, s in enumerate(stations)]
    lines = []
    for i, station in zip(number, stations, strict=True):
        if station.motion == "per-epoch":
            raise ValueError(f'station "{station.name}" moves; g2o has one pose for each vertex')
        if station.pose is None:
            raise ValueError(f'station "{station.name}" has no pose; write an adjusted model')
        if not numbered:
            lines.append(f"# {i} is {station.name}")
        lines.append(f"VERTEX_SE3:QUAT {i} {_words(_numbers(station.pose))}")
        if "pose" not in station.free:
            lines.append(f"FIX {i}")
    for k in range(0 if links is None else len(links.name)):
        assert links is not None
        (kind_a, a), (kind_b, b) = links.from_node[k], links.to_node[k]
        if (kind_a, kind_b) != ("station", "station"):
            raise ValueError(
                f'link "{links.name[k]}" joins a {kind_a} and a {kind_b}; '
                "g2o knows poses of stations only"
            )
        back = np.argsort(_TURN_FIRST)
        information = np.linalg.inv(links.covariance[k])[back][:, back]
        numbers = [*_numbers(links.pose[k]), *information[_UPPER]]
        lines.append(f"EDGE_SE3:QUAT {number[a]} {number[b]} {_words(numbers)}")
    text = "\n".join(lines) + "\n"
    file = Path(file)
    data = gzip.compress(text.encode(), mtime=0) if file.suffix == ".gz" else text.encode()
    write_files(file.absolute().parent, {file.name: data})


def _parse(file: Path):
    """Vertices by number, edges as (line, from, to, numbers), and held vertices."""
    vertices: dict[int, list[float]] = {}
    edges: list[tuple[int, int, int, list[float]]] = []
    held: set[int] = set()
    for line, words in _lines(file):
        try:
            match words[0]:
                case "VERTEX_SE3:QUAT":
                    if int(words[1]) in vertices:
                        raise ValueError(f"vertex {words[1]} is there already")
                    vertices[int(words[1])] = _floats(words[2:], 7)
                case "EDGE_SE3:QUAT":
                    if int(words[1]) == int(words[2]):
                        raise ValueError(f"the edge joins vertex {words[1]} with itself")
                    edges.append((line, int(words[1]), int(words[2]), _floats(words[3:], 28)))
                case "FIX":
                    held.update(map(int, words[1:]))
                case other:
                    raise ValueError(f"{other} is not read here (3-D poses and their edges are)")
        except (ValueError, IndexError) as problem:
            raise RecordingError(f"{file.name} line {line}: {problem}; mend the line") from None
    return vertices, edges, held


def _lines(file: Path) -> Iterator[tuple[int, list[str]]]:
    if not file.is_file():
        raise RecordingError(f"{file}: there is no such file; give a .g2o or .g2o.gz file")
    with gzip.open(file, "rt") if file.suffix == ".gz" else open(file) as stream:
        number = 0
        try:
            for number, line in enumerate(stream, 1):
                words = line.partition("#")[0].split()
                if words:
                    yield number, words
        except (EOFError, OSError, zlib.error, UnicodeDecodeError) as problem:
            raise RecordingError(
                f"{file.name} after line {number}: it can't be read on ({problem}); is the file "
                "whole? Fetch it again"
            ) from None


def _floats(words: list[str], count: int) -> list[float]:
    if len(words) != count:
        raise ValueError(f"there are {len(words)} numbers where {count} are needed")
    numbers = list(map(float, words))
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
    if not any(numbers[3:7]):
        raise ValueError("the quaternion is zero")
    return numbers


def _vectors(rows: Float[np.ndarray, "n 7"]) -> Float[np.ndarray, "n 6"]:
    """(turn, shift) of x y z qx qy qz qw."""
    return np.concatenate([Rotation.from_quat(rows[:, 3:]).as_rotvec(), rows[:, :3]], axis=1)


def _numbers(pose: Float[np.ndarray, "6"]) -> list[float]:
    """x y z qx qy qz qw of (turn, shift)."""
    return [*pose[3:], *Rotation.from_rotvec(np.array(pose[:3])).as_quat(canonical=True)]


def _words(numbers) -> str:
    return " ".join(f"{value:.17g}" for value in numbers)


def _definite(name, lines, information, mend: bool) -> Float[np.ndarray, "n 6 6"]:
    """Information matrices, mended or refused where they are not positive definite."""
    values, vectors = np.linalg.eigh(information)
    least = 1e-6 * values[:, -1]
    bad = values[:, 0] <= 1e-12 * values[:, -1]
    if not bad.any():
        return information
    hopeless = np.flatnonzero(values[:, -1] <= 0.0)
    if len(hopeless):
        raise RecordingError(
            f"{name} line {lines[hopeless[0]]}: the information matrix has no positive eigenvalue; "
            "mend the line or leave it out"
        )
    if not mend:
        raise RecordingError(
            f"{name} line {lines[int(np.flatnonzero(bad)[0])]}: the information matrix is not "
            f"positive definite (so are {int(bad.sum())} of {len(bad)}); mend them, or have the "
            "nearest ones that are: jaxvm convert --mend, import_g2o(file, mend=True)"
        )
    raised = np.where(bad[:, None], np.maximum(values, least[:, None]), values)
    return np.einsum("nij,nj,nkj->nik", vectors, raised, vectors)
