"""Hypotheses: what enters where (a group), how it runs in time (a course), who has it (a scope).

Groups of one size with courses of one size make a *family*; its members share the shapes of their
products when they are scored.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxvm.discover.courses import Course
from jaxvm.discover.groups import Group
from jaxvm.physics.catalogue import Entry
from jaxvm.physics.catalogue.entry import EACH
from jaxvm.physics.effects import Effect, Scope
from jaxvm.physics.forms import FORMS
from jaxvm.physics.ports import PORTS

FREE = 8
"""A hypothesis with more columns than this is a free form: a curve or a map."""

_FEW = 3
"""So many other groups of terms a name may have to be asked what else it may stand for."""

_UNEVEN = 4.0
"""Ratio of two neighbouring steps of a grid from which the wider one is a gap in it."""


@dataclass(frozen=True)
class Family:
    """Groups with the same number of terms, courses with the same number of bases, all scopes.

    Hypothesis (g, c, s) is valid where the scope is of the group's kind; `valid` has the shape
    [groups, courses, scopes]. `kinds` are those of the courses' drivers, `asked` the number of
    drivers and forms of that kind that the family asks about, `named` that among which each entry
    of the catalogue, by whether it varies, shares its prior.
    """

    groups: tuple[Group, ...]
    courses: tuple[Course, ...]
    scopes: tuple[Scope, ...]
    valid: np.ndarray
    kinds: tuple[str, ...]
    asked: tuple[int, ...]
    named: dict[tuple[str, bool], int]

    @property
    def n_terms(self) -> int:
        """Terms of each group."""
        return len(self.groups[0].terms)

    @property
    def n_bases(self) -> int:
        """Bases of each course."""
        return len(FORMS[self.courses[0].form].bases)

    def by_driver_and_form(self) -> dict[tuple[str, str], list[int]]:
        """Places of the courses that differ in their constants alone."""
        places: dict[tuple[str, str], list[int]] = {}
        for place, course in enumerate(self.courses):
            places.setdefault((course.driver, course.form), []).append(place)
        return places

    def with_best_constants(self, values: np.ndarray) -> list[tuple[int, int, int]]:
        """Of members that differ in the constants of their courses alone the one of largest value.

        `values` [groups, courses, scopes] are -inf for members that don't count.
        """
        best = []
        for places in self.by_driver_and_form().values():
            own = values[:, places]
            at = np.argmax(own, axis=1)
            found = np.argwhere(np.isfinite(own.max(axis=1)))
            best += [(int(g), places[at[g, s]], int(s)) for g, s in found]
        return best

    def at_peaks(self, values: np.ndarray) -> np.ndarray:
        """Values [groups, courses, scopes] with those at the best constant raised to the peak.

        The grid of a time constant is coarse: between its points the largest value is that of the
        parabola through the best point and its neighbours, over the log of the constant. Courses
        with no refined constant, or with several, are left as they are, and so is a point beside a
        gap of the grid: a parabola knows nothing of what is there.
        """
        raised = values.copy()
        for (_, form), places in self.by_driver_and_form().items():
            constants = FORMS[form].constants
            if len(constants) != 1 or not constants[0].refined or len(places) < 3:
                continue
            x = np.log([self.courses[place].constants[0] for place in places])
            step = np.diff(x)
            if (step <= 0.0).any():
                continue
            own = values[:, places]
            at = np.argmax(own, axis=1)
            g, s = np.nonzero((at > 0) & (at < len(places) - 1) & np.isfinite(own).all(axis=1))
            beside = np.stack([step[:-1], step[1:]])
            even = beside.max(axis=0) <= _UNEVEN * beside.min(axis=0)
            here = even[at[g, s] - 1]
            g, s = g[here], s[here]
            k = at[g, s]
            near = k + np.array([[-1], [0], [1]])
            raised[g, np.array(places)[k], s] = _peak(x[near], own[g, near, s])
        return raised


def _peak(x: Float[np.ndarray, "3 n"], y: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, " n"]:
    """Largest values of parabolas through three points, of which the middle one is highest."""
    left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[2] - y[1]) / (x[2] - x[1])
    curvature = np.minimum((right - left) / (0.5 * (x[2] - x[0])), -1e-300)
    slope = (left * (x[2] - x[1]) + right * (x[1] - x[0])) / (x[2] - x[0])
    return y[1] - np.where(slope == 0.0, 0.0, 0.5 * slope**2 / curvature)


@dataclass(frozen=True)
class Hypothesis:
    """One member of a family.

    `alternatives` is the number of drivers and forms that were asked along under each name (and of
    the same kind, under "" for none), marks counted, too: its own prior is the smaller, the more
    there were.
    """

    group: Group
    course: Course
    scope: Scope
    entries: tuple[Entry, ...]
    alternatives: dict[str, int] = field(default_factory=dict, compare=False)

    @property
    def n_columns(self) -> int:
        """Number of amplitudes: terms times bases."""
        return len(self.group.terms) * len(FORMS[self.course.form].bases)

    def same(self, other: "Hypothesis") -> bool:
        """Whether both say the same of the observations, whatever their names."""
        mine = self.group.terms, self.course.driver, self.course.form, self.scope
        return mine == (other.group.terms, other.course.driver, other.course.form, other.scope)

    def contains(self, other: "Hypothesis") -> bool:
        """Whether another is a special case of this one at the same place: a parabola's line."""
        terms = set(other.group.terms) <= set(self.group.terms)
        bases = set(FORMS[other.course.form].labels) <= set(FORMS[self.course.form].labels)
        driver = self.course.driver == other.course.driver
        return terms and bases and driver and self.scope == other.scope

    def covered(self, other: "Hypothesis") -> bool:
        """Whether this would name what another, that has no name, left over at the same place.

        A free-form curve or map that is not quite right leaves a remainder of the same kind,
        constant or changing, and a name for a remainder is a wrong name.
        """
        alike = (self.course.driver == "constant") == (other.course.driver == "constant")
        unnamed = bool(self.entries) and not other.entries
        return unnamed and alike and self.scope == other.scope and self.group.mark is None

    def remainder(self) -> "Hypothesis | None":
        """What it lacks of its name: the further terms of the fullest group that contains its own.

        A mount that turned about one axis, as far as one recording tells, may have turned about all
        of them. None where there are no further ones, or more than `FREE`.
        """
        own = set(self.group.terms)
        alike = [terms for e in self.entries[:1] for terms in e.groups if own < {*terms}]
        fullest = max((terms for terms in alike if len(terms) <= FREE), key=len, default=())
        further = tuple(term for term in fullest if term not in own)
        return replace(self, group=replace(self.group, terms=further)) if further else None

    def instead(self) -> list["Hypothesis"]:
        """What else its name may stand for: the fullest groups without any of these terms.

        Distortion that depends on the range may enter with the radius or without. None where there
        are many (waves of any length, seams anywhere): they differ by a constant, and not by kind.
        """
        further = self.remainder()
        known = {*self.group.terms, *(further.group.terms if further else ())}
        found = []
        for terms in sorted((g for e in self.entries[:1] for g in e.groups), key=len, reverse=True):
            if len(terms) <= FREE and not known & {*terms}:
                found.append(replace(self, group=replace(self.group, terms=terms)))
                known |= {*terms}
        return found if len(found) <= _FEW else []

    def effect(self, amplitudes) -> Effect:
        """The hypothesis as an effect with given amplitudes."""
        entry = self.entries[0] if self.entries else None
        return Effect(
            name=entry.physics if entry else describe(self),
            terms=self.group.terms,
            driver=self.course.driver,
            form=self.course.form,
            constants=self.course.constants,
            reference=self.course.reference,
            scope=self.scope,
            amplitudes=tuple(float(a) for a in amplitudes),
            catalogue_id=entry.id if entry else "",
        )


_MAPS = {
    "image": "the detector errs by a smooth map over the image",
    "fine image": "the detector errs by a map with fine detail over the image",
    "finest image": "the detector errs by a map with fine detail over the image",
    "fine plate": "the target stands off its plane by a smooth surface",
    "plate": "the target stands off its plane by a smooth surface",
    "pixels": "the detector errs by a wave of {:.0f} px over the image",
}


def describe(hypothesis: Hypothesis) -> str:
    """A hypothesis without a name, in words."""
    meaning = {port.name: port.meaning for port in PORTS}
    first = hypothesis.group.terms[0]
    words = _MAPS.get(first.driver, meaning[first.port])
    if first.driver == "pixels":
        words = words.format(1.0 / math.hypot(*first.constants))
    if first.driver in EACH:
        words += f", for each {first.driver} by its own amount"
    elif first.driver != "one" and first.driver not in _MAPS:
        words += f", varying with {first.driver.replace('_', ' ')}"
    if hypothesis.course.form != "constant":
        form = FORMS[hypothesis.course.form].words.format(driver=hypothesis.course.driver)
        words += f", {form}"
    return words
