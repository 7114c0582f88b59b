"""Layouts: where the stations of a structure stand, and which of them may see each other.

World: x along the structure, y to its left, z up. A layout is one entry of `LAYOUTS`: a function of
its sizes, and defaults of what equips it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

Lines = Int[np.ndarray, "lines 2"]
"""Sight lines: the station that sees, the station that is seen."""


class Impossible(ValueError):
    """A size that no structure can have; says at which table and key of the description."""

    def __init__(self, table: str, key: str, problem: str):
        super().__init__(problem)
        self.table, self.key = table, key


@dataclass(frozen=True, eq=False)
class Structure:
    """Stations, and the lines along which one may see another.

    Attributes:
        names: of the stations.
        position: of the stations in the world (m).
        heading: turn of each station about the world's z axis (rad), x of a station being ahead.
        lines: which station may see which.
        moves: stations that a deformation carries along.
        held: the station that fixes the world, unless the description names others.
        axis: long axis of the structure in the world (unit vector, level).
        origin: where the modes of a deformation vanish (m); None: at the held station.
        marks_at: where each line has marks of its own, on the station that is seen (m); None:
            a station has marks for all who see it.
        wander: standard deviations (rad, m) with which moving stations are put elsewhere in every
            epoch.
    """

    names: tuple[str, ...]
    position: Float[np.ndarray, "stations 3"]
    heading: Float[np.ndarray, " stations"]
    lines: Lines
    moves: Bool[np.ndarray, " stations"]
    held: int = 0
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0)
    origin: tuple[float, float, float] | None = None
    marks_at: Float[np.ndarray, "lines 3"] | None = None
    wander: tuple[float, float] = (0.0, 0.0)

    def both_ways(self) -> "Structure":
        """The structure with every line looked along from both ends."""
        return replace(self, lines=np.unique([*self.lines, *self.lines[:, ::-1]], axis=0))


@dataclass(frozen=True)
class Plan:
    """What a layout is made for.

    Attributes:
        stations: their number.
        size: the layout's own sizes, by key of [structure].
        reach: how far a camera sees (m); None: what suits the layout.
        redundancy: sight lines per station, where the layout draws them.
        cameras: cameras of a station, where the layout is one station.
        links: whether links alone join the stations.
        rng: draws what is random in a layout.
    """

    stations: int
    size: dict[str, float]
    reach: float | None
    redundancy: float
    cameras: int
    links: bool
    rng: np.random.Generator


@dataclass(frozen=True)
class Layout:
    """A kind of structure.

    Attributes:
        place: its stations and lines.
        stations: default number of stations, and the least.
        size: keys of [structure] with their defaults; whole numbers are counts.
        marks_m: default size of the marks of a station (m).
        focal_px: default focal length of a camera that looks along one line (px).
        both_ways: whether a line is looked along from both ends by default.
    """

    place: Callable[[Plan], Structure]
    stations: int
    least: int
    size: dict[str, float] = field(default_factory=dict)
    marks_m: float = 0.5
    focal_px: float = 5000.0
    both_ways: bool = False


def near(position: Float[np.ndarray, "n 3"], reach: float) -> Lines:
    """Lines between all that are within reach (m), from the one with the lower number."""
    pairs = KDTree(position).query_pairs(reach, output_type="ndarray")
    return pairs[np.lexsort(pairs.T[::-1])].astype(int)


def numbered(prefix: str, n: int) -> tuple[str, ...]:
    """Names with numbers from 1, as wide as the last."""
    width = len(str(n))
    return tuple(f"{prefix}{k + 1:0{width}d}" for k in range(n))


def ship(plan: Plan) -> Structure:
    """Stations bow to stern on decks, to port and starboard in turn.

    They see along their deck, and through hatches the deck above and below near their own frame.
    """
    length, decks = plan.size["length_m"], int(plan.size["decks"])
    height, width = plan.size["deck_height_m"], plan.size["width_m"]
    if plan.stations < 2 * decks:
        raise Impossible(
            "",
            "stations",
            f"{plan.stations} stations are too few for {decks} decks; give at least {2 * decks}",
        )
    names, parts = (), []
    for deck, own in enumerate(np.array_split(np.arange(plan.stations), decks)):
        x = np.linspace(0.0, length, len(own))
        side = 0.35 * width * (-1.0) ** (np.arange(len(own)) + deck)
        # Decks rise towards bow and stern (sheer), a hundredth of the length.
        z = deck * height + 0.01 * length * (2.0 * x / length - 1.0) ** 2
        parts.append(np.stack([x, side, z], axis=1))
        names += numbered(f"deck{deck + 1}-", len(own))
    position = np.concatenate(parts)
    deck = np.repeat(np.arange(decks), [len(part) for part in parts])
    spacing = length / (len(parts[-1]) - 1)
    lines = near(position, plan.reach or float(np.hypot(2.2 * spacing, width)))
    apart = np.abs(position[lines[:, 0], 0] - position[lines[:, 1], 0])
    floors = np.abs(np.diff(deck[lines], axis=1)[:, 0])
    lines = lines[(floors == 0) | ((floors == 1) & (apart < 0.6 * spacing))]
    return Structure(names, position, np.zeros(len(names)), lines, np.ones(len(names), bool))


def tunnel(plan: Plan) -> Structure:
    """Stations along both walls of a tunnel that turns left; they see what no wall hides."""
    length, radius = plan.size["length_m"], plan.size["radius_m"]
    half = 0.5 * plan.size["width_m"]
    if radius <= 2.0 * half or length > 5.0 * radius:
        raise Impossible(
            "structure",
            "radius_m",
            f"a tunnel {length:g} m long and {2 * half:g} m wide can't turn with a radius of "
            f"{radius:g} m; give at least {max(2.5 * half, 0.2 * length):g}",
        )
    left = np.arange(plan.stations) % 2 == 0
    angle = np.empty(plan.stations)
    for side in (left, ~left):
        angle[side] = np.linspace(0.0, length / radius, int(side.sum()))
    # Stations stand off the wall, or a camera of the inner wall would see nothing but wall.
    clear = min(0.6, 0.3 * half)
    own = radius + np.where(left, -1.0, 1.0) * (half - clear)
    position = np.stack([own * np.sin(angle), radius - own * np.cos(angle), 0.0 * own], axis=1)
    position[:, 2] = 1.5
    spacing = length / max(int((~left).sum()) - 1, 1)
    lines = near(position, plan.reach or float(np.hypot(1.3 * spacing, 2.0 * half)))
    # A chord comes nearest to the centre of the curve at the foot of its perpendicular.
    a, b = (position[lines[:, k], :2] - [0.0, radius] for k in (0, 1))
    along = np.clip(-np.sum(a * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0.0, 1.0)
    nearest = np.linalg.norm(a + along[:, None] * (b - a), axis=1)
    names = [""] * plan.stations
    for word, side in (("left-", left), ("right-", ~left)):
        for place, name in zip(np.flatnonzero(side), numbered(word, int(side.sum())), strict=True):
            names[place] = name
    moves = np.ones(plan.stations, bool)
    return Structure(tuple(names), position, angle, lines[nearest > radius - half], moves)


def bridge(plan: Plan) -> Structure:
    """Stations on both sides of a deck and on towers above it."""
    length, height = plan.size["length_m"], plan.size["tower_height_m"]
    towers, each = int(plan.size["towers"]), int(plan.size["tower_stations"])
    deck = plan.stations - towers * each
    if deck < 3:
        raise Impossible(
            "",
            "stations",
            f"{plan.stations} stations leave {deck} for the deck, beside {towers} towers with "
            f"{each} each; give at least {towers * each + 3}",
        )
    half = 0.5 * plan.size["width_m"]
    x = np.linspace(0.0, length, deck)
    side = half * (-1.0) ** np.arange(deck)
    # The road rises to the middle, a hundredth of the length.
    parts = [np.stack([x, side, 0.01 * length * (1.0 - (2.0 * x / length - 1.0) ** 2)], axis=1)]
    names = numbered("deck-", deck)
    for tower in range(towers):
        foot = length * (tower + 0.5) / towers
        up = height * (np.arange(each) + 1.0) / each
        parts.append(np.stack([foot + 0.0 * up, -half * (-1.0) ** np.arange(each), up], axis=1))
        names += numbered(f"tower{tower + 1}-", each)
    position = np.concatenate(parts)
    spacing = length / (deck - 1)
    reach = plan.reach or max(2.3 * spacing, 1.2 * float(np.hypot(height, 2.0 * half)))
    moves = np.ones(plan.stations, bool)
    return Structure(names, position, np.zeros(plan.stations), near(position, reach), moves)


def wind_tunnel(plan: Plan) -> Structure:
    """A few outer stations above and around a model; marks on sections of its swept wings."""
    outer, span = int(plan.size["outer"]), plan.size["span_m"]
    distance, sections = plan.size["distance_m"], plan.stations - outer
    if sections < 3:
        raise Impossible(
            "",
            "stations",
            f"{plan.stations} stations leave {sections} sections of the model, beside {outer} "
            f"outer stations; give at least {outer + 3}",
        )
    if distance < 0.5 * span:
        raise Impossible(
            "structure",
            "distance_m",
            f"outer stations {distance:g} m from the middle stand inside a span of {span:g} m; "
            f"give at least {0.5 * span:g}",
        )
    y = np.linspace(-0.5 * span, 0.5 * span, sections)
    wing = np.stack([-0.5 * np.abs(y), y, 0.0 * y], axis=1)
    right, left = numbered("right-", sections // 2)[::-1], numbered("left-", sections // 2)
    names = (*right, *(("body",) if sections % 2 else ()), *left)
    azimuth = 2.0 * np.pi * (np.arange(outer) + 0.5) / outer
    around = distance * np.stack(
        [0.7 * np.cos(azimuth), 0.7 * np.sin(azimuth), np.full(outer, 0.7)], axis=1
    )
    watcher, seen = np.divmod(np.arange(outer * sections), sections)
    lines = np.stack([watcher, outer + seen], axis=1)
    return Structure(
        (*numbered("outer-", outer), *names),
        np.concatenate([around, wing]),
        np.concatenate([azimuth + np.pi, np.zeros(sections)]),
        lines if plan.reach is None else lines[_lengths(around, wing)[watcher, seen] <= plan.reach],
        np.arange(plan.stations) >= outer,
        axis=(0.0, 1.0, 0.0),
        origin=(0.0, 0.0, 0.0),
    )


def chain(plan: Plan) -> Structure:
    """A straight relay: each station sees the next."""
    n = plan.stations
    position = np.zeros((n, 3))
    position[:, 0] = plan.size["spacing_m"] * np.arange(n)
    lines = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    lines = _within(lines, position, plan.reach)
    return Structure(numbered("s", n), position, np.zeros(n), lines, np.ones(n, bool))


def ring(plan: Plan) -> Structure:
    """A closed relay on a circle: each station sees the next, the last one the first."""
    n = plan.stations
    angle = 2.0 * np.pi * np.arange(n) / n
    radius = 0.5 * plan.size["spacing_m"] / np.sin(np.pi / n)
    position = radius * np.stack([np.sin(angle), 1.0 - np.cos(angle), 0.0 * angle], axis=1)
    lines = np.stack([np.arange(n), (np.arange(n) + 1) % n], axis=1)
    lines = _within(lines, position, plan.reach)
    return Structure(numbered("s", n), position, angle, lines, np.ones(n, bool))


def station(plan: Plan) -> Structure:
    """One station whose cameras look to all sides, inside a frame of known marks.

    The frame is put elsewhere in every epoch and ties all cameras together each time. With links
    alone every two of the cameras are joined, each camera being a body of its own.
    """
    m, distance = plan.cameras, plan.size["distance_m"]
    azimuth = 2.0 * np.pi * np.arange(m) / m
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=1)
    if plan.links:
        pairs = np.stack(np.triu_indices(m, 1), axis=1)
        return Structure(numbered("camera-", m), 0.3 * ahead, azimuth, pairs, np.ones(m, bool))
    return Structure(
        ("station", "frame"),
        np.zeros((2, 3)),
        np.zeros(2),
        np.tile([0, 1], (m, 1)),
        np.array([False, True]),
        marks_at=distance * ahead,
        wander=(plan.size["moved_rad"], plan.size["moved_m"]),
    )


def random(plan: Plan) -> Structure:
    """Stations scattered over a plain, with as many lines as asked for, connected for sure.

    Lines join neighbours: a tree that reaches everything, then others drawn among the near ones.
    """
    n, spacing = plan.stations, plan.size["spacing_m"]
    wanted = round(plan.redundancy * n)
    if not n - 1 <= wanted <= n * (n - 1):
        raise Impossible(
            "sights",
            "redundancy",
            f"{n} stations with {plan.redundancy:g} sight lines each have {wanted} lines, but need "
            f"{n - 1} to be connected and can't have more than {n * (n - 1)}; give "
            f"{1.0 if wanted < n - 1 else n - 1:g}",
        )
    side = int(np.ceil(np.sqrt(n)))
    row, column = np.divmod(plan.rng.permutation(side * side)[:n], side)
    # Hills are low: cameras that look level see their neighbours.
    jitter = plan.rng.uniform(-1.0, 1.0, (n, 3)) * [0.3, 0.3, 0.1]
    position = spacing * (np.stack([column, row, np.zeros(n)], axis=1) + jitter)
    lines = _connected_lines(position, wanted, plan.rng)
    lines = _within(lines, position, plan.reach)
    heading = plan.rng.uniform(-np.pi, np.pi, n)
    return Structure(numbered("s", n), position, heading, lines, np.ones(n, bool))


def _connected_lines(position, wanted: int, rng: np.random.Generator) -> Lines:
    """So many lines between neighbours that leave no station alone."""
    n, tree = len(position), KDTree(position)
    k = min(n - 1, 12)
    while True:
        distance, neighbour = map(np.asarray, tree.query(position, k + 1))
        a, b = np.repeat(np.arange(n), k), neighbour[:, 1:].ravel()
        graph = coo_matrix((distance[:, 1:].ravel(), (a, b)), (n, n))
        parts = connected_components(graph, directed=False, return_labels=False)
        keys = np.unique(np.minimum(a, b) * n + np.maximum(a, b))
        if (parts == 1 and 2 * len(keys) >= wanted) or k == n - 1:
            break
        k = min(2 * k, n - 1)
    spanning = minimum_spanning_tree(graph.tocsr()).tocoo()
    ends = np.stack([spanning.row, spanning.col], axis=1).astype(int)
    back = rng.random(len(ends)) < 0.5
    ends[back] = ends[back, ::-1]
    taken = ends[:, 0] * n + ends[:, 1]
    free = np.setdiff1d(np.concatenate([keys, (keys % n) * n + keys // n]), taken)
    chosen = rng.choice(free, wanted - len(taken), replace=False)
    every = np.sort(np.concatenate([taken, chosen]))
    return np.stack(np.divmod(every, n), axis=1)


def _within(lines: Lines, position, reach: float | None) -> Lines:
    if reach is None:
        return lines
    return lines[np.linalg.norm(np.diff(position[lines], axis=1)[:, 0], axis=1) <= reach]


def _lengths(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> np.ndarray:
    return np.linalg.norm(a[:, None] - b[None], axis=2)


LAYOUTS: dict[str, Layout] = {
    "ship": Layout(
        ship,
        12,
        4,
        {"length_m": 120.0, "width_m": 16.0, "decks": 2, "deck_height_m": 6.0},
        both_ways=True,
    ),
    "tunnel": Layout(
        tunnel, 16, 4, {"length_m": 200.0, "radius_m": 400.0, "width_m": 10.0}, both_ways=True
    ),
    "bridge": Layout(
        bridge,
        14,
        4,
        {
            "length_m": 300.0,
            "width_m": 12.0,
            "towers": 2,
            "tower_height_m": 60.0,
            "tower_stations": 2,
        },
        marks_m=1.0,
        focal_px=8000.0,
        both_ways=True,
    ),
    "wind-tunnel": Layout(
        wind_tunnel, 13, 5, {"outer": 4, "span_m": 2.0, "distance_m": 3.0}, marks_m=0.1
    ),
    "chain": Layout(chain, 10, 2, {"spacing_m": 10.0}),
    "ring": Layout(ring, 12, 3, {"spacing_m": 10.0}),
    "station": Layout(
        station, 1, 1, {"distance_m": 3.0, "moved_m": 0.1, "moved_rad": 0.05}, 0.3, 2500.0
    ),
    "random": Layout(random, 20, 2, {"spacing_m": 10.0}),
}
"""The layouts by name."""
