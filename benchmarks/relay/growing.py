"""How errors grow along a chain: closed form, first-order covariance, Monte Carlo.

Straight chains of up to 20 links of 10 m, of isotropic links and of planar plates. For plates the
closed form takes the tilt as the turn that has a lever. First order knows no shortening: a chain
whose turns wander by angles of variance sum s^2 ends short by L s^2 n (n - 1) / 2 on average (two
axes), which for frontal plates is more than their depth errors.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from intervals import bars, rms, words
from marks import FRONTAL, LENGTH, TILTED, equal_links, isotropic
from matplotlib.figure import Figure

from jaxvm.pose.chains import growth, simulate, straight_growth

SEED = 1
KINDS = {
    # name: covariance of a link; turn with a lever (rad), across, along the line of sight (m)
    "isotropic": (isotropic(20e-6, 0.2e-3), 20e-6, 0.2e-3, 0.2e-3),
    "tilted plates": (TILTED.covariance(), TILTED.tilt, TILTED.lateral, TILTED.depth),
    "frontal plates": (FRONTAL.covariance(), FRONTAL.tilt, FRONTAL.lateral, FRONTAL.depth),
}
QUANTITIES = {"turn": ("turn across", 1e6, "µrad"), "lateral": ("across", 1e3, "mm"),
              "axial": ("along", 1e3, "mm")}  # fmt: skip


def one(kind: str, longest: int, trials: int) -> dict:
    """Deviations of every station of one chain, by the three ways (rad, m)."""
    covariance, tilt, across, along = KINDS[kind]
    links = equal_links(longest, (LENGTH, 0.0, 0.0), covariance)
    first = growth(links)
    n = np.arange(1, longest + 1)
    turn, lateral, _ = jax.vmap(lambda n: jnp.stack(straight_growth(n, LENGTH, tilt, across)))(n).T
    axial = jax.vmap(lambda n: straight_growth(n, LENGTH, tilt, along)[2])(n)
    key = jax.random.fold_in(jax.random.key(SEED), list(KINDS).index(kind))
    error = np.asarray(simulate(links, key, trials).error)
    squares = {
        "turn": np.mean(error[..., 1:3] ** 2, axis=-1),
        "lateral": np.mean(error[..., 4:] ** 2, axis=-1),
        "axial": error[..., 3] ** 2,
    }
    predicted = {
        "turn": np.sqrt(np.mean(np.asarray(first.turn)[:, 1:] ** 2, axis=1)),
        "lateral": first.lateral,
        "axial": first.axial,
    }
    closed = {"turn": turn, "lateral": lateral, "axial": axial}
    return {
        "kind": kind,
        "n": n.tolist(),
        "closed": {name: np.asarray(x).tolist() for name, x in closed.items()},
        "first_order": {name: np.asarray(x).tolist() for name, x in predicted.items()},
        "measured": {name: rms(x) for name, x in squares.items()},
        "shortening": {
            "predicted": (-LENGTH * tilt**2 * n * (n - 1) / 2).tolist(),
            "measured": error[..., 3].mean(axis=0).tolist(),
            "standard_error": (error[..., 3].std(axis=0) / trials**0.5).tolist(),
        },
    }


def study(longest: int, trials: int) -> dict:
    """All chains."""
    rows = [one(kind, longest, trials) for kind in KINDS]
    for row in rows:
        off = [
            np.max(np.abs(np.divide(row["first_order"][q], row["closed"][q]) - 1.0))
            for q in QUANTITIES
        ]
        row["closed_form_off_first_order"] = float(max(off))
    return {"seed": SEED, "trials": trials, "length_m": LENGTH, "rows": rows}


def table(results: dict) -> str:
    """Deviations at three lengths, measured beside predicted."""
    lines = [
        "| links | n | quantity | closed form | first order | Monte Carlo, 95 % | in interval |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        for n in (5, 10, 20):
            if n > len(row["n"]):
                continue
            for q, (name, unit, symbol) in QUANTITIES.items():
                own = {x: unit * np.asarray(y)[n - 1] for x, y in row["measured"][q].items()}
                first = unit * row["first_order"][q][n - 1]
                lines.append(
                    f"| {row['kind']} | {n} | {name} ({symbol}) | "
                    f"{unit * row['closed'][q][n - 1]:.4g} | {first:.4g} | {words(own)} | "
                    f"{'yes' if own['low'] <= first <= own['high'] else 'no'} |"
                )
    last = results["rows"][-1]["shortening"]
    lines += [
        "",
        f"Mean shortening of {len(results['rows'][-1]['n'])} links of frontal plates, which first "
        f"order does not know: {1e3 * last['measured'][-1]:.2f} ± "
        f"{1e3 * last['standard_error'][-1]:.2f} mm measured, {1e3 * last['predicted'][-1]:.2f} mm "
        "by L s² n (n - 1) / 2.",
    ]
    return "\n".join(lines)


def figure(results: dict, file: Path) -> None:
    """Angle, across, along, against the number of links; below, measured over first order."""
    drawn = Figure(figsize=(11.5, 6.2), layout="constrained")
    axes = drawn.subplots(2, 3, sharex=True, height_ratios=(2.0, 1.0))
    colours = dict(zip(KINDS, ("#0f766e", "#1d4ed8", "#c2410c"), strict=True))
    for (q, (name, unit, symbol)), (axis, below) in zip(QUANTITIES.items(), axes.T, strict=True):
        for row, aside in zip(results["rows"], (-0.22, 0.0, 0.22), strict=True):
            n, colour = np.array(row["n"]), colours[row["kind"]]
            first, own = np.array(row["first_order"][q]), row["measured"][q]
            axis.plot(n, unit * first, "-", color=colour, lw=1.2)
            axis.plot(n, unit * np.array(row["closed"][q]), "s", color=colour, mfc="none", ms=6)
            axis.plot(n, unit * np.array(own["value"]), "k.", ms=5, zorder=3)
            below.errorbar(n + aside, np.array(own["value"]) / first, bars(own) / first, fmt=".",
                           ms=3, color=colour, elinewidth=1.0)  # fmt: skip
        axis.set(ylabel=f"{name} ({symbol})", yscale="log")
        below.axhline(1.0, color="k", lw=0.8)
        below.set(xlabel="links", ylabel="measured / first order", ylim=(0.96, 1.04),
                  xticks=range(0, len(n) + 1, 5))  # fmt: skip
        for part in (axis, below):
            part.grid(alpha=0.25)
        if q == "axial":
            row = results["rows"][-1]
            both = np.hypot(row["first_order"]["axial"], _shortening(row["n"]))
            axis.plot(n, unit * both, ":", color=colours[row["kind"]], lw=1.5)
            below.text(0.98, 0.96, "frontal: above the frame from 3 links", fontsize=8,
                       ha="right", va="top", transform=below.transAxes)  # fmt: skip
    handles = [axis.plot([], [], "-", color=c, label=kind)[0] for kind, c in colours.items()]
    handles += [
        axis.plot([], [], "-", color="0.5", label="first-order covariance")[0],
        axis.plot([], [], "s", color="0.5", mfc="none", label="closed form")[0],
        axis.plot([], [], "k.", label="Monte Carlo (below: with 95 %)")[0],
        axis.plot([], [], ":", color=colours["frontal plates"], label="with second order")[0],
    ]
    drawn.legend(handles=handles, loc="outside upper center", ncols=7, fontsize=8.5, frameon=False)
    drawn.savefig(file, dpi=120)


def _shortening(n) -> np.ndarray:
    """RMS of the shortening of n frontal links: L / 2 times the sum of two squared random walks.

    With w_i the turn after i links, E[w_i^2 w_j^2] = s^4 (i j + 2 min(i, j)^2) for each axis, and
    the two axes are independent.
    """
    s, out = FRONTAL.tilt, []
    for count in n:
        i = np.arange(1, count)
        same = np.minimum.outer(i, i) ** 2
        square = np.sum(4 * np.multiply.outer(i, i) + 4 * same)
        out.append(0.5 * LENGTH * s**2 * np.sqrt(square))
    return np.array(out)
