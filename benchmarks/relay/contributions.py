"""Table and figure of the double chain: what each way of joining two chains contributes."""

from pathlib import Path

import numpy as np
from doubles import ESTIMATES, WORDS
from intervals import bars, divided, words
from matplotlib.figure import Figure

NOISES = ("isotropic", "tilted plates", "frontal plates")
WAYS = ("no levers", "levers, same ends", "levers, opposite ends")
COLOURS = {"isotropic": "#0f766e", "tilted plates": "#1d4ed8", "frontal plates": "#c2410c"}


def table(results: dict) -> str:
    """Deviations across of every estimate, then gains."""
    lines = [
        "Deviation of the far end across the chain (mm): first order / Monte Carlo.",
        "",
        "| case | " + " | ".join(WORDS[name] for name in ESTIMATES) + " |",
        "|---" * (len(ESTIMATES) + 1) + "|",
    ]
    for row in results["rows"]:
        values = []
        for name in ESTIMATES:
            first = row["predicted_m"]
            told = "" if first is None else f"{1e3 * first[name]:.4g} / "
            values.append(f"{told}{1e3 * row['measured_m'][name]['value']:.4g}")
        lines.append(f"| {row['case']} | " + " | ".join(values) + " |")
    lines += [
        "",
        "Gain of the adjustment: RMS across of another estimate over that of the adjusted one, "
        "Monte Carlo with 95 %, and first order where weights are right. Last: RMS of the turn "
        "across.",
        "",
        "| case | over mean with full covariances | first order | over classic mean | over equal "
        "weights | over single | link by link, full covariances, over far-end mean | turn |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        own = row["gain"]
        first = row["predicted_m"]
        told = "" if first is None else f"{first['weighted'] / first['adjusted']:.4g}"
        lines.append(
            f"| {row['case']} | {words(own['weighted/adjusted'])} | {told} | "
            f"{words(own['classic/adjusted'])} | {words(own['naive/adjusted'])} | "
            f"{words(own['single/adjusted'])} | {words(own['weighted/by_link'])} | "
            f"{words(row['turn_gain'])} |"
        )
    return "\n".join(lines)


def figure(results: dict, file: Path) -> None:
    """The factorial design, the steps of one case, and what sets the size of the gain."""
    drawn = Figure(figsize=(12.0, 8.6), layout="constrained")
    (design, steps), (ratio, rung) = drawn.subplots(2, 2)
    _design(design, results["rows"])
    _steps(steps, results["rows"])
    _ratio(ratio, results["ratios"])
    _rung(rung, results)
    for axis in (design, steps, ratio, rung):
        axis.title.set_fontsize(10.5)
    drawn.savefig(file, dpi=120)


def _design(axis, rows) -> None:
    """Gain by noise and arrangement."""
    for row in rows:
        if row["factor"] is None:
            continue
        noise, way = row["factor"]
        at = WAYS.index(way) + 0.26 * (NOISES.index(noise) - 1)
        own = row["gain"]["weighted/adjusted"]
        first = row["predicted_m"]["weighted"] / row["predicted_m"]["adjusted"]
        # A logarithmic bar of a gain of 1 would not be seen at all.
        axis.bar(at, first - 0.9, 0.22, bottom=0.9, color=COLOURS[noise], alpha=0.4)
        axis.errorbar(at, own["value"], bars(own)[:, None], fmt=".", color="k", capsize=3)
        top = max(own["high"], first)
        text = f"{own['value']:.3f}" if own["value"] < 2 else f"{own['value']:.3g}"
        axis.text(at, top * 1.12, text, ha="center", fontsize=8)
    for noise, colour in COLOURS.items():
        axis.bar(0, np.nan, color=colour, alpha=0.4, label=noise)
    axis.errorbar([], [], [], fmt=".", color="k", capsize=3, label="Monte Carlo, 95 %")
    axis.set(yscale="log", ylim=(0.9, 600), ylabel="gain: mean, full covariances / adjusted",
             title="noise and arrangement (bars: first order)")  # fmt: skip
    axis.set_xticks(range(3), WAYS)
    axis.legend(fontsize=8.5, loc="upper left")


def _steps(axis, rows) -> None:
    """Deviations of every estimate, tilted plates at opposite ends."""
    row = next(r for r in rows if r["case"] == "tilted plates, levers, opposite ends")
    wrong = next(r for r in rows if "believed isotropic" in r["case"])
    bars_ = [(WORDS[name], row["predicted_m"][name], row["measured_m"][name]) for name in ESTIMATES]
    bars_ += [("adjusted, weights believe\nisotropic noise", None, wrong["measured_m"]["adjusted"])]
    for k, (_, first, own) in enumerate(bars_):
        height = 1e3 * (own["value"] if first is None else first)
        axis.barh(k, height, 0.7, color=COLOURS["tilted plates"] if k < 7 else "0.6", alpha=0.4)
        mm = divided(own, 1e-3)
        axis.errorbar(mm["value"], k, xerr=bars(mm)[:, None], fmt=".", color="k", capsize=3)
        axis.text(mm["high"] * 1.08, k, f"{mm['value']:.3g}", va="center", fontsize=8)
    axis.set_yticks(range(len(bars_)), [name for name, _, _ in bars_], fontsize=8.5)
    axis.invert_yaxis()
    axis.set(xscale="log", xlim=(1.0, 60.0), xlabel="RMS across at the far end, 10 links (mm)",
             title="tilted plates, opposite ends: what each way leaves")  # fmt: skip
    axis.set_xticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])


def _ratio(axis, results) -> None:
    """Gain against how much better a line of sight is than a measured tilt."""
    lines = {
        "isotropic, opposite ends": ("#0f766e", "-"),
        "plates, opposite ends": ("#1d4ed8", "-"),
        "isotropic, same ends": ("#0f766e", ":"),
        "plates, same ends": ("#1d4ed8", ":"),
    }
    for name, (colour, style) in lines.items():
        axis.plot(results["ratio"], results["gain"][name], style, color=colour, label=name)
    axis.plot(results["ratio"], results["rule"], "k--", lw=0.9, label="√(1 + s²/2p²)")
    axis.set(xscale="log", yscale="log", xlabel="tilt · L / position across, of one link",
             ylabel="gain (first order)",
             title="not the axes: how much worse a tilt is than a line of sight")  # fmt: skip
    axis.legend(fontsize=8.5)
    axis.grid(alpha=0.25)


def _rung(axis, results) -> None:
    """Gain against the calibration of the stations; Monte Carlo where the cases have it."""
    curves = results["rungs"]
    styles = {"no levers": ":", "same ends": "--", "opposite ends": "-"}
    for name, values in curves["gain"].items():
        noise, way = name.split(", ")
        axis.plot(1e6 * np.array(curves["sigma_rad"]), values, styles[way], color=COLOURS[noise],
                  label=name)  # fmt: skip
    for row in results["rows"]:
        if row["group"] != "stations":
            continue
        at = 1e6 * row["rung_rad"]
        own = row["gain"]["weighted/adjusted"]
        axis.errorbar(at, own["value"], bars(own)[:, None], fmt=".", color="k", capsize=3)
    axis.errorbar([], [], [], fmt=".", color="k", capsize=3, label="Monte Carlo, 95 %")
    axis.set(xscale="log", yscale="log", xlabel="turn of a station's calibration (µrad)",
             ylabel="gain (first order)", title="stations decide how much is left")  # fmt: skip
    axis.legend(fontsize=8.5)
    axis.grid(alpha=0.25)
