"""Physics of detection: centroids of marks (PHYSICS rows 23, 65-75)."""

import numpy as np

from . import acts, courses, lens, spots
from .effect import effect
from .rotation import apply, back


@effect("circles-are-ellipses", (65,), "wsv", "target")
def _(site):
    """The centroid of the image of a disc is not the image of its centre."""
    target = site.target
    angle = 2.0 * np.pi * np.arange(16) / 16
    rim = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    course = courses.constant()

    def centroid(view, camera, mine, radius):
        own = view.scene.cameras[camera]
        axes = own.turn.T @ view.scene.stations[own.station].turn.T @ view.turn[mine]
        arms = apply(axes[:, None], radius * rim[None])
        points = (view.seen[mine][:, None] + arms).reshape(-1, 3)
        image = lens.image(own, points).reshape(-1, 16, 2)
        centre = lens.image(own, view.seen[mine])
        x, y = np.moveaxis(image - centre[:, None], -1, 0)
        xn, yn = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
        part = x * yn - xn * y
        area = 3.0 * part.sum(axis=1)
        return (
            np.stack([((x + xn) * part).sum(axis=1), ((y + yn) * part).sum(axis=1)], 1)
            / (area[:, None])
        )

    def hooks(size):
        def hook(view, xy):
            out = xy.copy()
            for camera in range(len(view.scene.cameras)):
                mine = (view.rows.camera == camera) & (view.rows.target == target)
                if mine.any():
                    out[mine] += centroid(view, camera, mine, abs(size))
            return out

        return {"lens": hook}

    draft = site.draft(hooks, 0.05 * site.half, 0.09 * site.half, course, {}, site.at_target())
    draft.sign = 1.0
    course.driver = "incidence"
    return draft


def _locked(site, curve, low, high):
    course = courses.constant()

    def field(view, uv):
        return np.stack([spots.at_phase(curve, uv[:, k]) for k in (0, 1)], axis=1)

    hooks = acts.on_image(site.cameras, field, course, "detect")
    draft = site.draft(hooks, low, high, course, {})
    draft.sign = 1.0
    course.driver = "sub-pixel phase"
    return draft


@effect("pixel-locking-small-spots", (66,), "bwsvr")
def _(site):
    """Sharp small spots: the pixels' own sampling."""
    curve = spots.locking(round(site.even(0.9, 1.4), 1), 0.3, 0.0, 8)
    return _locked(site, curve, 0.05, 2.0)


@effect("pixel-locking-threshold", (66, 67), "bwsvr")
def _(site):
    """Spots cut at a threshold before their centre of gravity is taken."""
    curve = spots.locking(round(site.even(1.2, 2.2), 1), 0.5, round(site.even(0.15, 0.4), 2), 6)
    return _locked(site, curve, 0.05, 3.0)


@effect("threshold-follows-light", (67,), "sr")
def _(site):
    """A background with a slope pulls the centroids, more so in bright light."""
    course = courses.sun(site)
    way = site.way()
    hooks = acts.on_image(
        site.cameras, lambda v, uv: np.broadcast_to(way, uv.shape), course, "detect"
    )
    return site.draft(hooks, 5e-3, 0.3, course, {})


@effect("side-light-on-target", (68,), "sr", "target")
def _(site):
    """The sunlit side of each mark is brighter; the side wanders with the sun's azimuth."""
    turn = site.even(-1.5, 1.5) / site.length
    start = site.even(0.0, 6.28)
    light = courses.sun(site, 60.0)
    target = site.target

    def field(view, uv):
        angle = start + turn * view.t
        way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        return way * (view.rows.target == target)[:, None]

    hooks = acts.on_image(acts.EVERY_CAMERA, field, light, "detect")
    return site.draft(hooks, 5e-3, 0.3, light, {}, site.at_target())


@effect("blooming-with-exposure", (69,), "v")
def _(site):
    """Charge of overexposed marks leaks along the columns, in proportion to the exposure."""
    course = courses.constant()

    def field(view, uv):
        longer = view.scene.exposure[view.rows.epoch] / np.mean(view.scene.exposure)
        return longer[:, None] * [0.0, 1.0]

    draft = site.draft(acts.on_image(site.cameras, field, course, "detect"), 0.01, 0.5, course, {})
    course.driver = "exposure_ms"
    return draft


@effect("dark-current-on-dim-marks", (70,), "sr", "target")
def _(site):
    """Dark current, doubling every 7 K, pulls dim marks towards the warm corner."""
    site.cameras = [c for c, target in site.scene.sees if target == site.target][:1]
    count = len(site.scene.targets[site.target].points)
    dim = site.rng.uniform(size=count) ** 2
    way = site.way()
    base = courses.follow(site, "board", "camera")
    course = courses.Course(
        lambda v: 2.0 ** (base.at(v) / 7.0), base.driver, "with driver", None,
        {"doubling_K": 7.0}, False,
    )  # fmt: skip
    target = site.target

    def field(view, uv):
        weak = dim[np.minimum(view.rows.point, count - 1)] * (view.rows.target == target)
        return weak[:, None] * way

    hooks = acts.on_image(site.cameras, field, course, "detect")
    where = {"camera": site.names()} | site.at_target()
    return site.draft(hooks, 2e-3, 0.1, course, {}, where)


@effect("spots-have-coma", (72,), "bw")
def _(site):
    """The centroid of a comatic spot is off along the radius, with a bent profile."""
    course = courses.constant()
    bend = site.even(4.0, 7.0)

    def field(view, uv):
        size = np.array([c.size for c in view.scene.cameras])[view.rows.camera]
        out = (uv - 0.5 * size) / (0.5 * np.linalg.norm(size, axis=1))[:, None]
        r = np.linalg.norm(out, axis=1)
        return out * np.sin(bend * r)[:, None]

    hooks = acts.on_image(site.cameras, field, course, "detect")
    return site.draft(hooks, 0.01, 0.6, course, {})


@effect("corners-biased-by-ink", (73,), "bw", "target")
def _(site):
    """Ink spreads: neighbouring corners move the opposite way along the target's diagonals."""
    scene = site.scene
    columns = scene.targets[0].grid[1]
    course = courses.constant()
    diagonal = np.array([1.0, 1.0 if site.rng.random() < 0.5 else -1.0, 0.0]) / np.sqrt(2.0)

    def field(view, uv):
        r, c = np.divmod(view.rows.point, columns)
        sign = np.where((r + c) % 2 == 0, 1.0, -1.0)
        camera = np.array([camera.turn for camera in view.scene.cameras])[view.rows.camera]
        way = back(camera, view.turn @ diagonal)[:, :2]
        return sign[:, None] * way / np.linalg.norm(way, axis=1)[:, None]

    hooks = acts.on_image(acts.EVERY_CAMERA, field, course, "detect")
    return site.draft(hooks, 0.01, 0.8, course, {}, site.at_target())


@effect("colour-filter-pattern", (75,), "bwsvr")
def _(site):
    """Demosaicing leaves a bias with a period of two pixels."""
    course = courses.constant()
    phase = site.rng.uniform(0.0, 6.28, 2)

    def field(view, uv):
        return np.stack([spots.two_pixel(1.0, uv[:, k], phase[k]) for k in (0, 1)], axis=1)

    draft = site.draft(acts.on_image(site.cameras, field, course, "detect"), 0.02, 0.5, course, {})
    course.driver = "pixel phase of period 2"
    return draft


@effect("wet-glass", (23,), "svr")
def _(site):
    """From an instant on a film on the front glass displaces the image smoothly."""
    course = courses.step(site)
    size = np.array(site.scene.cameras[site.cameras[0]].size)
    wave = site.rng.normal(size=(4, 2)) * 5.0
    phase = site.rng.uniform(0.0, 6.28, 4)
    push = site.rng.normal(size=(4, 2)) / 2.0

    def field(view, uv):
        return np.sin((uv / size.max()) @ wave.T + phase) @ push

    hooks = acts.on_image(site.cameras, field, course, "detect")
    return site.draft(hooks, 0.01, 0.5, course, {})
