"""Bundle adjustment of published and of simulated blocks of images against Ceres.

    python benchmarks/bundle_adjustment/run.py --ceres PROGRAM [--rounds 5]

PROGRAM is built from `peer/` (C++, Ceres' own automatic derivatives; `cmake -S
benchmarks/bundle_adjustment/peer -B build && cmake --build build`, with the distribution's
libceres-dev). Both take the same file, the same cost, the same start, two threads, no loss, nothing
held, and stop where the cost changes by less than 1e-7 of itself. Rounds are interleaved; medians
count. Times are warm, from the problem in memory (for us with all index tables, for Ceres with its
preprocessing) to within 0.1 % and 0.01 % of the best cost that any reaches, and to the end;
compiling stands apart. Peak memory is that of a whole process for one block, reading it included.
Simulated blocks (`simulated.py`) are as large as published ones of Dubrovnik, Trafalgar and Venice;
of the largest one three rounds are run, by the sparse solver. results.json, results.md and
results.png are written here.
"""

import argparse
import gzip
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

import simulated  # noqa: E402
from results import exponent, write  # noqa: E402

from jaxvm.network.scene import build  # noqa: E402
from jaxvm.recording import find_data  # noqa: E402
from jaxvm.recording.bal import import_bal  # noqa: E402
from jaxvm.solve.large import minimise_large, prepared  # noqa: E402
from jaxvm.solve.problem import scene_problem  # noqa: E402

BLOCKS = ["ladybug-49-7776", "trafalgar-21-11315", "trafalgar-39-18060"]
SIMULATED = {16: (22_106, 3.8), 257: (65_132, 3.5), 961: (187_103, 9.0)}
"""Points and mean number of images of a point, by the number of cameras."""

SOLVERS = ["DENSE_SCHUR", "SPARSE_SCHUR"]
LARGEST = 500  # cameras beyond which Ceres' dense solver and more than three rounds take too long
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


def theirs(program: Path, file: Path, solver: str) -> tuple[list[list[float]], str]:
    """The same of Ceres."""
    found = said([str(program), str(file), solver])
    return found["run"], found["ceres"]


def said(command: list[str]) -> dict:
    """What a program prints."""
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def peaks(file: Path, program: Path, solver: str) -> dict[str, float]:
    """Peak memory (MB) of one process of each that solves a block."""
    mine = said([sys.executable, __file__, "--peak", str(file)])
    other = said([str(program), str(file), solver])
    return {"jaxvm": mine["peak_kb"] / 1e3, solver: other["peak_kb"] / 1e3}


def peak_kb() -> int:
    """Peak memory of this process; what a parent had before (`ru_maxrss` has it) does not count."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0])


def seconds_to(rows: list[list[float]], cost: float) -> float:
    """Seconds until the cost is reached; infinite if it never is."""
    return next((t for c, t in rows if c <= cost), float("inf"))


def case(name: str, file: Path, program: Path, rounds: int) -> dict:
    """One block."""
    scene = build(import_bal(file))
    solvers = SOLVERS
    if len(scene.model.cameras) > LARGEST:
        solvers, rounds = SOLVERS[1:], min(rounds, 3)
    began = time.perf_counter()
    ours(scene)
    first = time.perf_counter() - began
    runs: dict[str, list] = {"jaxvm": [], **{solver: [] for solver in solvers}}
    prepare, version = [], ""
    for _ in range(rounds):
        rows, before = ours(scene)
        runs["jaxvm"].append(rows)
        prepare.append(before)
        for solver in solvers:
            rows, version = theirs(program, file, solver)
            runs[solver].append(rows)
    result = {
        "block": name,
        "observations": len(scene.recording.observations.pixel),
        "ceres": version,
        "first_s": first,
        "preparing_s": statistics.median(prepare),
        "peak_mb": peaks(file, program, solvers[-1]),
    }
    best = min(rows[-1][0] for found in runs.values() for rows in found)
    for method, found in runs.items():
        result[method] = {
            "start": found[0][0][0],
            "cost": found[0][-1][0],
            "evaluations": len(found[0]) - 1,
            "end_s": statistics.median(rows[-1][1] for rows in found),
            "run": found[0],
        } | {
            name: statistics.median(seconds_to(rows, (1.0 + share) * best) for rows in found)
            for name, share in NEAR.items()
        }
    return result


def programs(row: dict) -> list[str]:
    """Programs that ran a block."""
    return [name for name in ("jaxvm", *SOLVERS) if name in row]


def table(rows: list[dict]) -> str:
    """Results in Markdown."""
    lines = [
        "| block | program | start | end | evaluations | s to 0.1 % | to 0.01 % | to the end |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        for method in programs(row):
            own = row[method]
            name = method if method == "jaxvm" else f"Ceres {row['ceres']} {method}"
            lines.append(
                f"| {row['block']} | {name} | {own['start']:.9g} | {own['cost']:.9g} | "
                f"{own['evaluations']} | {own['0.1 %']:.3f} | {own['0.01 %']:.3f} | "
                f"{own['end_s']:.3f} |"
            )
    lines += ["", "Times of the faster Ceres over ours (above 1 we are faster):", ""]
    lines += ["| block | to 0.1 % | to 0.01 % | to the end |", "|---|---|---|---|"]
    for row in rows:
        peers = [row[name] for name in programs(row)[1:]]
        ratios = [
            f"{min(p[key] for p in peers) / row['jaxvm'][key]:.2f}" for key in (*NEAR, "end_s")
        ]
        lines.append(f"| {row['block']} | {' | '.join(ratios)} |")
    lines.append("")
    lines += [
        f"{row['block']}: {row['observations']:,} observations; {row['preparing_s']:.3f} s of ours "
        f"are index tables; the first run took {row['first_s']:.1f} s with compiling; peak memory "
        + ", ".join(f"{mb:,.0f} MB ({name})" for name, mb in row["peak_mb"].items())
        + "."
        for row in rows
    ]
    made = [row for row in rows if row["block"].startswith("simulated")]
    if len(made) > 2:
        slope, error = exponent(
            [row["observations"] for row in made], [row["jaxvm"]["end_s"] for row in made]
        )
        lines += ["", f"Our time grows with observations as n^({slope:.2f} +- {error:.2f})."]
    return "\n".join(lines) + "\n"


def figure(rows: list[dict]) -> Figure:
    """Cost above the best one over time."""
    drawn = Figure(figsize=(12, 3.2 * -(-len(rows) // 3)), layout="constrained")
    for row, axes in zip(rows, drawn.subplots(-(-len(rows) // 3), 3).flat, strict=False):
        for name in programs(row):
            cost, seconds = np.array(row[name]["run"]).T
            above = np.maximum(cost / row[name]["cost"] - 1.0, 1e-8)
            label = name if name == "jaxvm" else f"Ceres {name}"
            axes.step(seconds, above, where="post", label=label)
        axes.set(yscale="log", title=row["block"], xlabel="s", ylabel="cost above the best")
        axes.axhline(1e-3, color="0.8", zorder=0)
        axes.axhline(1e-4, color="0.8", zorder=0)
        axes.legend(fontsize=7)
    return drawn


def main() -> None:
    """Run all blocks and write the results."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--ceres", type=Path, help="the program built from peer/")
    asked.add_argument("--peak", type=Path, help="adjust this block alone, for its memory")
    asked.add_argument("--rounds", type=int, default=5)
    options = asked.parse_args()
    if options.peak:
        rows, _ = ours(build(import_bal(options.peak)))
        print(json.dumps({"cost": rows[-1][0], "peak_kb": peak_kb()}))
        return
    if not options.ceres:
        asked.error("--ceres is missing")
    load = os.getloadavg()[0]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in BLOCKS:
            packed = find_data(f"bal/{name}-pre.txt.gz")
            if packed is None:
                raise SystemExit(f"bal/{name}-pre.txt.gz is not there: set JAXVM_DATA")
            file = Path(folder) / f"{name}.txt"
            with gzip.open(packed) as source, file.open("wb") as plain:
                shutil.copyfileobj(source, plain)
            rows.append(case(name, file, options.ceres, options.rounds))
        for cameras, (points, views) in SIMULATED.items():
            file = Path(folder) / f"simulated-{cameras}-{points}.txt"
            simulated.write(file, cameras, points, views)
            rows.append(case(file.stem, file, options.ceres, options.rounds))
            print(json.dumps({k: v for k, v in rows[-1].items() if k != "run"})[:200], flush=True)
    found = {"cores": os.cpu_count(), "load_before": load, "rows": rows}
    write(HERE, json.loads(json.dumps(found, default=float)), table(rows), figure(rows))


if __name__ == "__main__":
    main()
