"""Unknowns: which parameters of a state are free, and how they are grouped for elimination.

The unknowns x are increments of the free parameters, state = base + factor * x[column]. They are
ordered [shared | local]: shared unknowns (cameras, static poses, effects) couple everything, local
ones (the poses of one epoch, or one point) touch only their own observations and are eliminated
first. `column` of a held parameter is `n`, one past the last.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxvm.network.state import Layout


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
        momentary: positions of poses that belong to one epoch only.
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
        """True for the entries of x that one epoch alone determines (poses per epoch)."""
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
) -> Unknowns:
    """Order the free parameters.

    Args:
        free: True where a parameter is estimated.
        group: local group of each parameter, -1 for shared ones.
        tie: position of the parameter whose unknown it shares (itself, if it is on its own).
        factor: change of the parameter for a unit change of its unknown.
        label: names.
        idle: positions that are free in form only.
        momentary: positions of poses of one epoch.
    """
    leads = free & (tie == np.arange(len(free)))
    shared = np.flatnonzero(leads & (group < 0))
    local = np.flatnonzero(leads & (group >= 0))
    groups, member_of = np.unique(group[local], return_inverse=True)
    order = np.argsort(member_of, kind="stable")
    local, member_of = local[order], member_of[order]
    sizes = np.bincount(member_of, minlength=len(groups)) if len(local) else np.zeros(0, int)
    size = int(sizes.max()) if len(sizes) else 0
    starts = np.concatenate([[0], np.cumsum(sizes)])[:-1].astype(int)
    rank = np.arange(len(local)) - (starts[member_of] if len(local) else 0)
    n = len(shared) + len(groups) * size
    column = np.full(len(free), n)
    column[shared] = np.arange(len(shared))
    column[local] = len(shared) + member_of * size + rank
    column = np.where(free, column[tie], n)
    return Unknowns(column, factor, len(shared), len(groups), size, label, idle, momentary)


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
