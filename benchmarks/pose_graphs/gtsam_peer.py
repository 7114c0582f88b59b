"""What do GTSAM's optimisers reach on the published pose graphs, in how many steps and seconds?

In an environment of its own, since GTSAM and jaxvm need nothing of each other:

    python -m venv peer && peer/bin/pip install gtsam==4.3 numpy
    peer/bin/python benchmarks/pose_graphs/gtsam_peer.py measure

writes gtsam.json. `solve FILE` optimises one graph, `judge FILE POSES` tells the chi-square of
poses that any solver found. FILE is a path, or the name of a graph (`sphere2500`) in the folder
`pose-graphs` of JAXVM_DATA or of ../shared/data.

Chi-square depends on the definition of an edge's error, and both use the file's information matrix
as it stands, so both are told:

- log: the SE(3) logarithm of measured^-1 . estimate. It is twice GTSAM's error.
- g2o: the translation and the vector part of the quaternion of measured^-1 . estimate
  (g2o, `EdgeSE3`). A turn by a small angle counts half, so this chi-square is smaller.

The first pose is held as in GTSAM's `Pose3SLAMExample_g2o.py`: by a prior at its value in the file,
variances 1e-6 (turn, rad^2) and 1e-4 (shift, m^2). Nothing else fixes the frame, so the prior costs
nothing at the optimum; it is left out of every chi-square.
"""

import argparse
import gzip
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import gtsam
import numpy as np

HERE = Path(__file__).parent
STARTS = ("chordal", "odometry", "given")
METHODS = ("gauss-newton", "levenberg-marquardt")
TURN_FIRST = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
"""From g2o's order of a twist (shift, turn) to GTSAM's (turn, shift)."""
HOLD = np.array([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
ISOTROPIC = np.diag([100.0, 100.0, 100.0, 400.0, 400.0, 400.0])
"""Weights of torus3D, which `cubicle` is given where its own matrices can't be used."""

GRAPHS = (
    ("smallGrid3D", False, ("chordal", "odometry")),
    ("parking-garage", False, ("chordal", "odometry")),
    ("sphere2500", False, ("chordal", "odometry")),
    ("torus3D", False, ("chordal", "odometry")),
    ("cubicle", True, ("chordal", "given")),
    ("cubicle", False, ("chordal", "given")),
)
"""Names, whether with isotropic weights, starts.

The poses given in the first four files are their odometry, but for rounding (4 mm at most); that of
`cubicle` lacks 802 of its steps.
"""
KNOWN = {"sphere2500": 1351.402, "parking-garage": 1.26838, "cubicle isotropic": 1658.219}
"""Least chi-square (log) that is known, from the table of shared data."""


@dataclass(frozen=True)
class Graph:
    """A file in g2o's format. Poses, in the world: x, y, z (m) and quaternion x, y, z, w."""

    name: str
    ids: np.ndarray  # [poses]
    given: np.ndarray  # [poses, 7]
    edges: np.ndarray  # [edges, 2], ids
    measured: np.ndarray  # [edges, 7], pose of the second in the frame of the first
    information: np.ndarray  # [edges, 6, 6], shift before turn


# Files


def find(file: str) -> Path:
    """A path as it is, or the graph of that name among the local data."""
    places = [Path(file)]
    for folder in (os.environ.get("JAXVM_DATA"), HERE.parents[1] / "../shared/data"):
        if folder:
            places.append(Path(folder) / "pose-graphs" / f"{file}.g2o.gz")
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(
        f"{file}: no such file, and no such graph in pose-graphs/ of the local data; "
        "name the data's folder in JAXVM_DATA"
    )


def lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    reader = gzip.open if path.suffix == ".gz" else open
    with reader(path, "rt", encoding="utf-8") as file:
        for number, line in enumerate(file, start=1):
            if words := line.split():
                yield number, words


def unit(poses: np.ndarray) -> np.ndarray:
    """With quaternions of length one: files round them to six digits, GTSAM's reader does this."""
    quaternion = poses[:, 3:]
    return np.hstack([poses[:, :3], quaternion / np.linalg.norm(quaternion, axis=1)[:, None]])


def read(path: Path) -> Graph:
    """Poses in the order of their ids, edges in the order of the file."""
    poses, edges = {}, []
    for number, (tag, *words) in lines(path):
        if tag == "VERTEX_SE3:QUAT" and len(words) == 8:
            poses[int(words[0])] = words[1:]
        elif tag == "EDGE_SE3:QUAT" and len(words) == 30:
            edges.append(words)
        elif tag != "FIX" and not tag.startswith("#"):
            raise ValueError(f"{path.name} line {number}: {tag} with {len(words)} values")
    ids = sorted(poses)
    given = np.array([poses[i] for i in ids], float).reshape(-1, 7)
    table = np.array(edges, float).reshape(-1, 30)
    upper = np.zeros((len(table), 6, 6))
    upper[:, *np.triu_indices(6)] = table[:, 9:]
    information = upper + np.triu(upper, 1).swapaxes(1, 2)
    return Graph(
        path.name.split(".")[0], np.array(ids), unit(given), table[:, :2].astype(int),
        unit(table[:, 2:9]), information,
    )  # fmt: skip


def write(path: Path, ids: np.ndarray, poses: np.ndarray) -> None:
    """All digits, unlike `gtsam.writeG2o`, so that `judge` finds the chi-square again."""
    rows = (
        f"VERTEX_SE3:QUAT {i} " + " ".join(repr(float(x)) for x in pose) + "\n"
        for i, pose in zip(ids, poses, strict=True)
    )
    path.write_text("".join(rows), encoding="utf-8")


def isotropic(graph: Graph) -> Graph:
    """The same graph, all edges with the weights of `ISOTROPIC`."""
    same = np.broadcast_to(ISOTROPIC, graph.information.shape)
    return replace(graph, name=f"{graph.name} isotropic", information=same)


def indefinite(graph: Graph) -> dict:
    """How many information matrices are not positive definite, and what becomes of them.

    GTSAM says nothing: Eigen stops the Cholesky decomposition at the first negative pivot, and the
    unfinished factor is taken for the square root of other weights.
    """
    count = int(np.sum(np.linalg.eigvalsh(graph.information)[:, 0] <= 0.0))
    told = {"information_not_positive_definite": count}
    if count:
        told["warning"] = f"log: {count} edges have weights that are not the file's; see indefinite"
    return told


# To GTSAM and back


def to_gtsam(pose: np.ndarray) -> gtsam.Pose3:
    x, y, z, w = pose[3:]
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), pose[:3])


def values_of(ids: np.ndarray, poses: list[gtsam.Pose3]) -> gtsam.Values:
    values = gtsam.Values()
    for i, pose in zip(ids.tolist(), poses, strict=True):
        values.insert(i, pose)
    return values


def rows_of(ids: np.ndarray, values: gtsam.Values) -> np.ndarray:
    rows = []
    for i in ids.tolist():
        pose = values.atPose3(i)
        q = pose.rotation().toQuaternion()
        rows.append([*pose.translation(), q.x(), q.y(), q.z(), q.w()])
    return np.array(rows)


def factors(graph: Graph) -> gtsam.NonlinearFactorGraph:
    """The edges alone, as `gtsam.readG2o` would make them."""
    out = gtsam.NonlinearFactorGraph()
    for (i, j), pose, weight in zip(
        graph.edges.tolist(), graph.measured, graph.information, strict=True
    ):
        noise = gtsam.noiseModel.Gaussian.Information(weight[TURN_FIRST])
        out.add(gtsam.BetweenFactorPose3(i, j, to_gtsam(pose), noise))
    return out


def held(graph: Graph, edges: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """The edges, and the prior of the first pose."""
    out = gtsam.NonlinearFactorGraph(edges)
    noise = gtsam.noiseModel.Diagonal.Variances(HOLD)
    out.add(gtsam.PriorFactorPose3(int(graph.ids[0]), to_gtsam(graph.given[0]), noise))
    return out


# Starts


def odometry(graph: Graph) -> list[gtsam.Pose3]:
    """Poses by composing the edges from each pose to the next, from the first pose of the file."""
    step = {}
    for (i, j), pose in zip(graph.edges.tolist(), graph.measured, strict=True):
        step.setdefault((i, j), pose)
    poses = [to_gtsam(graph.given[0])]
    for i, j in zip(graph.ids[:-1].tolist(), graph.ids[1:].tolist(), strict=True):
        if (i, j) not in step:
            raise ValueError(
                f"{graph.name}: no edge from pose {i} to pose {j}, hence no odometry; "
                "start from chordal or given"
            )
        poses.append(poses[-1].compose(to_gtsam(step[i, j])))
    return poses


def start_of(graph: Graph, whole: gtsam.NonlinearFactorGraph, start: str) -> gtsam.Values:
    if start == "chordal":
        return gtsam.InitializePose3.initialize(whole)
    poses = odometry(graph) if start == "odometry" else [to_gtsam(p) for p in graph.given]
    return values_of(graph.ids, poses)


# Optimisation


def optimiser(method: str, whole, start: gtsam.Values, tolerance: float, hook=None):
    """GTSAM's own settings (multifrontal Cholesky, COLAMD, at most 100 steps), but tolerances."""
    kinds = {
        "gauss-newton": (gtsam.GaussNewtonParams, gtsam.GaussNewtonOptimizer),
        "levenberg-marquardt": (gtsam.LevenbergMarquardtParams, gtsam.LevenbergMarquardtOptimizer),
    }
    params_kind, kind = kinds[method]
    params = params_kind()
    params.setRelativeErrorTol(tolerance)
    params.setAbsoluteErrorTol(tolerance)
    if hook is not None:
        params.iterationHook = hook
    return kind(whole, start, params), params


def followed(method: str, whole, start: gtsam.Values, tolerance: float) -> tuple:
    """Poses, the course of chi-square by steps, and why it stopped. Not timed, but warms up."""
    course = [2.0 * whole.error(start)]

    def note(_step: int, _before: float, after: float) -> None:
        course.append(2.0 * after)

    machine, params = optimiser(method, whole, start, tolerance, note)
    found = machine.optimize()
    if machine.iterations() >= params.getMaxIterations():
        why = "most steps"
    elif method == "gauss-newton" and course[-1] > course[-2]:
        why = "chi-square rose"  # GTSAM takes any step that does not lower it for the last
    elif method == "levenberg-marquardt" and machine.lambda_() >= params.getlambdaUpperBound():
        why = "damping at its bound"
    else:
        why = "converged"
    return found, machine.iterations(), course, why


def timed(method: str, whole, start: gtsam.Values, tolerance: float, repeats: int) -> dict:
    """Seconds from start values to result, with the ordering of unknowns, without the graph.

    The processor's seconds tell the work where other programs hold the processor up.
    """
    wall, processor = [], []
    for _ in range(repeats):
        began, used = time.perf_counter(), time.process_time()
        optimiser(method, whole, start, tolerance)[0].optimize()
        wall.append(time.perf_counter() - began)
        processor.append(time.process_time() - used)
    return {
        "median_s": float(np.median(wall)), "min_s": min(wall), "max_s": max(wall),
        "processor_median_s": float(np.median(processor)),
        "processors_busy": sum(processor) / sum(wall), "repeats": repeats,
    }  # fmt: skip


def solve(
    graph: Graph, start: str, method: str, repeats: int, tolerance: float = 1e-5
) -> tuple[dict, np.ndarray | None]:
    """What GTSAM makes of a graph, and the poses [poses, 7]; none where it gives up."""
    row = {
        "graph": graph.name, "poses": len(graph.ids), "edges": len(graph.edges),
        "start": start, "method": method, "tolerance": tolerance,
    } | indefinite(graph)  # fmt: skip
    edges = factors(graph)
    whole = held(graph, edges)
    try:
        values = start_of(graph, whole, start)
        row["start_chi2_log"] = 2.0 * edges.error(values)
        found, steps, course, why = followed(method, whole, values, tolerance)
        poses = rows_of(graph.ids, found)
        row |= {"iterations": steps, "stopped": why, "chi2_log": 2.0 * edges.error(found)}
        row |= {"chi2_g2o": chi2_g2o(graph, poses), "chi2_log_with_prior_by_step": course}
        row["time"] = timed(method, whole, values, tolerance, repeats) if repeats else None
        return row, poses
    except (RuntimeError, ValueError) as error:
        return row | {"failed": " ".join(str(error).split())[:120]}, None


# Judging


def times(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Product of quaternions x, y, z, w [n, 4]."""
    v = p[:, 3:] * q[:, :3] + q[:, 3:] * p[:, :3] + np.cross(p[:, :3], q[:, :3])
    return np.hstack([v, p[:, 3:] * q[:, 3:] - np.sum(p[:, :3] * q[:, :3], axis=1)[:, None]])


def between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a^-1 . b, of poses [n, 7]."""
    back = a[:, 3:] * np.array([-1.0, -1.0, -1.0, 1.0])
    shift = b[:, :3] - a[:, :3]
    turned = 2.0 * np.cross(back[:, :3], shift)
    shift = shift + back[:, 3:] * turned + np.cross(back[:, :3], turned)
    return np.hstack([shift, times(back, b[:, 3:])])


def chi2_g2o(graph: Graph, poses: np.ndarray) -> float:
    """Chi-square of g2o's error: of q and -q, the same turn, the one with positive scalar part."""
    first, second = (poses[np.searchsorted(graph.ids, graph.edges[:, k])] for k in (0, 1))
    left = between(graph.measured, between(first, second))
    sign = np.where(left[:, 6:] < 0.0, -1.0, 1.0)
    error = np.hstack([left[:, :3], sign * left[:, 3:6]])
    return float(np.einsum("ni,nij,nj->", error, graph.information, error))


def chi2_log(graph: Graph, poses: np.ndarray) -> float:
    """Chi-square of GTSAM's error function."""
    values = values_of(graph.ids, [to_gtsam(pose) for pose in poses])
    return 2.0 * factors(graph).error(values)


def judge(graph: Graph, found: Graph) -> dict:
    if missing := sorted(set(graph.ids.tolist()) - set(found.ids.tolist())):
        raise ValueError(f"{found.name}: {len(missing)} poses are missing, first {missing[0]}")
    poses = found.given[np.searchsorted(found.ids, graph.ids)]
    return {
        "graph": graph.name,
        "chi2_log": chi2_log(graph, poses),
        "chi2_g2o": chi2_g2o(graph, poses),
    } | indefinite(graph)


# All


def threaded() -> bool:
    """Whether this GTSAM was linked with TBB, the only way in which it uses several threads."""
    site = Path(gtsam.__file__).parents[1]
    libraries = [*site.glob("gtsam/*.so*"), *site.glob("gtsam.libs/*.so*")]
    return any(b"libtbb" in library.read_bytes() for library in libraries)


def full_logarithm() -> bool:
    """Whether this GTSAM's error is the logarithm: as a build option it is of first order."""
    pose = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.7, 1.1), np.array([1.0, 2.0, 3.0]))
    return np.allclose(gtsam.Pose3().localCoordinates(pose), gtsam.Pose3.Logmap(pose))


def circumstances() -> dict:
    load = os.getloadavg()[0]
    return {
        "versions": {name: importlib.metadata.version(name) for name in ("gtsam", "numpy")}
        | {"python": platform.python_version()},
        "machine": {"cores": os.cpu_count(), "system": f"{platform.system()} {platform.machine()}"},
        "tbb": threaded(),
        "threads": "several (TBB)" if threaded() else 1,
        "full_logarithm": full_logarithm(),
        "load_before": load,
        "times_provisional": load > 0.3,
    }


def measure(repeats: int) -> dict:
    """Every graph from every start by both methods, and the best beside what is known."""
    out, rows = circumstances(), []
    for name, plain, starts in GRAPHS:
        graph = read(find(name))
        graph = isotropic(graph) if plain else graph
        for start in starts:
            for method in METHODS:
                rows.append(solve(graph, start, method, repeats)[0])
                print(summary(rows[-1]), file=sys.stderr, flush=True)
    return out | {"rows": rows, "known": [compared(rows, *known) for known in KNOWN.items()]}


def summary(row: dict) -> str:
    head = f"{row['graph']:20} {row['start']:9} {row['method']:20}"
    if "failed" in row:
        return f"{head} failed: {row['failed'][:60]}"
    seconds = f"{row['time']['median_s']:.3f} s" if row["time"] else ""
    return (
        f"{head} {row['iterations']:4} steps, {row['stopped']:20} "
        f"log {row['chi2_log']:.7g} g2o {row['chi2_g2o']:.7g} {seconds}"
    )


def compared(rows: list[dict], name: str, known: float) -> dict:
    best = min(row["chi2_log"] for row in rows if row["graph"] == name and "chi2_log" in row)
    agrees = abs(best - known) <= 1e-5 * known
    return {"graph": name, "known_chi2_log": known, "best_chi2_log": best, "agrees": agrees}


def options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="pose graphs by GTSAM")
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("solve", help="optimise one graph")
    one.add_argument("--start", choices=STARTS, default="chordal")
    one.add_argument("--method", choices=METHODS, default=METHODS[0])
    one.add_argument("--tolerance", type=float, default=1e-5, help="relative and absolute")
    one.add_argument("--out", type=Path, help="where to write the poses, in g2o's format")
    two = commands.add_parser("judge", help="chi-square of poses that a solver found")
    three = commands.add_parser("measure", help="all graphs; writes gtsam.json")
    for command in (one, two):
        command.add_argument("file", help="path of a g2o file, or name of a graph of the data")
        command.add_argument("--isotropic", action="store_true", help="weights 100 and 400")
    two.add_argument("poses", type=Path, help="g2o file with the poses")
    for command in (one, three):
        command.add_argument("--repeats", type=int, default=5)
    return parser.parse_args()


def main() -> None:
    asked = options()
    if asked.command == "measure":
        text = json.dumps(measure(asked.repeats), indent=1)
        (HERE / "gtsam.json").write_text(text + "\n", encoding="utf-8")
        return
    graph = read(find(asked.file))
    graph = isotropic(graph) if asked.isotropic else graph
    if asked.command == "judge":
        print(json.dumps(judge(graph, read(asked.poses)), indent=1))
        return
    row, poses = solve(graph, asked.start, asked.method, asked.repeats, asked.tolerance)
    if asked.out and poses is not None:
        write(asked.out, graph.ids, poses)
    print(json.dumps(circumstances() | row, indent=1))


if __name__ == "__main__":
    main()
