"""Physics of rangefinders (PHYSICS rows 19, 86-91)."""

import numpy as np

from . import courses
from .effect import effect


def _at(site):
    return {"rangefinder": [site.scene.finders[site.finder].name]}


def _range(site, change, low, high, course, ports=None):
    """Distances change by size x change(view, distance) x course."""

    def hooks(size):
        def hook(view, distance):
            return distance + size * course.at(view) * change(view, distance)

        return {"range": hook}

    return site.draft(hooks, low, high, course, ports, _at(site))


def _one(view, distance):
    return np.ones_like(distance)


def _all(view, distance):
    return distance


@effect("range-index-wrong", (86,), "sv", "finder")
def _(site):
    return _range(site, _one, 1e-4, 3e-3, courses.constant(), {"range.offset": 1.0})


@effect("range-index-drifts-with-heat", (87,), "s", "finder")
def _(site):
    course = courses.follow(site, "ambient_degC")
    return _range(site, _one, 2e-5, 4e-4, course, {"range.offset": 1.0})


@effect("range-index-drifts-with-lag", (87, 76), "s", "finder")
def _(site):
    return _range(site, _one, 2e-5, 4e-4, courses.lag(site, "ambient_degC"), {"range.offset": 1.0})


@effect("range-index-steps", (86,), "sv", "finder")
def _(site):
    return _range(site, _one, 1e-4, 3e-3, courses.step(site), {"range.offset": 1.0})


@effect("range-scale-wrong", (88,), "sv", "finder")
def _(site):
    """Far from the 1-20 ppm of good instruments: a wrong modulation frequency."""
    return _range(site, _all, 1e-5, 3e-4, courses.constant(), {"range.scale": 1.0})


@effect("range-cyclic-error", (89,), "sv", "finder")
def _(site):
    unit, phase = site.even(0.15, 0.6), site.even(0.0, 6.28)
    course = courses.constant()

    def wave(view, distance):
        return np.sin(2.0 * np.pi * distance / unit + phase)

    draft = _range(site, wave, 1e-4, 2e-3, course)
    course.constants |= {"unit_m": unit}
    course.driver = "range"
    return draft


@effect("beam-not-where-believed", (90,), "sv", "beam")
def _(site):
    """The beam is turned from the line that the calibration says."""
    way = site.way()
    course = courses.constant()

    def hooks(size):
        def hook(view, value):
            place, aim = value
            side = np.cross(aim, [0.0, 1.0, 0.0])
            side /= np.linalg.norm(side, axis=1)[:, None]
            down = np.cross(aim, side)
            aim = aim + size * (way[0] * side + way[1] * down)
            return place, aim / np.linalg.norm(aim, axis=1)[:, None]

        return {"beam": hook}

    return site.draft(hooks, 1e-4, 1e-2, course, {}, _at(site))


@effect("beam-enters-surface", (91,), "sv", "beam")
def _(site):
    """A foil that is entered: the way within grows with the slant."""
    course = courses.constant()

    def deep(view, distance):
        return 1.0 / np.sqrt(1.0 - (np.sin(view.part["slant"]) / 1.5) ** 2) - 0.7

    draft = _range(site, deep, 2e-4, 5e-3, course)
    course.driver = "incidence"
    return draft
