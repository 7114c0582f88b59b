"""Figures of a network as inline SVG in the page's own colours: they suit light and dark."""

import io
import re
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

_COLOURS = {
    "#010203": "var(--ink)",
    "#010204": "var(--grid)",
    "#010205": "var(--c1)",
    "#010206": "var(--c2)",
    "#010207": "var(--c3)",
    "#010208": "var(--c4)",
    "#010209": "var(--c5)",
    "#01020a": "var(--c6)",
}
"""Colours that matplotlib draws with, and what the page makes of them."""

_INK, _GRID, *_CURVES = _COLOURS
_STYLE: dict[Any, Any] = {
    "font.size": 10.0,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _INK,
    "axes.labelcolor": _INK,
    "text.color": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "grid.color": _GRID,
    "grid.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "jaxvm",
}
_POINTS = 400
"""Bodies that are drawn one by one; more than that as a band."""


def growth_figures(bodies: list[dict[str, Any]]) -> list[str]:
    """Standard deviations of position and of turn against the number of edges to a held body.

    One point for each body, or for many the median and the middle 90 % at each distance. None where
    no body is free and joined to a held one.
    """
    shown = [
        b
        for b in bodies
        if not b["held"] and None not in (b["distance_edges"], b["position_std_max_m"])
    ]
    if not shown:
        return []
    distance = np.array([b["distance_edges"] for b in shown])
    return [
        _growth(distance, np.array([b[key] for b in shown]), colour, label)
        for key, colour, label in (
            ("position_std_max_m", _CURVES[0], "position (m)"),
            ("turn_std_max_rad", _CURVES[1], "turn (rad)"),
        )
    ]


def _growth(distance: np.ndarray, value: np.ndarray, colour: str, label: str) -> str:
    at = np.unique(distance)
    quantiles = [np.quantile(value[distance == k], (0.05, 0.5, 0.95)) for k in at]
    low, middle, high = np.array(quantiles).T
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(4.4, 2.9), layout="constrained")
        axis = figure.subplots()
        if len(value) <= _POINTS:
            axis.plot(distance, value, "o", ms=4, color=colour, alpha=0.6, mew=0)
        else:
            axis.fill_between(at, low, high, color=colour, alpha=0.25, lw=0)
        axis.plot(at, middle, color=colour, lw=1.6)
        axis.set(xlabel="edges to the nearest held body", ylabel=f"σ of the {label}")
        axis.set_xlim(0, None)
        axis.set_ylim(0, None)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.ticklabel_format(axis="y", scilimits=(-3, 3))
        return _svg(figure, f"Standard deviation of the {label} against distance")


def convergence_figure(histories: list[dict[str, Any]]) -> str:
    """Cost above the best one, relative to it, against evaluations; both axes logarithmic.

    Where the best cost is zero, the cost itself. What is below 1e-12 is drawn there. Curve k has
    the page's colour c1 to c6 of k modulo 6; the page names them. An empty text where no history
    has a cost.
    """
    curves = []
    for k, history in enumerate(histories):
        x = np.array(history["evaluations"], float)
        y = np.array([np.nan if c is None else c for c in history["cost"]], float)
        kept = np.isfinite(y) & (x > 0)
        if kept.any():
            curves.append((k, x[kept], y[kept]))
    if not curves:
        return ""
    best = min(float(y.min()) for _, _, y in curves)
    relative = best > 1e-12 * max(float(y.max()) for _, _, y in curves)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=(6.4, 3.2), layout="constrained")
        axis = figure.subplots()
        for k, x, y in curves:
            excess = (y - best) / best if relative else y
            axis.plot(
                x, np.maximum(excess, 1e-12), "o-" if len(x) < 60 else "-", ms=3.5, lw=1.5,
                color=_CURVES[k % len(_CURVES)],
            )  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel="evaluations")
        axis.set_ylabel("cost / best − 1" if relative else "cost")
        if relative:
            axis.axhline(0.01, color=_INK, lw=0.8, ls=":")
            axis.annotate(
                "1 % above the best", (1.0, 0.01), xycoords=("axes fraction", "data"),
                ha="right", va="bottom", fontsize=8,
            )  # fmt: skip
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.xaxis.set_minor_formatter(lambda value, _: "")
        return _svg(figure, "Cost against evaluations")


def _svg(figure: Figure, title: str) -> str:
    """The figure as an element of a page: no name spaces, no metadata, colours by name."""
    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(
        buffer, metadata=dict.fromkeys(("Creator", "Date", "Format", "Type"))
    )
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", text, flags=re.S)
    text = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    for colour, name in _COLOURS.items():
        text = text.replace(colour, name)
    text = re.sub(r'<svg([^>]*?) width="[^"]*"', r"<svg\1", text, count=1)
    text = re.sub(r'<svg([^>]*?) height="[^"]*"', r"<svg\1", text, count=1)
    return text.replace("<svg", f'<svg class="figure" role="img" aria-label="{title}"', 1)
