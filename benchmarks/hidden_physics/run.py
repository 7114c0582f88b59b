"""What is found of what an independent simulator hides, and what where nothing is hidden?

Small deformation scenes: every effect that can be hidden, over several seeds, and scenes with
nothing hidden. For each: was the right physics named first, or among the doubles; at the right
place; with which size, in standard deviations; and the held-out improvement. The seeds are not
those of the tests. `python benchmarks/hidden_physics/run.py [SEEDS] [EMPTY]`.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from results import markdown, write  # noqa: E402

from jaxvm.discover import diagnose  # noqa: E402
from jaxvm.recording import read_recording  # noqa: E402
from jaxvm.simulate import HIDEABLE, simulate_deformation_scene  # noqa: E402

CATALOGUE = {
    "plate-expansion": "target-expansion",
    "humidity-growth": "target-growth-anisotropic",
    "plate-bow": "target-bow",
    "mark-displaced": "mark-displaced",
    "reference-moved": "target-moved",
    "mount-slip": "mount-slip",
    "mount-creep": "mount-creep",
    "vibration": "mount-vibration",
    "hysteresis": "mount-hysteresis",
    "bracket-growth": "bracket-growth",
    "focal-drift": "focal-drift",
    "principal-point-walk": "principal-point-walk",
    "self-heating": "self-heating",
    "lens-radial": "radial-beyond-model",
    "pixel-locking": "pixel-locking",
    "trigger-offset": "trigger-offset",
    "rolling-shutter": "rolling-shutter",
    "air-bending": "air-bending",
    "range-drift": "range-drift",
}
"""The catalogue's name of what the simulator hides."""


def one(hide, seed: int) -> dict:
    with tempfile.TemporaryDirectory() as folder:
        made = simulate_deformation_scene(hide, seed=seed, size="small")
        recording = read_recording(made.write(Path(folder) / "recording"))
    began = time.perf_counter()
    found = diagnose(recording)
    row = {
        "hidden": made.truth[0].effect if made.truth else "nothing",
        "seed": seed,
        "rms_px": made.truth[0].rms_px if made.truth else 0.0,
        "verdict": found.verdict,
        "p_left": found.left_p_value,
        "findings": len(found.findings),
        "heldout_px": [found.plain.heldout_rms_px, found.final.heldout_rms_px],
        "seconds": time.perf_counter() - began,
    }
    if made.truth and found.findings:
        finding = found.findings[0]
        right = CATALOGUE[made.truth[0].effect]
        doubles = [rival.hypothesis.effect(()).catalogue_id for rival in finding.rivals]
        row |= {
            "named": finding.effect.catalogue_id,
            "weight": finding.weight,
            "first": finding.effect.catalogue_id == right,
            "among_doubles": right in (finding.effect.catalogue_id, *doubles),
            "place": finding.effect.scope.as_dict(),
        }
    return row


def table(results: dict) -> str:
    """results.md."""
    hidden = [row for row in results["rows"] if row["hidden"] != "nothing"]
    rows = [
        [
            row["hidden"],
            row["seed"],
            f"{row['rms_px']:.3f}",
            row.get("named", "nothing"),
            "yes" if row.get("first") else "no",
            f"{row['heldout_px'][0]:.4f}",
            f"{row['heldout_px'][1]:.4f}",
        ]
        for row in hidden
    ]
    head = ["hidden", "seed", "size (px RMS)", "named", "rightly", "held-out before", "after (px)"]
    return (
        f"Of {results['hidden']} hidden effects {results['found']} were found, "
        f"{results['named_first']} named first; of {results['empty']} scenes with nothing hidden "
        f"{results['false_claims']} had a claim.\n\n{markdown(head, rows)}"
    )


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    n_empty = int(sys.argv[2]) if len(sys.argv) > 2 else 20
    rows = []
    for seed in range(101, 101 + n_seeds):
        for hide in HIDEABLE:
            rows.append(one(hide, seed))
            print(rows[-1], flush=True)
    for seed in range(201, 201 + n_empty):
        rows.append(one((), seed))
        print(rows[-1], flush=True)
    hidden = [row for row in rows if row["hidden"] != "nothing"]
    empty = [row for row in rows if row["hidden"] == "nothing"]
    results = {
        "hidden": len(hidden),
        "found": sum(row["findings"] > 0 for row in hidden),
        "named_first": sum(row.get("first", False) for row in hidden),
        "named_or_among_doubles": sum(row.get("among_doubles", False) for row in hidden),
        "empty": len(empty),
        "false_claims": sum(row["findings"] > 0 for row in empty),
        "not_consistent": sum(row["verdict"] != "consistent" for row in empty),
        "rows": rows,
    }
    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    for row in hidden:
        colour = "#0f766e" if row.get("first") else "#c2410c"
        left.plot(*row["heldout_px"], "o", ms=4, color=colour)
    left.set(xlabel="held-out RMS, plain (px)", ylabel="held-out RMS, final (px)", xscale="log")
    left.axhline(0.05, color="#334155", ls=":")
    right.plot(np.sort([row["p_left"] for row in empty]), np.linspace(0, 1, len(empty)), "o-")
    right.plot([0, 1], [0, 1], color="#334155", ls=":")
    right.set(xlabel="family-wise p where nothing is hidden", ylabel="share of scenes below")
    write(HERE, results, table(results), figure)


if __name__ == "__main__":
    main()
