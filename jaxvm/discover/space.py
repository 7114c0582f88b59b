"""The space of hypotheses: port x driver x form x scope, enumerated for one recording."""

from collections import Counter

import numpy as np

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
from jaxvm.discover.hypotheses import FREE, Family, Hypothesis
from jaxvm.network.scene import Scene
from jaxvm.physics.catalogue import CATALOGUE, Entry, entries_for, entries_of
from jaxvm.physics.catalogue.entry import EACH, each
from jaxvm.physics.catalogue.maps import fine_image_map, image_map, plate_map
from jaxvm.physics.drivers import OWN_BODY, OWN_POWER_ON
from jaxvm.physics.effects import Scope, Term
from jaxvm.physics.forms import FORMS

NAMED_ONLY = (
    "affine",
    "affine lag",
    "lag with state",
    "delay",
    "transient with state",
    "hysteresis with state",
    "parabola",
    "turning",
    "square",
    "ageing",
    "staircase",
    "doubling",
    "fading",
    "two decays",
    "direction",
)
"""Forms that are asked only where the catalogue names them."""


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
    varies = course.form != "constant"
    asked = {e.id: each * family.named[e.id, varies] * _variants(e, group) for e in entries}
    asked[""] = each * family.asked[index[1]]
    return Hypothesis(group, course, scope, entries, asked)


def _variants(entry: Entry, group: Group) -> int:
    """Number of groups of an entry that differ in the constants of their patterns alone."""
    if not any(term.constants for term in group.terms):
        return 1
    alike = [(term.port, term.driver, term.basis) for term in group.terms]
    return sum(alike == [(t.port, t.driver, t.basis) for t in own] for own in entry.groups) or 1


def _asked_of_names(scene: Scene, courses: list[Course]) -> dict[tuple[str, bool], int]:
    """Number of drivers and forms among which each entry of the catalogue shares its prior.

    By its name and by whether it varies. They are those in which it is asked of one body; where it
    may also never change, that has one half of the prior, and all that varies the other.
    """
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
        view = Scope(camera=one["camera"].camera, target=one["target"].target)
        one |= {"face": one["target"], "mark": one["target"], "view": view}
    distinct = {(course.driver, course.form): course for course in courses}
    kinds = {
        (kind, *named): kinds_in_scope(driver_kind(scene, named[0]), named[0], scope, scene)
        for kind, scope in one.items()
        for named, course in distinct.items()
        if _follows(scene, scope, course)
    }

    def asked(entry: Entry, varies: bool) -> int:
        return sum(
            entry.takes(kinds.get((entry.entity, driver, form), ()), form)
            for driver, form in distinct
            if (form != "constant") == varies
        )

    shares = {}
    for entry in CATALOGUE:
        own = {varies: asked(entry, varies) for varies in (False, True)}
        halves = 2 if all(own.values()) else 1
        shares |= {(entry.id, varies): max(halves * n, 1) for varies, n in own.items()}
    return shares


def _family(scene: Scene, groups, courses, scopes, named: dict[tuple[str, bool], int]) -> Family:
    driven = [driver_kind(scene, course.driver) for course in courses]
    distinct = set(zip(driven, ((c.driver, c.form) for c in courses), strict=True))
    asked = Counter(kind for kind, _ in distinct)
    faces = _faces(scene)
    group_scope = np.array([[_has(scope, group, faces) for scope in scopes] for group in groups])
    # Courses that differ in their constants alone are followed by the same bodies.
    alike = {(course.driver, course.form): course for course in courses}
    known = {key: [_follows(scene, s, course) for s in scopes] for key, course in alike.items()}
    course_scope = np.array([known[course.driver, course.form] for course in courses])
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


def _has(scope: Scope, group: Group, faces: set[Scope]) -> bool:
    """Whether the bodies of a scope have a group; a mark, which has its own, is in that of all."""
    if group.mark is not None:
        return scope == Scope()
    alike = scope in faces if group.entity == "face" else _kind(scope) == group.entity
    return alike and (not group.target or scope.target == (group.target,))


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
    asked = [(course.driver, course.form) for course in courses]
    distinct = set(asked)
    together: dict[tuple, list[Group]] = {}
    for group in [*groups, *every_port()]:
        entries = entries_of(group.terms, group.entity)
        taken = {
            (driver, form)
            for driver, form in distinct
            if any(entry.takes(kinds[driver], form) for entry in entries)
        }
        special = is_special(group)
        many = len(group.terms) > FREE
        own = tuple(
            place
            for place, course in enumerate(courses)
            if asked[place] in taken
            and not (many and course.form == "step" and place not in within)
            and (course.form in NAMED_ONLY or (special and (place or group not in listed)))
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
        return "view"
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
    return scopes + _views(scene)


def _views(scene: Scene) -> list[Scope]:
    """Targets as single cameras see them."""
    cameras, targets = scene.model.cameras, scene.model.targets
    obs = scene.recording.observations
    seen = np.flatnonzero(np.bincount(obs.target * len(cameras) + obs.camera))
    pairs = (divmod(int(view), len(cameras)) for view in seen)
    return [Scope(camera=(cameras[c].name,), target=(targets[t].name,)) for t, c in pairs]


def _faces(scene: Scene) -> set[Scope]:
    """Views of targets that cameras of several stations see."""
    station = {camera.name: camera.station for camera in scene.model.cameras}
    views = _views(scene)
    seers = {(view.target, station[view.camera[0]]) for view in views}
    count = Counter(target for target, _ in seers)
    return {view for view in views if count[view.target] > 1}


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
                    yield [Group(own, entry.entity, target=target.name)], known
