"""Families of hypotheses over the cells of a scene: what does not change from one fit to the next.

A scope of a relay network holds few of its cells, and not every group is asked about every scope:
hypotheses are kept by scope, each with the cells that it acts on and no others.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jaxvm.discover.cells import Arrangement, gathered, padded_lists
from jaxvm.discover.hypotheses import Family
from jaxvm.discover.once import once
from jaxvm.network.binding import in_scope, ranges_in_scope
from jaxvm.network.scene import Scene
from jaxvm.physics.effects import Scope, evaluate
from jaxvm.physics.forms import BASIS_INDEX, FORMS

MOST_PRODUCTS = 6_000_000
"""Numbers that products within groups, of weights or of tangents, may take: 48 MB."""


@dataclass(frozen=True)
class Place:
    """The cells of one scope.

    Attributes:
        cells: which of all cells.
        group: of these cells those of each local group, padded with their number.
        epoch: of these cells those of each epoch, padded with their number.
    """

    cells: Int[np.ndarray, " n"]
    group: Int[np.ndarray, "groups width"]
    epoch: Int[np.ndarray, "epochs wide"]

    @classmethod
    def of(cls, arrangement: Arrangement, inside: np.ndarray) -> "Place":
        """The place of the cells that are inside."""
        cells = arrangement.cells
        own = np.flatnonzero(inside)
        n_groups = len(cells.group)
        label = cells.group_of[own]
        touched = np.unique(label[label < n_groups])
        rank = np.full(n_groups + 1, -1)
        rank[touched] = np.arange(len(touched))
        return cls(
            cells=own,
            group=padded_lists(rank[label], len(touched), len(own)),
            epoch=padded_lists(cells.epoch_of[own], cells.n_epochs, len(own)),
        )


@dataclass(frozen=True)
class Part:
    """Courses of a family at one scope.

    Attributes:
        scope: which of the family's scopes.
        courses: which of the family's courses.
        place: the cells in scope.
        table: all courses of the family, in each view.
        view: of each of these cells.
    """

    scope: int
    courses: Int[np.ndarray, " b"]
    place: Place
    table: Float[np.ndarray, "courses bases views"]
    view: Int[np.ndarray, " n"]

    @once
    def weights(self) -> Float[np.ndarray, "b bases n"]:
        """Weights of each course at each of these cells."""
        return self.table[self.courses][:, :, self.view]

    @once
    def by_group(self) -> Float[np.ndarray, "groups b_bases width"]:
        """Weights gathered by local group."""
        return np.moveaxis(gathered(self._flat, self.place.group), 1, 0)

    @once
    def by_epoch(self) -> Float[np.ndarray, "epochs b_bases wide"]:
        """Weights gathered by epoch."""
        return np.moveaxis(gathered(self._flat, self.place.epoch), 1, 0)

    @once
    def within(self) -> Float[np.ndarray, "b bases bases groups_width_width"] | None:
        """Products of the weights of two cells of a group; None where they would be too many."""
        b, n_bases, _ = self.weights.shape
        if b * n_bases**2 * self.place.group.size * self.place.group.shape[1] > MOST_PRODUCTS:
            return None
        own = gathered(self._flat, self.place.group).reshape(b, n_bases, *self.place.group.shape)
        return np.einsum("bigv,bjgw->bijgvw", own, own).reshape(b, n_bases, n_bases, -1)

    @property
    def _flat(self) -> np.ndarray:
        return self.weights.reshape(-1, self.weights.shape[2])

    def forget(self) -> None:
        """Drop what was gathered: it takes more room than time."""
        for name in ("weights", "by_group", "by_epoch", "within"):
            self.__dict__.pop(name, None)


@dataclass(frozen=True)
class Battery:
    """Families of hypotheses, and the parts of each over the cells of a scene."""

    families: tuple[Family, ...]
    parts: tuple[tuple[Part, ...], ...]

    @once
    def n_columns(self) -> int:
        """Number of columns of all hypotheses."""
        return sum(int(np.sum(f.valid)) * f.n_terms * f.n_bases for f in self.families)


def battery(scene: Scene, arrangement: Arrangement, families: tuple[Family, ...]) -> Battery:
    """Families with their courses and scopes over the cells of a scene."""
    inside = _inside(scene, arrangement, families[0].scopes)
    places: dict[int, Place] = {}
    parts = []
    for family, table in zip(families, course_tables(scene, families), strict=True):
        asked = np.asarray(family.valid.any(axis=0))
        own = []
        for s in map(int, np.flatnonzero(asked.any(axis=0) & inside.any(axis=1))):
            if s not in places:
                places[s] = Place.of(arrangement, inside[s])
            courses, view = np.flatnonzero(asked[:, s]), arrangement.view[places[s].cells]
            own.append(Part(s, courses, places[s], table, view))
        parts.append(tuple(own))
    return Battery(families, tuple(parts))


def _inside(scene: Scene, arrangement: Arrangement, scopes: tuple[Scope, ...]) -> np.ndarray:
    """Whether a cell is in a scope [scopes, cells]."""
    found = []
    for scope in scopes:
        own = [in_scope(scene, scope, rows) for rows in scene.tables]
        if scene.network.ranges is not None:
            own.append(ranges_in_scope(scene, scope))
        found.append(np.concatenate(own))
    inside = np.stack(found) > 0
    first = arrangement.rows.min(axis=1)  # any observation speaks for its cell
    return inside[:, np.where(first < inside.shape[1], first, 0)]


def course_tables(scene: Scene, families: tuple[Family, ...]) -> list[np.ndarray]:
    """Courses [courses, bases, views] of each family."""
    channels = scene.network.channels
    number = {name: k for k, name in enumerate(channels.names)}
    place: dict[tuple, int] = {}
    columns, index = [], []
    for family in families:
        of_family = []
        for course in family.courses:
            form = FORMS[course.form]
            reference = course.reference if form.centred else 0.0
            for k, name in enumerate(form.bases):
                own = (*form.read_by(k, course.constants), 1.0, 1.0)[:2]
                key = (course.driver, reference, name, own)
                if key not in place:
                    place[key] = len(columns)
                    columns.append((BASIS_INDEX[name], number[course.driver], reference, own))
                of_family.append(place[key])
        index.append(np.array(of_family).reshape(len(family.courses), family.n_bases))
    basis, channel, reference, constants = map(np.array, zip(*columns, strict=True))
    table = evaluate(basis, channel, reference, constants, channels)
    return [np.asarray(table)[own] for own in index]
