"""One moving camera with shared intrinsics against Ceres: three real problems of a film production.

    python benchmarks/bundle_adjustment/libmv.py --peer PYTHON [--rounds 5]

PYTHON is one that has pycolmap (`libmv_peer.py`). Hundreds of images see some dozen points; free
are all poses and points, the focal length, k1 and k2, as in Ceres' own example for these files.
Both take the file's values as start, no loss, nothing held, and stop where the cost changes by less
than 1e-7 of itself. Rounds are interleaved; medians count. Times are warm and to the end, ours with
all index tables; compiling stands apart. results-libmv.json and results-libmv.md are written here.
"""

import argparse
import json
import os
import statistics
import subprocess
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp

from jaxvm.network.scene import Scene, build
from jaxvm.network.start import start
from jaxvm.recording import find_data
from jaxvm.recording.libmv import import_libmv, libmv_poses
from jaxvm.solve.adjust import Adjustment, adjust

HERE = Path(__file__).parent
PROBLEMS = ["problem_01", "problem_02", "problem_03"]
SOLVERS = ["DENSE_SCHUR", "SPARSE_SCHUR"]
OPTIONS = dict(check=False, rtol=1e-7, damping=1e-4, max_steps=500)


def at_poses_of_file(file: Path) -> Scene:
    """The scene of a file, its poses too."""
    scene = build(import_libmv(file))
    poses = jnp.asarray(libmv_poses(file))
    poses = scene.state.world_from_station.at[: len(poses)].set(poses)
    return scene.with_state(eqx.tree_at(lambda s: s.world_from_station, scene.state, poses))


def ours(scene: Scene) -> tuple[Adjustment, float]:
    """The adjustment and its seconds."""
    began = time.perf_counter()
    found = adjust(scene, **OPTIONS)
    return found, time.perf_counter() - began


def theirs(python: Path, file: Path, solver: str) -> tuple[list[list[float]], str]:
    """Cost and seconds of Ceres after each iteration, and its version."""
    command = [str(python), "-B", str(HERE / "libmv_peer.py"), str(file), "--solver", solver]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = json.loads(text)
    return found["runs"][0], found["ceres"]


def case(name: str, python: Path, rounds: int) -> dict:
    """One problem."""
    file = find_data(f"libmv-ba/{name}.bin")
    if file is None:
        raise SystemExit(f"libmv-ba/{name}.bin is not there: set JAXVM_DATA")
    scene = at_poses_of_file(file)
    found, first = ours(scene)
    seconds, runs, version = [], {solver: [] for solver in SOLVERS}, ""
    for _ in range(rounds):
        seconds.append(ours(scene)[1])
        for solver, own in runs.items():
            rows, version = theirs(python, file, solver)
            own.append(rows)
    from_images = adjust(start(build(import_libmv(file))), **OPTIONS)
    result = {
        "problem": name,
        "images": len(scene.recording.time),
        "points": len(scene.model.targets[0].points),
        "markers": len(scene.recording.observations.pixel),
        "ceres": version,
        "first_s": first,
        "cost_from_images": from_images.cost,
        "jaxvm": {
            "start": found.cost_before,
            "cost": found.cost,
            "evaluations": found.evaluations - 1,
            "why": found.why,
            "end_s": statistics.median(seconds),
        },
    }
    for solver, own in runs.items():
        result[solver] = {
            "start": own[0][0][0],
            "cost": own[0][-1][0],
            "evaluations": len(own[0]) - 1,
            "end_s": statistics.median(rows[-1][1] for rows in own),
        }
    return result


def table(rows: list[dict]) -> str:
    """Results in Markdown."""
    lines = [
        "One moving camera with shared intrinsics:",
        "",
        "| problem | images, points, markers | program | start | end | evaluations | s to end |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for method in ("jaxvm", *SOLVERS):
            own = row[method]
            name = method if method == "jaxvm" else f"Ceres {row['ceres']} {method}"
            lines.append(
                f"| {row['problem']} | {row['images']}, {row['points']}, {row['markers']} | {name} "
                f"| {own['start']:.7g} | {own['cost']:.7g} | {own['evaluations']} | "
                f"{own['end_s']:.3f} |"
            )
    lines.append("")
    lines += [
        f"{row['problem']}: the first run took {row['first_s']:.1f} s with compiling; from poses "
        f"out of the images in place of the file's it ends at {row['cost_from_images']:.7g}."
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run all problems and write the results."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--peer", type=Path, required=True, help="python with pycolmap")
    asked.add_argument("--rounds", type=int, default=5)
    options = asked.parse_args()
    load = os.getloadavg()[0]
    rows = [case(name, options.peer, options.rounds) for name in PROBLEMS]
    content = {"cores": os.cpu_count(), "load_before": load, "rows": rows}
    (HERE / "results-libmv.json").write_text(json.dumps(content, indent=1, default=float) + "\n")
    (HERE / "results-libmv.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
