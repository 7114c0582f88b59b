"""Physics of mounts, stations and chains (PHYSICS rows 11, 25-37)."""

import numpy as np

from . import acts, courses
from .effect import effect

_TURNS = ("mount.turn_x", "mount.turn_y", "mount.turn_z")
_SHIFTS = ("mount.shift_x", "mount.shift_y", "mount.shift_z")


def _named(ports, axis):
    return {port: float(a) for port, a in zip(ports, axis, strict=True) if a}


def _turn(site, course, low, high):
    axis = site.axis()
    hooks = acts.turn_camera(site.cameras, axis, course)
    return site.draft(hooks, low, high, course, _named(_TURNS, axis))


def _shift(site, course, low, high):
    axis = site.axis()
    hooks = acts.shift_camera(site.cameras, axis, course)
    return site.draft(hooks, low, high, course, _named(_SHIFTS, axis))


def _tilt(site, course, low, high):
    axis = site.axis()
    hooks = acts.turn_station(site.station, axis, course)
    return site.draft(hooks, low, high, course, _named(_TURNS, axis), site.at_station())


@effect("pillar-tilts-in-sun", (11, 82), "sr", "station")
def _(site):
    return _tilt(site, courses.sun(site), 5e-6, 3e-4)


@effect("pillar-tilts-with-air", (11, 76), "sr", "station")
def _(site):
    return _tilt(site, courses.lag(site, "ambient_degC"), 1e-6, 5e-5)


@effect("mount-turns-with-heat", (25,), "svr", "body")
def _(site):
    return _turn(site, courses.follow(site, "housing", "camera"), 1e-6, 5e-5)


@effect("mount-turns-with-lag", (25, 76), "sr", "body")
def _(site):
    return _turn(site, courses.lag(site, "housing", "camera"), 1e-6, 5e-5)


@effect("mount-turns-two-constants", (25, 77), "sr", "body")
def _(site):
    return _turn(site, courses.two_lags(site, "ambient_degC"), 1e-6, 5e-5)


@effect("mount-turns-with-backlash", (25, 79), "sr", "body")
def _(site):
    return _turn(site, courses.backlash(site, "housing", "camera"), 1e-6, 5e-5)


@effect("mount-turns-in-sun", (25, 82), "sr", "body")
def _(site):
    return _turn(site, courses.sun(site), 5e-6, 5e-4)


@effect("mount-turns-with-its-own-node", (25, 81), "sr", "body")
def _(site):
    """Follows the mount's temperature against the air's, which no sensor logs."""
    return _turn(site, courses.difference(site, "mount"), 1e-6, 1e-4)


@effect("bracket-grows", (26,), "sr", "body")
def _(site):
    return _shift(site, courses.follow(site, "ambient_degC"), 5e-7, 2e-5)


@effect("station-beam-bends", (27, 82), "svr", "station")
def _(site):
    """The cameras of a station turn against each other with the gradient across the beam."""
    own = [k for k, c in enumerate(site.scene.cameras) if c.station == site.station]
    sign = {k: (1.0 if i == 0 else -1.0) for i, k in enumerate(own)}
    course = courses.sun(site) if site.rng.random() < 0.5 else courses.rate(site, "ambient_degC")
    axis = np.append(site.way(), 0.0)

    def hooks(size):
        def hook(view, value):
            side = np.zeros(len(view.rows))
            for k, s in sign.items():
                side[view.rows.camera == k] = s
            amount = 0.5 * size * course.at(view) * side
            return value[0] + amount[:, None] * axis, value[1]

        return {"camera": hook}

    return site.draft(hooks, 5e-6, 1e-3, course, {}, site.at_station())


@effect("mount-creeps", (28,), "sr", "body")
def _(site):
    return _turn(site, courses.onset(site, 0.0), 1e-5, 3e-4)


@effect("mount-creeps-logarithmically", (28,), "sr", "body")
def _(site):
    return _turn(site, courses.logarithm(site), 3e-6, 1e-4)


@effect("mount-starts-to-creep", (28,), "svr", "body")
def _(site):
    return _turn(site, courses.onset(site), 1e-5, 5e-4)


@effect("mount-slips", (29,), "svr", "body")
def _(site):
    return _turn(site, courses.step(site), 2e-5, 1e-3)


@effect("mount-slips-sideways", (29,), "svr", "body")
def _(site):
    return _shift(site, courses.step(site), 1e-5, 1e-3)


@effect("mount-vibrates", (32,), "svr", "body")
def _(site):
    return _turn(site, courses.periodic(site, 0.03, 0.3), 1e-6, 5e-4)


@effect("wind-on-camera", (33,), "sr", "body")
def _(site):
    return _turn(site, courses.gusts(site), 1e-6, 2e-4)


@effect("tripod-settles", (34,), "sr", "station")
def _(site):
    return _tilt(site, courses.logarithm(site), 5e-6, 5e-4)


@effect("pair-calibration-aged", (35,), "sv", "body")
def _(site):
    return _turn(site, courses.constant(), 1e-5, 5e-4)


@effect("pair-shift-aged", (35,), "sv", "body")
def _(site):
    return _shift(site, courses.constant(), 1e-5, 1e-3)


@effect("hand-over-plate-not-rigid", (36,), "r", "target")
def _(site):
    """The face that the next station sees moves against the face that this one sees."""
    plate = int(site.rng.integers(1, 3))
    seer = 2 * plate
    site.target = plate
    axis = np.append(site.way(), 0.0)
    course = courses.lag(site, "ambient_degC")

    def hooks(size):
        def hook(view, value):
            mine = (view.rows.target == plate) & (view.rows.camera == seer)
            amount = size * course.at(view) * mine
            return value[0] + amount[:, None] * axis, value[1]

        return {"target": hook}

    where = site.at_target() | {"camera": [site.scene.cameras[seer].name]}
    return site.draft(hooks, 2e-6, 1e-4, course, {}, where)


@effect("neighbour-warms-mount", (37,), "svr", "body")
def _(site):
    """Follows the housing of another camera on its station."""
    cameras = site.scene.cameras
    near = {cameras[k].station for k in site.cameras}
    others = [k for k, c in enumerate(cameras) if c.station in near and k not in site.cameras]
    other = int(site.rng.choice(others))
    course = courses.follow(site, "housing", other)
    return _turn(site, course, 2e-7, 3e-5)
