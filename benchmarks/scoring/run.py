"""How fast are hypotheses scored, in how much memory, and against refitting each of them?

    python benchmarks/scoring/run.py [--quick]

The deformation scene (two cameras, three targets) is simulated without hidden physics over more and
more epochs, its plain model fitted, and more and more hypotheses are scored, with 299 sign-flips
for the null distribution and without. Each size runs in a process of its own, so that its peak
memory is known. Refitting, in another one, is what the diagnosis does with the few hypotheses that
lead (`jaxvm.discover.select.refit`, here without epochs that are set aside); what it would take for
all is that of the median of a few that are drawn at random, warm.
Writes results.json, results.md and results.png.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[1]))
import results

HERE = Path(__file__).parent
EPOCHS = (24, 48, 97, 240, 480)
HYPOTHESES = (1_000, 3_000, 10_000, 30_000, 80_000)
MANY, LONG = 10_000, 240  # the size that the target speaks of: 100,000 residuals
ROUNDS, REFITS = 5, 8


def some(families, wanted: int):
    """About so many hypotheses: every n-th course of each family."""
    total = sum(int(family.valid.sum()) for family in families)
    step = max(round(total / wanted), 1)
    kept = [
        replace(
            family,
            courses=family.courses[::step],
            valid=family.valid[:, ::step],
            kinds=family.kinds[::step],
            asked=family.asked[::step],
        )
        for family in families
    ]
    return tuple(family for family in kept if family.valid.any())


def fitted(epochs: int):
    """The plain model of a scene of so many epochs, adjusted."""
    from jaxvm.network.scene import build
    from jaxvm.network.start import start
    from jaxvm.recording import read_recording
    from jaxvm.simulate import scene as world
    from jaxvm.simulate import simulate_deformation_scene
    from jaxvm.solve.adjust import adjust

    world.EXTENTS["asked"] = world.Extent(epochs, 300.0 * 97 / epochs, 6)
    with tempfile.TemporaryDirectory() as place:
        made = simulate_deformation_scene((), seed=5, size="asked")
        recording = read_recording(made.write(Path(place) / "recording"))
    return adjust(start(build(recording)).with_effects((), (16, 8)))


def score(epochs: int, wanted: int) -> dict:
    """Times of scoring so many hypotheses on a scene of so many epochs, and the memory it takes."""
    from jaxvm.discover.noise import random_signs
    from jaxvm.discover.score import ScoreTests
    from jaxvm.discover.space import enumerate_hypotheses

    fit = fitted(epochs)
    recording = fit.scene.recording
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    few = some(enumerate_hypotheses(fit.scene), wanted)
    times: dict[str, dict] = {}
    for name, flips in (("plain", 0), ("flipped", 299)):
        seconds, found = [], 0
        signs = random_signs(len(recording.time), flips, 0) if flips else None
        for _ in range(ROUNDS + 1):
            began = time.perf_counter()
            found = ScoreTests.of(fit, few).score(1.0, signs).n
            seconds.append(time.perf_counter() - began)
        times[name] = {
            "hypotheses": found,
            "first_s": seconds[0],
            "seconds": float(np.median(seconds[1:])),
        }
    return {
        "epochs": epochs,
        "residuals": 2 * len(recording.observations.epoch) + len(recording.ranges.epoch),
        **times["plain"],
        "flipped_s": times["flipped"]["seconds"],
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6,
        "memory_before_mb": before * 1024 / 1e6,
    }


def refit(epochs: int, wanted: int) -> dict:
    """Seconds that refitting one of so many hypotheses takes, warm: the median of a few."""
    from jaxvm.discover.heldout import split
    from jaxvm.discover.select import refit as refitted
    from jaxvm.discover.space import enumerate_hypotheses, member

    fit = fitted(epochs)
    sound = tuple(np.ones(len(rows)) for rows in fit.scene.tables)
    every = split(fit.scene, np.zeros(epochs, bool), sound)
    few = some(enumerate_hypotheses(fit.scene), wanted)
    rng, seconds = np.random.default_rng(0), []
    for _ in range(REFITS):
        family = few[rng.integers(len(few))]
        g, c, s = rng.permutation(np.argwhere(family.valid))[0]
        hypothesis = member(family, (int(g), int(c), int(s)), fit.scene)
        amplitudes = np.zeros(family.n_terms * family.n_bases)
        refitted(fit, hypothesis, amplitudes, every)
        began = time.perf_counter()
        refitted(fit, hypothesis, amplitudes, every)
        seconds.append(time.perf_counter() - began)
    return {"refit_s": float(np.median(seconds))}


TASKS = {"score": score, "refit": refit}


def apart(task: str, epochs: int, wanted: int) -> dict:
    """A task in a process of its own."""
    command = [sys.executable, __file__, "--one", task, str(epochs), str(wanted)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(said.splitlines()[-1])


def table(found: dict) -> str:
    """results.md."""
    target = found["target"]
    lines = [
        "# Scoring of hypotheses",
        "",
        f"{os.cpu_count()} processors, warm, medians of {ROUNDS}. "
        "`python benchmarks/scoring/run.py`",
        "",
        f"{target['hypotheses']:,} hypotheses on {target['residuals']:,} residuals: "
        f"**{target['seconds']:.2f} s** ({target['flipped_s']:.2f} s with 299 sign-flips), peak "
        f"memory of the process {target['memory_mb']:,.0f} MB, of which "
        f"{target['memory_before_mb']:,.0f} MB before the first score. Refitting takes "
        f"{target['refit_s']:.2f} s for one hypothesis, {target['factor']:,.0f} times as long for "
        "all.",
        "",
        "Time grows with the residuals as n^{:.2f} ± {:.2f}, ".format(*found["of_residuals"])
        + "with the hypotheses as n^{:.2f} ± {:.2f}.".format(*found["of_hypotheses"]),
        "",
        "| residuals | hypotheses | seconds | with 299 sign-flips | first call | peak memory |",
        "|---|---|---|---|---|---|",
        *(
            f"| {size['residuals']:,} | {size['hypotheses']:,} | {size['seconds']:.3f} | "
            f"{size['flipped_s']:.3f} | {size['first_s']:.2f} | {size['memory_mb']:,.0f} MB |"
            for size in found["sizes"]
        ),
    ]
    return "\n".join(lines) + "\n"


def draw(found: dict) -> Figure:
    """results.png."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    by_size = found["by_residuals"]
    left.loglog([r["residuals"] for r in by_size], [r["seconds"] for r in by_size], "o-")
    left.set(
        xlabel="residuals",
        ylabel="seconds",
        title=f"{by_size[-1]['hypotheses']:,} hypotheses or so: n^{found['of_residuals'][0]:.2f}",
    )
    many = found["by_hypotheses"]
    right.semilogx([r["hypotheses"] for r in many], [r["seconds"] for r in many], "o-")
    right.set_ylim(0.0, 1.15 * max(r["seconds"] for r in many))
    right.set_xticks(HYPOTHESES, [f"{n:,}" for n in HYPOTHESES])
    right.minorticks_off()
    left.set_yticks([0.5, 1, 2, 4, 8], ["0.5", "1", "2", "4", "8"])
    left.tick_params(axis="y", which="minor", left=False, labelleft=False)
    right.set(
        xlabel="hypotheses",
        title=f"{found['target']['residuals']:,} residuals: n^{found['of_hypotheses'][0]:.2f}",
    )
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description="time the scoring of hypotheses")
    parser.add_argument("--quick", action="store_true", help="two small sizes, nothing written")
    parser.add_argument("--one", nargs=3, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        task, *numbers = options.one
        print(json.dumps(TASKS[task](*map(int, numbers))))
        return
    epochs = EPOCHS[:2] if options.quick else EPOCHS
    long = epochs[-1] if options.quick else LONG
    sizes = []
    for number in epochs:
        for wanted in HYPOTHESES if number == long else (MANY,):
            sizes.append(apart("score", number, wanted))
            print(json.dumps(sizes[-1]), flush=True)

    def nearest(number: int) -> dict:
        own = (size for size in sizes if size["epochs"] == number)
        return min(own, key=lambda size: abs(size["hypotheses"] - MANY))

    refit_s = apart("refit", long, MANY)["refit_s"]
    target = nearest(long)
    by_residuals = [nearest(number) for number in epochs]
    by_hypotheses = [size for size in sizes if size["epochs"] == long]

    def grows(rows: list[dict], by: str) -> tuple[float, float]:
        return results.exponent([row[by] for row in rows], [row["seconds"] for row in rows])

    found = {
        "processors": os.cpu_count(),
        "sizes": sizes,
        "target": {
            **target,
            "refit_s": refit_s,
            "factor": refit_s * target["hypotheses"] / target["seconds"],
        },
        "by_residuals": by_residuals,
        "by_hypotheses": by_hypotheses,
        "of_residuals": grows(by_residuals, "residuals"),
        "of_hypotheses": grows(by_hypotheses, "hypotheses"),
    }
    if options.quick:
        print(table(found))
        return
    results.write(HERE, found, table(found), draw(found))


if __name__ == "__main__":
    main()
