"""Where stations truly are, epoch by epoch, and whether all of them hang together."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from jaxvm.recording.errors import did_you_mean
from jaxvm.recording.model import Motion, Station
from jaxvm.scenes.deform import displacements
from jaxvm.scenes.describe import Description
from jaxvm.scenes.layouts import LAYOUTS, Impossible, Plan, Structure

LEVEL_RAD = 0.03
"""Standard deviation with which stations are put up level and in line."""


@dataclass(frozen=True, eq=False)
class Placement:
    """True poses world_from_station of all stations at all epochs.

    Attributes:
        rotation, shift: of each station and epoch (shift in m).
        held: stations whose poses the model gives.
        moving: stations that have another pose in every epoch.
    """

    rotation: Float[np.ndarray, "stations epochs 3 3"]
    shift: Float[np.ndarray, "stations epochs 3"]
    held: Bool[np.ndarray, " stations"]
    moving: Bool[np.ndarray, " stations"]

    @property
    def vectors(self) -> Float[np.ndarray, "stations epochs 6"]:
        """The same as turn (rad) and shift (m)."""
        n, epochs, _ = self.shift.shape
        turn = Rotation.from_matrix(self.rotation.reshape(-1, 3, 3)).as_rotvec()
        return np.concatenate([turn.reshape(n, epochs, 3), self.shift], axis=2)

    @property
    def rows(self) -> Int[np.ndarray, "stations epochs"]:
        """Number of each pose: one for all epochs of a station that stays, one for each else."""
        epochs = self.shift.shape[1]
        count = np.where(self.moving, epochs, 1)
        first = np.cumsum(count) - count
        return first[:, None] + np.where(self.moving[:, None], np.arange(epochs), 0)

    def stations(self, names: tuple[str, ...]) -> tuple[Station, ...]:
        """What a model says of them: held ones have their poses, the others are free."""
        motions: dict[bool, Motion] = {False: "static", True: "per-epoch"}
        first = self.vectors[:, 0]
        return tuple(
            Station(
                name,
                motions[bool(moving)],
                pose if held else None,
                frozenset() if held else frozenset({"pose"}),
            )
            for name, moving, held, pose in zip(names, self.moving, self.held, first, strict=True)
        )


def structure_of(description: Description, rng: np.random.Generator) -> Structure:
    """Stations and lines of the description's layout.

    Raises:
        RecordingError: sizes that no such structure can have.
    """
    plan = Plan(
        stations=description.stations,
        size=description.structure,
        reach=description.reach_m,
        redundancy=description.redundancy,
        cameras=description.cameras.count,
        links=description.observe == "links",
        rng=rng,
    )
    try:
        made = LAYOUTS[description.layout].place(plan)
    except Impossible as problem:
        raise description.error(problem.table, problem.key, str(problem)) from None
    if len(made.lines) == 0:
        key = None if description.reach_m is None else "reach_m"
        raise description.error("sights", key, "no station sees another; raise sights.reach_m")
    return made.both_ways() if description.both_ways else made


def place_stations(
    description: Description, structure: Structure, rng: np.random.Generator
) -> Placement:
    """True poses of the stations, carried along by the deformation of their structure.

    Raises:
        RecordingError: a station that is to be held is none of the structure's.
    """
    held = np.zeros(len(structure.names), bool)
    held[structure.held] = not description.held
    place = {name: k for k, name in enumerate(structure.names)}
    for name in description.held:
        if name not in place:
            raise description.error(
                "",
                "held",
                f'there is no station "{name}" to be held; {did_you_mean(name, place)}',
            )
        held[place[name]] = True
    n, epochs = len(held), description.epochs
    astray = Rotation.from_rotvec(rng.normal(0.0, LEVEL_RAD, (n, 3)))
    heading = structure.heading[:, None] * [0.0, 0.0, 1.0]
    base = (Rotation.from_rotvec(heading) * astray).as_matrix()
    turn, shift = np.zeros((2, n, epochs, 3))
    wanders = epochs > 1 and any(structure.wander)
    moving = structure.moves & ~held & bool(description.deformation or wanders)
    if description.deformation and moving.any():
        first = structure.position[np.argmax(held)]
        turn[moving], shift[moving] = displacements(
            structure.position[moving],
            structure.axis,
            first if structure.origin is None else np.array(structure.origin),
            description.deformation,
            description.interval_s * np.arange(epochs),
            description.period_s,
        )
    if wanders:
        for part, spread in zip((turn, shift), structure.wander, strict=True):
            part[moving] += spread * rng.standard_normal((int(moving.sum()), epochs, 3))
    turned = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(n, epochs, 3, 3)
    return Placement(turned @ base[:, None], structure.position[:, None] + shift, held, moving)


@dataclass(frozen=True, eq=False)
class Ties:
    """What joins two stations at an epoch: a view or a link."""

    a: Int[np.ndarray, " n"]
    b: Int[np.ndarray, " n"]
    epoch: Int[np.ndarray, " n"]


def check_joined(
    description: Description, structure: Structure, placement: Placement, ties: Ties
) -> None:
    """Check that ties lead from a held station to every pose.

    Raises:
        RecordingError: a station that nobody sees, or that is joined to no held one; by name.
    """
    rows = placement.rows
    n_rows = int(rows[-1, -1]) + 1
    ends = rows[ties.a, ties.epoch], rows[ties.b, ties.epoch]
    graph = coo_matrix((np.ones(len(ties.a)), ends), (n_rows, n_rows))
    part = connected_components(graph, directed=False)[1]
    known = np.zeros(int(part.max()) + 1, bool)
    known[part[rows[placement.held].ravel()]] = True
    lost = ~known[part[rows]]
    if not lost.any():
        return
    names = np.array(structure.names, object)
    tied = np.zeros(len(names), bool)
    tied[ties.a] = tied[ties.b] = True
    alone = lost.any(axis=1) & ~tied
    which = np.flatnonzero(alone if alone.any() else lost.any(axis=1))
    when = ""
    if alone.any():
        what = "is seen by no station and sees none"
    else:
        what = f"is joined to no held station ({', '.join(names[placement.held][:3])})"
        if placement.moving[which[0]]:
            when = f" at epoch {int(np.flatnonzero(lost[which[0]])[0])}"
    more = f" (nor are {len(which) - 1} more)" if len(which) > 1 else ""
    key = None if description.reach_m is None else "reach_m"
    raise description.error(
        "sights",
        key,
        f'station "{names[which[0]]}" {what}{when}{more}; raise sights.reach_m, or let cameras and '
        "marks be seen better (cameras.focal_px, marks.size_m, marks.incidence_deg)",
    )
