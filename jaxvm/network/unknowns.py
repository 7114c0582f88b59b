"""Unknowns: which parameters of a state are free, and how they are grouped for elimination.

The unknowns x are increments of the free parameters, state = base + factor * x[column]. They are
ordered [shared | local]: shared unknowns (cameras, static poses, effects) couple everything, local
ones (the poses of one epoch, or one point) touch only their own observations and are eliminated
first. `column` of a held parameter is `n`, one past the last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from jaxvm.geometry.lenses import lens_family
from jaxvm.network.state import Layout
from jaxvm.physics.blocks import rounded
from jaxvm.physics.forms import FORMS

if TYPE_CHECKING:
    from jaxvm.network.scene import Scene


@dataclass(frozen=True)
class Unknowns:
    """Columns of the free parameters.

    Attributes:
        column: unknown of each position of the flat state; `n` where it is held.
        factor: change of the parameter for a unit change of its unknown.
        n_shared: number of shared unknowns.
        n_groups: number of local groups.
        group_size: unknowns in a local group; smaller groups are filled up.
        label: name of each position of the flat state.
        idle: positions that have an unknown but don't move (spare room for effects).
        momentary: positions of poses and amplitudes that belong to one epoch only.
    """

    column: Int[np.ndarray, " parameters"]
    factor: Float[np.ndarray, " parameters"]
    n_shared: int
    n_groups: int
    group_size: int
    label: tuple[str, ...]
    idle: Int[np.ndarray, " idle"]
    momentary: Int[np.ndarray, " momentary"]

    @property
    def n(self) -> int:
        """Length of x, padding included."""
        return self.n_shared + self.n_groups * self.group_size

    @property
    def active(self) -> np.ndarray:
        """True for the entries of x that move: neither padding nor idle."""
        mask = np.zeros(self.n + 1, bool)
        mask[self.column] = True
        mask[self.column[self.idle]] = False
        return mask[:-1]

    @property
    def of_one_epoch(self) -> np.ndarray:
        """True for the entries of x that one epoch alone determines (poses, amplitudes)."""
        mask = np.zeros(self.n + 1, bool)
        mask[self.column[self.momentary]] = True
        return mask[:-1]

    def names(self) -> list[str]:
        """Name of each unknown; "" for padding."""
        names = [""] * (self.n + 1)
        for position in range(len(self.column) - 1, -1, -1):
            names[self.column[position]] = self.label[position]
        return names[:-1]


def arrange(
    free: Float[np.ndarray, " parameters"],
    group: Int[np.ndarray, " parameters"],
    tie: Int[np.ndarray, " parameters"],
    factor: Float[np.ndarray, " parameters"],
    label: tuple[str, ...],
    idle: Int[np.ndarray, " idle"],
    momentary: Int[np.ndarray, " momentary"],
    spare: bool,
) -> Unknowns:
    """Order the free parameters.

    Args:
        free: True where a parameter is estimated.
        group: local group of each parameter, -1 for shared ones.
        tie: position of the parameter whose unknown it shares (itself, if it is on its own).
        factor: change of the parameter for a unit change of its unknown.
        label: names.
        idle: positions that are free in form only.
        momentary: positions of poses and amplitudes of one epoch.
        spare: whether there are empty groups up to a round number.
    """
    leads = free & (tie == np.arange(len(free)))
    shared = np.flatnonzero(leads & (group < 0))
    local = np.flatnonzero(leads & (group >= 0))
    # A group that nothing is free in keeps its place: a missing view is no other program.
    local = local[np.argsort(group[local], kind="stable")]
    member_of = group[local] - group[local].min(initial=len(free))
    n_groups = int(member_of.max(initial=-1)) + 1
    n_groups = rounded(n_groups) if spare and n_groups else n_groups
    sizes = np.bincount(member_of, minlength=n_groups)
    size = int(sizes.max(initial=0))
    starts = np.concatenate([[0], np.cumsum(sizes)])[:-1].astype(int)
    rank = np.arange(len(local)) - (starts[member_of] if len(local) else 0)
    n = len(shared) + n_groups * size
    column = np.full(len(free), n)
    column[shared] = np.arange(len(shared))
    column[local] = len(shared) + member_of * size + rank
    column = np.where(free, column[tie], n)
    return Unknowns(column, factor, len(shared), n_groups, size, label, idle, momentary)


def local_groups(layout: Layout, candidates: dict[str, np.ndarray], free: np.ndarray) -> np.ndarray:
    """Choose the family of local groups that eliminates most unknowns.

    Args:
        layout: layout of the state.
        candidates: for each family, the group of each parameter (-1: not of this family).
        free: True where a parameter is estimated.
    """
    counts = {name: int(np.sum(free & (group >= 0))) for name, group in candidates.items()}
    best = max(counts, key=lambda name: counts[name], default="")
    if not counts or counts[best] == 0:
        return np.full(layout.size, -1)
    return candidates[best]


def free_unknowns(scene: Scene) -> Unknowns:
    """Free parameters of the engineer's model, plus all amplitudes and refinable constants."""
    model, layout = scene.model, scene.network.layout
    free = np.zeros(layout.size, bool)
    tie = np.arange(layout.size)
    factor = np.ones(layout.size)
    label = [""] * layout.size
    by_epoch, by_point = np.full(layout.size, -1), np.full(layout.size, -1)

    def release(slots, names):
        free[slots] = True
        for slot, name in zip(np.ravel(slots), names, strict=True):
            label[slot] = name

    pose_parts = [f"turn {a}" for a in "xyz"] + [f"shift {a}" for a in "xyz"]
    for i, camera in enumerate(model.cameras):
        own = np.array([i])
        focal = layout.slots("focal", own)[0]
        if "focal" in camera.free:
            release(focal, [f"camera {camera.name}: focal {a}" for a in "xy"])
        if "aspect-locked-focal" in camera.free:
            release(focal, [f"camera {camera.name}: focal"] * 2)
            tie[focal[1]] = focal[0]
            ratio = np.asarray(scene.state.focal[i])
            factor[focal[1]] = ratio[1] / ratio[0]
        if "centre" in camera.free:
            slots = layout.slots("centre", own)[0]
            release(slots, [f"camera {camera.name}: centre {a}" for a in "xy"])
        n = lens_family(camera.lens).n_coefficients
        if "distortion" in camera.free and n:
            slots = layout.slots("distortion", own, n)[0]
            release(slots, [f"camera {camera.name}: distortion {k + 1}" for k in range(n)])
        if "pose" in camera.free:
            slots = layout.slots("station_from_camera", own)[0]
            release(slots, [f"camera {camera.name} in its station: {p}" for p in pose_parts])

    ids = scene.recording.epoch_ids
    bodies = [
        ("station", model.stations, scene.station_row, "world_from_station"),
        ("target", model.targets, scene.target_row, "carrier_from_target"),
    ]
    placed = placed_epochs(scene)
    for kind, of_kind, rows, table in bodies:
        for i, body in enumerate(of_kind):
            if "pose" not in body.free:
                continue
            moving = body.motion == "per-epoch"
            for epoch in np.flatnonzero(placed[kind][i]) if moving else (0,):
                slots = layout.slots(table, rows[i, epoch : epoch + 1])[0]
                when = f" at epoch {ids[epoch]}" if moving else ""
                release(slots, [f"{kind} {body.name}{when}: {p}" for p in pose_parts])
                if moving:
                    by_epoch[slots] = epoch
    for i, target in enumerate(model.targets):
        if "points" in target.free:
            rows = np.arange(scene.first_point[i], scene.first_point[i + 1])
            slots = layout.slots("point", rows)
            names = [f"point {p} of target {target.name}: {a}" for p in target.point_names
                     for a in "xyz"]  # fmt: skip
            release(slots, names)
            by_point[slots] = rows[:, None]
    for i, finder in enumerate(model.rangefinders):
        if "pose" in finder.free:
            slots = layout.slots("station_from_rangefinder", np.array([i]))[0]
            release(slots, [f"rangefinder {finder.name}: {p}" for p in pose_parts])
    links = layout.all("link")
    release(links, [f"link {k // 6}: {pose_parts[k % 6]}" for k in range(len(links))])
    idle = _release_effects(scene, layout, release, factor, tie)
    group = local_groups(layout, {"epochs": by_epoch, "points": by_point}, free)
    # Some epochs more or less are no other program; a block of images has points of its own.
    spare = group is by_epoch
    momentary = np.flatnonzero(free & (by_epoch >= 0))
    momentary = np.append(momentary, layout.all("amplitude")[_amplitudes_of_one_epoch(scene)])
    return arrange(free, group, tie, factor, tuple(label), idle, momentary, spare)


def _amplitudes_of_one_epoch(scene: Scene) -> np.ndarray:
    """Columns of the effects that one epoch has for itself."""
    own = [
        column
        for effect, (columns, _) in zip(scene.effects, scene.places(), strict=True)
        for k, column in enumerate(range(columns.start, columns.stop))
        if effect.terms[k // len(FORMS[effect.form].bases)].driver == "epoch"
    ]
    return np.array(own, int)


def _release_effects(scene: Scene, layout: Layout, release, factor, tie) -> np.ndarray:
    """Give every column and constant an unknown; returns the positions that stay idle.

    Spare columns and constants that can't be refined have an unknown too, so that the sizes of a
    problem depend on the room for effects and not on the effects.
    """
    amplitude, constant = layout.all("amplitude"), layout.all("constant")[:-1]
    release(amplitude, ["spare amplitude"] * len(amplitude))
    release(constant, ["spare constant"] * len(constant))
    busy = np.zeros(layout.size, bool)
    column, first = 0, 0
    owner: dict[str, int] = {}
    for effect in scene.effects:
        form = FORMS[effect.form]
        n, m = effect.n_columns, len(effect.constants)
        owner.setdefault(effect.name, first)
        if effect.shares in owner:
            tie[constant[first : first + m]] = constant[owner[effect.shares] + np.arange(m)]
        release(amplitude[column : column + n], [f"{effect.name}: amplitude"] * n)
        release(
            constant[first : first + m],
            [f"{effect.name}: {form.constants[k].name}" for k in range(m)],
        )
        busy[amplitude[column : column + n]] = True
        refined = [first + k for k in range(m) if form.constants[k].refined]
        busy[constant[refined]] = True
        column, first = column + n, first + m
    # The unknown of a constant is its relative change.
    factor[constant] = np.asarray(scene.state.constant)[:-1]
    slots = np.concatenate([amplitude, constant])
    return slots[~busy[slots]]


def placed_epochs(scene: Scene) -> dict[str, np.ndarray]:
    """For stations and targets, whether they are anywhere in an epoch [body, epoch].

    The pose of a body that moves freely is unknown where neither images nor links touch it: it is
    no unknown of the adjustment then, and a range to it says nothing.
    """
    seen, model = _epochs_seen(scene), scene.model
    return {
        kind: seen[kind][: len(bodies)]
        | np.array([b.motion != "per-epoch" or "pose" not in b.free for b in bodies], bool)[:, None]
        for kind, bodies in (("station", model.stations), ("target", model.targets))
    }


def _epochs_seen(scene: Scene) -> dict[str, np.ndarray]:
    """For stations and targets, whether any observation touches them [body, epoch]."""
    obs, model = scene.recording.observations, scene.model
    n_epochs, places = len(scene.recording.time), scene.station_places
    seen = {
        "station": np.zeros((len(model.stations) + 1, n_epochs), bool),
        "target": np.zeros((len(model.targets), n_epochs), bool),
        "camera": np.zeros((len(model.cameras), n_epochs), bool),
    }
    seen["target"][obs.target, obs.epoch] = True
    seen["camera"][obs.camera, obs.epoch] = True
    links = scene.recording.links
    if links is not None:
        epoch = np.maximum(links.epoch, 0)
        for nodes in (links.from_node, links.to_node):
            for (kind, number), when in zip(nodes, epoch, strict=True):
                seen[kind][number, when] = True
    # What a station carries touches it, too; the last row collects what the world carries.
    for kind, bodies in (("camera", model.cameras), ("target", model.targets)):
        carrier = np.array([places.get(body.station, -1) for body in bodies], int)
        np.logical_or.at(seen["station"], carrier, seen[kind])
    return seen
