"""What does adjustment gain, and where does the published gain of the double chain come from?

    python benchmarks/relay/run.py [--quick] [--out DIR] [--only STUDY | --again]

Four studies, each closed form or first-order covariance beside Monte Carlo with 95 % intervals:
chains (`growing`), relay stations (`stations`), loops and whole networks (`meshes`), double
chains (`doubles`). Writes results.json, results.md and four figures beside this file; with --quick
fewer trials and smaller networks, into `report/` (which git ignores). --only runs one
study and keeps the others of results.json, --again draws tables and figures from it.
"""

import argparse
import json
import time
from pathlib import Path

import contributions
import doubles
import growing
import jax
import meshes
import stations
from intervals import RESAMPLES

from jaxvm.compiling import compile_seconds

HERE = Path(__file__).parent

FULL = {
    "chains": lambda: growing.study(20, 20_000),
    "stations": lambda: stations.study(12, 1000, 5),
    "networks": lambda: meshes.study(
        {"ring with chords": 24, "ladder": 30, "grid": 36, "random": 48},
        (3, 4, 8, 16, 32), 1000, 2,
    ),
    "doubles": lambda: doubles.study(2000, 25),
}  # fmt: skip

QUICK = {
    "chains": lambda: growing.study(10, 500),
    "stations": lambda: stations.study(4, 200, 1),
    "networks": lambda: meshes.study({"ladder": 8, "random": 12}, (3,), 200, 1),
    "doubles": lambda: doubles.study(200, 5),
}

TABLES = {
    "chains": ("Chains: errors along n links of 10 m", growing.table),
    "stations": ("Relay stations: gain over the plain pairs", stations.table),
    "networks": ("Loops and networks", meshes.table),
    "doubles": ("The double chain, 10 links of 10 m", contributions.table),
}

FIGURES = {
    "chains": growing.figure,
    "stations": stations.figure,
    "networks": meshes.figure,
    "doubles": contributions.figure,
}


def markdown(results: dict) -> str:
    """All tables."""
    parts = []
    for name, (title, table) in TABLES.items():
        own = results[name]
        parts += [
            f"## {title}",
            f"{own['trials']} trials, seed {own['seed']}; intervals by bootstrap ({RESAMPLES} "
            "resamples of whole trials).",
            table(own),
        ]
    return "\n\n".join(parts) + "\n"


def computed(results: dict, studies: dict) -> dict:
    """Results with these studies done, and the seconds that each took."""
    for name, study in studies.items():
        began, compiled = time.perf_counter(), compile_seconds()
        busy = time.process_time()
        results[name] = study()
        results["seconds"][name] = {
            "all": round(time.perf_counter() - began, 1),
            "of_which_compiling": round(compile_seconds() - compiled, 1),
            "processor": round(time.process_time() - busy, 1),
        }
        print(name, results["seconds"][name], flush=True)
    return results


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few trials, small networks")
    parser.add_argument("--out", type=Path, default=None)
    parser.add_argument("--only", choices=FULL, help="one study, the others as they are")
    parser.add_argument("--again", action="store_true", help="tables and figures alone")
    options = parser.parse_args()
    out = options.out or (HERE / "report" if options.quick else HERE)
    out.mkdir(parents=True, exist_ok=True)
    file, studies = out / "results.json", QUICK if options.quick else FULL
    results = {"quick": options.quick, "jax": jax.__version__, "seconds": {}}
    if options.only or options.again:
        results = json.loads(file.read_text(encoding="utf-8"))
        studies = {name: studies[name] for name in studies if name == options.only}
    told = json.dumps(computed(results, studies), indent=1)
    file.write_text(told + "\n", encoding="utf-8")
    # Tables and figures are those of the file.
    results = json.loads(told)
    for name, figure in FIGURES.items():
        figure(results[name], out / f"{name}.png")
    told = markdown(results)
    (out / "results.md").write_text(told, encoding="utf-8")
    print(told)


if __name__ == "__main__":
    main()
