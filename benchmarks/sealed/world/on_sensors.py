"""Physics of sensors, shutters and clocks (PHYSICS rows 51-63, 71, 96)."""

import numpy as np

from . import acts, courses
from .effect import effect

CLOCKS = {"clock.offset": 1.0}


def _walk(site, course, low, high):
    way = site.way()
    hooks = acts.principal_point(site.cameras, way, course)
    return site.draft(
        hooks, low, high, course, {"sensor.cx": float(way[0]), "sensor.cy": float(way[1])}
    )


@effect("principal-point-walks-with-heat", (51,), "svr", "body")
def _(site):
    return _walk(site, courses.follow(site, "housing", "camera"), 0.003, 0.3)


@effect("principal-point-walks-with-lag", (51, 76), "sr", "body")
def _(site):
    return _walk(site, courses.lag(site, "housing", "camera"), 0.003, 0.3)


@effect("principal-point-two-constants", (51, 77), "sr", "body")
def _(site):
    return _walk(site, courses.two_lags(site, "ambient_degC"), 0.003, 0.3)


@effect("principal-point-follows-board", (51, 84), "sr", "body")
def _(site):
    """Follows the sensor board, of which only the housing is logged."""
    return _walk(site, courses.follow(site, "board", "camera", plain=False), 0.003, 0.3)


@effect("self-heating-moves-image", (52,), "sr", "body")
def _(site):
    return _walk(site, courses.power_on(site), 0.05, 3.0)


@effect("self-heating-one-exponential", (52,), "svr", "body")
def _(site):
    return _walk(site, courses.warm_up(site), 0.05, 3.0)


@effect("self-heating-changes-focal", (52,), "sr")
def _(site):
    course = courses.warm_up(site)
    return site.draft(acts.zoom(site.cameras, course), 1e-5, 3e-3, course, {"sensor.focal": 1.0})


@effect("frame-rate-changes-heat", (53,), "sr", "body")
def _(site):
    """From an instant on the camera runs faster, and settles at another temperature."""
    return _walk(site, courses.onset(site), 0.02, 2.0)


@effect("sensor-not-flat", (54,), "bw")
def _(site):
    """Heights of the sensor's surface shift the image by height x tangent of the ray."""
    camera = site.scene.cameras[0]
    edge = 0.5 * np.hypot(*camera.size) / camera.focal[0]
    shape = site.rng.normal(size=6)
    shape /= np.linalg.norm(shape)
    course = courses.constant()

    def field(view, xy):
        x, y = (xy / edge).T
        height = np.stack(
            [x * y, x * x - y * y, x**3 - x * y * y, y**3 - x * x * y, x**2 * y, x * y**2], axis=1
        )
        return (height @ shape)[:, None] * xy

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 0.1 / camera.focal[0], 10.0 / camera.focal[0], course, {})


@effect("sensor-tilted", (55,), "w")
def _(site):
    """The plane of the sensor is not square to the axis: a homography of the image."""
    way = site.way()
    course = courses.constant()

    def hooks(size):
        def hook(view, image):
            slope = size * course.at(view) * acts.cameras_mask(view, site.cameras)
            return image / (1.0 - slope * (image @ way))[:, None]

        return {"lens": hook}

    return site.draft(hooks, 5e-5, 5e-3, course, {})


@effect("pixels-not-square", (56,), "sv")
def _(site):
    course = courses.constant()

    def field(view, xy):
        return xy * [0.5, -0.5]

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 1e-5, 1e-3, course, {})


@effect("pixel-rows-skewed", (56,), "bwsv")
def _(site):
    course = courses.constant()

    def field(view, xy):
        return xy[:, ::-1] * [1.0, 0.0]

    hooks = acts.on_image(site.cameras, field, course)
    return site.draft(hooks, 1e-5, 1e-3, course, {"sensor.skew": 1.0})


@effect("sensor-stitched", (57,), "bwsv")
def _(site):
    """The sensor was exposed in fields that join with steps."""
    size = np.array(site.scene.cameras[site.cameras[0]].size)
    lines = np.sort(site.rng.uniform(0.25, 0.75, 2)) * size[0]
    jumps = site.rng.normal(size=(3, 2))
    jumps[0] = 0.0
    course = courses.constant()

    def field(view, uv):
        return jumps[np.searchsorted(lines, uv[:, 0])]

    hooks = acts.on_image(site.cameras, field, course, "sensor")
    return site.draft(hooks, 2e-3, 0.06, course, {})


@effect("region-of-interest-shifted", (63,), "sr", "body")
def _(site):
    """Half or whole pixels at a change of settings."""
    course = courses.step(site)
    way = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]][site.rng.integers(3)])
    hooks = acts.principal_point(site.cameras, way, course)
    size = float(site.rng.choice([0.5, 1.0, 2.0]))
    ports = {p: float(a) for p, a in zip(("sensor.cx", "sensor.cy"), way, strict=True) if a}
    return site.draft(hooks, size, size, course, ports, fixed=True)


@effect("readout-compressed", (63,), "sv")
def _(site):
    """The camera resamples its image by a factor about its first pixel."""
    course = courses.step(site)
    hooks = acts.on_image(site.cameras, lambda v, uv: uv, course, "sensor")
    return site.draft(hooks, 1e-5, 1e-2, course, {})


def _clock(site, late, low, high, course, ports=None, fixed=False):
    """Exposures of the cameras are late by size x late(view) (s)."""

    def hooks(size):
        def hook(view, t):
            mine = acts.cameras_mask(view, site.cameras)
            return t + size * late(view) * mine

        return {"clock": hook}

    return site.draft(hooks, low, high, course, ports, fixed=fixed)


def _rows(view):
    """Image row from -1/2 to 1/2 where the mark is (of the world without the effect at first)."""
    high = np.array([c.size[1] for c in view.scene.cameras])[view.rows.camera]
    return view.plain.pixel[:, 1] / high - 0.5


@effect("rolling-shutter", (58,), "v")
def _(site):
    course = courses.constant()
    draft = _clock(site, _rows, 1e-4, 0.06, course, {"shutter.row_time": 1.0})
    course.driver = "image row"
    return draft


@effect("camera-triggered-late", (59,), "v", "body")
def _(site):
    course = courses.constant()
    return _clock(site, course.at, 2e-5, 0.02, course, CLOCKS)


@effect("trigger-late-from-an-instant", (59,), "v", "body")
def _(site):
    course = courses.step(site)
    return _clock(site, course.at, 2e-5, 0.02, course, CLOCKS)


@effect("frame-slip", (60,), "v", "body")
def _(site):
    """From an instant on one camera delivers the frame before: late by a period of its rate."""
    course = courses.step(site)
    period = 1.0 / float(site.rng.choice([60.0, 75.0, 100.0, 120.0, 200.0]))
    return _clock(site, course.at, period, period, course, CLOCKS, fixed=True)


@effect("clocks-drift", (61,), "v", "body")
def _(site):
    course = courses.steady(site)
    most = 1e-4 * site.length
    return _clock(site, course.at, 0.01 * most, most, course, CLOCKS)


@effect("clock-drifts-with-heat", (61,), "v", "body")
def _(site):
    course = courses.follow(site, "housing", "camera")
    return _clock(site, course.at, 2e-6, 2e-3, course, CLOCKS)


@effect("stamp-at-start-of-exposure", (62,), "v", "body")
def _(site):
    """The stamp is off the exposure's middle by a share of its length, which changes."""
    course = courses.constant()

    def late(view):
        return view.scene.exposure[view.rows.epoch]

    draft = _clock(site, late, 0.05, 1.0, course, {})
    course.driver = "exposure_ms"
    return draft


@effect("blur-with-uneven-shutter", (71,), "v", "body")
def _(site):
    """Light comes in unevenly during the exposure: the centroid of the streak is off its middle.

    The mark is really exposed at five instants, with weights that rise along the exposure.
    """
    nodes, weights = np.polynomial.legendre.leggauss(5)
    course = courses.constant()

    def hooks(size):
        def hook(view, t):
            share = weights * (1.0 + np.clip(size, -1, 1) * nodes)
            middle = 0.5 * float(np.sum(share * nodes) / np.sum(share))
            length = view.scene.exposure[view.rows.epoch]
            return t + middle * length * acts.cameras_mask(view, site.cameras)

        return {"clock": hook}

    draft = site.draft(hooks, 0.02, 0.33, course, {})
    course.driver = "exposure_ms"
    return draft


@effect("line-clock-wrong", (96,), "v")
def _(site):
    """Lines last longer than the data sheet says; the first line is on time."""
    course = courses.constant()

    def late(view):
        return _rows(view) + 0.5

    draft = _clock(site, late, 1e-5, 5e-3, course, {})
    course.driver = "image row"
    return draft
