"""Physics of targets and marks (PHYSICS rows 1-15, 97)."""

import numpy as np

from . import acts, courses
from .effect import effect
from .rotation import back


def _growth(axis):
    """Field that stretches the target along its axes in proportion to `axis`."""
    axis = np.asarray(axis, float)
    return lambda v, mark: mark * axis


def _unit(site):
    """Function to coordinates from -1 to 1 over the target."""
    middle, half = site.middle, 0.5 * np.ptp(site.scene.targets[site.target].points[:, :2], axis=0)
    return lambda mark: ((mark - middle)[:, :2] / half).T


def _out_of_plane(site, function):
    """Field along z given by a function of the unit coordinates."""
    unit = _unit(site)

    def field(view, mark):
        x, y = unit(mark)
        return np.stack([0 * x, 0 * x, function(x, y)], axis=1)

    return field


def _whole(site, course, low, high, axis, ports):
    hooks = acts.reshape(site.target, _growth(axis), course)
    return site.draft(hooks, low, high, course, ports, site.at_target())


@effect("target-grows-with-air", (1,), "svr", "target")
def _(site):
    course = courses.follow(site, "ambient_degC")
    return _whole(site, course, 1e-6, 80e-6, [1, 1, 1], {"target.scale": 1.0})


@effect("target-grows-with-lag", (1, 76), "sr", "target")
def _(site):
    course = courses.lag(site, "ambient_degC")
    return _whole(site, course, 1e-6, 80e-6, [1, 1, 1], {"target.scale": 1.0})


@effect("target-warmed-by-sun", (1, 82), "sr", "target")
def _(site):
    return _whole(site, courses.sun(site), 1e-5, 8e-4, [1, 1, 1], {})


@effect("target-swells-with-humidity", (2, 76), "bwsr", "target")
def _(site):
    axis = [1.0, site.even(0.1, 0.35), 0.0]
    course = courses.lag(site, "humidity_pct")
    ports = {"target.scale_x": axis[0], "target.scale_y": axis[1]}
    return _whole(site, course, 5e-6, 150e-6, axis, ports)


@effect("target-printed-too-large", (3,), "sv", "target")
def _(site):
    return _whole(site, courses.constant(), 5e-4, 1e-2, [1, 1, 1], {"target.scale": 1.0})


@effect("target-printed-unequally", (4,), "bwsvr", "target")
def _(site):
    ports = {"target.scale_x": 0.5, "target.scale_y": -0.5}
    return _whole(site, courses.constant(), 3e-4, 5e-3, [0.5, -0.5, 0], ports)


@effect("target-bow", (5,), "bwsvr", "target")
def _(site):
    a, b = site.way()
    course = courses.constant()
    field = _out_of_plane(site, lambda x, y: a * (1 - x * x) + b * (1 - y * y))
    hooks = acts.reshape(site.target, field, course)
    ports = {"target.bow_x": a, "target.bow_y": b}
    width = 2.0 * site.half
    return site.draft(hooks, 1e-4 * width, 5e-3 * width, course, ports, site.at_target())


@effect("target-twist", (6,), "bwsvr", "target")
def _(site):
    course = courses.constant()
    hooks = acts.reshape(site.target, _out_of_plane(site, lambda x, y: x * y), course)
    ports = {"target.twist": 1.0}
    return site.draft(hooks, 5e-5, 2e-3, course, ports, site.at_target())


@effect("target-bent-unevenly", (6,), "bwsv", "target")
def _(site):
    a, b = site.way()
    course = courses.constant()
    field = _out_of_plane(site, lambda x, y: a * (x**3 - x) + b * (y**3 - y))
    hooks = acts.reshape(site.target, field, course)
    return site.draft(hooks, 5e-5, 2e-3, course, {}, site.at_target())


def _bending(site, course, low, high):
    field = _out_of_plane(site, lambda x, y: 1 - x * x)
    hooks = acts.reshape(site.target, field, course)
    return site.draft(hooks, low, high, course, {"target.bow_x": 1.0}, site.at_target())


@effect("target-bends-with-humidity", (7, 76), "bwsr", "target")
def _(site):
    return _bending(site, courses.lag(site, "humidity_pct"), 3e-6, 3e-4)


@effect("target-bends-while-warming", (7,), "sr", "target")
def _(site):
    return _bending(site, courses.rate(site, "ambient_degC"), 1e-5, 2e-3)


@effect("target-bends-in-sun", (7, 82), "sr", "target")
def _(site):
    return _bending(site, courses.sun(site), 2e-5, 2e-3)


@effect("board-sags-under-its-weight", (5, 31), "bw", "target")
def _(site):
    """Bends with the share of gravity that stands on the plate."""
    up = site.scene.up
    course = courses.constant()

    def field(view, mark):
        x, y = _unit(site)(mark)
        load = -(view.turn[:, :, 2] @ up)
        return np.stack([0 * x, 0 * x, load * (1 - x * x) * (1 - 0.4 * y * y)], axis=1)

    hooks = acts.reshape(site.target, field, course)
    draft = site.draft(hooks, 2e-5, 3e-3, course, {}, site.at_target())
    course.driver = "gravity"
    return draft


def _one_mark(site, course, low, high):
    target = site.scene.targets[site.target]
    inner = int(site.rng.integers(len(target.points)))
    way = np.append(site.way(), 0.0)
    if site.rng.random() < 0.2:
        way = np.array([0.0, 0.0, 1.0])

    def field(view, mark):
        return (view.rows.point == inner)[:, None] * way

    hooks = acts.reshape(site.target, field, course)
    where = site.at_target() | {"point": [target.names[inner]]}
    draft = site.draft(hooks, low, high, course, {"target.point": 1.0}, where)
    course.constants["direction"] = way.tolist()
    return draft


@effect("mark-misplaced", (8,), "bwsv", "target")
def _(site):
    return _one_mark(site, courses.constant(), 1e-5, 1e-3)


@effect("mark-restuck", (8,), "bwsvr", "target")
def _(site):
    return _one_mark(site, courses.step(site), 1e-5, 1e-3)


@effect("mark-creeps", (9,), "bwsvr", "target")
def _(site):
    return _one_mark(site, courses.onset(site), 5e-6, 3e-4)


@effect("mark-creeps-with-heat", (9,), "sr", "target")
def _(site):
    return _one_mark(site, courses.follow(site, "ambient_degC"), 1e-6, 3e-5)


_SHIFTS = ("structure.shift_x", "structure.shift_y", "structure.shift_z")
_TURNS = ("structure.turn_x", "structure.turn_y", "structure.turn_z")


def _moves(site, course, low, high, axis=None, turns=False):
    axis = site.axis() if axis is None else np.asarray(axis)
    act = acts.turn_target if turns else acts.shift_target
    ports = {p: float(a) for p, a in zip(_TURNS if turns else _SHIFTS, axis, strict=True) if a}
    where = site.at_target()
    return site.draft(act(site.target, axis, course), low, high, course, ports, where)


@effect("reference-steps", (10,), "sr", "static")
def _(site):
    return _moves(site, courses.step(site), 1e-5, 5e-3)


@effect("reference-drifts", (10,), "sr", "static")
def _(site):
    return _moves(site, courses.ramp(site), 1e-5, 5e-3)


@effect("reference-turns", (10,), "sr", "static")
def _(site):
    return _moves(site, courses.step(site), 1e-5, 2e-3, turns=True)


@effect("structure-bends-with-lag", (12, 76), "sr", "static")
def _(site):
    """Its carrier bends with the air's temperature: the target turns and shifts together."""
    return _moves(site, courses.lag(site, "ambient_degC"), 2e-6, 2e-3)


@effect("structure-bends-in-sun", (12, 82), "sr", "static")
def _(site):
    return _moves(site, courses.sun(site), 2e-5, 5e-3)


@effect("structure-vibrates", (13,), "sr", "static")
def _(site):
    return _moves(site, courses.periodic(site, 0.05, 0.3), 1e-5, 1e-2)


@effect("arm-sags", (14,), "sr", "static")
def _(site):
    return _moves(site, courses.logarithm(site), 1e-6, 1e-4, [0.0, 1.0, 0.0])


@effect("marks-at-wrong-depth", (15,), "bwsvr", "target")
def _(site):
    """Some marks (of another make) have their optical centre behind the measured point."""
    count = len(site.scene.targets[site.target].points)
    other = site.rng.random(count) < 0.5
    course = courses.constant()

    def field(view, mark):
        deep = other[np.minimum(view.rows.point, count - 1)].astype(float)
        sight = back(view.turn, np.zeros_like(mark) + [0.0, 0.0, 1.0])
        return deep[:, None] * (0.0 * sight + [0.0, 0.0, 1.0])

    hooks = acts.reshape(site.target, field, course)
    return site.draft(hooks, 5e-6, 5e-4, course, {}, site.at_target())


@effect("scale-bar-at-another-temperature", (97,), "sr", "target")
def _(site):
    """The target lags behind the sensor that its size is corrected by."""
    tau = site.between(0.03, 0.2) * site.length

    def change(values):
        return courses.lagged(values, tau) - values

    course = courses.follow(
        site, "ambient_degC", None, change, constants={"tau_s": tau}, plain=False
    )
    return _whole(site, course, 2e-6, 80e-6, [1, 1, 1], {})
