"""How long does a diagnosis of the real recording sony-board take, cold and warm, and how large?

Whole processes of `jaxvm diagnose sony-board` are timed: first with an empty compile cache, then
three times with it filled. Peak memory is that of the process (maximum resident set).
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from matplotlib.figure import Figure

HERE = Path(__file__).parent
MRCAL_MM = (-1.03983, 0.52493)
"""Bow across columns and rows in mrcal's own solution (its published camera model)."""


def timed(cache: str, out: str) -> dict:
    """Seconds and peak memory of one process, and its answer."""
    program = (
        "import json, resource, sys\n"
        "from jaxvm.cli import main\n"
        f"status = main(['diagnose', 'sony-board', '--out', {out!r}, '--quiet'])\n"
        "peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "print(json.dumps({'status': status, 'peak_gb': peak / 1e6}))\n"
    )
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    seconds = time.perf_counter() - began
    answer = json.loads(done.stdout.strip().splitlines()[-1])
    return {"seconds": seconds, **answer}


def main() -> None:
    with tempfile.TemporaryDirectory() as work:
        cache, out = f"{work}/compiled", f"{work}/report"
        runs = [timed(cache, out) for _ in range(4)]
        report = json.loads(Path(out, "report.json").read_text())
    steps = [("plain", report["plain"]["heldout_rms_px"])]
    steps += [(f["physics"], f["heldout_rms_px"]["after"]) for f in report["findings"]]
    first = report["findings"][0]
    bow = [1e3 * p["value"] for p in first["parameters"]]
    results = {
        "cold_seconds": runs[0]["seconds"],
        "warm_seconds": sorted(run["seconds"] for run in runs[1:]),
        "peak_gb": max(run["peak_gb"] for run in runs),
        "heldout_px": steps,
        "bow_mm": bow,
        "bow_mm_mrcal": MRCAL_MM,
        "bow_relative_difference": [a / b - 1 for a, b in zip(bow, MRCAL_MM, strict=True)],
        "processors": os.cpu_count(),
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    left.bar(["cold", "warm"], [runs[0]["seconds"], results["warm_seconds"][1]])
    left.set(ylabel="seconds, whole process")
    right.barh([name for name, _ in steps], [value for _, value in steps], color="#0f766e")
    right.axvline(0.57, color="#c2410c", ls=":", label="bowed board, by mrcal's model")
    right.invert_yaxis()
    right.set(xlabel="RMS on held-out frames (px)")
    right.legend(fontsize=7)
    figure.savefig(HERE / "results.png", dpi=120)
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
