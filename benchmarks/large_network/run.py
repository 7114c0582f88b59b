"""How large a network of cameras can be adjusted, how fast, in how much memory?

    python benchmarks/large_network/run.py

Random networks (`jaxvm simulate`, layout random: five sight lines a station, cameras in sectors, a
body of twenty marks on each station; about 100 image points a station) of 100 to 10,000 stations,
each in a process of its own: simulated, started from the data alone, adjusted. The time of the
adjustment is that of a second run (nothing compiles), from the tables to the minimum. Writes
results.json, results.md and results.png beside this file.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.stats import linregress, t

HERE = Path(__file__).parent
SIZES = (100, 200, 500, 1000, 2000, 5000, 10000)

SCENE = """layout = "random"
stations = {n}
seed = 1
[structure]
spacing_m = 20.0
[sights]
redundancy = 5
[cameras]
each = "sector"
[marks]
count = 20
"""


def one(n: int, repeats: int) -> dict:
    """Simulate, start and adjust a network of n stations in this process."""
    from jaxvm.network.scene import build
    from jaxvm.network.start import start
    from jaxvm.scenes import read_description, simulate_network
    from jaxvm.solve.adjust import adjust

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.toml"
        file.write_text(SCENE.format(n=n))
        began = time.perf_counter()
        made = simulate_network(read_description(file), 0)
    told = {"stations": n, "simulate_s": time.perf_counter() - began}
    began = time.perf_counter()
    scene = build(made.recording)
    told["build_s"] = time.perf_counter() - began
    began = time.perf_counter()
    begun = start(scene)
    told["start_s"] = time.perf_counter() - began
    results = [adjust(begun, "gauss-newton", check=False) for _ in range(repeats + 1)]
    seconds = [result.seconds for result in results]
    found = results[-1]
    truth = np.asarray(made.truth.state(scene).world_from_station)
    error = np.asarray(found.scene.state.world_from_station)[:, 3:] - truth[:, 3:]
    return told | {
        "points": len(made.recording.observations.epoch),
        "cold_s": seconds[0],
        "adjust_s": float(np.median(seconds[1:])),
        "evaluations": found.evaluations,
        "variance_factor": found.variance_factor,
        "cost_before": found.cost_before,
        "cost": found.cost,
        "why": found.why,
        "position_rms_m": float(np.sqrt(np.mean(error**2))),
        "peak_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6,
    }


def exponent(rows: list[dict], least: int) -> tuple[float, float]:
    """Slope of log time over log points, and half its 95 % interval, from `least` stations on."""
    kept = [row for row in rows if row["stations"] >= least]
    x, y = (np.log([row[key] for row in kept]) for key in ("points", "adjust_s"))
    if len(kept) < 3:
        return float("nan"), float("nan")
    fit = linregress(x, y)
    return float(fit.slope), float(t.ppf(0.975, len(x) - 2) * fit.stderr)


def table(rows: list[dict]) -> str:
    """Results in Markdown."""
    lines = [
        "| stations | image points | adjust, warm (s) | evaluations | variance factor | "
        "position RMS (mm) | start (s) | build (s) | peak (GB) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['stations']:,} | {row['points']:,} | {row['adjust_s']:.2f} | "
            f"{row['evaluations']} | {row['variance_factor']:.4f} | "
            f"{1e3 * row['position_rms_m']:.2f} | {row['start_s']:.1f} | {row['build_s']:.1f} | "
            f"{row['peak_gb']:.2f} |"
        )
    slope, half = exponent(rows, 500)
    lines += ["", f"Time grows with the points to the power {slope:.2f} ± {half:.2f} (95 %), "
              "from 500 stations on."]  # fmt: skip
    return "\n".join(lines) + "\n"


def draw(rows: list[dict], file: Path) -> None:
    """Time and memory over the number of image points."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    points = [row["points"] for row in rows]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    left.loglog(points, [row["adjust_s"] for row in rows], "o-", label="adjust (warm)")
    left.loglog(points, [row["start_s"] for row in rows], "s--", label="start from the data")
    left.loglog(points, [row["build_s"] for row in rows], "^:", label="tables")
    left.axhline(60, color="0.6", lw=1)
    left.set(xlabel="image points", ylabel="time (s)", title="two cores")
    left.legend()
    right.loglog(points, [row["peak_gb"] for row in rows], "o-")
    right.axhline(8, color="0.6", lw=1)
    right.set(xlabel="image points", ylabel="peak memory (GB)", title="whole process")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=130)


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--sizes", type=int, nargs="+", default=list(SIZES))
    asked.add_argument("--repeats", type=int, default=3)
    asked.add_argument("--one", type=int, help=argparse.SUPPRESS)
    options = asked.parse_args()
    if options.one:
        print(json.dumps(one(options.one, options.repeats)))
        return
    rows = []
    for n in options.sizes:
        command = [sys.executable, __file__, "--one", str(n), "--repeats", str(options.repeats)]
        told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        rows.append(json.loads(told.splitlines()[-1]))
        print(f"{n} stations: {rows[-1]['adjust_s']:.2f} s", file=sys.stderr, flush=True)
        (HERE / "results.json").write_text(
            json.dumps({"cores": os.cpu_count(), "rows": rows}, indent=1) + "\n"
        )
    (HERE / "results.md").write_text(table(rows))
    draw(rows, HERE / "results.png")
    print(table(rows))


if __name__ == "__main__":
    main()
