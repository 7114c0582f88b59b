"""Physics of the air and of windows (PHYSICS rows 16-22, 50, 98)."""

import numpy as np

from . import acts, courses, refraction
from .effect import effect
from .rotation import apply, back


def _axes(view):
    """Axes of each row's camera in the world."""
    scene = view.scene
    station = np.array([s.turn for s in scene.stations])[view.station()]
    return station @ np.array([c.turn for c in scene.cameras])[view.rows.camera]


def _places(view):
    """Pupil of each row's camera in the world."""
    scene = view.scene
    station = view.station()
    axes = np.array([s.turn for s in scene.stations])[station]
    origin = np.array([s.shift for s in scene.stations])[station]
    return apply(axes, np.array([c.shift for c in scene.cameras])[view.rows.camera]) + origin


def _bending(site, gradient, course, low, high, ports=None):
    """Rays bent by temperature gradients (K/m, world) = size x gradient(place) x course."""

    def hooks(size):
        def hook(view, seen):
            axes, origin = _axes(view), _places(view)
            amount = size * course.at(view)[:, None] * refraction.INDEX_PER_KELVIN

            def bend(place):
                return amount * back(axes, gradient(apply(axes, place) + origin))

            return refraction.appear(seen, bend)

        return {"air": hook}

    where = {"camera": [c.name for c in site.scene.cameras]}
    return site.draft(hooks, low, high, course, ports, where)


@effect("air-layered-vertically", (16,), "sr")
def _(site):
    """The logged vertical gradient bends all rays."""
    up = site.scene.up
    course = courses.follow(site, "gradient_K_per_m", None, lambda x: x)
    course = courses.Course(
        lambda v: v.air("gradient_K_per_m"), "gradient_K_per_m", "with driver", None, {}, True
    )
    # Where it is warmer above, rays are bowed upwards and marks are seen too high.
    ports = {"medium.bend_v": -abs(refraction.INDEX_PER_KELVIN)}
    draft = _bending(site, lambda x: np.broadcast_to(up, x.shape), course, 0.3, 3.0, ports)
    draft.sign = 1.0
    return draft


@effect("air-layered-over-hot-ground", (16, 82), "sr")
def _(site):
    """A warm layer over sunlit ground; it thins out with height over some decimetres."""
    up, course = site.scene.up, courses.sun(site)
    high, ground = site.even(0.4, 1.0), -site.even(0.8, 1.6)

    def gradient(x):
        above = np.clip(x @ up - ground, 0.0, None)
        return -np.exp(-above / high)[:, None] * up

    draft = _bending(site, gradient, course, 0.5, 8.0)
    draft.sign = 1.0
    return draft


@effect("air-layered-sideways", (17, 82), "sr")
def _(site):
    """A sunlit wall beside the line of sight warms the air near it."""
    course = courses.sun(site)
    side = np.array([1.0, 0.0, 0.0])
    thick, wall = site.even(1.0, 3.0), site.even(2.0, 4.0)

    def gradient(x):
        return np.exp(-np.clip(wall - x @ side, 0.0, None) / thick)[:, None] * side

    return _bending(site, gradient, course, 0.2, 6.0)


@effect("heat-haze", (18, 98), "sr")
def _(site):
    """Turbulence: random tilts, alike for neighbouring marks, that grow with the way."""
    salt = site.even(1.0, 3.0)
    light = courses.sun(site, 120.0)

    def course_at(view):
        return 0.4 + np.clip(light.at(view) + 0.5, 0.0, None)

    course = courses.Course(course_at, "random", "always", None, {}, False)
    waves = site.rng.normal(size=(6, 2)) * 12.0

    def field(view, xy):
        phase = np.sin(np.outer(view.t, np.arange(1, 13)) * 7.77 * salt) * 437.585
        phase = 2.0 * np.pi * (phase - np.floor(phase))
        other = (view.rows.camera * 3 + view.rows.target)[:, None] * 2.399
        angle = (view.ray[:, :2] / view.ray[:, 2:]) @ waves.T
        u = np.cos(angle + phase[:, :6] + other).sum(axis=1)
        v = np.cos(angle + phase[:, 6:] + other).sum(axis=1)
        path = np.sqrt(np.linalg.norm(view.ray, axis=1) / 100.0)
        return np.stack([u, v], axis=1) * (path / np.sqrt(3.0))[:, None]

    hooks = acts.on_image(acts.EVERY_CAMERA, field, course)
    where = {"camera": [c.name for c in site.scene.cameras]}
    return site.draft(hooks, 1e-6, 3e-5, course, {}, where)


def _glass(site, trace, low, high, course, ports):
    """A window before the cameras; with a course of 0 and 1 it is there only where that is 1."""

    def hooks(size):
        def hook(view, seen):
            there = acts.cameras_mask(view, site.cameras) & (course.at(view) > 0.5)
            out = seen.copy()
            if there.any():
                out[there] = trace(seen[there], size)
            return out

        return {"glass": hook}

    draft = site.draft(hooks, low, high, course, ports)
    draft.sign = 1.0
    return draft


_AHEAD = np.array([0.0, 0.0, 1.0])


@effect("plane-window", (20,), "bwv")
def _(site):
    def trace(points, size):
        return refraction.through_window(points, size, 0.02, 1.5, _AHEAD, _AHEAD)

    return _glass(site, trace, 1e-3, 1e-2, courses.constant(), {"medium.window": 1.0})


@effect("wedged-window-refitted", (21,), "svr")
def _(site):
    """After an instant the window in front has a wedge."""
    way = site.way()
    gap = 0.02

    def trace(points, size):
        behind = np.append(np.sin(size) * way, np.cos(size))
        out = refraction.through_window(points, 0.004, gap, 1.5, _AHEAD, behind)
        square = refraction.through_window(points, 0.004, gap, 1.5, _AHEAD, _AHEAD)
        return points + out - square

    return _glass(site, trace, 3e-5, 3e-3, courses.step(site), {})


@effect("dome-off-centre", (21,), "wv")
def _(site):
    """A dome whose centre is beside the pupil."""
    radius = site.even(0.05, 0.09)
    way = np.append(site.way(), 0.5)
    index = 1.5

    def trace(points, size):
        return refraction.through_dome(points, radius, 0.004, index, size * way)

    return _glass(site, trace, 3e-4, 5e-3, courses.constant(), {})


@effect("window-warped-by-heat", (22, 82), "svr")
def _(site):
    """A window that is warmer in its middle is a weak lens, off the camera's axis."""
    short = site.scene.kind == "stereo"
    course = courses.rate(site, "housing", "camera") if short else courses.sun(site)
    off = 0.3 * site.way()

    def field(view, xy):
        camera = view.scene.cameras[site.cameras[0]]
        edge = 0.5 * np.hypot(*camera.size) / camera.focal[0]
        return xy / edge - off

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 3e-6, 2e-4, course, {})


@effect("filter-screwed-on", (50, 20), "bwv")
def _(site):
    """From an instant on there is a plate before the lens."""

    def trace(points, size):
        return refraction.through_window(points, size, 0.005, 1.52, _AHEAD, _AHEAD)

    return _glass(site, trace, 8e-4, 6e-3, courses.step(site), {"medium.window": 1.0})
