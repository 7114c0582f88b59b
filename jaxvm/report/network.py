"""The picture page of an adjusted network: network.html, and its numbers as network.json."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from jinja2 import Environment, PackageLoader
from markupsafe import Markup
from scipy.special import chdtrc, chdtri

from jaxvm import __version__
from jaxvm.network.cycles import (
    cycle_effects,
    fundamental_cycles,
    minimum_cycle_basis,
    misclosure,
)
from jaxvm.network.graph import components, n_conditions, shortest_path_tree, unheld_parts
from jaxvm.network.redundancy import HARDLY_CHECKED, WeakEdge
from jaxvm.recording.files import write_files
from jaxvm.report.network_figures import convergence_figure, growth_figures
from jaxvm.report.network_graph import BodyGraph, body_graph
from jaxvm.report.network_view import network_view
from jaxvm.report.network_words import angle, length, number, verdict
from jaxvm.solve.adjust import Adjustment

FORMAT = 1

History = tuple[np.ndarray, np.ndarray]
"""Evaluations, and the cost after each."""

_MINIMUM_BASIS = 300
"""Conditions up to which the cycles are those of a minimum basis."""

_MOST_CYCLES = 5000
"""Cycles whose misclosures are computed; of more, the shortest."""

_SHOWN = 30
"""Rows of a table on the page."""


@dataclass(frozen=True, eq=False)
class NetworkNumbers:
    """What the page shows: the graph behind it, and its document."""

    bodies: BodyGraph
    document: dict[str, Any]


def write_network_page(
    adjustment: Adjustment,
    folder: str | Path,
    histories: Mapping[str, History] | None = None,
    method: str = "",
    scale: float = 1.0,
) -> Path:
    """Write `network_files` into a folder; returns the path of network.html.

    The folder is made if it is not there. Files of an earlier page are replaced.

    Raises:
        ValueError: a history has not one cost for each evaluation.
        OSError: the folder can't be written.
    """
    write_files(folder, network_files(adjustment, histories, method, scale))
    return Path(folder) / "network.html"


def network_files(
    adjustment: Adjustment,
    histories: Mapping[str, History] | None = None,
    method: str = "",
    scale: float = 1.0,
) -> dict[str, str]:
    """The texts of network.html and network.json, by their names.

    The page holds all that it needs: nothing is fetched.

    Args:
        adjustment: of a scene with links, sight lines, or both. Links of weight zero are shown as
            rejected.
        histories: of further methods: evaluations, and the cost after each.
        method: that the adjustment itself used, in words.
        scale: factor on covariances: 1 trusts the stated sigmas, the variance factor the residuals.

    Raises:
        ValueError: a history has not one cost for each evaluation.
    """
    numbers = _numbers(adjustment, histories, method, scale)
    text = json.dumps(numbers.document, allow_nan=False) + "\n"
    return {"network.html": _html(numbers), "network.json": text}


def network_document(
    adjustment: Adjustment,
    histories: Mapping[str, History] | None = None,
    method: str = "",
    scale: float = 1.0,
) -> dict[str, Any]:
    """Content of network.json (format 1): all numbers of the page; arguments as for the page.

    Turns are in rad, shifts in m. A standard deviation "max" is the one along the worst direction.
    Bodies, edges and cycles are referred to by their places in the lists.
    """
    return _numbers(adjustment, histories, method, scale).document


def _numbers(adjustment, histories, method, scale) -> NetworkNumbers:
    bodies = body_graph(adjustment, scale)
    curves = {method or "this adjustment": _own_history(adjustment)}
    for name, (evaluations, costs) in (histories or {}).items():
        evaluations, costs = np.ravel(evaluations), np.ravel(costs)
        if len(evaluations) != len(costs):
            raise ValueError(
                f'the history "{name}" has {len(evaluations)} evaluations and {len(costs)} costs; '
                "give one cost for each"
            )
        curves[name if name not in curves else f"{name} (given)"] = (evaluations, costs)
    document = {
        "format": FORMAT,
        "recording": adjustment.scene.model.name,
        "adjustment": _summary(adjustment, bodies, method, scale),
        "bodies": _bodies(adjustment, bodies),
        "edges": _edges(bodies),
        "rejected": [
            {"name": name, "from": int(bodies.body[a]), "to": int(bodies.body[b])}
            for name, a, b in bodies.rejected
        ],
        "weak_edges": _weak(bodies),
        "unobservable": _unobservable(bodies),
        "cycles": _cycles(bodies),
        "link_tests": _link_tests(adjustment, bodies),
        "sight_tests": _sight_tests(bodies),
        "convergence": [
            {"method": name, "evaluations": np.asarray(e).tolist(), "cost": _numbers_or_none(c)}
            for name, (e, c) in curves.items()
        ],
    }
    return NetworkNumbers(bodies, document)


def _own_history(adjustment: Adjustment) -> History:
    costs, at = np.asarray(adjustment.history, float), adjustment.evaluations_at
    return np.arange(1, len(costs) + 1) if at is None else np.asarray(at), costs


def _numbers_or_none(values) -> list[float | None]:
    return [_finite(value) for value in np.ravel(values)]


def _finite(value) -> float | None:
    return float(value) if np.isfinite(value) else None


def variance_bounds(degrees_of_freedom: int, alpha: float = 0.05) -> tuple[float, float] | None:
    """Bounds that the variance factor keeps with probability 1 - alpha if model and sigmas are
    right: chi-square quantiles over the degrees of freedom; None without any."""
    f = degrees_of_freedom
    if f <= 0:
        return None
    return float(chdtri(f, 1.0 - alpha / 2.0) / f), float(chdtri(f, alpha / 2.0) / f)


def _summary(adjustment: Adjustment, bodies: BodyGraph, method: str, scale: float):
    graph, f = bodies.graph, adjustment.degrees_of_freedom
    parts = components(graph) if graph.names else []
    held = np.array([np.isin(part, graph.held).sum() for part in parts], int)
    bounds = variance_bounds(f)
    counts = {
        kind: sum(body.kind == kind for body in bodies.bodies)
        for kind in ("station", "target", "camera")
    }
    return {
        "method": method,
        "stations": counts["station"],
        "targets": counts["target"],
        "cameras": counts["camera"],
        "nodes": len(graph.names),
        "links": int(np.sum(~bodies.sight)),
        "sight_lines": int(np.sum(bodies.sight)),
        "parts": len(parts),
        "independent_cycles": n_conditions(graph) if parts else 0,
        "conditions": 6 * n_conditions(graph) if parts else 0,
        "conditions_of_further_held": int(6 * np.maximum(held - 1, 0).sum()),
        "held": [body.name for body in bodies.bodies if body.held],
        "cost_before": _finite(adjustment.cost_before),
        "cost": _finite(adjustment.cost),
        "degrees_of_freedom": int(f),
        "variance_factor": _finite(adjustment.variance_factor),
        "variance_factor_bounds_95": None if bounds is None else list(bounds),
        "p_value": float(chdtrc(f, 2.0 * adjustment.cost)) if f > 0 else None,
        "covariance_scale": float(scale),
        "evaluations": int(adjustment.evaluations),
        "accepted": int(adjustment.accepted),
        "why": adjustment.why,
        "converged": bool(adjustment.converged),
        "seconds": float(adjustment.seconds),
        "seconds_compiling": float(adjustment.seconds_compiling),
        "mounts_counted_as_known": bodies.n_folded,
        "views_without_pose": bodies.n_poseless,
    }


def distances(bodies: BodyGraph) -> Int[np.ndarray, " nodes"]:
    """Fewest edges between each node and a held one; -1 where none is joined to it."""
    graph = bodies.graph
    if len(graph.held) == 0:
        return np.full(len(graph.names), -1)
    return shortest_path_tree(graph, graph.held, np.ones(len(graph.edges))).depth


def worst_deviation(covariance: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """Standard deviation along the direction in which it is largest; NaN where it is not known."""
    values = np.linalg.eigvalsh(np.nan_to_num(covariance))
    worst = np.sqrt(np.maximum(values.max(axis=1, initial=0.0), 0.0))
    return np.where(np.isfinite(covariance).all(axis=(1, 2)), worst, np.nan)


def _bodies(adjustment: Adjustment, bodies: BodyGraph) -> list[dict[str, Any]]:
    """One entry for each body; of one that moves, deviations are those of its worst pose.

    None stands for what no observation tells.
    """
    epochs, far = adjustment.scene.recording.epoch_ids, distances(bodies)
    shift = worst_deviation(bodies.covariance[:, 3:, 3:])
    turn = worst_deviation(bodies.covariance[:, :3, :3])
    axes = np.sqrt(np.maximum(np.diagonal(bodies.covariance, axis1=1, axis2=2), 0.0))
    result = []
    for body in bodies.bodies:
        worst = int(np.argmax(np.nan_to_num(shift[body.nodes], nan=-1.0)))
        k, reached = body.nodes[worst], far[body.nodes]
        result.append(
            {
                "kind": body.kind,
                "name": body.name,
                "held": body.held,
                "poses": len(body.nodes),
                "worst_epoch": int(epochs[worst]) if len(body.nodes) > 1 else None,
                "turn_rad": bodies.pose[body.nodes[0], :3].tolist(),
                "position_m": bodies.pose[body.nodes[0], 3:].tolist(),
                "distance_edges": int(reached[reached >= 0].min(initial=len(far) + 1))
                if (reached >= 0).any()
                else None,
                "position_std_m": _numbers_or_none(axes[k, 3:]),
                "position_std_max_m": _finite(shift[k]),
                "turn_std_rad": _numbers_or_none(axes[k, :3]),
                "turn_std_max_rad": _finite(turn[k]),
                "position_covariance_m2": [
                    _numbers_or_none(r) for r in bodies.covariance[k, 3:, 3:]
                ],
            }
        )
    return result


def _edges(bodies: BodyGraph) -> list[dict[str, Any]]:
    graph = bodies.graph
    turn, shift = (
        worst_deviation(graph.covariance[:, part, part]) for part in (slice(0, 3), slice(3, 6))
    )
    return [
        {
            "kind": "sight" if bodies.sight[k] else "link",
            "name": graph.edge_names[k],
            "from": int(bodies.body[a]),
            "to": int(bodies.body[b]),
            "redundancy": float(bodies.redundancy[k]),
            "bridge": bool(bodies.bridge[k]),
            "turn_std_max_rad": float(turn[k]),
            "shift_std_max_m": float(shift[k]),
        }
        for k, (a, b) in enumerate(graph.edges)
    ]


def _weak(bodies: BodyGraph) -> list[dict[str, Any]]:
    """Bridges and edges that are hardly checked, the weakest first."""
    graph, share = bodies.graph, bodies.redundancy
    weak = np.flatnonzero(bodies.bridge | (share < HARDLY_CHECKED))
    result = []
    for k in weak[np.argsort(share[weak], kind="stable")]:
        ends = (graph.names[graph.edges[k, 0]], graph.names[graph.edges[k, 1]])
        edge = WeakEdge(int(k), graph.edge_names[k], ends, float(share[k]), bool(bodies.bridge[k]))
        result.append({"edge": int(k), "redundancy": float(share[k]), "words": edge.words()})
    return result


def _unobservable(bodies: BodyGraph) -> list[str]:
    """Parts that no link or sight line joins to a held body, in words."""
    graph, result = bodies.graph, []
    for part in unheld_parts(graph) if graph.names else []:
        shown = ", ".join(graph.names[node] for node in part[:6])
        more = f" and {len(part) - 6} more" if len(part) > 6 else ""
        result.append(
            f"no link or sight line joins {shown}{more} to a held body: only priors or other "
            "observations can tell where this part is"
        )
    return result


def _cycles(bodies: BodyGraph) -> list[dict[str, Any]]:
    """A cycle basis (of a large one the shortest cycles), the largest test statistic first.

    Of a minimum basis also whether each cycle improves the network, or only edges beside its best
    tree.
    """
    graph = bodies.graph
    if not graph.names:
        return []
    few = n_conditions(graph) <= _MINIMUM_BASIS
    basis = minimum_cycle_basis(graph) if few else fundamental_cycles(graph)
    basis = sorted(basis, key=len)
    effects = cycle_effects(graph, basis) if few else [None] * len(basis)
    result = []
    for cycle, effect in list(zip(basis, effects, strict=True))[:_MOST_CYCLES]:
        try:
            found = misclosure(graph, cycle)
        except ValueError:  # views without a pixel's worth of noise: there is nothing to test by
            continue
        walked = [graph.edges[edge][:: 1 if sign > 0 else -1] for edge, sign in cycle]
        result.append(
            {
                "edges": [edge for edge, _ in cycle],
                "signs": [sign for _, sign in cycle],
                "bodies": [int(bodies.body[a]) for a, _ in walked],
                "turn_rad": float(np.linalg.norm(found.twist[:3])),
                "shift_m": float(np.linalg.norm(found.twist[3:])),
                "statistic": float(found.statistic),
                "deviations": float(np.sqrt(found.statistic)),
                "p_value": found.p_value,
                "effective": None if effect is None else effect.effective,
                "effect": None if effect is None else effect.words(),
            }
        )
    return sorted(result, key=lambda cycle: -cycle["statistic"])


def _link_tests(adjustment: Adjustment, bodies: BodyGraph) -> list[dict[str, Any]]:
    """Standardised residuals of links, the least likely first."""
    chosen = np.flatnonzero(~bodies.sight)
    of_link = bodies.source[chosen]
    test, checked = bodies.link_test[of_link], bodies.link_checked[of_link]
    p = np.where(checked > 0, chdtrc(np.maximum(checked, 1), test), 1.0)
    residual = bodies.link_residual[of_link]
    return [
        {
            "edge": int(chosen[k]),
            "statistic": float(test[k]),
            "checked": int(checked[k]),
            "p_value": float(p[k]),
            "turn_rad": float(np.linalg.norm(residual[k, :3])),
            "shift_m": float(np.linalg.norm(residual[k, 3:])),
        }
        for k in np.lexsort((-test, p))
    ]


def _sight_tests(bodies: BodyGraph) -> list[dict[str, Any]]:
    """Squared residuals of the image points of sight lines over their redundancy, largest first."""
    chosen = np.flatnonzero(bodies.sight)
    excess = bodies.excess[bodies.source[chosen]]
    order = np.argsort(-excess, kind="stable")
    return [{"edge": int(chosen[k]), "variance_factor": float(excess[k])} for k in order]


def _html(numbers: NetworkNumbers) -> str:
    # select_autoescape() goes by the ending of a name, and ".j2" is none of its endings.
    environment = Environment(
        loader=PackageLoader("jaxvm.report"), autoescape=True, trim_blocks=True
    )
    d = numbers.document
    script = resources.files("jaxvm.report").joinpath("templates/network.js").read_text("utf-8")
    stations = sorted(
        (body for body in d["bodies"] if not body["held"]),
        key=lambda body: (
            -np.inf if body["position_std_max_m"] is None else -body["position_std_max_m"]
        ),
    )
    view = network_view(numbers.bodies, d)
    return environment.get_template("network.html.j2").render(
        d=d,
        a=d["adjustment"],
        view=view,
        verdict=verdict(d),
        held=[body for body in d["bodies"] if body["held"]],
        stations=stations[:_SHOWN],
        n_stations=len(stations),
        shown=_SHOWN,
        minimum_basis=_MINIMUM_BASIS,
        growth=[Markup(figure) for figure in growth_figures(d["bodies"])],
        convergence=Markup(convergence_figure(d["convergence"])),
        script=Markup(script),
        length=length,
        angle=angle,
        number=number,
        version=__version__,
    )
