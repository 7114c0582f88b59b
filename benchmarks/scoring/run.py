"""How fast are hypotheses scored, after compilation?

The full deformation scene (two cameras, three targets, 97 epochs) is simulated without hidden
physics, its plain model fitted, and all hypotheses are scored with 299 sign-flips. A second call
with the same shapes times the run without compilation.
"""

import json
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxvm.discover.hypotheses import enumerate_hypotheses
from jaxvm.discover.noise import multipliers
from jaxvm.discover.score import ScoreTests
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.recording import read_recording
from jaxvm.simulate import simulate_deformation_scene
from jaxvm.solve.adjust import adjust

HERE = Path(__file__).parent


def main() -> None:
    folder = Path(tempfile.mkdtemp()) / "recording"
    recording = read_recording(simulate_deformation_scene((), seed=5).write(folder))
    fitted = adjust(start(build(recording)).with_effects((), (16, 8)))
    families = enumerate_hypotheses(fitted.scene)
    # Every sixth course: about the 5,000 hypotheses that the target speaks of.
    few = tuple(
        replace(
            f, courses=f.courses[::6], valid=f.valid[:, ::6], kinds=f.kinds[::6], asked=f.asked[::6]
        )
        for f in families
    )
    few = tuple(family for family in few if family.valid.any())
    rows = []
    for asked, flips in ((few, 299), (families, 0), (families, 299)):
        seconds = []
        for _ in range(4):
            began = time.perf_counter()
            signs = multipliers(len(recording.time), 1, flips, 0) if flips else None
            ranking = ScoreTests.of(fitted, asked).score(1.0, signs)
            seconds.append(time.perf_counter() - began)
        rows.append(
            {
                "flips": flips,
                "hypotheses": ranking.n,
                "first_call_s": seconds[0],
                "run_s": sorted(seconds[1:]),
                "per_5000_s": 5000 * float(np.median(seconds[1:])) / ranking.n,
            }
        )
    results = {
        "residuals": 2 * len(recording.observations.epoch) + len(recording.ranges.epoch),
        "scoring": rows,
        "processors": os.cpu_count(),
    }
    (HERE / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    figure = Figure(figsize=(6, 3), layout="constrained")
    axis = figure.subplots()
    labels = [f"{row['hypotheses']:,} hypotheses\n{row['flips']} sign-flips" for row in rows]
    axis.bar(labels, [np.median(row["run_s"]) for row in rows])
    axis.set(
        ylabel="seconds",
        title=f"{results['residuals']:,} residuals",
    )
    figure.savefig(HERE / "results.png", dpi=120)
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
