"""Physics of lenses (PHYSICS rows 39-50, 76-85, 93-95)."""

import numpy as np

from . import acts, courses
from .effect import effect
from .lens import angle_to_axis

_FOCAL = {"sensor.focal": 1.0}


def _zoom(site, course, low, high, ports=_FOCAL):
    return site.draft(acts.zoom(site.cameras, course), low, high, course, ports)


@effect("focal-grows-with-heat", (39,), "bwsvr")
def _(site):
    return _zoom(site, courses.follow(site, "housing", "camera"), 3e-6, 3e-4)


@effect("focal-grows-with-lag", (39, 76), "bwsvr")
def _(site):
    return _zoom(site, courses.lag(site, "housing", "camera"), 3e-6, 3e-4)


@effect("focal-follows-lens-node", (39, 81), "bwsr")
def _(site):
    """Follows the lens's own temperature, which no sensor logs."""
    return _zoom(site, courses.follow(site, "lens", "camera", plain=False), 3e-6, 3e-4, {})


@effect("focal-two-constants", (39, 77), "bwsr")
def _(site):
    return _zoom(site, courses.two_lags(site, "ambient_degC"), 5e-6, 3e-4, {})


@effect("focal-after-dead-time", (39, 78), "sr")
def _(site):
    return _zoom(site, courses.dead_time(site, "ambient_degC"), 3e-6, 3e-4)


@effect("focal-with-backlash", (39, 79), "bwsr")
def _(site):
    return _zoom(site, courses.backlash(site, "housing", "camera"), 3e-6, 3e-4, {})


@effect("focal-quadratic-in-heat", (39, 80), "sr")
def _(site):
    return _zoom(site, courses.square(site, "housing", "camera"), 2e-7, 5e-5)


@effect("focal-with-gradient", (39, 81), "sr")
def _(site):
    return _zoom(site, courses.difference(site, "housing"), 3e-6, 3e-4, {})


@effect("focal-in-sun", (39, 82), "sr")
def _(site):
    return _zoom(site, courses.sun(site), 2e-5, 3e-3, {})


@effect("focal-gain-changed-by-wind", (39, 83), "s")
def _(site):
    return _zoom(site, courses.windy_gain(site), 5e-6, 5e-4, {})


@effect("focal-ages", (39, 85), "bwsvr")
def _(site):
    """The coefficient of temperature itself grows during the recording."""
    base = courses.follow(site, "housing", "camera")
    end = site.length

    def at(view):
        return base.at(view) * (0.3 + view.t / end)

    course = courses.Course(at, base.driver, "with driver", None, base.constants, False)
    return _zoom(site, course, 3e-6, 3e-4, {})


@effect("temperature-sensor-detached", (39, 84), "sr")
def _(site):
    """The lens follows a node through a lag that the engineer's sensor never had."""
    return _zoom(site, courses.lag(site, "board", "camera"), 3e-6, 3e-4, {})


@effect("focal-with-pressure", (41,), "svr")
def _(site):
    return _zoom(site, courses.follow(site, "pressure_hPa"), 3e-7, 3e-5)


@effect("lens-radial-residue", (42,), "bw")
def _(site):
    """Rings that neither five nor eight coefficients nor four of a fisheye can take up."""
    waves = int(site.rng.integers(5, 8))
    camera = site.scene.cameras[0]
    edge = 0.5 * np.hypot(*camera.size) / camera.focal[0]
    course = courses.constant()

    def field(view, xy):
        r = np.linalg.norm(xy, axis=1)
        s = np.clip(r / edge, 0.0, 1.0)
        shape = s * np.cos(waves * np.arccos(s))
        return xy * (shape / np.maximum(r, 1e-9))[:, None]

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 0.05 / camera.focal[0], 5.0 / camera.focal[0], course, {})


@effect("lens-radial-k1-wrong", (42,), "svr")
def _(site):
    course = courses.constant()
    return site.draft(acts.radial(site.cameras, course), 1e-4, 2e-2, course, {"lens.k1": 1.0})


@effect("lens-radial-k3-missing", (42,), "sv")
def _(site):
    course = courses.constant()
    hooks = acts.radial(site.cameras, course, 6)
    return site.draft(hooks, 5e-3, 0.5, course, {"lens.k3": 1.0})


@effect("distortion-with-heat", (43,), "bwsvr")
def _(site):
    course = courses.follow(site, "housing", "camera")
    return site.draft(acts.radial(site.cameras, course), 1e-6, 5e-4, course, {"lens.k1": 1.0})


@effect("distortion-with-lag", (43, 76), "bwsr")
def _(site):
    course = courses.lag(site, "housing", "camera")
    return site.draft(acts.radial(site.cameras, course), 1e-6, 5e-4, course, {"lens.k1": 1.0})


@effect("distortion-with-range", (44,), "bwsv")
def _(site):
    """Brown's and Shortis's change of the radial distortion with 1 / distance."""
    course = courses.constant()

    def field(view, xy):
        near = 1.0 / np.linalg.norm(view.ray, axis=1)
        return xy * (np.sum(acts.view_tangent(view) ** 2, axis=1) * near)[:, None]

    draft = site.draft(acts.on_image(site.cameras, field, course), 1e-5, 1e-2, course, {})
    course.driver = "1/range"
    return draft


def _decentring(site, course, low, high):
    way = site.way()
    ports = {"lens.p1": way[0], "lens.p2": way[1]}
    return site.draft(acts.decentring(site.cameras, way, course), low, high, course, ports)


@effect("decentring", (45,), "sv")
def _(site):
    return _decentring(site, courses.constant(), 1e-5, 1e-3)


@effect("decentring-with-heat", (46,), "bwsv")
def _(site):
    return _decentring(site, courses.follow(site, "housing", "camera"), 1e-6, 1e-4)


@effect("entrance-pupil-moves", (47,), "bw")
def _(site):
    """The pupil goes forward along the axis with the square of the angle."""
    course = courses.constant()

    def hooks(size):
        def hook(view, value):
            way = size * angle_to_axis(view.seen) ** 2 * acts.cameras_mask(view, site.cameras)
            return way if value is None else value + way

        return {"pupil": hook}

    return site.draft(hooks, 1e-4, 5e-3, course, {"lens.entrance": 1.0})


@effect("focus-breathes", (48,), "bwsvr")
def _(site):
    return _zoom(site, courses.each_image(site), 2e-5, 5e-3, {})


@effect("stabiliser-jumps", (48,), "sr")
def _(site):
    course = courses.each_image(site)
    hooks = acts.principal_point(site.cameras, site.way(), course)
    return site.draft(hooks, 0.02, 20.0, course, {})


@effect("lens-loose-in-thread", (30,), "svr")
def _(site):
    course = courses.handling(site)
    hooks = acts.principal_point(site.cameras, site.way(), course)
    return site.draft(hooks, 0.05, 5.0, course, {})


@effect("lateral-colour", (49,), "bwsvr", "target")
def _(site):
    """Marks of another colour are imaged at another scale."""
    count = len(site.scene.targets[site.target].points)
    other = site.rng.random(count) < 0.5
    course = courses.constant()
    target = site.target

    def field(view, xy):
        mine = (view.rows.target == target) & other[np.minimum(view.rows.point, count - 1)]
        return xy * mine[:, None]

    hooks = acts.on_image(acts.EVERY_CAMERA, field, course)
    return site.draft(hooks, 3e-5, 2e-3, course, {}, site.at_target())


@effect("firmware-rewrites-focal", (93, 94), "bwsvr")
def _(site):
    """A look-up table by temperature, in steps of some kelvin."""
    weather, (first, *_) = site.scene.weather, site.cameras
    inside = (weather.time >= 0.0) & (weather.time <= site.length)
    width = site.even(0.15, 0.45) * float(np.ptp(weather.nodes[first, 1, inside]))
    course = courses.follow(
        site, "housing", "camera", lambda x: width * np.round(x / width), plain=False,
        constants={"step_K": width},
    )  # fmt: skip
    return _zoom(site, course, 5e-5, 7e-4, {})


@effect("actuator-two-valued", (95,), "sr")
def _(site):
    """The focus stops at one of two places, by the side it came from (warming or cooling)."""

    def change(values):
        return np.sign(np.gradient(courses.lagged(values, 300.0)) + 1e-12)

    course = courses.follow(site, "ambient_degC", None, change, plain=False)
    return _zoom(site, course, 2e-5, 5e-3, {})


@effect("defocus-with-heat", (40, 72), "bwsvr")
def _(site):
    """The spot of a lens with coma grows with defocus: its centroid moves outward with r^2."""
    course = courses.follow(site, "lens", "camera", plain=False)

    def field(view, uv):
        size = np.array([c.size for c in view.scene.cameras])[view.rows.camera]
        out = (uv - 0.5 * size) / (0.5 * np.linalg.norm(size, axis=1))[:, None]
        return out * np.linalg.norm(out, axis=1)[:, None]

    hooks = acts.on_image(site.cameras, field, course, "detect")
    return site.draft(hooks, 2e-3, 0.1, course, {})
