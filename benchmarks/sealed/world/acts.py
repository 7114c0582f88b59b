"""Elementary ways in which something is out of place; each makes hooks of `chain` for a size."""

import numpy as np

EVERY_CAMERA = range(99)
"""Also those that only a plan has."""


def cameras_mask(view, cameras):
    return np.isin(view.rows.camera, cameras)


def turn_camera(cameras, axis, course):
    """The camera's body turns by size (rad) x course about an axis of its own."""
    return _pose("camera", lambda v: cameras_mask(v, cameras), 0, axis, course)


def shift_camera(cameras, axis, course):
    """The camera's body shifts by size (m) x course along its own axes."""
    return _pose("camera", lambda v: cameras_mask(v, cameras), 1, axis, course)


def turn_station(station, axis, course):
    return _pose("station", lambda v: v.station() == station, 0, axis, course)


def shift_target(target, axis, course):
    return _pose("target", lambda v: v.rows.target == target, 1, axis, course)


def turn_target(target, axis, course):
    return _pose("target", lambda v: v.rows.target == target, 0, axis, course)


def _pose(step, who, part, axis, course):
    axis = np.asarray(axis, float)

    def hooks(size):
        def hook(view, value):
            if "shots" in view.part and step != "target":
                return value
            amount = size * course.at(view) * who(view)
            out = list(value)
            out[part] = out[part] + amount[:, None] * axis
            return tuple(out)

        return {step: hook}

    return hooks


def reshape(target, field, course):
    """Marks move on their target by size (m, or per metre) x field(points) x course."""

    def hooks(size):
        def hook(view, mark):
            mine = view.rows.target == target
            amount = size * course.at(view) * mine
            return mark + amount[:, None] * field(view, mark)

        return {"shape": hook}

    return hooks


def on_image(cameras, field, course, step="lens"):
    """Image (or pixels, at step "sensor" or "detect") moves by size x field x course."""

    def hooks(size):
        def hook(view, image):
            amount = size * course.at(view) * cameras_mask(view, cameras)
            return image + amount[:, None] * field(view, image)

        return {step: hook}

    return hooks


def zoom(cameras, course):
    """The principal distance grows by the factor 1 + size x course."""
    return on_image(cameras, lambda v, xy: xy, course)


def principal_point(cameras, way, course):
    """The principal point walks by size (px) x course in a direction."""
    way = np.asarray(way, float)
    return on_image(cameras, lambda v, uv: np.broadcast_to(way, uv.shape), course, "sensor")


def radial(cameras, course, power=2):
    """Radial displacement r^power times the image vector (power 2: Brown's k1)."""

    def field(view, xy):
        return xy * np.sum(view_tangent(view) ** 2, axis=1)[:, None] ** (power // 2)

    return on_image(cameras, field, course)


def decentring(cameras, way, course):
    """Brown's decentring p1, p2 in proportion to `way`."""
    p1, p2 = way

    def field(view, xy):
        x, y = view_tangent(view).T
        q = x * x + y * y
        return np.stack(
            [2.0 * p1 * x * y + p2 * (q + 2.0 * x * x), p1 * (q + 2.0 * y * y) + 2.0 * p2 * x * y],
            axis=1,
        )

    return on_image(cameras, field, course)


def view_tangent(view):
    """Tangents of the ray's angles, or for wide lenses the image point itself."""
    ray = view.ray
    if view.scene.kind == "wide":
        across = np.hypot(ray[:, 0], ray[:, 1])
        angle = np.arctan2(across, ray[:, 2])
        return ray[:, :2] * (angle / np.maximum(across, 1e-12))[:, None]
    return ray[:, :2] / ray[:, 2:]
