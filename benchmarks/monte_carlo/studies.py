"""Trials together against one after the other: scores of a diagnosis, and compensation.

    python benchmarks/monte_carlo/studies.py

Scores: residuals of noise alone on the deformation scene, against all hypotheses of a diagnosis;
what is known of these is kept either way. Compensation: a camera of `../drift/world.py` watches a
plate while temperature changes; a model of one time constant is learnt from images that are
noisier each time, and the drift that it leaves of another day is measured; one after the other by
the whole `identify`, together by its last adjustment alone. The same trials are drawn either way;
how far they differ stands in the table. Medians of warm runs, compiling apart. Writes
results-studies.json and results-studies.md.
"""

import json
import os
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxvm.discover.space import enumerate_hypotheses
from jaxvm.identify.identify import CONTINUOUS
from jaxvm.montecarlo import run
from jaxvm.montecarlo.drift import compensation_study, structure_study
from jaxvm.montecarlo.scores import score_study
from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.recording import Recording, read_recording
from jaxvm.simulate import scene as simulated
from jaxvm.simulate import simulate_deformation_scene
from jaxvm.solve.adjust import adjust

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "drift"))
import results
from world import pair, relative

HERE = Path(__file__).parent
EPOCHS = (97, 240)
ROUNDS, ALONE, TOGETHER = 3, 4, 64
FAMILY, SEEDS = "one node", (4, 5)
ONE_LAG = CONTINUOUS[2]


def timed(study, trials: int, batch: int | None = None):
    """Results, and seconds of a trial: the median of warm runs."""
    run(study, 0, trials, batch=batch)
    found = [run(study, 1, trials, batch=batch) for _ in range(ROUNDS)]
    return found[0], float(np.median([(one.seconds - one.compiling) / trials for one in found]))


def compared(of: str, size: str, one, many, error: str) -> dict:
    """A row of the table: two studies of the same trials."""
    alone, alone_s = timed(one, ALONE, 1)
    together, together_s = timed(many, TOGETHER)
    a, b = (found.columns[error] for found in (alone, together))
    differ = float(np.abs(b[:ALONE] - a).max() / np.abs(a).max())
    return {
        "study": of,
        "size": size,
        "alone_s": alone_s,
        "together_s": together_s,
        "factor": alone_s / together_s,
        "batch": together.batch,
        "differ": differ,
        "failed": together.failed,
    }


def scores(epochs: int) -> dict:
    simulated.EXTENTS["asked"] = simulated.Extent(epochs, 300.0 * 97 / epochs, 6)
    with tempfile.TemporaryDirectory() as place:
        made = simulate_deformation_scene((), seed=5, size="asked")
        recording = read_recording(made.write(Path(place) / "recording"))
    fit = adjust(start(build(recording)).with_effects((), (16, 8)))
    families = enumerate_hypotheses(fit.scene)
    n = sum(int(family.valid.sum()) for family in families)
    residuals = 2 * len(recording.observations.epoch)
    study = score_study(fit, families)
    size = f"{n:,} hypotheses, {residuals:,} residuals"
    return compared("score of a diagnosis", size, study, study, "error.drop[0]")


def compensation(seed: int) -> dict:
    made = pair(seed, FAMILY)
    train, other = (_without_noise(own) for own in made)
    drift = relative(*made).reshape(-1, 2)
    one = compensation_study(train, other, drift, structures=[ONE_LAG])
    many = structure_study(train, other, drift, ONE_LAG)
    size = (
        f"{len(train.time)} and {len(other.time)} epochs of {len(drift) // len(other.time)} marks"
    )
    return compared("compensation", size, one, many, "error.rms_px[0]")


def _without_noise(made) -> Recording:
    with tempfile.TemporaryDirectory() as place:
        replace(made, measured=made.pixel).write(Path(place) / "recording")
        return read_recording(Path(place) / "recording")


def table(rows: list[dict]) -> str:
    """results-studies.md."""
    head = [
        "study",
        "size",
        "one by one",
        "together",
        "times as fast",
        "batch",
        "largest difference",
        "failed",
    ]
    lines = [
        [
            row["study"],
            row["size"],
            f"{1e3 * row['alone_s']:.0f} ms",
            f"{1e3 * row['together_s']:.0f} ms",
            f"{row['factor']:.1f}",
            row["batch"],
            f"{row['differ']:.0e}",
            row["failed"],
        ]
        for row in rows
    ]
    return (
        f"# Monte Carlo of other estimators, milliseconds a trial\n\n{os.cpu_count()} processors, "
        f"medians of {ROUNDS} warm runs. `python benchmarks/monte_carlo/studies.py`\n\n"
        + results.markdown(head, lines)
    )


def main() -> None:
    rows = []
    for row in (*map(scores, EPOCHS), *map(compensation, SEEDS)):
        print(row, flush=True)
        rows.append(row)
    (HERE / "results-studies.json").write_text(json.dumps(rows, indent=1) + "\n")
    (HERE / "results-studies.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
