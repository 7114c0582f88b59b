"""Hidden effects inside cameras: lens, sensor, centroids, shutter."""

import numpy as np

from jaxvm.simulate.bodies import Site, after, plus
from jaxvm.simulate.hidden import (
    MINUTE,
    Truth,
    either_sign,
    hidden,
    onset,
    usual,
)


@hidden("focal-drift", "the left camera's focal length grows with the warmth of its body")
def focal_drift(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["left"]
    rate = strength * rng.uniform(40e-6, 80e-6)
    warmth = camera.housing.above(usual(site, camera.housing))
    cold = camera.focal
    camera.focal = lambda t: cold(t) * (1.0 + rate * warmth(t))[:, None]
    return Truth(
        "focal-drift",
        "The focal length of the camera left grows with its body temperature.",
        {"camera": ["left"]},
        "body_left_degC",
        {"growth": (rate, "1/K")},
    )


@hidden("principal-point-walk", "the right camera's image moves on its sensor with body warmth")
def principal_point_walk(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["right"]
    size, angle = strength * rng.uniform(0.02, 0.06), rng.uniform(0.0, 2 * np.pi)
    rate = size * np.array([np.cos(angle), np.sin(angle)])
    warmth = camera.housing.above(usual(site, camera.housing))
    camera.centre = plus(camera.centre, lambda t: warmth(t)[:, None] * rate)
    return Truth(
        "principal-point-walk",
        "The principal point of the camera right walks with its body temperature.",
        {"camera": ["right"]},
        "body_right_degC",
        {"walk along u": (rate[0], "px/K"), "walk along v": (rate[1], "px/K")},
    )


@hidden("self-heating", "the left camera's image moves while it warms up after power-on")
def self_heating(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["left"]
    shift = strength * either_sign(rng, 0.3, 0.8)
    axis = int(rng.integers(2))
    tau = rng.uniform(20.0, 60.0) * MINUTE
    direction = np.eye(2)[axis]
    camera.centre = plus(
        camera.centre,
        lambda t: shift * onset(t - camera.powered_on_s, tau)[:, None] * direction,
    )
    return Truth(
        "self-heating",
        f"After power-on the image of the camera left moves along {'uv'[axis]} and comes to rest.",
        {"camera": ["left"]},
        "time since power-on",
        {f"shift along {'uv'[axis]}": (shift, "px"), "time constant": (tau, "s")},
    )


@hidden("lens-radial", "the right camera's lens bends more at the edge than its calibration says")
def lens_radial(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["right"]
    extra = strength * either_sign(rng, 0.10, 0.25)
    calibrated = camera.lens
    camera.lens = plus(calibrated, lambda ideal: extra * (ideal**2).sum(1)[:, None] ** 3 * ideal)
    return Truth(
        "lens-radial",
        "The lens of the camera right has more radial distortion of high order than its model.",
        {"camera": ["right"]},
        "image radius",
        {"distortion of the seventh order": (extra, "1")},
    )


@hidden("pixel-locking", "the centres of marks are drawn towards the raster of pixels")
def pixel_locking(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    bias = strength * either_sign(rng, 0.04, 0.08)
    for camera in site.cameras.values():
        camera.detect = after(camera.detect, lambda pixel: pixel + bias * np.sin(2 * np.pi * pixel))
    return Truth(
        "pixel-locking",
        "Measured positions are biased with a period of one pixel.",
        {"camera": list(site.cameras)},
        "position within the pixel",
        {"amplitude": (bias, "px")},
    )


@hidden("trigger-offset", "the right camera exposes later than the recorded time")
def trigger_offset(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["right"]
    late = strength * rng.uniform(4e-3, 12e-3)
    camera.delay = plus(camera.delay, lambda row: np.full_like(row, late))
    return Truth(
        "trigger-offset",
        f"The camera right exposes {1e3 * late:.1f} ms after the recorded time.",
        {"camera": ["right"]},
        "image velocity",
        {"delay": (late, "s")},
    )


@hidden("rolling-shutter", "the left camera exposes its rows one after the other")
def rolling_shutter(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["left"]
    height = camera.image_size[1]
    frame = strength * rng.uniform(15e-3, 40e-3)  # the recorded time is that of the middle row
    camera.delay = plus(camera.delay, lambda row: frame * ((row + 0.5) / height - 0.5))
    return Truth(
        "rolling-shutter",
        f"The shutter of the camera left rolls: its rows are exposed over {1e3 * frame:.0f} ms.",
        {"camera": ["left"]},
        "image row and image velocity",
        {"time per frame": (frame, "s")},
    )


CAMERA_EFFECTS = (
    focal_drift,
    principal_point_walk,
    self_heating,
    lens_radial,
    pixel_locking,
    trigger_offset,
    rolling_shutter,
)
