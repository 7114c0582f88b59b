"""Loops, effective resistance, and Monte Carlo of whole networks: adjusted against unadjusted.

Unadjusted is what one has without an adjustment: every station by the best path from the first
(least sum of variances), in the same draws. Networks are scenes of stations that links alone join,
adjusted by `jaxvm.montecarlo`; a few draws of each are adjusted under the conditions of its
cycles too.

Links are isotropic (20 µrad, 0.2 mm), tilted plates as far away as the stations are apart, or such
plates both ways (a camera and a plate at either end).
"""

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from intervals import bars, gain, words
from marks import TILTED, isotropic, relative
from matplotlib.figure import Figure
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import Delaunay
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxvm.geometry import pose_from_vector, so3_log
from jaxvm.montecarlo import montecarlo
from jaxvm.network.cycles import fundamental_cycles
from jaxvm.network.draw import drawn as drawn_network
from jaxvm.network.graph import (
    PoseGraph,
    chain_poses,
    compose,
    n_conditions,
    shortest_path_tree,
)
from jaxvm.network.redundancy import effective_resistance
from jaxvm.network.scene import Scene, build
from jaxvm.pose.chains import Link, drawn, pose_error
from jaxvm.pose.relay import adjust_relay
from jaxvm.recording.model import Model, Station
from jaxvm.recording.recording import Links, Recording, no_observations
from jaxvm.solve.condition import adjust_conditions

SEED = 4
KINDS = ("isotropic", "plates", "plates both ways")
LAYOUTS = ("ring with chords", "ladder", "grid", "random")


# Loops and resistors


def loop(n: int, trials: int) -> dict:
    """Adjusted over plain variance of neighbours in a loop of n equal links: 1 - 1 / n."""
    pairs = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    link = Link(jnp.zeros((n, 6)), jnp.broadcast_to(1e-8 * jnp.eye(6), (n, 6, 6)))
    first = np.asarray(adjust_relay(pairs, link).links(pairs).covariance)
    half = n // 2
    far = adjust_relay(pairs, link).between(0, half).covariance
    squares = _relay_squares(pairs, link, trials)
    ratio = gain(squares, np.full(len(squares), 1e-8))
    return {
        "n": n,
        "closed": 1.0 - 1.0 / n,
        "first_order": float(np.mean(np.diagonal(first, axis1=1, axis2=2)) / 1e-8),
        "measured": {name: x**2 for name, x in ratio.items()},
        "far_closed": half * (n - half) / n,
        "far_first_order": float(np.trace(far) / 6e-8),
    }


def _relay_squares(pairs: np.ndarray, links: Link, trials: int) -> np.ndarray:
    """Mean squares of the errors of all adjusted pairs, by trial."""

    def once(key):
        adjusted = adjust_relay(pairs, drawn(links, key)).links(pairs)
        return jnp.mean(jax.vmap(pose_error)(adjusted.pose, links.pose) ** 2)

    keys = jax.random.split(jax.random.key(SEED), trials)
    return np.asarray(jax.jit(lambda keys: jax.lax.map(once, keys, batch_size=100))(keys))


def resistors(n: int, trials: int) -> dict:
    """A random network without levers: adjusted variances of all its pairs are resistances."""
    place = layout("random", n)
    pairs = place.edges
    rng = np.random.default_rng(SEED)
    own = np.hstack([rng.normal(0.0, 1.0, (n, 3)), np.zeros((n, 3))])
    variance = 1e-8 * rng.uniform(0.25, 4.0, len(pairs))
    links = Link(
        jnp.asarray(relative(own[pairs])), jnp.asarray(variance)[:, None, None] * jnp.eye(6)
    )
    graph = PoseGraph(
        tuple(map(str, range(n))), pairs, tuple(map(str, range(len(pairs)))),
        np.asarray(links.pose), np.asarray(links.covariance), np.zeros(1, int),
    )  # fmt: skip
    every = np.stack(np.triu_indices(n, 1), axis=1)
    spread = np.asarray(adjust_relay(pairs, links).links(every).covariance)
    adjusted = np.diagonal(spread, axis1=1, axis2=2)
    resistance = np.array([effective_resistance(graph, a, b, variance) for a, b in every])
    at_edges = np.array([effective_resistance(graph, a, b, variance) for a, b in pairs])
    squares = _relay_squares(pairs, links, trials)
    return {
        "stations": n,
        "links": len(pairs),
        "largest_relative_difference": float(np.max(np.abs(adjusted / resistance[:, None] - 1.0))),
        "measured_over_resistance": gain(squares, np.full(len(squares), at_edges.mean())),
    }


# Whole networks


@dataclass(frozen=True, eq=False)
class Layout:
    """Where stations stand (m), how they are turned, and which of them see each other."""

    pose: np.ndarray
    edges: np.ndarray


def layout(name: str, n: int) -> Layout:
    """Stations about 10 m apart, turned about the vertical at random."""
    rng = np.random.default_rng(LAYOUTS.index(name))
    if name == "ring with chords":
        angle = 2.0 * np.pi * np.arange(n) / n
        radius = 10.0 / (2.0 * np.sin(np.pi / n))
        at = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        edges = [(a, (a + 1) % n) for a in range(n)] + [
            (a, a + n // 2) for a in range(0, n // 2, 3)
        ]
    elif name == "ladder":
        at = np.array([(10.0 * (k // 2), 4.0 * (k % 2)) for k in range(n)])
        edges = [(k, k + 2) for k in range(n - 2)] + [(k, k + 1) for k in range(0, n, 2)]
    elif name == "grid":
        wide = int(np.sqrt(n))
        at = 10.0 * np.stack(np.divmod(np.arange(n), wide), axis=1)
        near = cdist(at, at, "cityblock") == 10.0
        edges = np.argwhere(np.triu(near)).tolist()
    else:
        at = _scattered(rng, n)
        edges = _seen(at)
    height = rng.normal(0.0, 1.0, n)
    turn = np.stack([np.zeros(n), np.zeros(n), rng.uniform(-np.pi, np.pi, n)], axis=1)
    edges = np.array(edges)
    # Which of the two ends carries the plate is a matter of chance.
    edges = np.where(rng.random(len(edges))[:, None] < 0.5, edges, edges[:, ::-1])
    return Layout(np.column_stack([turn, at, height]), edges)


def _scattered(rng, n: int) -> np.ndarray:
    """Random places, 100 m^2 for each, none nearer than 4 m to another."""
    at = np.zeros((0, 2))
    while len(at) < n:
        place = rng.uniform(0.0, 10.0 * np.sqrt(n), (1, 2))
        if not len(at) or cdist(place, at).min() > 4.0:
            at = np.concatenate([at, place])
    return at


def _seen(at: np.ndarray) -> list[tuple[int, int]]:
    """Neighbours of a triangulation: those that join all stations, and the nearer half."""
    tri = Delaunay(at).simplices
    pairs = np.unique(np.sort(tri[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    length = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
    tree = minimum_spanning_tree(coo_array((length, tuple(pairs.T)), shape=(len(at),) * 2))
    needed = {tuple(sorted(pair)) for pair in np.argwhere(tree.toarray() > 0).tolist()}
    return [
        (int(a), int(b)) for (a, b), far in zip(pairs, length, strict=True)
        if far < np.median(length) or (a, b) in needed
    ]  # fmt: skip


def network(name: str, n: int, kind: str) -> tuple[Scene, PoseGraph]:
    """The scene at its true state, and its links as a graph."""
    place = layout(name, n)
    edges = place.edges
    if kind == "plates both ways":
        edges = np.concatenate([edges, edges[:, ::-1]])
    pose = relative(place.pose[edges])
    spread = np.array([_covariance(kind, own) for own in pose])
    names = tuple(f"{k}: {a}-{b}" for k, (a, b) in enumerate(edges))
    stations = tuple(
        Station(f"s{i}", "static", own, frozenset({"pose"}) if i else frozenset())
        for i, own in enumerate(place.pose)
    )
    links = Links(
        name=names, from_node=[("station", int(a)) for a in edges[:, 0]],
        to_node=[("station", int(b)) for b in edges[:, 1]], pose=pose, covariance=spread,
        epoch=np.full(len(edges), -1),
    )  # fmt: skip
    recording = Recording(
        Model("network", (), stations, ()), np.zeros(1, int), np.zeros(1), {}, no_observations(),
        links=links, timed=False,
    )  # fmt: skip
    graph = PoseGraph(tuple(s.name for s in stations), edges, names, pose, spread, np.zeros(1, int))
    return build(recording), graph


def _covariance(kind: str, pose: np.ndarray) -> np.ndarray:
    if kind == "isotropic":
        return isotropic(20e-6, 0.2e-3)
    # The line of sight in the axes of the plate's station.
    sight = Rotation.from_rotvec(pose[:3]).inv().apply(pose[3:])
    return TILTED.at(np.linalg.norm(pose[3:])).covariance(sight)


def errors_of(truth):
    """For `montecarlo`: turn from the truth and position of all stations but the first."""

    def quantity(state):
        def one(own, true):
            turn = pose_from_vector(true).rotation.T @ pose_from_vector(own).rotation
            return jnp.concatenate([so3_log(turn), own[3:]])

        return jax.vmap(one)(state.world_from_station[1:], truth[1:])

    return quantity


def one(name: str, n: int, kind: str, trials: int, compared: int) -> dict:
    """Gain, measured over predicted, chi-square of one network."""
    scene, graph = network(name, n, kind)
    key = jax.random.fold_in(jax.random.key(SEED), 10 * LAYOUTS.index(name) + KINDS.index(kind))
    truth = scene.state.world_from_station
    found = montecarlo(scene, errors_of(truth), key, trials)
    own = found.errors.reshape(-1, n - 1, 6)
    draws = _draws(scene, key, trials)
    worst = _disagreement(graph, draws[~found.failed][:compared], np.array(truth), own)
    tree = shortest_path_tree(graph, 0)
    plain = _chained(graph, draws[~found.failed], np.array(truth), tree)
    path_variance = np.array(
        [np.diagonal(_far_covariance(graph, tree, node))[3:].mean() for node in range(1, n)]
    )
    shift_variance = np.diagonal(found.covariance).reshape(n - 1, 6)[:, 3:].mean(axis=1)
    before, after = (np.mean(x[..., 3:] ** 2, axis=2) for x in (plain, own))
    far = int(np.argmax(path_variance))
    dimension = found.errors.shape[1]
    count = len(own) * dimension
    bounds = chi2.ppf([0.025, 0.975], count) / count
    freedom = found.degrees_of_freedom
    station = np.sqrt(after.mean(axis=0) / shift_variance)
    return {
        "layout": name,
        "stations": n,
        "links": len(graph.edges),
        "cycles": n_conditions(graph),
        "kind": kind,
        "failed": int(found.failed.sum()),
        "gain": gain(before.mean(axis=1), after.mean(axis=1)),
        "gain_predicted": float(np.sqrt(path_variance.mean() / shift_variance.mean())),
        "far_gain": gain(before[:, far], after[:, far]),
        "far_gain_predicted": float(np.sqrt(path_variance[far] / shift_variance[far])),
        "turn_gain": gain(*(np.mean(x[..., :3] ** 2, axis=(1, 2)) for x in (plain, own))),
        "rms_mm": 1e3 * float(np.sqrt(after.mean())),
        "measured_over_predicted": gain(
            after.mean(axis=1), np.full(len(after), shift_variance.mean())
        ),
        "path_measured_over_predicted": gain(
            before.mean(axis=1), np.full(len(before), path_variance.mean())
        ),
        "stations_measured_over_predicted": [float(station.min()), float(station.max())],
        "chi_square": found.chi_square,
        "chi_square_bounds": bounds.tolist(),
        "cost_over_freedom": gain(2.0 * found.cost, np.full(len(found.cost), float(freedom))),
        "disagreement": worst,
    }


def _draws(scene: Scene, key, trials: int) -> np.ndarray:
    """Measured links of every trial: those that `montecarlo` draws."""
    keys = jax.vmap(lambda k: jax.random.fold_in(key, k))(jnp.arange(trials))

    def once(key):
        return drawn_network(scene.network, scene.state, key).links.measured

    return np.asarray(jax.jit(jax.vmap(once))(keys))


def _chained(graph: PoseGraph, draws, truth, tree) -> np.ndarray:
    """Errors along the best paths, in the measure of `errors_of`."""
    poses = np.array([chain_poses(replace(graph, pose=own), truth[:1], tree) for own in draws])
    return _off(poses[:, 1:], truth[1:])


def _off(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    true = Rotation.from_rotvec(truth[:, :3]).inv()
    turn = [(true * Rotation.from_rotvec(own)).as_rotvec() for own in poses[..., :3]]
    return np.concatenate([np.array(turn), poses[..., 3:] - truth[:, 3:]], axis=-1)


def _far_covariance(graph: PoseGraph, tree, node: int) -> np.ndarray:
    """Of turn and position along the best path; the trace of each does not depend on the axes."""
    return compose(graph, tree.way_to(node))[1]


def _disagreement(graph: PoseGraph, draws, truth, errors) -> dict:
    """Condition adjustment of the same draws against the poses of `montecarlo`."""
    worst, cycles, tree = np.zeros(2), fundamental_cycles(graph), shortest_path_tree(graph, 0)
    for own, error in zip(draws, errors, strict=False):
        conditions = adjust_conditions(replace(graph, pose=own), cycles)
        # Corrected links close every cycle, so that any tree gives the poses of the nodes.
        off = _chained(graph, [conditions.pose], truth, tree)[0] - error
        worst = np.maximum(worst, [np.abs(off[:, :3]).max(), np.abs(off[:, 3:]).max()])
    return {"turn_rad": float(worst[0]), "shift_m": float(worst[1])}


def study(sizes: dict[str, int], loops: tuple[int, ...], trials: int, compared: int) -> dict:
    """Loops, resistors and all networks."""
    return {
        "seed": SEED,
        "trials": trials,
        "compared": compared,
        "loops": [loop(n, trials) for n in loops],
        "resistors": resistors(sizes["random"] // 2, trials),
        "rows": [
            one(name, sizes[name], kind, trials, compared) for name in sizes for kind in KINDS
        ],
    }


def table(results: dict) -> str:
    """Loops, then networks."""
    lines = ["| loop of n | 1 - 1/n | adjusted variance | Monte Carlo, 95 % | n/2 apart: closed |"
             " adjusted |", "|---|---|---|---|---|---|"]  # fmt: skip
    lines += [
        f"| {row['n']} | {row['closed']:.4f} | {row['first_order']:.4f} | "
        f"{words(row['measured'])} | {row['far_closed']:.3f} | {row['far_first_order']:.3f} |"
        for row in results["loops"]
    ]
    own = results["resistors"]
    lines += [
        "",
        f"Random network of {own['stations']} stations and {own['links']} links without levers: "
        "adjusted variances of all pairs and axes differ from effective resistance by at most "
        f"{own['largest_relative_difference']:.1e}; Monte Carlo over theory "
        f"{words(own['measured_over_resistance'])}.",
        "",
        "| network | stations, links, cycles | links | gain over best path, 95 % | theory |"
        " farthest station | theory | adjusted mm | measured / predicted | chi-square |"
        " cost / freedom |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        low, high = row["chi_square_bounds"]
        squared = {n: x**2 for n, x in row["cost_over_freedom"].items()}
        lines.append(
            f"| {row['layout']} | {row['stations']}, {row['links']}, {row['cycles']} | "
            f"{row['kind']} | {words(row['gain'])} | {row['gain_predicted']:.3f} | "
            f"{words(row['far_gain'])} | {row['far_gain_predicted']:.3f} | "
            f"{row['rms_mm']:.3f} | {words(row['measured_over_predicted'])} | "
            f"{row['chi_square']:.4f} ({low:.4f} to {high:.4f}) | {words(squared)} |"
        )
    worst = [max(r["disagreement"][n] for r in results["rows"]) for n in ("turn_rad", "shift_m")]
    lines += [
        "",
        f"Condition adjustment of {results['compared']} draws of each network gives the poses of "
        f"the parametric adjustment to {worst[0]:.1e} rad and {worst[1]:.1e} m.",
        f"Trials that did not converge: {sum(row['failed'] for row in results['rows'])}.",
    ]
    return "\n".join(lines)


def figure(results: dict, file: Path) -> None:
    """Gain over the best path, measured over predicted, chi-square."""
    drawn_ = Figure(figsize=(11.5, 4.6), layout="constrained")
    axes = drawn_.subplots(1, 3, sharey=True, width_ratios=(1.5, 1.0, 1.0))
    colours = dict(zip(KINDS, ("#0f766e", "#c2410c", "#1d4ed8"), strict=True))
    for k, row in enumerate(results["rows"]):
        at = -(k // len(KINDS)) - 0.22 * (k % len(KINDS))
        colour = colours[row["kind"]]
        axes[0].barh(at, row["gain_predicted"] - 0.9, 0.18, 0.9, color=colour, alpha=0.35)
        for axis, value in zip(axes, ("gain", "measured_over_predicted"), strict=False):
            axis.errorbar(row[value]["value"], at, xerr=bars(row[value])[:, None], fmt=".",
                          color="k" if value == "gain" else colour, capsize=3)  # fmt: skip
        low, high = row["chi_square_bounds"]
        axes[2].plot([low, high], [at, at], "-", color=colour, lw=5, alpha=0.35)
        axes[2].plot(row["chi_square"], at, "k.")
    names = [
        f"{row['layout']}\n{row['stations']} stations" for row in results["rows"][:: len(KINDS)]
    ]
    axes[0].set_yticks(-np.arange(len(names)) - 0.22, names)
    axes[0].set(xlabel="gain: RMS position, best path / adjusted (bars: theory)", xscale="log",
                xlim=(0.9, 100.0))  # fmt: skip
    axes[0].set_xticks([1, 2, 5, 10, 20, 50, 100], ["1", "2", "5", "10", "20", "50", "100"])
    axes[1].set(xlabel="RMS position, measured / predicted")
    axes[2].set(xlabel="mean of eᵀ C⁻¹ e / dimension")
    for axis in axes:
        axis.axvline(1.0, color="k", lw=0.8)
        axis.grid(axis="x", alpha=0.25)
    handles = [axes[0].barh([0], [0], color=c, alpha=0.35, label=k) for k, c in colours.items()]
    handles += [
        axes[1].errorbar([], [], xerr=[], fmt=".", color="k", capsize=3, label="Monte Carlo, 95 %"),
        axes[2].plot([], [], "-", color="0.4", lw=5, alpha=0.35, label="95 % if C holds")[0],
    ]
    drawn_.legend(handles=handles, loc="outside upper center", ncols=5, fontsize=9, frameon=False)
    drawn_.savefig(file, dpi=120)
