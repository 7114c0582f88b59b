"""When two names and two places are the same: rows of PHYSICS.md, its exact ties, and scopes.

A name is a set of row numbers of PHYSICS.md. Modifiers of section 7 (a lag, a second time constant,
hysteresis) say how an effect follows its driver, not which effect it is.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

MODIFIERS = frozenset(range(76, 86))


@dataclass(frozen=True)
class Facts:
    """What of a recording decides ties and places.

    Attributes:
        names: names of all bodies by kind: "camera", "station", "target", "rangefinder".
        station_of: the station of each camera and rangefinder.
        spacing_s: median spacing of the epochs (s).
        first_s: time of the first epoch (s), from which reports count.
        rolled: whether any camera sees a target in attitudes that differ in roll by over 10 deg.
        seers: the cameras that see each target.
    """

    names: dict[str, tuple[str, ...]]
    station_of: dict[str, str]
    spacing_s: float
    first_s: float
    rolled: bool
    seers: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def alone(self, station: str) -> bool:
        """Whether a station carries one camera only."""
        cameras = [c for c in self.names["camera"] if self.station_of[c] == station]
        return len(cameras) == 1


@dataclass(frozen=True)
class Tie:
    """Rows that are one column of the model, where `holds` says so of recording and effect."""

    rows: frozenset[int]
    holds: Callable[[Facts, dict], bool]
    why: str


def _always(facts: Facts, hidden: dict) -> bool:
    return True


def _unrolled(facts: Facts, hidden: dict) -> bool:
    return len(facts.names["target"]) == 1 and not facts.rolled


def _alone(facts: Facts, hidden: dict) -> bool:
    where = hidden.get("where", {})
    stations = {facts.station_of.get(camera, "") for camera in where.get("camera", ())}
    stations |= set(where.get("station", ()))
    return bool(stations) and all(facts.alone(station) for station in stations)


TIES: tuple[Tie, ...] = (
    Tie(
        frozenset({59, 62}), _always,
        "a clock that is late and half an exposure are one constant times the image velocity",
    ),
    Tie(
        frozenset({19, 88}), _always,
        "the refractive index of the air and the frequency of the rangefinder are one range scale",
    ),
    Tie(frozenset({3, 64}), _always, "a wrong spacing in a file is a wrong print scale"),
    Tie(
        frozenset({30, 63}), _always,
        "a principal point that jumps is one step, whether lens or image window jumped",
    ),
    Tie(
        frozenset({4, 56}), _unrolled,
        "aspect is the x-scale of the only target, where neither was ever rolled",
    ),
    Tie(
        frozenset({25, 11}), _alone,
        "the turn of a station's only camera is the turn of the station (chain of rigid frames)",
    ),
    Tie(
        frozenset({28, 34}), _alone,
        "a mount that creeps under a station's only camera is a tripod that settles",
    ),
)  # fmt: skip
"""Exact ties of PHYSICS.md section 0 between rows. Near ties are not here: they are decidable."""


def core(rows: Iterable[int]) -> frozenset[int]:
    """Rows without the modifiers, unless there is nothing else."""
    rows = frozenset(rows)
    return rows - MODIFIERS or rows


def widened(hidden: dict, facts: Facts) -> frozenset[int]:
    """Rows that name a hidden effect, its exact ties in this recording included."""
    rows = core(hidden["rows"])
    for tie in TIES:
        if rows & tie.rows and tie.holds(facts, hidden):
            rows = rows | tie.rows
    return rows


def same_name(hidden: dict, rows: Iterable[int], facts: Facts) -> bool:
    """Whether the rows of a claim name the hidden effect."""
    return bool(widened(hidden, facts) & core(rows))


def same_place(hidden: dict, where: dict[str, list[str]], facts: Facts) -> bool:
    """Whether a claimed scope is the true place. An empty one means all bodies of the kind."""
    true = hidden.get("where") or {}
    if "point" in true or "point" in where:
        return all(set(true.get(k, ())) == set(where.get(k, ())) for k in ("target", "point"))
    if not true or not where:
        given = true or where
        return all(set(names) == set(facts.names[kind]) for kind, names in given.items())
    if set(true) == set(where):
        return all(set(true[kind]) == set(where[kind]) for kind in true)
    # A target, and the target as the only cameras see it that do, are the same observations.
    if set(true) | set(where) == {"camera", "target"} and "target" in true and "target" in where:
        cameras = set(true.get("camera", ())) | set(where.get("camera", ()))
        sees = {camera for target in true["target"] for camera in facts.seers.get(target, ())}
        return set(true["target"]) == set(where["target"]) and cameras == sees
    # All cameras of a station and the station are one place (chain of rigid frames).
    if set(true) | set(where) == {"camera", "station"}:
        return _cameras(true, facts) == _cameras(where, facts)
    return False


def _cameras(where: dict[str, list[str]], facts: Facts) -> set[str]:
    stations = where.get("station", ())
    riding = {c for c in facts.names["camera"] if facts.station_of[c] in stations}
    return riding | set(where.get("camera", ()))
