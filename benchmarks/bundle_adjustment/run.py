"""Bundle adjustment of published blocks of images against Ceres.

    python benchmarks/bundle_adjustment/run.py --peer PYTHON [--rounds 5]

PYTHON is one that has pycolmap, which brings Ceres with compiled cost functions (`ceres_peer.py`).
Both take the same file, the same start, two threads, no loss, nothing held, and stop where the cost
changes by less than 1e-7 of itself. Rounds are interleaved; medians count. Times are warm, from the
problem in memory (for us with all index tables, for Ceres with its preprocessing) to within 0.1 %
and 0.01 % of the best cost that either reaches, and to the end; compiling stands apart.
results.json and results.md are written here.
"""

import argparse
import json
import os
import statistics
import subprocess
import time
from pathlib import Path

from jaxvm.network.scene import build
from jaxvm.recording import find_data
from jaxvm.recording.bal import import_bal
from jaxvm.solve.large import minimise_large, prepared
from jaxvm.solve.problem import scene_problem

HERE = Path(__file__).parent
BLOCKS = ["ladybug-49-7776", "trafalgar-21-11315", "trafalgar-39-18060"]
SOLVERS = ["DENSE_SCHUR", "SPARSE_SCHUR"]
NEAR = {"0.1 %": 1e-3, "0.01 %": 1e-4}
RTOL = 1e-7
DAMPING = 1e-4  # as Ceres begins


def ours(scene) -> tuple[list[list[float]], float]:
    """Cost and seconds after each evaluation, and the seconds of preparation among them."""
    began = time.perf_counter()
    host = prepared(scene_problem(scene))
    assert host is not None
    before = time.perf_counter() - began
    fit = minimise_large(*host, "levenberg-marquardt", rtol=RTOL, damping=DAMPING)
    return [
        [float(c), before + float(t)] for c, t in zip(fit.history, fit.seconds, strict=True)
    ], before


def theirs(python: Path, file: Path, solver: str) -> tuple[list[list[float]], str]:
    """The same of Ceres."""
    command = [str(python), "-B", str(HERE / "ceres_peer.py"), str(file), "--solver", solver]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    found = json.loads(text)
    return found["runs"][0], found["ceres"]


def seconds_to(rows: list[list[float]], cost: float) -> float:
    """Seconds until the cost is reached; infinite if it never is."""
    return next((t for c, t in rows if c <= cost), float("inf"))


def case(name: str, python: Path, rounds: int) -> dict:
    """One block."""
    file = find_data(f"bal/{name}-pre.txt.gz")
    if file is None:
        raise SystemExit(f"bal/{name}-pre.txt.gz is not there: set JAXVM_DATA")
    scene = build(import_bal(file))
    began = time.perf_counter()
    ours(scene)
    first = time.perf_counter() - began
    runs: dict[str, list] = {"jaxvm": [], **{solver: [] for solver in SOLVERS}}
    prepare, version = [], ""
    for _ in range(rounds):
        rows, before = ours(scene)
        runs["jaxvm"].append(rows)
        prepare.append(before)
        for solver in SOLVERS:
            rows, version = theirs(python, file, solver)
            runs[solver].append(rows)
    result = {
        "block": name,
        "observations": len(scene.recording.observations.pixel),
        "ceres": version,
        "first_s": first,
        "preparing_s": statistics.median(prepare),
    }
    for method, found in runs.items():
        # COLMAP counts points behind a camera as fitted: each program has a best cost of its own.
        best = min(found[0][-1][0], *(r[-1][0] for r in found))
        result[method] = {
            "start": found[0][0][0],
            "cost": best,
            "evaluations": len(found[0]) - 1,
            "end_s": statistics.median(rows[-1][1] for rows in found),
        } | {
            name: statistics.median(seconds_to(rows, (1.0 + share) * best) for rows in found)
            for name, share in NEAR.items()
        }
    return result


def table(rows: list[dict]) -> str:
    """Results in Markdown."""
    lines = [
        "| block | program | start | end | evaluations | s to 0.1 % | to 0.01 % | to the end |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for method in ("jaxvm", *SOLVERS):
            own = row[method]
            name = method if method == "jaxvm" else f"Ceres {row['ceres']} {method}"
            lines.append(
                f"| {row['block']} | {name} | {own['start']:.9g} | {own['cost']:.9g} | "
                f"{own['evaluations']} | {own['0.1 %']:.3f} | {own['0.01 %']:.3f} | "
                f"{own['end_s']:.3f} |"
            )
    lines.append("")
    lines += [
        f"{row['block']}: {row['preparing_s']:.3f} s of ours are index tables; the first run took "
        f"{row['first_s']:.1f} s with compiling."
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run all blocks and write the results."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--peer", type=Path, required=True, help="python with pycolmap")
    asked.add_argument("--rounds", type=int, default=5)
    options = asked.parse_args()
    load = os.getloadavg()[0]
    rows = [case(name, options.peer, options.rounds) for name in BLOCKS]
    content = {"cores": os.cpu_count(), "load_before": load, "rows": rows}
    content = json.dumps(content, indent=1, default=float)
    (HERE / "results.json").write_text(content + "\n")
    (HERE / "results.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
