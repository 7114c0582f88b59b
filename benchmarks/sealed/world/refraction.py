"""Light through air of uneven index and through glass, by tracing rays."""

import numpy as np

INDEX_PER_KELVIN = -0.95e-6


def appear(points, bend, steps=16):
    """Where points [n, 3] appear from the origin when rays bend on their way.

    `bend(x)` is the gradient of the logarithm of the refractive index (1/m) at places [n, 3]. A
    ray leaves the origin, is stepped by the midpoint rule along d/ds (dx/ds) = bend across the
    ray, and its start is corrected until it meets the point.
    """
    length = np.linalg.norm(points, axis=1)[:, None]
    aim = points / length
    for _ in range(2):
        place, way = np.zeros_like(points), aim.copy()
        ds = length / steps
        for _ in range(steps):
            half = place + 0.5 * ds * way
            curve = bend(half)
            curve = curve - np.sum(curve * way, axis=1)[:, None] * way
            place = place + ds * way + 0.5 * ds**2 * curve
            way = way + ds * curve
        aim = aim + (points - place) / length
        aim /= np.linalg.norm(aim, axis=1)[:, None]
    return aim * length


def refract(way, normal, ratio):
    """Snell's law for unit directions at a surface; `ratio` is index before over index after."""
    cosine = np.sum(way * normal, axis=1)[:, None]
    inside = 1.0 - ratio**2 * (1.0 - cosine**2)
    return ratio * way + (np.sqrt(inside) - ratio * cosine) * normal


def through_window(points, thickness, gap, index, front, behind):
    """Where points appear through a window in front of the camera, flat on both faces.

    Args:
        thickness, gap: of the glass and from pupil to glass (m).
        front, behind: unit normals (away from the camera) of the near and the far face.
    """

    def leave(aim):
        near = gap / aim[:, 2:] * aim
        glass = refract(aim, np.broadcast_to(front, aim.shape), 1.0 / index)
        far = behind * (thickness + gap)
        run = np.sum((far - near) * behind, axis=1) / np.sum(glass * behind, axis=1)
        out = refract(glass, np.broadcast_to(behind, aim.shape), index)
        return near + run[:, None] * glass, out

    return _meet(points, leave)


def through_dome(points, radius, thickness, index, centre):
    """Where points appear through a dome of two spheres about `centre` (m, camera axes)."""

    def cut(start, way, size):
        off = start - centre
        along = np.sum(off * way, axis=1)
        run = -along + np.sqrt(along**2 - np.sum(off**2, axis=1) + size**2)
        return start + run[:, None] * way

    def leave(aim):
        near = cut(np.zeros_like(aim), aim, radius)
        glass = refract(aim, (near - centre) / radius, 1.0 / index)
        far = cut(near, glass, radius + thickness)
        return far, refract(glass, (far - centre) / (radius + thickness), index)

    return _meet(points, leave)


def _meet(points, leave):
    """Aim rays so that after `leave(aim)` = (place, way) they go through the points."""
    length = np.linalg.norm(points, axis=1)[:, None]
    aim = points / length
    for _ in range(6):
        place, way = leave(aim)
        run = np.sum((points - place) * way, axis=1)[:, None]
        aim = aim + (points - place - run * way) / length
        aim /= np.linalg.norm(aim, axis=1)[:, None]
    return aim * length
