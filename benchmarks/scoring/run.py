"""How fast are hypotheses scored, in how much memory, and against refitting each of them?

    python benchmarks/scoring/run.py [--quick]

The deformation scene (two cameras, three targets) is simulated without hidden physics over more and
more epochs, its plain model fitted, and more and more hypotheses are scored, with 299 sign-flips
for the null distribution and without. A size runs in a process of its own, so that its peak memory
is known. Refitting is the adjustment with one hypothesis in the model, as the diagnosis does it
with the few that lead; what it would take for all is that of the median of a few, warm.
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


def one(epochs: int, wanted: list[int]) -> dict:
    """Times of scoring so many hypotheses on a scene of so many epochs, and of refitting one."""
    from jaxvm.discover.noise import random_signs
    from jaxvm.discover.score import ScoreTests
    from jaxvm.discover.space import enumerate_hypotheses, member
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
    fit = adjust(start(build(recording)).with_effects((), (16, 8)))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    families = enumerate_hypotheses(fit.scene)
    rows = []
    for number in wanted:
        few = some(families, number)
        for flips in (0, 299):
            seconds = []
            signs = random_signs(len(recording.time), flips, 0) if flips else None
            for _ in range(ROUNDS + 1):
                began = time.perf_counter()
                ranking = ScoreTests.of(fit, few).score(1.0, signs)
                seconds.append(time.perf_counter() - began)
            rows.append(
                {
                    "hypotheses": ranking.n,
                    "flips": flips,
                    "first_s": seconds[0],
                    "seconds": float(np.median(seconds[1:])),
                }
            )
    refits = []
    few = some(families, MANY)
    rng = np.random.default_rng(0)
    for _ in range(REFITS):
        family = few[rng.integers(len(few))]
        g, c, s = rng.permutation(np.argwhere(family.valid))[0]
        hypothesis = member(family, (int(g), int(c), int(s)), fit.scene)
        effect = hypothesis.effect((0.0,) * (family.n_terms * family.n_bases))
        with_it = fit.scene.with_effects((effect,), (16, 8))
        adjust(with_it, check=False)
        began = time.perf_counter()
        adjust(with_it, check=False)
        refits.append(time.perf_counter() - began)
    return {
        "epochs": epochs,
        "residuals": 2 * len(recording.observations.epoch) + len(recording.ranges.epoch),
        "rows": rows,
        "refit_s": float(np.median(refits)),
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "memory_before_mb": before / 1024,
    }


def apart(epochs: int, wanted: list[int]) -> dict:
    """The same in a process of its own."""
    command = [sys.executable, __file__, "--one", str(epochs), *map(str, wanted)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return json.loads(said.splitlines()[-1])


def plain(size: dict) -> list[dict]:
    return [row for row in size["rows"] if not row["flips"]]


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
        f"memory of the whole process {target['memory_mb']:.0f} MB. Refitting takes "
        f"{target['refit_s']:.2f} s for one hypothesis, {target['factor']:,.0f} times as long for "
        "all.",
        "",
        "Time grows with the residuals as n^{:.2f} ± {:.2f}, ".format(*found["of_residuals"])
        + "with the hypotheses as n^{:.2f} ± {:.2f}.".format(*found["of_hypotheses"]),
        "",
        "| residuals | hypotheses | sign-flips | seconds | first call | peak memory of the size |",
        "|---|---|---|---|---|---|",
    ]
    for size in found["sizes"]:
        for row in size["rows"]:
            lines.append(
                f"| {size['residuals']:,} | {row['hypotheses']:,} | {row['flips']} | "
                f"{row['seconds']:.3f} | {row['first_s']:.2f} | {size['memory_mb']:.0f} MB |"
            )
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
        title=f"{by_size[0]['hypotheses']:,} hypotheses or so: n^{found['of_residuals'][0]:.2f}",
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
    parser.add_argument("--one", type=int, nargs="+", default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(options.one[0], options.one[1:])))
        return
    epochs = EPOCHS[:2] if options.quick else EPOCHS
    long = epochs[-1] if options.quick else LONG
    sizes = []
    for number in epochs:
        sizes.append(apart(number, list(HYPOTHESES if number == long else (MANY,))))
        print(json.dumps(sizes[-1]), flush=True)
    of_long = next(size for size in sizes if size["epochs"] == long)
    target = min(plain(of_long), key=lambda row: abs(row["hypotheses"] - MANY))
    flipped = next(
        row for row in of_long["rows"] if row["flips"] and row["hypotheses"] == target["hypotheses"]
    )
    by_residuals = [
        {"residuals": size["residuals"]}
        | min(plain(size), key=lambda row: abs(row["hypotheses"] - MANY))
        for size in sizes
    ]
    by_hypotheses = plain(of_long)
    found = {
        "processors": os.cpu_count(),
        "sizes": sizes,
        "target": {
            **target,
            "residuals": of_long["residuals"],
            "flipped_s": flipped["seconds"],
            "refit_s": of_long["refit_s"],
            "factor": of_long["refit_s"] * target["hypotheses"] / target["seconds"],
            "memory_mb": of_long["memory_mb"],
        },
        "by_residuals": by_residuals,
        "by_hypotheses": by_hypotheses,
        "of_residuals": results.exponent(
            [row["residuals"] for row in by_residuals], [row["seconds"] for row in by_residuals]
        ),
        "of_hypotheses": results.exponent(
            [row["hypotheses"] for row in by_hypotheses],
            [row["seconds"] for row in by_hypotheses],
        ),
    }
    if options.quick:
        print(table(found))
        return
    results.write(HERE, found, table(found), draw(found))


if __name__ == "__main__":
    main()
