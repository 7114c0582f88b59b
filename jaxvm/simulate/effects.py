"""Physics that can be hidden in the scene: each entry changes what one body of the site does.

An effect is written as what happens to the body (a plate grows, a mount slips), never as a change
of pixels. Thermal quantities count from their mean over the recording: nominal values are those of
usual conditions. Sizes are drawn from the ranges that PHYSICS.md calls plausible.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from zlib import crc32

import numpy as np

from jaxvm.simulate.bodies import Camera, Plate, Site, after, along, plus

MINUTE = 60.0
AIR_INDEX_PER_KELVIN = 0.95e-6
"""Fall of the refractive index of air per kelvin (20 degC, 1013 hPa, green light)."""


@dataclass(frozen=True)
class Truth:
    """What was hidden in a recording.

    Attributes:
        effect: key in `HIDEABLE`.
        sentence: what happens, in plain English.
        place: where, e.g. {"camera": ["left"]}.
        driver: the quantity that it follows.
        parameters: name -> (value, unit).
        rms_px: RMS of its change of a pixel coordinate over all observations.
        rms_affected_px: the same over the observations that it changes at all.
        rms_range_m: RMS of its change of a measured distance.
    """

    effect: str
    sentence: str
    place: dict[str, list[str]]
    driver: str
    parameters: dict[str, tuple[float, str]] = field(default_factory=dict)
    rms_px: float = 0.0
    rms_affected_px: float = 0.0
    rms_range_m: float = 0.0


Hide = Callable[[Site, np.random.Generator, float], Truth]


@dataclass(frozen=True)
class HiddenEffect:
    """One effect that the scene can hide: `hide(site, rng, strength)` changes the site."""

    key: str
    description: str
    hide: Hide

    def into(self, site: Site, seed: int, strength: float) -> Truth:
        """Hide it in a site; the draw of its size depends on the seed and on this effect only."""
        return self.hide(site, np.random.default_rng([seed, crc32(self.key.encode())]), strength)


HIDEABLE: dict[str, HiddenEffect] = {}
"""The effects that `simulate_deformation_scene` can hide, by key."""


def _hideable(key: str, description: str) -> Callable[[Hide], Hide]:
    def register(hide: Hide) -> Hide:
        HIDEABLE[key] = HiddenEffect(key, description, hide)
        return hide

    return register


def _either_sign(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))


# --- plates -------------------------------------------------------------------------------------


@_hideable("plate-expansion", "the near reference plate, of aluminium, grows with the air's warmth")
def _plate_expansion(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_near"]
    expansion = strength * rng.uniform(21e-6, 25e-6)
    tau = rng.uniform(10.0, 40.0) * MINUTE
    warmth = site.weather.ambient.lagged(tau).about_mean(site.epoch_t)
    _grow(plate, lambda t: expansion * warmth(t)[:, None] * np.array([1.0, 1.0]))
    return Truth(
        "plate-expansion",
        f"The plate {plate.name} expands with the air temperature and lags behind it.",
        {"target": [plate.name]},
        "ambient_degC",
        {"expansion": (expansion, "1/K"), "lag": (tau, "s")},
    )


@_hideable(
    "humidity-growth", "the paper on the far reference plate swells, mostly in one direction"
)
def _humidity_growth(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_far"]
    across = strength * rng.uniform(20e-6, 45e-6)
    along_grain = across * rng.uniform(0.15, 0.35)
    damp = site.weather.humidity.about_mean(site.epoch_t)
    _grow(plate, lambda t: damp(t)[:, None] * np.array([across, along_grain]))
    return Truth(
        "humidity-growth",
        f"The paper of {plate.name} grows with humidity, more along x than along y.",
        {"target": [plate.name]},
        "humidity_pct",
        {"growth along x": (across, "1/%RH"), "growth along y": (along_grain, "1/%RH")},
    )


@_hideable("plate-bow", "the deck's plate is bent out of its plane")
def _plate_bow(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["deck"]
    bow = strength * _either_sign(rng, 0.5e-3, 1.5e-3)
    axis = int(rng.integers(2))
    middle, half = plate.middle[axis], plate.half_m

    def lift(t, nominal):
        height = bow * (1.0 - ((nominal[:, axis] - middle) / half) ** 2)
        return height[:, None] * np.array([0.0, 0.0, 1.0])

    plate.shape = plus(plate.shape, lift)
    return Truth(
        "plate-bow",
        f"The plate {plate.name} is bent along its {'xy'[axis]} axis: "
        f"the middle stands {1e3 * bow:+.2f} mm along +z against the edges.",
        {"target": [plate.name]},
        "constant",
        {"deflection": (bow, "m")},
    )


@_hideable("mark-displaced", "one mark of a fixed plate was glued back in a slightly wrong place")
def _mark_displaced(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_near"]
    which = int(rng.integers(plate.side**2))
    size, angle = strength * rng.uniform(0.2e-3, 0.5e-3), rng.uniform(0.0, 2 * np.pi)
    offset = size * np.array([np.cos(angle), np.sin(angle), 0.0])
    name, at = plate.mark_names[which], plate.nominal[which]

    def restuck(t, nominal):
        return np.isclose(nominal, at).all(axis=1)[:, None] * offset

    plate.shape = plus(plate.shape, restuck)
    return Truth(
        "mark-displaced",
        f"Mark {name} of {plate.name} is not where its coordinates say.",
        {"target": [plate.name], "point": [name]},
        "constant",
        {"displacement x": (offset[0], "m"), "displacement y": (offset[1], "m")},
    )


@_hideable("reference-moved", "the far reference plate was knocked and stands elsewhere since")
def _reference_moved(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    plate = site.plates["reference_far"]
    t0 = _moment(site, rng)
    axis = str(rng.choice(["x", "z"]))
    shift = strength * _either_sign(rng, 1e-3, 3e-3)
    rest = plate.place
    knock = along(axis, lambda t: shift * (t >= t0))

    def place(t):
        placed = rest(t)
        return type(placed)(placed.rotation, placed.shift + knock(t))

    plate.place = place
    return Truth(
        "reference-moved",
        f"The plate {plate.name} was knocked {1e3 * shift:+.2f} mm along the world's {axis} axis.",
        {"target": [plate.name]},
        "time",
        {"displacement": (shift, "m"), "moment": (t0, "s")},
    )


def _grow(plate: Plate, growth) -> None:
    """Let a plate grow about its middle by growth(t) along its x and y axes."""
    middle = plate.middle
    plate.shape = plus(
        plate.shape,
        lambda t, nominal: np.column_stack(
            [growth(t) * (nominal - middle)[:, :2], np.zeros(len(nominal))]
        ),
    )


# --- mounts -------------------------------------------------------------------------------------


@_hideable("mount-slip", "the right camera turns suddenly in its mount")
def _mount_slip(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    t0 = _moment(site, rng)
    turn = strength * _either_sign(rng, 30e-6, 150e-6)
    _turn(site.cameras["right"], "y", lambda t: turn * (t >= t0))
    return Truth(
        "mount-slip",
        "The camera right slipped in its mount: from one moment on it looks elsewhere.",
        {"camera": ["right"]},
        "time",
        {"turn about y": (turn, "rad"), "moment": (t0, "s")},
    )


@_hideable("mount-creep", "the left camera's mount settles for hours after set-up")
def _mount_creep(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    turn = strength * _either_sign(rng, 60e-6, 160e-6)
    tau = rng.uniform(80.0, 180.0) * MINUTE
    _turn(site.cameras["left"], "x", lambda t: turn * _onset(t, tau))
    return Truth(
        "mount-creep",
        "The mount of the camera left creeps: it tilts quickly at first, then ever more slowly.",
        {"camera": ["left"]},
        "time",
        {"turn about x": (turn, "rad"), "time constant": (tau, "s")},
    )


@_hideable("vibration", "the left camera nods with the rhythm of a machine")
def _vibration(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    turn = strength * rng.uniform(15e-6, 50e-6)
    period = rng.uniform(45.0, 90.0) * MINUTE
    phase = rng.uniform(0.0, 2 * np.pi)
    _turn(site.cameras["left"], "x", lambda t: turn * np.sin(2 * np.pi * t / period + phase))
    return Truth(
        "vibration",
        f"The mount of the camera left nods to and fro every {period / MINUTE:.0f} minutes.",
        {"camera": ["left"]},
        "time",
        {"amplitude about x": (turn, "rad"), "period": (period, "s"), "phase": (phase, "rad")},
    )


@_hideable("hysteresis", "the right camera turns with temperature through a joint with play")
def _hysteresis(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    rate = strength * _either_sign(rng, 15e-6, 35e-6)
    ambient = site.weather.ambient
    width = rng.uniform(0.3, 0.5) * ambient.span(site.epoch_t)
    follower = ambient.with_play(width).about_mean(site.epoch_t)
    _turn(site.cameras["right"], "y", lambda t: rate * follower(t))
    return Truth(
        "hysteresis",
        "The camera right turns with the air temperature, but through a joint with play: "
        "after each turn of the temperature it first stays where it is.",
        {"camera": ["right"]},
        "ambient_degC",
        {"turn about y": (rate, "rad/K"), "play": (width, "K")},
    )


@_hideable(
    "bracket-growth", "the right camera's bracket grows with temperature and carries it away"
)
def _bracket_growth(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["right"]
    axis = str(rng.choice(["x", "z"]))
    # Along z the pictures change less: a longer arm is needed to show it.
    growth = strength * (rng.uniform(20e-6, 40e-6) if axis == "x" else rng.uniform(60e-6, 90e-6))
    warmth = site.weather.ambient.about_mean(site.epoch_t)
    camera.shift = plus(camera.shift, along(axis, lambda t: growth * warmth(t)))
    return Truth(
        "bracket-growth",
        f"The bracket of the camera right grows with the air temperature along {axis}.",
        {"camera": ["right"]},
        "ambient_degC",
        {f"growth along {axis}": (growth, "m/K")},
    )


def _turn(camera: Camera, axis: str, angle) -> None:
    camera.turn = plus(camera.turn, along(axis, angle))


# --- lens and sensor ----------------------------------------------------------------------------


@_hideable("focal-drift", "the left camera's focal length grows with the warmth of its body")
def _focal_drift(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["left"]
    rate = strength * rng.uniform(40e-6, 80e-6)
    warmth = camera.housing.about_mean(site.epoch_t)
    cold = camera.focal
    camera.focal = lambda t: cold(t) * (1.0 + rate * warmth(t))[:, None]
    return Truth(
        "focal-drift",
        "The focal length of the camera left grows with its body temperature.",
        {"camera": ["left"]},
        "body_left_degC",
        {"growth": (rate, "1/K")},
    )


@_hideable("principal-point-walk", "the right camera's image moves on its sensor with body warmth")
def _principal_point_walk(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["right"]
    size, angle = strength * rng.uniform(0.02, 0.06), rng.uniform(0.0, 2 * np.pi)
    rate = size * np.array([np.cos(angle), np.sin(angle)])
    warmth = camera.housing.about_mean(site.epoch_t)
    camera.centre = plus(camera.centre, lambda t: warmth(t)[:, None] * rate)
    return Truth(
        "principal-point-walk",
        "The principal point of the camera right walks with its body temperature.",
        {"camera": ["right"]},
        "body_right_degC",
        {"walk along u": (rate[0], "px/K"), "walk along v": (rate[1], "px/K")},
    )


@_hideable("self-heating", "the left camera's image moves while it warms up after power-on")
def _self_heating(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["left"]
    shift = strength * _either_sign(rng, 0.3, 0.8)
    axis = int(rng.integers(2))
    tau = rng.uniform(20.0, 60.0) * MINUTE
    direction = np.eye(2)[axis]
    camera.centre = plus(
        camera.centre,
        lambda t: shift * _onset(t - camera.powered_on_s, tau)[:, None] * direction,
    )
    return Truth(
        "self-heating",
        f"After power-on the image of the camera left moves along {'uv'[axis]} and comes to rest.",
        {"camera": ["left"]},
        "time since power-on",
        {f"shift along {'uv'[axis]}": (shift, "px"), "time constant": (tau, "s")},
    )


@_hideable(
    "lens-radial", "the right camera's lens bends more at the edge than its calibration says"
)
def _lens_radial(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    camera = site.cameras["right"]
    extra = strength * _either_sign(rng, 0.10, 0.25)
    calibrated = camera.lens
    camera.lens = plus(calibrated, lambda ideal: extra * (ideal**2).sum(1)[:, None] ** 3 * ideal)
    return Truth(
        "lens-radial",
        "The lens of the camera right has more radial distortion of high order than its model.",
        {"camera": ["right"]},
        "image radius",
        {"distortion of the seventh order": (extra, "1")},
    )


@_hideable("pixel-locking", "the centres of marks are drawn towards the raster of pixels")
def _pixel_locking(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    bias = strength * _either_sign(rng, 0.04, 0.08)
    for camera in site.cameras.values():
        camera.detect = after(camera.detect, lambda pixel: pixel + bias * np.sin(2 * np.pi * pixel))
    return Truth(
        "pixel-locking",
        "Measured positions are biased with a period of one pixel.",
        {"camera": list(site.cameras)},
        "position within the pixel",
        {"amplitude": (bias, "px")},
    )


# --- shutter and clock --------------------------------------------------------------------------


@_hideable("trigger-offset", "the right camera exposes later than the recorded time")
def _trigger_offset(site: Site, rng: np.random.Generator, strength: float) -> Truth:
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


@_hideable("rolling-shutter", "the left camera exposes its rows one after the other")
def _rolling_shutter(site: Site, rng: np.random.Generator, strength: float) -> Truth:
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


# --- air and rangefinder ------------------------------------------------------------------------


@_hideable("air-bending", "warm air above cool air bends the lines of sight")
def _air_bending(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    per_kelvin = strength * AIR_INDEX_PER_KELVIN * rng.uniform(0.8, 1.5)
    gradient = site.weather.gradient
    site.index_slope = plus(site.index_slope, lambda t: -per_kelvin * gradient(t))
    return Truth(
        "air-bending",
        "Lines of sight are curved by the vertical gradient of the air temperature.",
        {"camera": list(site.cameras)},
        "gradient_K_per_m",
        {"curvature": (per_kelvin, "rad/m per K/m")},
    )


@_hideable("range-drift", "the rangefinder's index point drifts with temperature")
def _range_drift(site: Site, rng: np.random.Generator, strength: float) -> Truth:
    disto = site.rangefinder
    rate = strength * _either_sign(rng, 0.1e-3, 0.3e-3)
    warmth = site.weather.ambient.about_mean(site.epoch_t)
    disto.index = plus(disto.index, lambda t: rate * warmth(t))
    return Truth(
        "range-drift",
        f"The distances of the rangefinder {disto.name} drift with the air temperature.",
        {"rangefinder": [disto.name]},
        "ambient_degC",
        {"drift": (rate, "m/K")},
    )


# --- forms in time ------------------------------------------------------------------------------


def _onset(since, tau: float):
    """1 - exp(-t/tau) from t = 0 on."""
    return np.where(since > 0.0, -np.expm1(-np.maximum(since, 0.0) / tau), 0.0)


def _moment(site: Site, rng: np.random.Generator) -> float:
    """A moment in the middle half of the recording, half-way between two epochs."""
    k = int(rng.integers(site.epoch_t.size // 4, 3 * site.epoch_t.size // 4))
    return float(0.5 * (site.epoch_t[k] + site.epoch_t[k + 1]))
