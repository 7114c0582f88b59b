"""The space of hypotheses: port x driver x form x scope, enumerated for one recording.

A *group* is what enters where (terms), a *course* how it runs in time (driver, form, constants), a
*scope* who has it. Groups of one size with courses of one size make a *family*; its members share
the shapes of their products when they are scored.
"""

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jaxvm.discover.courses import (
    Course,
    air_is_logged,
    camera_of,
    courses_of_marks,
    driver_kind,
    enumerate_courses,
    kinds_in_scope,
)
from jaxvm.discover.curves import CURVED, CURVED_FAST, curved_drivers
from jaxvm.discover.groups import (
    Group,
    entity_of,
    every_port,
    is_special,
    marks_of,
    patterned_groups,
    single_groups,
)
from jaxvm.network.scene import Scene
from jaxvm.physics.catalogue import CATALOGUE, Entry, entries_for
from jaxvm.physics.catalogue.entry import EACH, each
from jaxvm.physics.catalogue.maps import fine_image_map, image_map, plate_map
from jaxvm.physics.drivers import OWN_BODY, OWN_POWER_ON
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.forms import FORMS
from jaxvm.physics.ports import PORTS

NAMED_ONLY = (
    "affine",
    "affine lag",
    "lag with state",
    "transient with state",
    "parabola",
    "turning",
    "square",
    "ageing",
    "staircase",
    "doubling",
    "two decays",
    "direction",
)
"""Forms that are asked only where the catalogue names them."""

FREE = 8
"""A hypothesis with more columns than this is a free form: a curve or a map."""


@dataclass(frozen=True)
class Family:
    """Groups with the same number of terms, courses with the same number of bases, all scopes.

    Hypothesis (g, c, s) is valid where the scope is of the group's kind; `valid` has the shape
    [groups, courses, scopes]. `kinds` are those of the courses' drivers, `asked` the number of
    drivers and forms of that kind that the family asks about, `named` that in which each entry of
    the catalogue is asked.
    """

    groups: tuple[Group, ...]
    courses: tuple[Course, ...]
    scopes: tuple[Scope, ...]
    valid: np.ndarray
    kinds: tuple[str, ...]
    asked: tuple[int, ...]
    named: dict[str, int]

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
        with no refined constant, or with several, are left as they are.
        """
        raised = values.copy()
        for (_, form), places in self.by_driver_and_form().items():
            constants = FORMS[form].constants
            if len(constants) != 1 or not constants[0].refined or len(places) < 3:
                continue
            x = np.log([self.courses[place].constants[0] for place in places])
            if (np.diff(x) <= 0.0).any():
                continue
            own = values[:, places]
            at = np.argmax(own, axis=1)
            g, s = np.nonzero((at > 0) & (at < len(places) - 1) & np.isfinite(own).all(axis=1))
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

    def same(self, other: "Hypothesis") -> bool:
        """Whether both say the same of the observations, whatever their names."""
        mine = self.group.terms, self.course.driver, self.course.form, self.scope
        return mine == (other.group.terms, other.course.driver, other.course.form, other.scope)

    def contains(self, other: "Hypothesis") -> bool:
        """Whether another is a special case of this one at the same place: a parabola's line."""
        terms = set(other.group.terms) <= set(self.group.terms)
        bases = set(FORMS[other.course.form].bases) <= set(FORMS[self.course.form].bases)
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


def enumerate_hypotheses(scene: Scene) -> tuple[Family, ...]:
    """All hypotheses that a recording can be asked about."""
    scopes = _scopes(scene)
    courses = enumerate_courses(scene)
    kinds = {
        course.driver: kinds_in_scope(
            driver_kind(scene, course.driver), course.driver, Scope(), scene
        )
        for course in courses
    }
    named = [
        Group(terms, entry.entity)
        for entry in CATALOGUE
        if entry.entity != "mark"
        for terms in entry.groups
        if terms[0].driver not in EACH
    ]
    single, patterned = single_groups(), patterned_groups()
    # Named groups without a pattern follow every course; the others only those that have a name.
    listed = {*single, *patterned}
    every_named = list(dict.fromkeys(named))
    moving = [g for g in every_named if g not in listed and not is_special(g)]
    common = [course for course in courses if course.form not in NAMED_ONLY]
    by_bases = {n: [c for c in common if len(FORMS[c.form].bases) == n] for n in (1, 2)}
    constant = [Course("constant", "constant")]
    marks = marks_of(scene)
    of_marks = courses_of_marks(scene, courses, len({group.mark for group in marks}))
    candidates = [
        (single, by_bases[1]),
        (single, by_bases[2]),
        (patterned, constant),
        *((_of_size(moving, size), by_bases[n]) for size in (1, 2, 3) for n in (1, 2)),
        *_as_named(every_named, courses, kinds, listed),
        *((_of_size(marks, size), of_marks) for size in (1, 2, 3)),
        *_free_forms(scene, constant),
        *_of_each_mark(scene, courses, kinds),
    ]
    asked = _asked_of_names(scene, courses)
    families = (
        _family(scene, groups, own, scopes, asked) for groups, own in candidates if groups and own
    )
    return tuple(family for family in families if family.valid.any())


def families_of(scene: Scene, groups: list[Group]) -> tuple[Family, ...]:
    """Families of given groups that never change, for all scopes."""
    constant, scopes = [Course("constant", "constant")], _scopes(scene)
    asked = _asked_of_names(scene, constant)
    return tuple(_family(scene, [group], constant, scopes, asked) for group in groups)


def member(family: Family, index: tuple[int, int, int], scene: Scene) -> Hypothesis:
    """The hypothesis at [group, course, scope] of a family, with the names it has."""
    group, course, scope = (
        family.groups[index[0]],
        family.courses[index[1]],
        family.scopes[index[2]],
    )
    if group.mark is not None:
        target = scene.model.targets[group.mark[0]]
        scope = Scope(target=(target.name,), point=(target.point_names[group.mark[1]],))
    kinds = kinds_in_scope(family.kinds[index[1]], course.driver, scope, scene)
    entries = entries_for(group.terms, group.entity, kinds, course.form)
    each = len(family.groups) if group.mark is not None else 1
    asked = {entry.id: each * family.named[entry.id] * _variants(entry, group) for entry in entries}
    asked[""] = each * family.asked[index[1]]
    return Hypothesis(group, course, scope, entries, asked)


def _variants(entry: Entry, group: Group) -> int:
    """Number of groups of an entry that differ in the constants of their patterns alone."""
    if not any(term.constants for term in group.terms):
        return 1
    alike = [(term.port, term.driver, term.basis) for term in group.terms]
    return sum(alike == [(t.port, t.driver, t.basis) for t in own] for own in entry.groups) or 1


def _asked_of_names(scene: Scene, courses: list[Course]) -> dict[str, int]:
    """Number of drivers and forms in which each entry of the catalogue is asked of one body."""
    model = scene.model
    one = {
        kind: Scope(**{kind: (bodies[0].name,)})
        for kind, bodies in (
            ("camera", model.cameras),
            ("station", model.stations),
            ("target", model.targets),
            ("rangefinder", model.rangefinders),
        )
        if bodies
    }
    if model.targets:
        one |= {"face": one["target"], "mark": one["target"]}
    distinct = {(course.driver, course.form): course for course in courses}
    kinds = {
        (kind, *named): kinds_in_scope(driver_kind(scene, named[0]), named[0], scope, scene)
        for kind, scope in one.items()
        for named, course in distinct.items()
        if _follows(scene, scope, course)
    }

    def asked(entry: Entry) -> int:
        own = (kinds.get((entry.entity, *named), ()) for named in distinct)
        return sum(entry.takes(k, form) for k, (_, form) in zip(own, distinct, strict=True))

    return {entry.id: max(asked(entry), 1) for entry in CATALOGUE}


def _family(scene: Scene, groups, courses, scopes, named: dict[str, int]) -> Family:
    driven = [driver_kind(scene, course.driver) for course in courses]
    distinct = set(zip(driven, ((c.driver, c.form) for c in courses), strict=True))
    asked = Counter(kind for kind, _ in distinct)
    group_scope = np.array([[_has(scope, group) for scope in scopes] for group in groups])
    course_scope = np.array([[_follows(scene, s, course) for s in scopes] for course in courses])
    valid = group_scope[:, None, :] & course_scope[None]
    # What nothing in this recording has (a rangefinder, say) is not computed either.
    seen = np.flatnonzero(valid.any(axis=(1, 2)))
    kept = tuple(groups[g] for g in seen)
    return Family(
        kept,
        tuple(courses),
        tuple(scopes),
        valid[seen],
        tuple(driven),
        tuple(asked[kind] for kind in driven),
        named,
    )


def _has(scope: Scope, group: Group) -> bool:
    """Whether the bodies of a scope have a group; a mark, which has its own, is in that of all."""
    if group.mark is not None:
        return scope == Scope()
    return _kind(scope) == group.entity and (not group.target or scope.target == (group.target,))


def _follows(scene: Scene, scope: Scope, course: Course) -> bool:
    """Whether a course is one for the bodies of a scope: some drivers belong to cameras."""
    driver = course.driver
    if driver in (OWN_BODY, OWN_POWER_ON):
        return len(scope.camera) > 1
    if scope.target and camera_of(driver, scene) and course.form != "doubling":
        # Targets are as warm as the air. What doubles is the dark current of a camera.
        return not air_is_logged(scene)
    camera = driver.removeprefix("time since power-on of ")
    return camera == driver or scope.camera == (camera,)


def _as_named(
    groups: list[Group],
    courses: list[Course],
    kinds: dict[str, tuple[str, ...]],
    listed: set[Group],
):
    """Groups and courses that are asked only where the catalogue has a name for both together.

    Those that are `listed` are asked with the constant course already.
    """
    # At the ends of a recording a step is a constant, which a map without a name explains.
    steps = [place for place, course in enumerate(courses) if course.form == "step"]
    within = steps[len(steps) // 8 : len(steps) - len(steps) // 8]
    together: dict[tuple, list[Group]] = {}
    for group in [*groups, *every_port()]:
        entries = [e for e in CATALOGUE if group.terms in e.groups and e.entity == group.entity]
        special = is_special(group)
        many = len(group.terms) > FREE
        own = tuple(
            place
            for place, course in enumerate(courses)
            if not (many and course.form == "step" and place not in within)
            and (course.form in NAMED_ONLY or (special and (place or group not in listed)))
            and any(entry.takes(kinds[course.driver], course.form) for entry in entries)
        )
        for n in (1, 2, 3):
            of_size = tuple(k for k in own if len(FORMS[courses[k].form].bases) == n)
            if of_size:
                together.setdefault((len(group.terms), of_size), []).append(group)
    for (_, places), members in together.items():
        yield members, [courses[k] for k in places]


def _of_size(groups: list[Group], n_terms: int) -> list[Group]:
    return [group for group in groups if len(group.terms) == n_terms]


def _kind(scope: Scope) -> str:
    if scope.camera and scope.target:
        return "face"
    return next(iter(scope.as_dict()), "all")


def _scopes(scene: Scene) -> list[Scope]:
    """Single entities and, where there are several, all of a kind together; the first is all."""
    model, scopes = scene.model, [Scope()]
    for kind, bodies in (
        ("camera", model.cameras),
        ("target", model.targets),
        ("station", model.stations),
        ("rangefinder", model.rangefinders),
    ):
        names = tuple(body.name for body in bodies)
        scopes += [Scope(**{kind: (name,)}) for name in names]
        if len(names) > 1:
            scopes.append(Scope(**{kind: names}))
    return scopes + _faces(scene)


def _faces(scene: Scene) -> list[Scope]:
    """Targets as single cameras see them, where cameras of several stations see them."""
    model, obs = scene.model, scene.recording.observations
    seen = np.unique(np.stack([obs.target, obs.camera], axis=1), axis=0)
    found = []
    for t, target in enumerate(model.targets):
        seers = [model.cameras[c] for c in seen[seen[:, 0] == t, 1]]
        if len({camera.station for camera in seers}) > 1:
            found += [Scope(camera=(camera.name,), target=(target.name,)) for camera in seers]
    return found


def _free_forms(scene: Scene, constant: list[Course]):
    """Curves of ports with time or a quantity, maps over the image and over plates."""
    for form, curved in (("curve", CURVED), ("fine curve", CURVED_FAST)):
        curves = [Course(name, form, own) for name, own in curved_drivers(scene, form)]
        for n in (1, 2, 3):
            groups = [
                Group(tuple(Term(port) for port in ports), entity_of(ports[0]))
                for ports in curved
                if len(ports) == n
            ]
            yield groups, curves
    yield [Group(image_map(), "camera")], constant
    yield [Group(fine_image_map(), "camera")], constant
    yield [Group(plate_map(), "target")], constant


def _of_each_mark(scene: Scene, courses: list[Course], kinds: dict[str, tuple[str, ...]]):
    """Physics that every mark of a target has to an extent of its own."""
    for entry in CATALOGUE:
        for terms in (own for own in entry.groups if own[0].driver == "mark"):
            ports = [term.port for term in terms]
            known = [
                course
                for course in courses
                if entry.takes(kinds[course.driver], course.form)
                and len(FORMS[course.form].bases) == 1
            ]
            for target, first in zip(scene.model.targets, scene.first_point, strict=False):
                if "points" not in target.free:
                    marks = range(int(first), int(first) + len(target.points))
                    own = each("mark", *ports, numbers=marks)
                    yield [Group(own, "target", target=target.name)], known
