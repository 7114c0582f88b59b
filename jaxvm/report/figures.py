"""The pictures of a report: where it differed, what explains it, how well it fits afterwards."""

import io
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxvm.discover.collocation import Signal
from jaxvm.discover.diagnosis import Diagnosis, Finding
from jaxvm.discover.locate import ResidualTable
from jaxvm.physics.catalogue.entry import HYSTERESIS

BEFORE, AFTER, INK = "#c2410c", "#0f766e", "#334155"
_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
}


def figures(diagnosis: Diagnosis) -> dict[str, Figure]:
    """All figures of a report by name, in the order in which the page shows them."""
    with mpl.rc_context(_STYLE):
        made = {
            "residual_field": residual_field(diagnosis),
            "residual_marks": residual_marks(diagnosis),
            "heldout": heldout_quality(diagnosis),
            "histogram": histogram(diagnosis),
        }
        for number, finding in enumerate(diagnosis.findings, start=1):
            made[f"finding_{number}_evidence"] = evidence_figure(diagnosis, finding)
            made[f"finding_{number}_ranking"] = ranking_figure(finding)
        if diagnosis.signal is not None:
            made["signal"] = signal_figure(diagnosis.signal)
    return made


def png(figure: Figure) -> bytes:
    """A figure as a PNG file."""
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def _figure(width: float, height: float, columns: int = 1, rows: int = 1, **options):
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False, **options)


def residual_field(diagnosis: Diagnosis, cameras: int = 2, bins: int = 20) -> Figure:
    """Mean residual over the image, before and after, of the cameras with the largest excess."""
    model = diagnosis.recording.model
    square = np.sum(diagnosis.before.residual**2, axis=1) * diagnosis.before.used
    worst = np.argsort(-np.bincount(diagnosis.before.camera, square, len(model.cameras)))
    shown = worst[: min(cameras, len(model.cameras))]
    figure, axes = _figure(9.0, 3.4 * len(shown), 2, len(shown))
    for row, camera in zip(axes, shown, strict=True):
        width, height = model.cameras[camera].image_size
        edges = np.linspace(0, width, bins + 1), np.linspace(0, height, bins * height // width + 1)
        fields = [
            _binned(table, table.camera == camera, *edges)
            for table in (diagnosis.before, diagnosis.after)
        ]
        largest = max(float(np.quantile(np.hypot(*f[2:4]), 0.9)) for f in fields if f[0].size)
        arrow = width / bins / max(largest, 1e-9)
        drawn = None
        for axis, (x, y, u, v), name in zip(row, fields, ("before", "after"), strict=True):
            drawn = axis.quiver(
                x, y, u * arrow, v * arrow, np.hypot(u, v), angles="xy", scale_units="xy",
                scale=1.0, cmap="viridis", clim=(0.0, largest), width=0.004,
            )  # fmt: skip
            axis.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="u (px)")
            axis.set_title(f"camera {model.cameras[camera].name}: {name}")
        row[0].set_ylabel("v (px)")
        assert drawn is not None
        figure.colorbar(drawn, ax=list(row), label="mean residual (px)", shrink=0.85)
    return figure


def _binned(table: ResidualTable, chosen: np.ndarray, edges_u, edges_v):
    """Centre and mean residual of the image cells that hold enough points."""
    chosen = chosen & table.used
    pixel, residual = table.pixel[chosen], table.residual[chosen]
    i = np.digitize(pixel[:, 0], edges_u) - 1
    j = np.digitize(pixel[:, 1], edges_v) - 1
    inside = (i >= 0) & (i < len(edges_u) - 1) & (j >= 0) & (j < len(edges_v) - 1)
    cell = (j * (len(edges_u) - 1) + i)[inside]
    cells = (len(edges_u) - 1) * (len(edges_v) - 1)
    count = np.bincount(cell, minlength=cells)
    good = count >= 3
    columns = (*pixel[inside].T, *residual[inside].T)
    return tuple(
        (np.bincount(cell, value, cells)[good] / count[good]) if good.any() else np.zeros(0)
        for value in columns
    )


def residual_marks(diagnosis: Diagnosis, targets: int = 3) -> Figure:
    """RMS residual of every mark over the targets, before and after."""
    model = diagnosis.recording.model
    square = np.sum(diagnosis.before.residual**2, axis=1) * diagnosis.before.used
    worst = np.argsort(-np.bincount(diagnosis.before.target, square, len(model.targets)))
    shown = worst[: min(targets, len(model.targets))]
    figure, axes = _figure(9.0, 2.9 * len(shown), 2, len(shown))
    for row, target in zip(axes, shown, strict=True):
        points = model.targets[target].points[:, :2]
        maps = []
        for table in (diagnosis.before, diagnosis.after):
            own = table.used & (table.target == target)
            total = np.bincount(
                table.point[own], np.sum(table.residual[own] ** 2, axis=1), len(points)
            )
            count = np.bincount(table.point[own], minlength=len(points))
            maps.append(np.sqrt(total / np.maximum(2.0 * count, 1.0)))
        top = float(np.quantile(maps[0], 0.99))
        drawn = None
        for axis, values, name in zip(row, maps, ("before", "after"), strict=True):
            drawn = axis.scatter(
                *points.T, c=values, s=60, marker="s", cmap="magma_r", vmin=0.0, vmax=top
            )
            axis.set(aspect="equal", xlabel="x on the target (m)")
            axis.invert_yaxis()
            axis.margins(0.12)
            axis.set_title(f"target {model.targets[target].name}: {name}")
        row[0].set_ylabel("y on the target (m)")
        assert drawn is not None
        figure.colorbar(drawn, ax=list(row), label="RMS residual (px)", shrink=0.85)
    return figure


def heldout_quality(diagnosis: Diagnosis) -> Figure:
    """RMS on held-out epochs: step by step, and epoch by epoch."""
    steps = [("plain model", diagnosis.plain.heldout_rms_px)]
    for number, finding in enumerate(diagnosis.findings, start=1):
        steps.append((f"+ finding {number}", finding.gain.after_px))
    if diagnosis.signal is not None:
        steps.append((f"+ finding {len(steps)}", diagnosis.signal.gain.after_px))
    figure, axes = _figure(9.0, 3.2, 2, width_ratios=(1.0, 1.5))
    left, right = axes[0]
    colours = [BEFORE, *[AFTER] * (len(steps) - 1)]
    bars = left.bar(range(len(steps)), [v for _, v in steps], color=colours, width=0.62)
    left.bar_label(bars, fmt="%.3f", padding=2)
    left.axhline(diagnosis.noise_px, color=INK, ls=":", lw=1.0, label="noise, robust")
    left.set_xticks(range(len(steps)), [n for n, _ in steps], rotation=30 if len(steps) > 3 else 0)
    crossed = "each third foretold from the others"
    title = crossed if diagnosis.second_look else "epochs that were never fitted"
    left.set(ylabel="held-out RMS (px)", title=title)
    left.margins(y=0.35)
    left.legend(loc="upper right")
    ids = diagnosis.recording.epoch_ids[diagnosis.held]
    scale = _pixels_per_sigma(diagnosis)
    for heldout, colour, name in (
        (diagnosis.heldout_before, BEFORE, "before"),
        (diagnosis.heldout_after, AFTER, "after"),
    ):
        if len(steps) == 1 and name == "after":
            continue
        rms = np.sqrt(heldout.square / np.maximum(heldout.count, 1.0)) * scale
        right.plot(ids, rms, "o-", ms=3, lw=0.8, color=colour, label=name)
    right.axhline(diagnosis.noise_px, color=INK, ls=":", lw=1.0)
    right.set(xlabel="epoch", ylabel="RMS (px)", title="each held-out epoch", ylim=(0.0, None))
    right.legend()
    return figure


def histogram(diagnosis: Diagnosis) -> Figure:
    """Residuals before and after against the normal curve of the noise."""
    figure, axes = _figure(9.0, 2.8)
    axis: Axes = axes[0, 0]
    noise = diagnosis.noise_px
    reach = 5.0 * noise
    edges = np.linspace(-reach, reach, 81)
    tables = ((diagnosis.before, BEFORE, "before"), (diagnosis.after, AFTER, "after"))
    for table, colour, name in tables if diagnosis.findings else tables[:1]:
        values = table.residual[table.used].ravel()
        outside = float(np.mean(np.abs(values) > reach))
        label = f"{name} ({100 * outside:.2g} % beyond)"
        axis.hist(
            values, edges.tolist(), density=True, histtype="step", color=colour, lw=1.3, label=label
        )
    normal = np.exp(-0.5 * (edges / noise) ** 2) / (noise * np.sqrt(2.0 * np.pi))
    axis.plot(edges, normal, color=INK, ls=":", lw=1.0, label=f"normal, {noise:.3f} px")
    axis.set(xlabel="residual of a pixel coordinate (px)", ylabel="density (1/px)")
    axis.legend()
    return figure


def signal_figure(signal: Signal) -> Figure:
    """Mean product of the errors of two marks of one image against their distance."""
    figure, axes = _figure(9.0, 2.8)
    axis: Axes = axes[0, 0]
    distance, before, after = signal.by_distance.T
    axis.axhline(0.0, color=INK, ls=":", lw=1.0)
    axis.plot(distance, before, "o-", ms=4, color=BEFORE, label="before")
    axis.plot(distance, after, "o-", ms=4, color=AFTER, label="less what the marks around foretell")
    axis.set(
        xlabel="distance of two marks of one image (px)",
        ylabel="product of errors\n(sigma squared)",
        title="what neighbouring marks share",
    )
    axis.legend()
    return figure


def ranking_figure(finding: Finding, count: int = 10) -> Figure:
    """The leading hypotheses by evidence when the finding was made."""
    leading = finding.ranking[:count]
    figure, axes = _figure(9.0, 1.2 + 0.3 * len(leading))
    axis = axes[0, 0]
    words = [text for text, _ in leading]
    values = [value for _, value in leading]
    chosen = [AFTER if k == finding.chosen else "#94a3b8" for k in range(len(leading))]
    axis.barh(range(len(leading)), values, color=chosen, height=0.7)
    axis.set_yticks(range(len(leading)), words, fontsize=7)
    axis.invert_yaxis()
    axis.set_xlabel("evidence foretold by one tangent (twice a log posterior weight)")
    return figure


def evidence_figure(diagnosis: Diagnosis, finding: Finding) -> Figure:
    """Residuals against what drives the finding.

    For a course in time: the residuals of every fitted epoch along the effect's pattern, without
    and with the effect, over its driver. For a constant effect: the residual of each point along
    the shift that the effect gives it, over that shift; a slope of one is the effect.
    """
    scale = _pixels_per_sigma(diagnosis)
    before, after = -finding.before * scale, -finding.after * scale
    shift = before - after
    fitted = np.isfinite(shift).all(axis=1)
    if finding.effect.driver == "constant":
        return _against_shift(before[fitted], after[fitted], shift[fitted])
    return _against_driver(diagnosis, finding, before, after, shift, fitted)


def _against_shift(before, after, shift) -> Figure:
    figure, axes = _figure(9.0, 3.2)
    axis = axes[0, 0]
    size = np.linalg.norm(shift, axis=1)
    along = shift / np.maximum(size, 1e-12)[:, None]
    # Points on the u-negative side count with the opposite sign, so that the line has two ends.
    sign = np.where(shift[:, np.argmax(np.abs(shift).mean(axis=0))] < 0.0, -1.0, 1.0)
    x = sign * size
    edges = np.unique(np.quantile(x, np.linspace(0.0, 1.0, 31)))
    cell = np.clip(np.digitize(x, edges) - 1, 0, len(edges) - 2)
    count = np.bincount(cell, minlength=len(edges) - 1)
    middle = np.bincount(cell, x, len(edges) - 1) / np.maximum(count, 1)
    for residual, colour, name in ((before, BEFORE, "without"), (after, AFTER, "with")):
        y = sign * np.sum(residual * along, axis=1)
        mean = np.bincount(cell, y, len(edges) - 1) / np.maximum(count, 1)
        spread = np.sqrt(np.bincount(cell, (y - mean[cell]) ** 2, len(edges) - 1)
                         / np.maximum(count, 1) / np.maximum(count - 1, 1))  # fmt: skip
        axis.errorbar(middle, mean, spread, fmt="o", ms=3.5, lw=1.0, color=colour,
                      label=f"{name} the effect")  # fmt: skip
    reach = middle[[0, -1]]
    axis.plot(reach, reach, color=INK, ls=":", lw=1.0, label="the effect")
    axis.set(xlabel="shift that the effect gives a point (px, signed)",
             ylabel="mean residual along it (px)")  # fmt: skip
    axis.legend()
    return figure


def _against_driver(diagnosis, finding, before, after, shift, fitted) -> Figure:
    obs, recording = diagnosis.recording.observations, diagnosis.recording
    n_epochs = len(recording.time)
    key = np.stack([obs.camera, obs.target, obs.point], axis=1)
    _, place = np.unique(key, axis=0, return_inverse=True)
    place = np.ravel(place)
    table = np.zeros((n_epochs, int(place.max()) + 1, 2))
    table[obs.epoch[fitted], place[fitted]] = shift[fitted]
    # The effect's pattern: the leading direction of its shifts over points, all epochs together.
    direction = np.linalg.svd(table.reshape(n_epochs, -1), full_matrices=False)[2][0]
    direction = direction.reshape(-1, 2)[place]

    def along(values):
        product = np.sum(np.where(fitted[:, None], values, 0.0) * direction, axis=1)
        weight = np.sum(direction**2, axis=1) * fitted
        total = np.bincount(obs.epoch, weight, n_epochs)
        mean = np.bincount(obs.epoch, product, n_epochs) / np.maximum(total, 1e-300)
        typical = np.sqrt(np.sum(weight**2) / max(np.sum(weight), 1e-300))
        return np.where(total > 0.0, mean * typical, np.nan)

    channels = diagnosis.scene.network.channels
    driver = finding.effect.driver
    values = np.asarray(channels.values)[channels.index(driver)]
    x = np.interp(recording.time, np.asarray(channels.time), values)
    label = driver.replace("_", " ")
    time, unit = _readable(recording.time - recording.time[0])
    panels = [(time, f"time ({unit})")]
    if driver.startswith("time"):
        x, unit = _readable(x)
        label = f"{label} ({unit})"
    if driver != "time":
        panels.insert(0, (x, label))
    figure, axes = _figure(9.0, 3.2, len(panels))
    for axis, (over, name) in zip(axes[0], panels, strict=True):
        order = np.argsort(over)
        loop = finding.effect.form in (*HYSTERESIS, "direction", "lag", "delay", "two lags", "rate")
        line = slice(None) if loop else order
        axis.plot(over, along(before), "o", ms=3.5, color=BEFORE, label="without the effect")
        axis.plot(over, along(after), "o", ms=2.5, color=AFTER, label="with the effect")
        curve = along(shift)[line]
        drawn = np.isfinite(curve)
        axis.plot(over[line][drawn], curve[drawn], color=INK, lw=0.9, label="the effect")
        axis.set(xlabel=name, ylabel="residual along the effect (px)")
    axes[0, 0].legend(fontsize=8)
    return figure


def _readable(seconds: np.ndarray) -> tuple[np.ndarray, str]:
    """Times in the unit that suits their span, and the unit."""
    span = float(np.ptp(seconds))
    unit, name = next(
        ((u, n) for u, n in ((3600.0, "h"), (60.0, "min")) if span > 3 * u), (1.0, "s")
    )
    return seconds / unit, name


def _pixels_per_sigma(diagnosis: Diagnosis) -> float:
    """The sigma (px) for which whitened residuals are quoted."""
    values, counts = np.unique(diagnosis.recording.observations.sigma, return_counts=True)
    return float(values[np.argmax(counts)])
