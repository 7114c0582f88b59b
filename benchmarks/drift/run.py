"""Train on one history of temperature, compensate another: how much drift and pose error goes.

`python benchmarks/drift/run.py [--count 20] [--first 0] [--jobs 2] [--out DIR]`

For every random world of `world.py`, of three families, a model is identified from one recording
and applied to a recording of another day, rate and range. Measured against the truth of the world,
which nothing here shares code with: the drift of the marks (px RMS) and the pose that OpenCV finds
from noise-free marks, before and after. Writes results.json, results.md and a figure beside this
file.
"""

import argparse
import json
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from world import FAMILIES, Made, pair, relative

HERE = Path(__file__).parent


def rms(values: np.ndarray) -> float:
    """Root of the mean square length of vectors along the last axis."""
    return float(np.sqrt(np.mean(np.sum(values**2, axis=-1))))


def poses(made: Made, pixels: np.ndarray) -> np.ndarray:
    """camera_from_plate of every image [epochs, 6] by OpenCV, with the camera as calibrated."""
    w = made.world
    matrix = np.array([[w.focal, 0.0, w.centre[0]], [0.0, w.focal, w.centre[1]], [0.0, 0.0, 1.0]])
    found = []
    for image in pixels:
        turn, shift = cv2.Rodrigues(cv2.Rodrigues(w.turn)[0])[0], w.shift[:, None].copy()
        _, turn, shift = cv2.solvePnP(
            w.plate, image, matrix, w.distortion, turn, shift, True, cv2.SOLVEPNP_ITERATIVE
        )
        found.append(np.concatenate([turn[:, 0], shift[:, 0]]))
    return np.array(found)


def one(task: tuple[str, int]) -> dict:
    """Results of one world."""
    from jaxvm.compiling import forget_compiled_if_many
    from jaxvm.identify import compensate, identify
    from jaxvm.identify.identify import CONTINUOUS, DISCRETE
    from jaxvm.recording import read_recording

    family, seed = task
    forget_compiled_if_many()
    train, test = pair(seed, family)
    with tempfile.TemporaryDirectory() as place:
        train.write(Path(place) / "train")
        test.write(Path(place) / "test")
        learnt, other = (read_recording(Path(place) / name) for name in ("train", "test"))
    truth = relative(train, test)
    reference = poses(train, train.pixel.mean(axis=0)[None])[0]
    before = poses(test, train.pixel.mean(axis=0) + truth) - reference
    answer: dict = {
        "family": family,
        "seed": seed,
        "logged": list(train.world.logged),
        "time_constants_s": train.world.thermal.time_constants().tolist(),
        "styles": [train.style, test.style],
        "sigma_px": train.world.sigma,
        "drift_px": rms(truth),
        "pose_m": rms(before[:, 3:]),
        "pose_rad": rms(before[:, :3]),
    }

    def applied(structures, one_step: bool) -> dict:
        began = time.perf_counter()
        found = identify(learnt, structures, one_step=one_step)
        seconds = time.perf_counter() - began
        (own,) = found.cameras
        done = compensate(other, found.model)
        left = truth + done.correction.reshape(truth.shape)
        after = poses(test, train.pixel.mean(axis=0) + left) - reference
        structure = own.fit.model.structure
        return {
            "structure": structure.name,
            "order": structure.order if hasattr(structure, "order") else structure.na,
            "left_px": rms(left),
            "removed": 1.0 - rms(left) / rms(truth),
            "left_inside_px": rms(left[~done.outside]) if (~done.outside).any() else None,
            "drift_inside_px": rms(truth[~done.outside]) if (~done.outside).any() else None,
            "removed_position": 1.0 - rms(after[:, 3:]) / rms(before[:, 3:]),
            "removed_attitude": 1.0 - rms(after[:, :3]) / rms(before[:, :3]),
            "foretold_px": own.drift.held_out_px,
            "outside": float(done.outside.mean()),
            "candidates": [[c.name, c.unknowns, c.score] for c in own.candidates],
            "warnings": list(own.warnings),
            "seconds": seconds,
        }

    answer["chosen"] = applied(None, False)
    answer["one step"] = applied(None, True)
    answer["static"] = applied(CONTINUOUS[:2], False)
    answer["ARX"] = applied(DISCRETE[:2], False)
    return answer


def right_order(row: dict) -> int | None:
    """Number of time constants that the inputs leave unknown; None outside the family."""
    nodes = {"one node": 1, "two nodes": 2}.get(row["family"])
    # A logged body is a node whose temperature is known.
    return None if nodes is None else nodes - ("body_camera_degC" in row["logged"])


def table(rows: list[dict]) -> str:
    """Figures of all families, as Markdown."""
    lines = [
        "| family | worlds | drift px | removed, median | least | >= 85 % | position removed |"
        " attitude removed | static, median | ARX | one step | order right |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]

    def share(name: str, own: list[dict], key: str = "removed") -> float:
        return 100.0 * float(np.median([row[name][key] for row in own]))

    for family in FAMILIES:
        own = [row for row in rows if row["family"] == family]
        if not own:
            continue
        removed = np.array([row["chosen"]["removed"] for row in own])
        known = [row for row in own if right_order(row) is not None]
        right = sum(row["chosen"]["order"] == right_order(row) for row in known)
        lines.append(
            f"| {family} | {len(own)} | {np.median([row['drift_px'] for row in own]):.2f} | "
            f"{100 * np.median(removed):.1f} % | {100 * removed.min():.1f} % | "
            f"{np.sum(removed >= 0.85)} | {share('chosen', own, 'removed_position'):.1f} % | "
            f"{share('chosen', own, 'removed_attitude'):.1f} % | {share('static', own):.1f} % | "
            f"{share('ARX', own):.1f} % | {share('one step', own):.1f} % | "
            f"{f'{right} of {len(known)}' if known else ''} |"
        )
    return "\n".join(lines)


def figure(rows: list[dict], file: Path) -> None:
    """Share removed of every world, by family and structure."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    drawn, axes = plt.subplots(1, 3, figsize=(11.0, 3.6), sharey=True)
    names = ("static", "ARX", "chosen", "one step")
    for axis, family in zip(axes, FAMILIES, strict=True):
        own = [row for row in rows if row["family"] == family]
        for k, name in enumerate(names):
            left = [100.0 * max(1.0 - row[name]["removed"], 1e-4) for row in own]
            at = k + 0.5 * (np.arange(len(left)) / max(len(left) - 1, 1) - 0.5)
            axis.semilogy(at, left, "o", ms=3)
            if left:
                axis.plot([k - 0.3, k + 0.3], [np.median(left)] * 2, "k-")
        axis.axhline(15.0, color="0.7", lw=0.8)
        axis.axhline(5.0, color="0.7", lw=0.8)
        axis.set_xticks(range(len(names)), names)
        axis.set_title(family)
    axes[0].set_ylabel("drift left in an unseen history (%)")
    drawn.tight_layout()
    drawn.savefig(file, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description="identify on one history, compensate another")
    parser.add_argument("--count", type=int, default=20, help="worlds of each family")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=HERE)
    options = parser.parse_args()
    tasks = [(f, s) for f in FAMILIES for s in range(options.first, options.first + options.count)]
    rows = []
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
        for row in pool.map(one, tasks):
            rows.append(row)
            kinds = ("chosen", "one step", "static", "ARX")
            told = "  ".join(f"{kind} {100 * row[kind]['removed']:.1f}" for kind in kinds)
            print(f"{row['family']:10s} {row['seed']:3d}  {row['chosen']['structure']:22s} {told}  "
                  f"position {100 * row['chosen']['removed_position']:.1f}  "
                  f"attitude {100 * row['chosen']['removed_attitude']:.1f}  "
                  f"outside {row['chosen']['outside']:.2f}", flush=True)  # fmt: skip
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "results.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    figure(rows, options.out / "removed.png")
    (options.out / "results.md").write_text(table(rows) + "\n", encoding="utf-8")
    print(table(rows))


if __name__ == "__main__":
    main()
