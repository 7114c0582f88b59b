"""Three experiments: warm-up from power-on, a day in a room, days outdoors. Drift, and its map.

`python benchmarks/drift/experiments.py`

The world is that of `world.py` (four nodes, sun and wind). Writes experiments.json (size of the
drift, time after which it falls below the noise in ten minutes, what a model leaves),
results-experiments.md and experiments.png.
"""

import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from world import Made, draw_world, record

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from results import markdown  # noqa: E402

from jaxvm.identify import identify  # noqa: E402
from jaxvm.identify.maps import drift_map, settled_after  # noqa: E402
from jaxvm.recording import Recording, read_recording  # noqa: E402

SEEDS = range(5)
EXPERIMENTS = {
    "warm-up, 3 h": dict(style="room", hours=3.0, low=21.9, high=22.1, every=60.0, on_s=120.0),
    "room, a day": dict(style="room", hours=24.0, low=19.0, high=25.0, every=300.0, on_s=-86400.0),
    "outdoors, 3 days": dict(
        style="outdoors", hours=72.0, low=8.0, high=26.0, every=900.0, on_s=-86400.0
    ),
}


def read(made: Made) -> Recording:
    """The recording as a user would read it."""
    with tempfile.TemporaryDirectory() as place:
        made.write(Path(place) / "recording")
        return read_recording(Path(place) / "recording")


def table(results: list[dict]) -> str:
    """results-experiments.md."""
    rows = [
        [
            row["experiment"],
            row["seed"],
            f"{row['drift_rms_px']:.3f}",
            f"{row['drift_range_px']:.3f}",
            "never" if row["at_rest_after_min"] is None else f"{row['at_rest_after_min']:.0f} min",
            row["structure"],
            f"{row['foretold_px']:.4f}",
        ]
        for row in results
    ]
    head = ["experiment", "camera", "drift (px RMS)", "range (px)", "at rest after", "model"]
    return markdown([*head, "error of foretold epochs (px)"], rows)


def main() -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    drawn, axes = plt.subplots(2, 3, figsize=(11.0, 6.0), layout="constrained")
    results = []
    for column, (name, history) in enumerate(EXPERIMENTS.items()):
        for seed in SEEDS:
            world = replace(
                draw_world(seed, "four nodes"), logged=("ambient_degC", "body_camera_degC")
            )
            made = record(world, seed=40 + column, **history)
            recording = read(made)
            found = identify(recording, one_step=False)
            (own,) = found.cameras
            rest = settled_after(own)
            start = 0.0 if history["on_s"] < 0.0 else history["on_s"]
            truth = made.pixel - made.pixel.mean(axis=0)
            move = made.pixel.mean(axis=1) - made.pixel[0].mean(axis=0)
            results.append(
                {
                    "experiment": name,
                    "seed": seed,
                    "sigma_px": world.sigma,
                    "drift_rms_px": float(np.sqrt(np.mean(np.sum(truth**2, axis=2)))),
                    "drift_range_px": float(np.ptp(np.linalg.norm(move, axis=1))),
                    "at_rest_after_min": None if rest is None else (rest - start) / 60.0,
                    "structure": own.fit.model.structure.name,
                    "foretold_px": own.drift.held_out_px,
                }
            )
            print(results[-1], flush=True)
            top, bottom = axes[:, column]
            top.plot(made.time / 3600.0, move[:, 0], "-", lw=0.8, color=f"C{seed}")
            top.plot(made.time / 3600.0, move[:, 1], "--", lw=0.8, color=f"C{seed}")
            if seed == SEEDS[0]:
                n = len(made.time)
                warm = np.argsort(made.nodes[1])
                cold, hot = (
                    np.isin(np.arange(n), warm[: n // 10]),
                    np.isin(np.arange(n), warm[-n // 10 :]),
                )
                at, by = drift_map(recording, "camera", cold, hot)
                arrows = bottom.quiver(at[:, 0], at[:, 1], by[:, 0], by[:, 1], angles="xy")
                size = float(np.median(np.linalg.norm(by, axis=1)))
                bottom.quiverkey(arrows, 0.88, 0.93, size, f"{size:.2f} px")
                bottom.set(title="cold to warm, one camera", xlabel="u (px)", ylabel="v (px)")
                bottom.set(xlim=(0, world.size[0]), ylim=(world.size[1], 0), aspect="equal")
        top.set(title=name, xlabel="hours", ylabel="mean drift (px): u —, v - -")
    drawn.savefig(HERE / "experiments.png", dpi=110)
    (HERE / "experiments.json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    (HERE / "results-experiments.md").write_text(table(results), encoding="utf-8")


if __name__ == "__main__":
    main()
