"""Courses: how an effect may run in time, enumerated for one recording.

A course is a time-like driver in a form. Constants that enter nonlinearly (lags, instants, periods)
are asked on a grid; a refit refines them.
"""

import math
import re
from dataclasses import dataclass

import numpy as np

from jaxvm.network.scene import Scene
from jaxvm.physics.drivers import OWN_BODY, SESSION, channel_kind
from jaxvm.physics.effects import Channels, Scope

_FEWEST_EPOCHS = 6
"""A shorter recording is asked only about what does not change."""

_MOST_INSTANTS = 60
"""Instants at which a step is asked."""

_RAMPS, _EVENTS = np.linspace(0.1, 0.8, 8), np.linspace(0.1, 0.7, 7)
"""Shares of the epochs before a ramp, or an event after which something settles."""

_DOUBLING = 7.0
"""Kelvin in which dark current doubles: 6 to 8 for most sensors."""

_STAIRS = [(share, k / 8.0) for share in np.geomspace(0.1, 0.5, 20).tolist() for k in range(8)]
"""Height of a stair as a share of a quantity's range, and where it begins: no refit moves them."""

ENDS = (0.01, 1.99)
"""Contacts at the ends of their travel, to which what was before a recording has led them."""

_MOST_OF_MARKS = 3000
"""Hypotheses about single marks; where marks and instants are many, fewer instants are asked."""


@dataclass(frozen=True)
class Course:
    """A time-like driver in a form with given constants."""

    driver: str
    form: str
    constants: tuple[float, ...] = ()
    reference: float = 0.0


def driver_kind(scene: Scene, driver: str) -> str:
    """Kind of a time-like driver: "constant", "quantity", "difference", "own", "time", "power-on".

    Time is "time or power-on" where nobody noted when the cameras were switched on.
    """
    channels = scene.network.channels
    kinds = channels.kinds
    kind = kinds[channels.names.index(driver)]
    if kind == "time" and "power-on" not in kinds:
        return "time or power-on"
    return "time" if kind == "order" else kind


def kinds_in_scope(kind: str, driver: str, scope: Scope, scene: Scene) -> tuple[str, ...]:
    """Kinds of a driver for the bodies of a scope, general ones first.

    The body of a camera is a neighbour of other cameras on its station, and of targets. Where what
    is nearer is logged, too (a camera's own body, the air), it is nothing else: physics of a body
    follows its own temperature, not one like it. What happens to a target in one camera's view is
    physics of that camera.
    """
    if kind not in ("quantity", "difference", "own"):
        return tuple(kind.split(" or "))
    own = channel_kind(driver)
    body = camera_of(driver, scene)
    if not body or scope == Scope() or scope.rangefinder:
        return ("quantity", own)
    if scope.target and not scope.camera:
        return ("neighbour",) if air_is_logged(scene) else ("quantity", own, "neighbour")
    stations = {camera.name: camera.station for camera in scene.model.cameras}
    near = scope.camera or [name for name, at in stations.items() if at in scope.station]
    if body in near:
        return ("quantity", own)
    beside = ("neighbour",) if stations[body] in {stations[name] for name in near} else ()
    logged = all(f"body_{name}_degC" in scene.network.channels.names for name in near)
    return beside if logged else ("quantity", own, *beside)


def camera_of(driver: str, scene: Scene) -> str:
    """The camera whose body's temperature a driver is, alone or against the air's; or ""."""
    found = re.fullmatch(r"body_(.+?)_degC( - .*)?", driver)
    return found[1] if found and found[1] in {c.name for c in scene.model.cameras} else ""


def air_is_logged(scene: Scene) -> bool:
    """Whether a temperature is logged that is not that of a camera."""
    channels = scene.network.channels.names
    return any(channel_kind(c) == "temperature" and not camera_of(c, scene) for c in channels)


def enumerate_courses(scene: Scene) -> list[Course]:
    """All courses that a recording can be asked about; the first is constant."""
    channels = scene.network.channels
    courses = [Course("constant", "constant")]
    if len(channels.epoch_time) < _FEWEST_EPOCHS:
        return courses
    span = longest_session(channels)
    longest = span / 3
    # A third of a handful of epochs is less than two spacings.
    shortest = min(max(2 * _spacing(channels), span / 200), longest / 2)
    lags = np.geomspace(shortest, longest, 6).tolist()
    for driver, kind in zip(channels.names, channels.kinds, strict=True):
        if kind in _OF_KIND:
            courses += _OF_KIND[kind](driver, channels, lags)
    return courses


def courses_of_marks(scene: Scene, courses: list[Course], n_marks: int) -> list[Course]:
    """A mark sits wrongly always, from a moment on, ever more slowly, or with temperature."""
    slow = [
        [course for course in courses if course.driver == "time" and course.form == form]
        for form in ("step", "onset", "creep", "settling")
    ]
    warm = [
        course
        for course in courses
        if course.form == "linear"
        and channel_kind(course.driver) == "temperature"
        and course.driver != OWN_BODY  # a mark belongs to no camera
    ]
    warm = [course for course in warm if not camera_of(course.driver, scene)] or warm
    every = math.ceil(max(n_marks * sum(map(len, slow)) / _MOST_OF_MARKS, 1.0))
    return [courses[0], *warm, *(course for own in slow for course in own[::every])]


def _of_quantity(driver: str, channels: Channels, lags: list[float]) -> list[Course]:
    """A recorded quantity: followed at once or late, by its rate, or with a memory of its way."""
    values = at_epochs(driver, channels)
    width = float(np.ptp(values))
    if width == 0.0:
        return []
    reference, span = _reference(driver, channels), longest_session(channels)
    hours = np.asarray(channels.epoch_time) / 3600.0
    rate = float(np.median(np.abs(np.gradient(values, hours))))
    return [
        Course(driver, "linear", (), reference),
        Course(driver, "quadratic", (), reference),
        *(
            Course(driver, form, (tau,), reference)
            for form in ("lag", "lag with state")
            for tau in lags
        ),
        # Nobody logs at which value a camera was calibrated: the mean is but a guess.
        Course(driver, "affine", (), reference),
        *(Course(driver, "affine lag", (tau,), reference) for tau in lags[1::2]),
        Course(driver, "lag", (_quick(lags)[-1],), reference),
        *(Course(driver, "delay", (late,), reference) for late in (*_quick(lags), *lags[:3])),
        Course(driver, "two lags", (lags[1], lags[4]), reference),
        Course(driver, "proportional"),
        Course(driver, "square"),
        Course(driver, "rate"),
        # What evens out in less than a step between epochs follows the rate late.
        *(Course(driver, "transient", (tau,)) for tau in (*_quick(lags), *lags[:4])),
        *(Course(driver, "transient with state", (tau,)) for tau in lags),
        *(
            Course(driver, "direction", (share * rate + 1e-12, tau))
            for share in (0.1, 0.7)
            for tau in (0.4 * lags[0], lags[0], lags[2])
        ),
        Course(driver, "ageing", (), reference),
        # Over less it is as good as constant.
        *([Course(driver, "doubling", (_DOUBLING,), reference)] if width > 0.5 * _DOUBLING else []),
        *(
            Course(driver, "turning", (times * span, tau), reference)
            for times in (4.0, 7.0, 15.0)
            for tau in (_quick(lags)[0], lags[0], lags[2])
        ),
        *(
            Course(driver, "staircase", (share * width, phase), reference)
            for share, phase in _STAIRS
        ),
        *_hysteresis(driver, width, reference),
    ]


def _quick(lags: list[float]) -> list[float]:
    """Lags shorter than those of the grid, as far as logs between epochs tell them."""
    return [0.15 * lags[0], 0.4 * lags[0]]


def _of_own(driver: str, channels: Channels, lags: list[float]) -> list[Course]:
    """A quantity that each camera has for itself: with a constant, too, as cameras differ."""
    reference = _reference(driver, channels)
    width = float(np.ptp(_recorded(driver, channels)))
    forms = ("linear", "affine", "quadratic", "parabola")
    return [
        *(Course(driver, form, (), reference) for form in forms),
        *(
            Course(driver, form, (tau,), reference)
            for form in ("lag", "affine lag")
            for tau in lags
        ),
        *(Course(driver, "delay", (dead_time,), reference) for dead_time in lags[:3]),
        *(_hysteresis(driver, width, reference) if width > 0.0 else ()),
    ]


def _of_difference(driver: str, channels: Channels, lags: list[float]) -> list[Course]:
    """A difference of two temperatures: followed at once or late."""
    reference = _reference(driver, channels)
    return [
        *(Course(driver, form, (), reference) for form in ("linear", "affine")),
        *(Course(driver, "lag", (tau,), reference) for tau in lags[1::2]),
    ]


def _of_clock(driver: str, channels: Channels, lags: list[float]) -> list[Course]:
    """Time since something began: what settles, fast or ever more slowly."""
    return [
        *(Course(driver, "onset", (tau,)) for tau in lags),
        *(Course(driver, "creep", (tau,)) for tau in lags[::2]),
    ]


def _of_power_on(driver: str, channels: Channels, lags: list[float]) -> list[Course]:
    """Time since a camera was switched on."""
    return [*_of_clock(driver, channels, lags), *_warming_up(driver, lags)]


def _warming_up(driver: str, lags: list[float]) -> list[Course]:
    """What a camera that was calibrated warm shows until it is: its parts, one after the other."""
    return [
        *(Course(driver, "fading", (tau,)) for tau in lags),
        *(Course(driver, "two decays", pair) for pair in zip(lags, lags[2:], strict=False)),
    ]


def _of_time(driver: str, channels: Channels, lags: list[float]) -> list[Course]:
    """Time: trends, steps between epochs, ramps, a comb of periods, what settles after an event."""
    span = longest_session(channels)
    since = np.unique(at_epochs(driver, channels))
    instants = gaps(driver, channels)
    if len(instants) > _MOST_INSTANTS:
        instants = instants[np.linspace(0, len(instants) - 1, _MOST_INSTANTS).astype(int)]
    periods = span / np.arange(1.0, min(span / (2.05 * _spacing(channels)), 34.0), 0.5)
    return [
        *_of_clock(driver, channels, lags),
        # Named only where nobody noted when the cameras were switched on.
        *_warming_up(driver, lags),
        Course(driver, "linear", (), _reference(driver, channels)),
        # What ages has done so before the recording, too.
        Course(driver, "affine", (), _reference(driver, channels)),
        Course(driver, "proportional"),
        *(Course(driver, "step", (t,)) for t in instants.tolist()),
        *(Course(driver, "ramp", (t,)) for t in np.quantile(since, _RAMPS).tolist()),
        *(Course(driver, "periodic", (period,)) for period in periods.tolist()),
        *(
            Course(driver, "settling", (start, tau))
            for start in np.quantile(since, _EVENTS).tolist()
            for tau in lags[2::2]
        ),
    ]


def gaps(driver: str, channels: Channels) -> np.ndarray:
    """Middles between epochs (s of the driver) where a step leaves some epochs on either side."""
    since = np.unique(at_epochs(driver, channels))
    return (0.5 * (since[1:] + since[:-1]))[2:-2]


def at_epochs(driver: str, channels: Channels) -> np.ndarray:
    """Values of a driver in all epochs."""
    return np.asarray(np.interp(channels.epoch_time, channels.time, _recorded(driver, channels)))


_OF_KIND = {
    "quantity": _of_quantity,
    "own": _of_own,
    "difference": _of_difference,
    "time": _of_time,
    "power-on": _of_power_on,
}
"""Courses of a driver by its kind; the order of images alone drives nothing."""


def _hysteresis(driver: str, width: float, reference: float) -> list[Course]:
    """Play of some shares of the range that a quantity takes, the contact anywhere at first."""
    halves = [share * width for share in (0.1, 0.2, 0.3)]
    return [
        *(Course(driver, "hysteresis", (half,), reference) for half in halves),
        *(
            Course(driver, "hysteresis with state", (half, first), reference)
            for half in halves
            for first in ENDS
        ),
    ]


def _recorded(driver: str, channels: Channels) -> np.ndarray:
    return np.asarray(channels.values)[channels.index(driver)]


def _reference(driver: str, channels: Channels) -> float:
    """Mean of a driver over the epochs, from which centred forms count.

    Where recordings were joined, that of the first: a further one, made to look into an effect,
    does not change the state that the effect is counted from.
    """
    values = np.array(np.interp(channels.epoch_time, channels.time, _recorded(driver, channels)))
    if SESSION in channels.names:
        since = np.interp(channels.epoch_time, channels.time, _recorded(SESSION, channels))
        values = values[: 1 + int(np.argmax(np.append(np.diff(since) < 0.0, True)))]
    return float(np.mean(values))


def longest_session(channels: Channels) -> float:
    """Length of the longest session (s): no lag or period is known from the pause between two."""
    if SESSION not in channels.names:
        return float(np.ptp(channels.epoch_time))
    since = np.interp(channels.epoch_time, channels.time, _recorded(SESSION, channels))
    return float(np.max(since))


def _spacing(channels: Channels) -> float:
    return float(np.median(np.diff(channels.epoch_time)))
