"""What the viewer draws: flat lists for the canvas, and the direction from which to look first."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxvm.report.network_graph import BodyGraph

_MOST_EDGES = 20_000
"""Edges that the viewer draws; of more than that, weak ones and an even choice of the others."""

_MOST_CYCLES = 100
_TILT = np.deg2rad(28.0)

BRIDGE, SIGHT, REJECTED = 1, 2, 4
"""Flags of a drawn edge."""


def network_view(bodies: BodyGraph, document: dict[str, Any]) -> dict[str, Any]:
    """Data of the viewer; parallel edges, and those of all epochs, are drawn as one.

    Positions are in m about their middle; `ellipsoid` has three semi-axes (m, one standard
    deviation) for each body; `axes` are the screen's right, up and towards the viewer at first.
    """
    listed = document["bodies"]
    position = np.array([body["position_m"] for body in listed]).reshape(-1, 3)
    low, high = (f(axis=0) if len(position) else np.zeros(3) for f in (position.min, position.max))
    middle = 0.5 * (low + high)
    size = float(np.linalg.norm(high - low)) or 1.0
    covariance = np.array([body["position_covariance_m2"] for body in listed], float)
    semi = semi_axes(np.nan_to_num(covariance.reshape(-1, 3, 3)))
    longest = np.linalg.norm(semi, axis=2).max(axis=1, initial=0.0)
    pairs, of_edge = _pairs(bodies, document)
    drawn = _chosen(pairs)
    place = np.full(len(pairs) + 1, -1)
    place[drawn] = np.arange(len(drawn))
    edges = [pairs[k] for k in drawn]
    return {
        "names": [body["name"] for body in listed],
        "kinds": [body["kind"] for body in listed],
        "held": [int(body["held"]) for body in listed],
        "distance": [body["distance_edges"] for body in listed],
        "position": _rounded(position - middle, size * 1e-6),
        "sigma_m": _digits([body["position_std_max_m"] or 0.0 for body in listed]),
        "sigma_rad": _digits([body["turn_std_max_rad"] or 0.0 for body in listed]),
        "epoch": [body["worst_epoch"] for body in listed],
        "ellipsoid": _digits(semi.ravel()),
        "traces": _traces(bodies, middle, size),
        "a": [edge["a"] for edge in edges],
        "b": [edge["b"] for edge in edges],
        "redundancy": _digits([edge["redundancy"] for edge in edges]),
        "flags": [edge["flags"] for edge in edges],
        "edge_names": [edge["name"] for edge in edges],
        "count": [edge["count"] for edge in edges],
        "edge_sigma_m": _digits([edge["sigma_m"] for edge in edges]),
        "edge_sigma_rad": _digits([edge["sigma_rad"] for edge in edges]),
        "n_edges": len(pairs),
        "mounts": [list(pair) for pair in bodies.mounts],
        "cycles": [
            sorted({int(place[of_edge[edge]]) for edge in cycle["edges"]} - {-1})
            for cycle in document["cycles"][:_MOST_CYCLES]
        ],
        "axes": first_axes(position).tolist(),
        "size": size,
        "scale": first_scale(longest, size),
    }


def semi_axes(covariance: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Principal semi-axes (rows) of the ellipsoids of one standard deviation."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]).swapaxes(1, 2)


def first_axes(position: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """Right, up and towards the viewer (rows): principal axes of the network, a little tilted.

    The direction of least extent points at the viewer, so that a planar network shows its face and
    a line its length; the tilt shows the rest. The world's z is kept pointing up where it can.
    """
    apart = position - position.mean(axis=0) if len(position) else np.zeros((1, 3))
    _, extent, axes = np.linalg.svd(np.vstack([apart, np.zeros((3, 3))]), full_matrices=False)
    right, up, out = axes
    # The deeper the network, the more from the side, lest its layers hide each other.
    side = (0.3 + 0.6 * extent[2] / max(extent[0], 1e-300)) * _TILT
    if abs(out[2]) > abs(up[2]):
        out = out if out[2] >= 0.0 else -out
        right = right if right[np.argmax(np.abs(right))] > 0.0 else -right
        up = np.cross(out, right)
    else:
        up = up if up[2] >= 0.0 else -up
        right = right if right[np.argmax(np.abs(right))] > 0.0 else -right
        out = np.cross(right, up)
    c, s = np.cos(_TILT), np.sin(_TILT)
    turned = np.array([right, c * up + s * out, c * out - s * up])
    c, s = np.cos(side), np.sin(side)
    return np.array([c * turned[0] - s * turned[2], turned[1], s * turned[0] + c * turned[2]])


def first_scale(longest: Float[np.ndarray, " n"], size: float) -> float:
    """A round factor (1, 2 or 5 times a power of ten) at which ellipsoids are well seen."""
    positive = longest[longest > 0.0]
    if len(positive) == 0:
        return 1.0
    share = 0.05 if len(longest) <= 300 else 0.02
    wanted = share * size / float(np.quantile(positive, 0.9))
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= wanted * 1.0001))


def _pairs(bodies: BodyGraph, document: dict[str, Any]):
    """Edges that join the same two bodies, together; and the pair of each edge."""
    place: dict[tuple[int, int], int] = {}
    pairs, of_edge = [], []
    for edge in document["edges"]:
        a, b = edge["from"], edge["to"]
        key = (min(a, b), max(a, b))
        flags = BRIDGE * edge["bridge"] + SIGHT * (edge["kind"] == "sight")
        if key not in place:
            place[key] = len(pairs)
            pairs.append(
                dict(a=a, b=b, name=edge["name"], count=0, flags=0, redundancy=np.inf,
                     sigma_m=np.inf, sigma_rad=np.inf)
            )  # fmt: skip
        pair = pairs[place[key]]
        pair["count"] += 1
        pair["flags"] |= flags
        pair["redundancy"] = min(pair["redundancy"], edge["redundancy"])
        pair["sigma_m"] = min(pair["sigma_m"], edge["shift_std_max_m"])
        pair["sigma_rad"] = min(pair["sigma_rad"], edge["turn_std_max_rad"])
        of_edge.append(place[key])
    for edge in document["rejected"]:
        pairs.append(
            dict(a=edge["from"], b=edge["to"], name=edge["name"], count=1, flags=REJECTED,
                 redundancy=0.0, sigma_m=0.0, sigma_rad=0.0)
        )  # fmt: skip
    return pairs, np.array(of_edge, int)


def _chosen(pairs) -> np.ndarray:
    if len(pairs) <= _MOST_EDGES:
        return np.arange(len(pairs))
    first = np.array([k for k, p in enumerate(pairs) if p["flags"] & (BRIDGE | REJECTED)], int)
    rest = np.setdiff1d(np.arange(len(pairs)), first)
    room = max(_MOST_EDGES - len(first), 1)
    even = rest[np.linspace(0, len(rest) - 1, room).astype(int)]
    return np.union1d(first, even)


def _traces(bodies: BodyGraph, middle, size: float) -> dict[str, Any]:
    """Courses of the bodies that move, about where each begins, and how much they are enlarged.

    Courses below a fiftieth of the network's size are drawn larger than they are.
    """
    moving = [k for k, body in enumerate(bodies.bodies) if len(body.nodes) > 1]
    courses = {k: bodies.pose[bodies.bodies[k].nodes, 3:] for k in moving}
    reach = max(
        (float(np.linalg.norm(c - c[0], axis=1).max()) for c in courses.values()), default=0.0
    )
    enlarged = first_scale(np.array([reach]), size) if 0.0 < reach < 0.02 * size else 1.0
    return {
        "enlarged": enlarged,
        "of": [
            {"body": k, "points": _rounded(c[0] - middle + enlarged * (c - c[0]), size * 1e-6)}
            for k, c in courses.items()
        ],
    }


def _rounded(values, unit: float) -> list[float]:
    """Multiples of a power of ten near the unit, flat."""
    digits = int(np.ceil(-np.log10(unit)))
    return np.round(np.ravel(values), digits).tolist()


def _digits(values) -> list[float]:
    """Four significant digits are more than a screen shows."""
    return [float(f"{value:.4g}") for value in np.ravel(values)]
