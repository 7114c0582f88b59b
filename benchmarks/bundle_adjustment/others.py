"""Bundle adjustment of published blocks of images against other programs of Python.

    python benchmarks/bundle_adjustment/others.py --jaxls PYTHON [--repeats 2] [--limit 120]

PYTHON is one that has jaxls (github.com/brentyi/jaxls): Levenberg-Marquardt in JAX, points
eliminated by their Schur complement (`jaxls_peer.py`), from two dampings: its default, and that of
its own benchmarks of such blocks. SciPy's least_squares gets our residuals and their sparse
Jacobian (`scipy_peer.py`). All take the same file and the same start, no loss, nothing held, and
stop where the cost changes by less than 1e-7 of itself, SciPy after `--limit` seconds at the
latest. Times are to within 0.1 % and 0.01 % of the least cost that any reaches, and to the end:
warm, the least of the repetitions; and that of the first run, which compiles. results-others.json
and results-others.md are written here.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

from run import BLOCKS, NEAR, ours, seconds_to

from jaxvm.network.scene import build
from jaxvm.recording import find_data
from jaxvm.recording.bal import import_bal

HERE = Path(__file__).parent
DAMPINGS = ["5e-4", "100"]


def peer(python: str | Path, script: str, file: Path, *options: object) -> dict:
    """What a peer prints."""
    command = [str(python), "-B", str(HERE / script), str(file), *map(str, options)]
    return json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)


def case(name: str, options) -> dict:
    """One block: for every program costs and seconds of its warm runs, and the first one's end."""
    file = find_data(f"bal/{name}-pre.txt.gz")
    if file is None:
        raise SystemExit(f"bal/{name}-pre.txt.gz is not there: set JAXVM_DATA")
    scene = build(import_bal(file))
    began = time.perf_counter()
    ours(scene)
    first = time.perf_counter() - began
    runs = [ours(scene)[0] for _ in range(options.repeats)]
    programs = {"jaxvm": {"runs": runs, "first_s": first, "why": "converged"}}
    for damping in DAMPINGS:
        found = peer(
            options.jaxls, "jaxls_peer.py", file, "--damping", damping,
            "--repeats", 1 + options.repeats,
        )  # fmt: skip
        programs[f"jaxls, damping {damping}"] = {
            "runs": found["runs"][1:],
            "first_s": found["runs"][0][-1][1],
            "why": found["why"][-1],
        }
    # A run to the limit says no more if it is repeated.
    found = peer(sys.executable, "scipy_peer.py", file, "--limit", options.limit)
    programs[f"SciPy {found['scipy']}"] = {
        "runs": found["runs"],
        "first_s": found["compiling"] + found["runs"][0][-1][1],
        "why": found["why"][0],
    }
    best = min(run[-1][0] for own in programs.values() for run in own["runs"])
    for own in programs.values():
        kept = own.pop("runs")
        own |= {
            "start": kept[0][0][0],
            "cost": min(run[-1][0] for run in kept),
            "evaluations": len(kept[0]) - 1,
            "end_s": min(run[-1][1] for run in kept),
        } | {
            near: min(seconds_to(run, (1.0 + share) * best) for run in kept)
            for near, share in NEAR.items()
        }
    return {"block": name, "best": best, "programs": programs}


def table(rows: list[dict]) -> str:
    """Results in Markdown."""
    lines = [
        "The same blocks, other programs of Python:",
        "",
        "| block | program | start | end | evaluations | s to 0.1 % | to 0.01 % | to the end "
        "| first run |",
        "|---|---|---|---|---|---|---|---|---|",
    ]

    def seconds(value: float) -> str:
        return f"{value:.2f}" if value < float("inf") else "never"

    for row in rows:
        for name, own in row["programs"].items():
            late = "" if own["why"].startswith("converged") else f" ({own['why']})"
            lines.append(
                f"| {row['block']} | {name} | {own['start']:.9g} | {own['cost']:.9g} | "
                f"{own['evaluations']} | {seconds(own['0.1 %'])} | {seconds(own['0.01 %'])} | "
                f"{own['end_s']:.2f}{late} | {own['first_s']:.1f} |"
            )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run all blocks and write the results."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--jaxls", type=Path, required=True, help="python with jaxls")
    asked.add_argument("--repeats", type=int, default=2)
    asked.add_argument("--limit", type=float, default=120.0, help="seconds for SciPy")
    options = asked.parse_args()
    load = os.getloadavg()[0]
    rows = [case(name, options) for name in BLOCKS]
    content = {"cores": os.cpu_count(), "load_before": load, "rows": rows}
    (HERE / "results-others.json").write_text(json.dumps(content, indent=1) + "\n")
    (HERE / "results-others.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
