"""Physics that stands in no list: what an honest diagnosis must not give a name."""

import numpy as np

from . import acts, courses
from .courses import Course
from .effect import effect


def _edge(site):
    camera = site.scene.cameras[site.cameras[0]]
    return 0.5 * np.hypot(*camera.size) / camera.focal[0], camera.focal[0]


@effect("image-swirl", (), "bwsv", outside=True)
def _(site):
    """The image is wound about a point beside the centre, most at some radius."""
    edge, focal = _edge(site)
    about, width = site.rng.normal(0.0, 0.2, 2) * edge, site.even(0.3, 0.6) * edge
    course = courses.constant()

    def field(view, xy):
        off = xy - about
        fall = np.exp(-0.5 * np.sum(off**2, axis=1) / width**2)
        return off[:, ::-1] * [-1.0, 1.0] * fall[:, None] / width

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 0.02 / focal, 8.0 / focal, course)


@effect("image-rings", (), "bwsv", outside=True)
def _(site):
    """Ripples of rings about a point beside the centre."""
    edge, focal = _edge(site)
    about, wave = site.rng.normal(0.0, 0.4, 2) * edge, site.even(0.15, 0.35) * edge
    course = courses.constant()

    def field(view, xy):
        off = xy - about
        r = np.linalg.norm(off, axis=1)
        return off * (np.sin(2.0 * np.pi * r / wave) / np.maximum(r, 1e-6))[:, None]

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 0.02 / focal, 4.0 / focal, course)


@effect("sensor-dent", (), "bwsv", outside=True)
def _(site):
    """A small region of the image is drawn to a point."""
    edge, focal = _edge(site)
    about, width = site.rng.uniform(-0.35, 0.35, 2) * edge, site.even(0.12, 0.22) * edge
    course = courses.constant()

    def field(view, xy):
        off = xy - about
        return off * (np.exp(-0.5 * np.sum(off**2, axis=1) / width**2) / width)[:, None]

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 0.03 / focal, 15.0 / focal, course)


def _turns(site, function, when="always", driver="time", t0=None, low=2e-6, high=1e-3):
    course = Course(lambda v: function(v.t), driver, when, t0, {}, False)
    hooks = acts.turn_camera(site.cameras, np.append(site.way(), 0.0), course)
    return site.draft(hooks, low, high, course)


@effect("camera-chirp", (), "svr", "body", outside=True)
def _(site):
    """An oscillation that becomes faster."""
    start, end = site.even(1.0, 2.5), site.even(5.0, 9.0)
    length = site.length

    def function(t):
        x = np.clip(t / length, 0.0, 2.0)
        return np.sin(2.0 * np.pi * (start * x + 0.5 * (end - start) * x * x))

    return _turns(site, function)


@effect("camera-there-and-back", (), "svr", "body", outside=True)
def _(site):
    """The camera leaves and comes back within part of the recording."""
    t0, width = site.even(0.3, 0.7) * site.length, site.even(0.04, 0.12) * site.length
    return _turns(site, lambda t: np.exp(-0.5 * ((t - t0) / width) ** 2), "from", t0=t0)


@effect("camera-sawtooth", (), "sr", "body", outside=True)
def _(site):
    """An air conditioner: slow rise, sudden fall."""
    period, phase = site.even(0.12, 0.35) * site.length, site.even(0.0, 1.0)
    return _turns(site, lambda t: 2.0 * ((t / period + phase) % 1.0) - 1.0, "periodic")


@effect("camera-beating", (), "svr", "body", outside=True)
def _(site):
    """Two near periods that beat."""
    period, ratio = site.even(0.07, 0.15) * site.length, site.even(1.15, 1.35)

    def function(t):
        a = 2.0 * np.pi * t / period
        return 0.5 * (np.sin(a) + np.sin(ratio * a))

    return _turns(site, function, "periodic")


@effect("mount-random-walk", (), "svr", "body", outside=True)
def _(site):
    """The mount wanders without cause."""
    count = 400
    steps = np.cumsum(site.rng.normal(size=2 * count)) / np.sqrt(count)
    knots = np.linspace(0.0, 2.0 * site.length, 2 * count)
    return _turns(site, lambda t: np.interp(t, knots, steps), driver="random")


@effect("focal-saturates-with-heat", (), "sr", outside=True)
def _(site):
    """The focal length follows the temperature only in a narrow range, then stops."""
    wide = site.even(0.4, 1.2)
    course = courses.follow(
        site, "ambient_degC", None, lambda x: np.tanh(x / wide) ** 3, plain=False
    )
    return site.draft(acts.zoom(site.cameras, course), 1e-5, 3e-3, course)


@effect("target-membrane-modes", (), "bwsv", "target", outside=True)
def _(site):
    """The target is buckled in a two-dimensional ripple."""
    m, n = int(site.rng.integers(2, 4)), int(site.rng.integers(2, 4))
    phase = site.rng.uniform(0.0, 6.28, 2)
    middle, half, target = site.middle, site.half, site.target
    course = courses.constant()

    def field(view, mark):
        x, y = ((mark - middle)[:, :2] / half).T
        z = np.sin(0.5 * np.pi * m * x + phase[0]) * np.sin(0.5 * np.pi * n * y + phase[1])
        return np.stack([0 * z, 0 * z, z], axis=1)

    hooks = acts.reshape(target, field, course)
    return site.draft(hooks, 5e-5, 4e-3, course, {}, site.at_target())


@effect("target-breathes-in-bursts", (), "svr", "target", outside=True)
def _(site):
    """The target grows in bursts of different height."""
    at = np.sort(site.rng.uniform(0.05, 0.95, 5)) * site.length
    high, width = site.rng.uniform(0.3, 1.0, 5), 0.03 * site.length

    def function(t):
        return np.sum(high * np.exp(-0.5 * ((t[:, None] - at) / width) ** 2), axis=1)

    course = Course(lambda v: function(v.t), "random", "always", None, {}, False)
    hooks = acts.reshape(site.target, lambda v, mark: mark, course)
    return site.draft(hooks, 1e-5, 5e-3, course, {}, site.at_target())


@effect("fringes-that-wander", (), "bwsv", outside=True)
def _(site):
    """Parallel fringes in the image that move on during the recording."""
    camera = site.scene.cameras[site.cameras[0]]
    wave = site.even(150.0, 400.0)
    along, push = site.way(), site.way()
    speed = site.even(1.0, 4.0) * 2.0 * np.pi / site.length
    course = Course(lambda v: np.ones(len(v.t)), "time", "always", None, {}, False)

    def field(view, uv):
        angle = (uv - 0.5 * np.array(camera.size)) @ along * 2.0 * np.pi / wave + speed * view.t
        return np.sin(angle)[:, None] * push

    hooks = acts.on_image(site.cameras, field, course, "detect")
    return site.draft(hooks, 0.01, 1.0, course)
