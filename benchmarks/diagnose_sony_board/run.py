"""How long does a diagnosis of the real recording sony-board take, cold and warm, and how large?

Whole processes of `jaxvm diagnose sony-board` are timed: first with an empty compile cache, then
with it filled. Peak memory is that of the process (maximum resident set). The first findings are
shown one by one: how far few coefficients come.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from matplotlib.figure import Figure

from jaxvm.discover import diagnose
from jaxvm.recording import open_recording

HERE = Path(__file__).parent
MRCAL_MM = (-1.03983, 0.52493)
"""Bow across columns and rows in mrcal's own solution (its published camera model)."""
WANTED_PX = 0.45
"""Held-out RMS to reach with at most 60 coefficients."""


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


def few(most: int) -> dict:
    """What the first findings are, and how far few coefficients come."""
    found = diagnose(open_recording("sony-board"), max_findings=most)
    steps, coefficients = [("the engineer's model", 0, found.plain.heldout_rms_px)], 0
    for finding in found.findings:
        coefficients += finding.effect.n_columns + len(finding.effect.constants)
        steps.append((finding.effect.name, coefficients, finding.gain.after_px))
    bent = found.findings[0]
    return {
        "steps": steps,
        "bow_mm": [1e3 * amplitude for amplitude in bent.effect.amplitudes],
        "bow_std_mm": [1e3 * std for std in bent.stds],
        "bow_mm_mrcal": MRCAL_MM,
    }


def table(found: dict) -> str:
    """results.md."""
    bow, std, known = found["bow_mm"], found["bow_std_mm"], found["bow_mm_mrcal"]
    lines = [
        "# Diagnosis of sony-board",
        "",
        f"{found['processors']} processors, whole processes: {found['cold_seconds']:.0f} s with an "
        f"empty compile cache, {found['warm_seconds']:.0f} s with a filled one; peak memory "
        f"{found['peak_gb']:.1f} GB.",
        "",
        f"The bow: {bow[0]:.3f} ± {std[0]:.3f} and {bow[1]:.3f} ± {std[1]:.3f} mm; mrcal: "
        f"{known[0]:.3f} and {known[1]:.3f} mm. Wanted: {WANTED_PX} px with at most 60 "
        "coefficients.",
        "",
        "| one finding after the other | coefficients so far | held-out RMS (px) |",
        "|---|---|---|",
        *(f"| {name} | {n} | {px:.4f} |" for name, n, px in found["steps"]),
        "",
        "| all findings, with their last names | own coefficients | held-out RMS (px) |",
        "|---|---|---|",
        *(f"| {name} | {n} | {px:.4f} |" for name, n, px in found["all_findings"]),
        "",
        f"Fitted together they leave {found['heldout_px']:.4f} px.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    with tempfile.TemporaryDirectory() as work:
        cache, out = f"{work}/compiled", f"{work}/report"
        runs = [timed(cache, out) for _ in range(2)]
        report = json.loads(Path(out, "report.json").read_text())
    first = few(2)
    whole = [
        (f["physics"], len(f["parameters"]), f["heldout_rms_px"]["after"])
        for f in report["findings"]
    ]
    results = {
        "cold_seconds": runs[0]["seconds"],
        "warm_seconds": runs[1]["seconds"],
        "peak_gb": max(run["peak_gb"] for run in runs),
        **first,
        "all_findings": whole,
        "heldout_px": report["final"]["heldout_rms_px"],
        "processors": os.cpu_count(),
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    (HERE / "results.md").write_text(table(results))
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.6))
    left.bar(["cold", "warm"], [run["seconds"] for run in runs])
    left.set(ylabel="seconds, whole process")
    bars = [*((f"{name} ({n})", px) for name, n, px in first["steps"])]
    bars.append(("with all findings", results["heldout_px"]))
    right.barh([name for name, _ in bars], [value for _, value in bars], color="#0f766e")
    right.axvline(WANTED_PX, color="#c2410c", ls=":", label="wanted")
    right.invert_yaxis()
    right.set(xlabel="RMS on held-out frames (px)")
    right.legend(fontsize=7)
    figure.savefig(HERE / "results.png", dpi=120)
    print(table(results))


if __name__ == "__main__":
    main()
