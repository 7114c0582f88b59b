"""How a picture is taken and a distance measured: light, lens, shutter, in plain numpy."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxvm.simulate.bodies import Camera, Pixels, Placement, Plate, Points, Rangefinder, Site, Times


def brown_lens(coefficients: Float[np.ndarray, "5"]) -> Callable[[Pixels], Pixels]:
    """Radial and decentring distortion (Brown 1971), k1 k2 p1 p2 k3 as OpenCV orders them."""
    k1, k2, p1, p2, k3 = coefficients

    def lens(ideal: Pixels) -> Pixels:
        x, y = ideal.T
        s = x * x + y * y
        radial = 1.0 + s * (k1 + s * (k2 + s * k3))
        return np.column_stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
                y * radial + 2.0 * p2 * x * y + p1 * (s + 2.0 * y * y),
            ]
        )

    return lens


def apparent(
    eye: Points, mark: Points, up: Float[np.ndarray, "3"], slope: Float[np.ndarray, " n"]
) -> Points:
    """Where the eye sees a mark (m) through air whose squared index grows evenly upwards.

    With s' = ds/n a ray is r'' = grad(n^2)/2 (Born & Wolf, 3.2): constant here, so the ray is a
    parabola, r = eye + p s + g s^2/2 with |p| = 1 at the eye and g = slope * up. Its arc s
    to the mark is found by iteration; the mark seems to lie at eye + p s.
    """
    g = slope[:, None] * up
    sight = mark - eye
    s = np.linalg.norm(sight, axis=1)
    for _ in range(4):
        s = np.linalg.norm(sight - 0.5 * g * s[:, None] ** 2, axis=1)
    return mark - 0.5 * g * s[:, None] ** 2


def picture(site: Site, camera: Camera, plate: Plate, t: Times, nominal: Points) -> Pixels:
    """True pixels of marks, each exposed at its own time t (s). Behind the camera: NaN."""
    mark = plate.place(t).outward(plate.shape(t, nominal))
    placed = camera.place(t)
    seen = apparent(site.station.outward(placed.shift), mark, site.up, site.index_slope(t))
    x, y, z = placed.inward(site.station.inward(seen)).T
    z = np.where(z > 0.0, z, np.nan)
    return camera.focal(t) * camera.lens(np.column_stack([x / z, y / z])) + camera.centre(t)


def photograph(site: Site, camera: Camera, plate: Plate) -> Float[np.ndarray, "epochs marks 2"]:
    """Measured pixels (noise-free) of all marks of a plate at all epochs.

    The row of a mark decides when it is exposed, and by then it may have gone to another row: the
    time is found by iteration.
    """
    marks = plate.nominal
    recorded = np.repeat(site.epoch_t, len(marks))
    nominal = np.tile(marks, (site.epoch_t.size, 1))
    pixel = picture(site, camera, plate, recorded, nominal)
    exposed = recorded
    for _ in range(8):
        later = recorded + camera.delay(pixel[:, 1])
        if np.array_equal(later, exposed):
            break
        exposed = later
        pixel = picture(site, camera, plate, exposed, nominal)
    return camera.detect(pixel).reshape(site.epoch_t.size, len(marks), 2)


def distances(site: Site, rangefinder: Rangefinder, plate: Plate) -> Times:
    """Measured distances (m, noise-free) along the beam to the face of a plate at all epochs."""
    t = site.epoch_t
    origin = site.station.outward(rangefinder.place.shift)
    beam = site.station.rotation.apply(rangefinder.place.rotation.apply([0.0, 0.0, 1.0]))
    placed: Placement = plate.place(t)
    foot = placed.inward(np.broadcast_to(origin, (t.size, 3)))
    ray = np.broadcast_to(placed.rotation.inv().apply(beam), (t.size, 3))
    length = -foot[:, 2] / ray[:, 2]
    for _ in range(6):  # the face may be bent: its height where the beam meets it
        hit = foot + length[:, None] * ray
        hit[:, 2] = 0.0
        length = (plate.shape(t, hit)[:, 2] - foot[:, 2]) / ray[:, 2]
    return length + rangefinder.index(t)
