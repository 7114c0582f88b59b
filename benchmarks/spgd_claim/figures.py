"""Figures: time and evaluations against the size of the network; wandering of SPGD on loops."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator
from verdict import METHODS, RACES, chosen, kinds, total_s

COLOURS = {
    "condition": "#b45309",
    "sparse": "#0f766e",
    "spgd": "#be123c",
    "lbfgs": "#4338ca",
}
MARKERS = {"condition": "s", "sparse": "o", "spgd": "^", "lbfgs": "D"}


def draw(content: dict, folder: Path) -> None:
    """All figures."""
    if content["cells"]:
        of_races(content, "seconds", folder / "time.png")
        of_races(content, "evaluations", folder / "evaluations.png")
        of_steps(content, folder / "step.png")
    if content["wander"]:
        of_loops(content, folder / "wander.png")


def of_races(content: dict, quantity: str, path: Path) -> None:
    """One row for each kind of network, one column for each race."""
    rows = kinds(content)
    figure = Figure(figsize=(11, 2.6 * len(rows) + 0.7), layout="constrained")
    axes = figure.subplots(len(rows), len(RACES), sharex=True, sharey=True, squeeze=False)
    for line, kind in zip(axes, rows, strict=True):
        for axis, race in zip(line, RACES, strict=True):
            for method in METHODS:
                cells = chosen(content, kind=kind, method=method, race=race)
                _curve(axis, cells, quantity, method)
            _log_axes(axis, content)
        line[0].set_ylabel(f"{_title(kind)}\n{quantity}")
    for axis, words in zip(axes[0], RACES.values(), strict=True):
        axis.set_title(words[0].upper() + words[1:], fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("stations")
    # Room for the arrows.
    low, high = axes[0, 0].get_ylim()
    axes[0, 0].set_ylim(low, 2.5 * high)
    figure.legend(handles=_legend(), loc="outside lower center", ncols=6, fontsize=9, frameon=False)
    figure.savefig(path, dpi=110)


def _title(kind: str) -> str:
    return f"{kind.split()[1]} links a station" if kind.startswith("random") else kind


def _curve(axis, cells: list[dict], quantity: str, method: str) -> None:
    """Medians of reached networks as a line, every network as a symbol, censored ones open."""
    colour, marker = COLOURS[method], MARKERS[method]

    def value(cell):
        return total_s(cell) if quantity == "seconds" else cell["evaluations"]

    reached = [c for c in cells if c["status"] == "reached"]
    censored = [c for c in cells if c["status"] == "censored" and "seconds" in c]
    sizes = sorted({c["n"] for c in reached})
    middle = [np.median([value(c) for c in reached if c["n"] == n]) for n in sizes]
    axis.plot(sizes, middle, color=colour, linewidth=1.2)
    axis.plot([c["n"] for c in reached], [value(c) for c in reached], marker, color=colour,
              markersize=3.5, alpha=0.6, markeredgewidth=0.0)  # fmt: skip
    for cell in censored:
        axis.annotate(
            "", (cell["n"], 2.2 * value(cell)), (cell["n"], value(cell)),
            arrowprops=dict(arrowstyle="->", color=colour, linewidth=0.8, shrinkA=2, shrinkB=0),
        )  # fmt: skip
    axis.plot([c["n"] for c in censored], [value(c) for c in censored], marker, color=colour,
              markersize=4.5, markerfacecolor="white")  # fmt: skip


def _log_axes(axis, content: dict) -> None:
    axis.set(xscale="log", yscale="log")
    sizes = sorted({cell["n"] for cell in content["cells"].values()})
    axis.set_xlim(0.8 * sizes[0], 1.25 * sizes[-1])
    wide = sizes[-1] > 100 * sizes[0]
    shown = (10, 100, 1_000, 10_000) if wide else sizes
    axis.xaxis.set_major_locator(FixedLocator(shown))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda n, _: f"{n:,.0f}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.yaxis.set_major_locator(LogLocator(numticks=8))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.grid(True, which="major", color="#e5e7eb", linewidth=0.7)
    axis.spines[["top", "right"]].set_visible(False)
    axis.set_axisbelow(True)


def _legend() -> list[Line2D]:
    own = [
        Line2D([], [], color=COLOURS[m], marker=MARKERS[m], markersize=5, linewidth=1.2, label=name)
        for m, name in METHODS.items()
    ]
    open_one = Line2D([], [], color="#6b7280", marker="o", markersize=5, markerfacecolor="white",
                      linewidth=0.0, label="target not reached: at least so much")  # fmt: skip
    return [*own, open_one]


def of_steps(content: dict, path: Path) -> None:
    """Seconds and memory of one step against the size, for every kind of network."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for method in METHODS:
        for k, kind in enumerate(kinds(content)):
            cells = [c for c in chosen(content, kind=kind, method=method, race="step")
                     if "step_s" in c]  # fmt: skip
            cells.sort(key=lambda c: c["n"])
            style = dict(color=COLOURS[method], marker=MARKERS[method], markersize=3.5,
                         linewidth=1.0, alpha=1.0 - 0.15 * k)  # fmt: skip
            sizes = [c["n"] for c in cells]
            left.plot(sizes, [1e3 * c["step_s"] for c in cells], **style)
            taken = [(c["n"], c["peak_bytes"] / 1e6) for c in cells if c["peak_bytes"] > 1e6]
            right.plot([n for n, _ in taken], [size for _, size in taken], **style)
    if not any(len(line.get_xdata()) for line in right.lines):
        right.set_ylim(1.0, 10.0)
    for axis, words in ((left, "one step (ms)"), (right, "memory of a step (MB), above 1")):
        _log_axes(axis, content)
        axis.set(xlabel="stations", ylabel=words)
    paler = Line2D([], [], linewidth=0.0, label=f"paler: {', '.join(map(_title, kinds(content)))}")
    figure.legend(handles=[*_legend()[:-1], paler], loc="outside lower center", ncols=3,
                  fontsize=8, frameon=False)  # fmt: skip
    figure.savefig(path, dpi=120)


def of_loops(content: dict, path: Path) -> None:
    """Excess against the number of links: medians, means, formula, and with the links' term."""
    rows = content["wander"]
    gains = list(dict.fromkeys(row["gain"] for row in rows))
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    axes = figure.subplots(1, len(gains), sharey=True, squeeze=False)[0]
    for axis, gain in zip(axes, gains, strict=True):
        for kind, marker in (("numbers", "o"), ("poses", "s")):
            own = sorted((r for r in rows if (r["gain"], r["kind"]) == (gain, kind)),
                         key=lambda r: r["n"])  # fmt: skip
            n = [row["n"] for row in own]

            def of(which, what, own=own):
                return [row[which][what] for row in own]

            line = "-" if kind == "numbers" else ""
            axis.plot(n, [row["formula"] for row in own], line or "_", color="#111827",
                      linewidth=1.0, markersize=14)  # fmt: skip
            axis.errorbar(n, of("misclosure alone", "mean"), of("misclosure alone", "error"),
                          fmt=marker, color="#fb923c", markersize=6, markerfacecolor="white",
                          linewidth=1.0)  # fmt: skip
            axis.plot(n, of("misclosure alone", "median"), marker + line, color="#be123c",
                      markersize=5, linewidth=1.0)  # fmt: skip
            axis.plot(n, of("with links", "median"), marker + line, color="#0f766e", markersize=5,
                      linewidth=1.0)  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel="links in the ring",
                 title=f"gain {gain} / tr H")  # fmt: skip
        axis.xaxis.set_major_locator(FixedLocator(sorted({row["n"] for row in rows})))
        axis.xaxis.set_major_formatter(FuncFormatter(lambda n, _: f"{n:.0f}"))
        axis.xaxis.set_minor_locator(NullLocator())
        axis.grid(True, color="#e5e7eb", linewidth=0.7)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel("|ξ − ξ_LS|² / |ξ_LS|²")
    handles = [
        Line2D([], [], color="#111827", linewidth=1.0, label="mean, first order in the gain"),
        Line2D([], [], color="#fb923c", marker="o", markerfacecolor="white", linewidth=0.0,
               label="mean measured"),
        Line2D([], [], color="#be123c", marker="o", label="median measured"),
        Line2D([], [], color="#0f766e", marker="o", label="median with the links' own term"),
        Line2D([], [], color="#6b7280", marker="s", linewidth=0.0, label="ring of poses"),
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    figure.savefig(path, dpi=120)
