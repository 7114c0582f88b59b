"""A relay station of m cameras calibrated in pairs: gain of the adjusted pairs over the plain ones.

Isotropic: all cameras in one place, any attitude; the adjusted variance of a pair is the effective
resistance of the graph of pairs, 2 / m with all of them. Realistic: cameras around a platform of
0.6 m across, each pair calibrated with a tilted plate 3 m before both (all correlations of its
picture), so that turns and shifts mix through the lever arms.

Each trial draws the calibrations, adjusts them parametrically (`adjust_relay`) and compares with
the truth; some are adjusted under the loop conditions too (`adjust_conditions`).
"""

from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from intervals import bars, gain, words
from marks import isotropic, pictured, relative
from matplotlib.figure import Figure

from jaxvm.network.cycles import fundamental_cycles
from jaxvm.network.graph import PoseGraph
from jaxvm.network.redundancy import effective_resistance
from jaxvm.pose.chains import Link, drawn, pose_error
from jaxvm.pose.relay import adjust_relay, all_pairs, pair_variance
from jaxvm.solve.condition import adjust_conditions

SEED = 3
PLANS = ("all pairs", "ring and next but one", "ring")
COUNTS = {
    "all pairs": (2, 3, 4, 5, 6, 8, 10, 12),
    "ring and next but one": (6, 8, 10, 12),
    "ring": (4, 6, 8, 12),
}


def pairs_of(plan: str, m: int) -> np.ndarray:
    """Pairs of m cameras that are calibrated."""
    if plan == "all pairs":
        return all_pairs(m)
    reach = 1 if plan == "ring" else 2
    listed = {tuple(sorted((a, (a + d) % m))) for a in range(m) for d in range(1, reach + 1)}
    return np.array(sorted(pair for pair in listed if pair[0] != pair[1]))


def ideal(m: int, pairs: np.ndarray) -> Link:
    """Cameras in one place, 0.1 mrad and 0.1 mm each way."""
    rng = np.random.default_rng(m)
    own = np.hstack([rng.normal(0.0, 1.0, (m, 3)), np.zeros((m, 3))])
    spread = jnp.broadcast_to(jnp.asarray(isotropic(1e-4, 1e-4)), (len(pairs), 6, 6))
    return Link(jnp.asarray(relative(own[pairs])), spread)


def realistic(m: int, pairs: np.ndarray) -> Link:
    """Cameras around a platform that look outward; a plate 3 m before the middle of each pair."""
    angle = 2.0 * np.pi * np.arange(m) / m
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(m)], axis=1)
    own = np.concatenate([np.zeros((m, 2)), angle[:, None], 0.3 * out], axis=1)
    ends = own[pairs]
    ahead = out[pairs].sum(axis=1)
    # A pair that looks in opposite directions is calibrated sideways.
    opposed = np.linalg.norm(ahead, axis=1) < 0.5
    ahead[opposed] = np.cross([0.0, 0.0, 1.0], out[pairs[opposed, 0]])
    place = ends[..., 3:].mean(axis=1) + 3.0 * ahead / np.linalg.norm(ahead, axis=1)[:, None]
    # Of the plate each camera has axes of its own, x along its line of sight.
    line = place[:, None] - ends[..., 3:]
    heading = np.arctan2(line[..., 1], line[..., 0])
    plates = np.zeros((*pairs.shape, 6))
    plates[..., 2], plates[..., 3:] = heading, place[:, None]
    seen = [relative(np.stack([ends[:, k], plates[:, k]], axis=1)) for k in (0, 1)]
    turned = relative(plates)

    def pair(first, between, second):
        exact = Link(between, jnp.zeros((6, 6)))
        return Link(first, picture).then(exact).then(Link(second, picture).back())

    picture = jnp.asarray(pictured(3.0))
    return jax.jit(jax.vmap(pair))(*map(jnp.asarray, (seen[0], turned, seen[1])))


SETUPS = {"isotropic, one place": ideal, "plates at 3 m, 0.6 m across": realistic}


@cache
def trial_errors(plan: str, m: int):
    """Of links and keys: errors of plain and adjusted pairs.

    Turn (rad) and position (m) in the axes of each pair's first camera, [trials, pairs, 6].
    """
    pairs = pairs_of(plan, m)

    def once(links, key):
        measured = drawn(links, key)
        adjusted = adjust_relay(pairs, measured).links(pairs)
        return tuple(
            jax.vmap(pose_error)(pose, links.pose) for pose in (measured.pose, adjusted.pose)
        )

    def all_trials(links, keys):
        return jax.lax.map(lambda key: once(links, key), keys, batch_size=100)

    return jax.jit(all_trials)


def graph_of(m: int, pairs: np.ndarray, links: Link) -> PoseGraph:
    """The same calibrations as a graph."""
    return PoseGraph(
        tuple(f"camera {i}" for i in range(m)), pairs, tuple(f"{a}-{b}" for a, b in pairs),
        np.asarray(links.pose), np.asarray(links.covariance), np.zeros(1, int),
    )  # fmt: skip


def disagreement(m: int, pairs: np.ndarray, links: Link, keys) -> dict:
    """Largest difference of condition and parametric adjustment on the same draws.

    Of the twist between the two adjusted poses of each pair: rad, m, and standard deviations.
    """
    worst = {"turn_rad": 0.0, "shift_m": 0.0, "deviations": 0.0}
    sigma = np.sqrt(np.diagonal(np.asarray(links.covariance), axis1=1, axis2=2))
    for key in keys:
        own = drawn(links, key)
        graph = graph_of(m, pairs, own)
        conditions = adjust_conditions(graph, fundamental_cycles(graph))
        parametric = adjust_relay(pairs, own).links(pairs)
        off = np.abs(jax.vmap(pose_error)(jnp.asarray(conditions.pose), parametric.pose))
        found = (off[:, :3].max(), off[:, 3:].max(), (off / sigma).max())
        worst = {n: max(x, float(y)) for (n, x), y in zip(worst.items(), found, strict=True)}
    return worst


def one(setup: str, plan: str, m: int, trials: int, compared: int) -> dict:
    """Gains of one station: RMS over its pairs, plain over adjusted."""
    pairs = pairs_of(plan, m)
    links = SETUPS[setup](m, pairs)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(SEED), m), trials)
    plain, adjusted = (np.asarray(x) for x in trial_errors(plan, m)(links, keys))
    theory = np.asarray(adjust_relay(pairs, links).links(pairs).covariance)
    row = {"setup": setup, "plan": plan, "m": m, "pairs": len(pairs)}
    for name, part in (("turn", slice(0, 3)), ("shift", slice(3, 6))):
        before, after = (np.mean(x[..., part] ** 2, axis=(1, 2)) for x in (plain, adjusted))
        variances = [
            np.mean(np.diagonal(np.asarray(x), axis1=1, axis2=2)[:, part])
            for x in (links.covariance, theory)
        ]
        row[f"{name}_gain"] = gain(before, after)
        row[f"{name}_predicted"] = float(np.sqrt(variances[0] / variances[1]))
        row[f"{name}_plain"] = float(np.sqrt(variances[0]))
    graph = graph_of(m, pairs, links)
    resistance = [effective_resistance(graph, a, b, np.ones(len(pairs))) for a, b in pairs]
    row["by_resistance"] = float(1.0 / np.sqrt(np.mean(resistance)))
    if plan == "all pairs":
        row["by_two_over_m"] = pair_variance(m) ** -0.5
    if compared and len(pairs) >= m:
        row["disagreement"] = disagreement(m, pairs, links, keys[:compared])
    return row


def study(most: int, trials: int, compared: int) -> dict:
    """All setups, plans and numbers of cameras."""
    rows = [
        one(setup, plan, m, trials, compared if plan == "all pairs" else 0)
        for setup in SETUPS
        for plan in PLANS
        for m in COUNTS[plan]
        if m <= most
    ]
    return {"seed": SEED, "trials": trials, "compared": compared, "rows": rows}


def table(results: dict) -> str:
    """Gains, measured beside predicted."""
    lines = [
        "| cameras | pairs | calibrated | station | √(m/2) | turn: theory | Monte Carlo, 95 % |"
        " shift: theory | Monte Carlo, 95 % |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        if row["m"] in (2, 3, 4, 6, 8, 12) and (row["plan"] == "all pairs" or row["m"] in (6, 12)):
            own = f"{row['by_two_over_m']:.4f}" if "by_two_over_m" in row else ""
            lines.append(
                f"| {row['m']} | {row['pairs']} | {row['plan']} | {row['setup']} | {own} | "
                f"{row['turn_predicted']:.4f} | {words(row['turn_gain'])} | "
                f"{row['shift_predicted']:.4f} | {words(row['shift_gain'])} |"
            )
    worst = worst_disagreement(results)
    lines += [
        "",
        f"Condition and parametric adjustment on the same draws ({results['compared']} of every "
        f"station with all pairs): poses differ by at most {worst['turn_rad']:.1e} rad, "
        f"{worst['shift_m']:.1e} m, {worst['deviations']:.1e} standard deviations of a "
        "calibration.",
    ]
    return "\n".join(lines)


def worst_disagreement(results: dict) -> dict:
    """Over all stations."""
    listed = [row["disagreement"] for row in results["rows"] if "disagreement" in row]
    return {name: max(own[name] for own in listed) for name in listed[0]}


def figure(results: dict, file: Path) -> None:
    """Gain against the number of cameras, by plan; turns, and shifts of the realistic station."""
    panels = [
        ("isotropic, one place", "turn", "isotropic, one place: turn and shift alike"),
        ("plates at 3 m, 0.6 m across", "turn", "plates, 0.6 m across: turn"),
        ("plates at 3 m, 0.6 m across", "shift", "plates, 0.6 m across: shift"),
    ]
    drawn = Figure(figsize=(11.5, 4.0), layout="constrained")
    colours = dict(zip(PLANS, ("#0f766e", "#1d4ed8", "#c2410c"), strict=True))
    axes = drawn.subplots(1, 3)
    axes[2].sharey(axes[1])
    for axis, (setup, quantity, title) in zip(axes, panels, strict=True):
        m = np.linspace(2, max(row["m"] for row in results["rows"]), 100)
        axis.plot(m, np.sqrt(m / 2), "--", color="0.4", lw=1.0, zorder=4, label="√(m/2)")
        for plan, colour in colours.items():
            rows = [r for r in results["rows"] if (r["setup"], r["plan"]) == (setup, plan)]
            own = {n: [r[f"{quantity}_gain"][n] for r in rows] for n in ("value", "low", "high")}
            x = [r["m"] for r in rows]
            axis.plot(x, [r[f"{quantity}_predicted"] for r in rows], "-", color=colour, label=plan)
            axis.errorbar(x, own["value"], bars(own), fmt=".", color="k", ms=4, capsize=2.5,
                          zorder=3)  # fmt: skip
        axis.set(xlabel="cameras of the station", title=title)
        axis.title.set_fontsize(10)
        axis.grid(alpha=0.25)
    axis.errorbar([], [], [], fmt=".", color="k", ms=4, capsize=2.5, label="Monte Carlo, 95 %")
    handles, names = axis.get_legend_handles_labels()
    drawn.legend(handles, names, loc="outside upper center", ncols=5, fontsize=9, frameon=False)
    axes[0].set_ylabel("RMS of plain pairs / adjusted")
    drawn.savefig(file, dpi=120)
