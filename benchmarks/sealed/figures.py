"""Draw a scored sealed benchmark.

`python benchmarks/sealed/figures.py DIR [DIR ...] [--label NAME]` reads DIR/results.json and saves
detection.png, confusion.png, sets.png, calibration.png and heldout.png in
benchmarks/sealed/seeds/NAME.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import numpy as np
from judge import SHOWN, Z_90
from matplotlib.figure import Figure
from tally import FLOOR_RATIO, page_of, wilson

GOOD, BAD, INK = "#0f766e", "#c2410c", "#334155"
MOST_NAMES = 80


def inside_effects(rows: list[dict]) -> list[tuple[dict, dict]]:
    """(row, effect) of all effects that the catalogue should know."""
    return [(r, e) for r in rows for e in r["effects"] if not e["outside"]]


def detection(rows: list[dict]) -> Figure:
    """Share detected, in the set and first against lambda, in bins of a third of a decade."""
    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.subplots()
    effects = [e for _, e in inside_effects(rows)]
    drop = np.maximum([e["expected_drop"] for e in effects], 0.1)
    place = np.round(3.0 * np.log10(drop)).astype(int) if len(drop) else np.zeros(0, int)
    looks = (
        ("detected", "something claimed", INK),
        ("in_set", "right name in the set", GOOD),
        ("first", "right name first", BAD),
    )
    for shift, (key, words, colour) in enumerate(looks):
        hits = np.array([e[key] for e in effects], bool)
        bins = np.unique(place)
        shares = [hits[place == b].mean() for b in bins]
        bounds = np.array([wilson(hits[place == b].sum(), (place == b).sum()) for b in bins])
        if not len(bins):
            continue
        x = 10.0 ** ((bins + 0.15 * (shift - 1)) / 3.0)
        errors = np.abs(bounds.T - shares)
        axes.errorbar(x, shares, errors, fmt="o-", ms=4, lw=1, color=colour, label=words)
    axes.axvline(SHOWN, color=INK, ls=":")
    axes.set(xscale="log", ylim=(-0.03, 1.03), ylabel="share, with 95 % interval")
    axes.set_xlabel("expected drop of chi-square, lambda")
    axes.legend(frameon=False)
    return figure


def confusion(rows: list[dict]) -> Figure:
    """Hidden effects against the first name claimed, where lambda is large enough."""
    pairs = Counter()
    for row, effect in inside_effects(rows):
        if effect["shown"] and row["n_hidden"] == 1:
            named = row["named"][0] if row["named"] else "nothing"
            pairs[effect["effect"], "unnamed" if named.startswith("unnamed") else named] += 1
    hidden = sorted({h for h, _ in pairs})
    counts = Counter()
    for (_, name), count in pairs.items():
        counts[name] += count
    names = sorted(n for n, _ in counts.most_common(MOST_NAMES))
    matrix = np.zeros((max(len(hidden), 1), len(names) + 1))
    for (h, name), count in pairs.items():
        column = names.index(name) if name in names else len(names)
        matrix[hidden.index(h), column] += count
    matrix /= np.maximum(matrix.sum(axis=1, keepdims=True), 1.0)
    size = (4 + 0.22 * len(names), 3 + 0.2 * len(hidden))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(matrix, cmap="Greens", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_xticks(range(len(names) + 1), [*names, "others"], rotation=90, fontsize=7)
    axes.set_yticks(range(len(hidden)), hidden, fontsize=7)
    axes.set(xlabel="named first", ylabel="hidden")
    figure.colorbar(image, ax=axes, label="share of the hidden effect's recordings")
    return figure


def set_sizes(rows: list[dict]) -> Figure:
    """Number of claims in a set, and of different names in it."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    own = [r for r in rows if r["n_hidden"] and not r["outside"]]
    largest = max((s for r in own for s in r["set_sizes"]), default=1)
    bins = np.arange(0.5, largest + 1.5)
    for key, words, colour in (
        ("set_sizes", "claims (name, place, driver)", GOOD),
        ("set_names", "different names", INK),
    ):
        sizes = [s for r in own for s in r[key]]
        axes.hist(sizes, bins, histtype="step", lw=2, color=colour, label=words)
    axes.set(xlabel="size of the set", ylabel="findings")
    axes.legend(frameon=False)
    return figure


def calibration(rows: list[dict]) -> Figure:
    """Deviations from the true sizes in standard deviations, beside the normal distribution."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    z = np.array([d for _, e in inside_effects(rows) if e["first"] for d in e["z"]])
    edges = np.linspace(-6.0, 6.0, 49)
    axes.hist(np.clip(z, -5.99, 5.99), edges, density=len(z) > 0, color=GOOD, alpha=0.6)
    x = np.linspace(-6.0, 6.0, 241)
    axes.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), color=INK)
    for limit in (-Z_90, Z_90):
        axes.axvline(limit, color=INK, ls=":")
    label = f"(estimate - truth) / standard deviation, {len(z)} sizes (ends: beyond)"
    axes.set(xlabel=label, ylabel="density")
    return figure


def held_out(rows: list[dict]) -> Figure:
    """Held-out RMS after the diagnosis over the noise floor."""
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axes = figure.subplots()
    edges = np.linspace(0.97, 1.2, 47)
    groups = (
        ("nothing hidden", INK, [r for r in rows if not r["n_hidden"]]),
        ("in the catalogue", GOOD, [r for r in rows if r["n_hidden"] and not r["outside"]]),
        ("outside", BAD, [r for r in rows if r["outside"]]),
    )
    for words, colour, own in groups:
        ratio = [r["floor_ratio"] for r in own if not r["failed"]]
        inside = np.clip(ratio, edges[0], np.nextafter(edges[-1], 0.0))
        axes.hist(inside, edges, histtype="step", lw=2, color=colour, label=words)
    axes.axvline(FLOOR_RATIO, color=INK, ls=":")
    label = "held-out RMS after the diagnosis / noise floor (right end: beyond)"
    axes.set(xlabel=label, ylabel="recordings")
    axes.legend(frameon=False)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description="draw a scored sealed benchmark")
    parser.add_argument("folders", type=Path, nargs="+", metavar="DIR")
    parser.add_argument("--label", default=None, help="of the folder; those of DIR if not set")
    options = parser.parse_args()
    rows = []
    for folder in options.folders:
        rows += json.loads((folder / "results.json").read_text())["rows"]
    label = options.label or "-".join(folder.resolve().name for folder in options.folders)
    drawn = {
        "detection": detection,
        "confusion": confusion,
        "sets": set_sizes,
        "calibration": calibration,
        "heldout": held_out,
    }
    for name, draw in drawn.items():
        file = page_of(label, f"{name}.png")
        draw(rows).savefig(file, dpi=120)
        print(f"written {file}")


if __name__ == "__main__":
    main()
