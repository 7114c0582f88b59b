"""Named physics of sensors, shutters and clocks."""

from itertools import combinations

from jaxvm.physics.catalogue.entry import (
    ALWAYS,
    HYSTERESIS,
    THERMAL,
    WARMING_UP,
    Entry,
    each,
    pair,
    plain,
)
from jaxvm.physics.catalogue.maps import height_map
from jaxvm.physics.effects import Term

SEAMS = tuple(round(0.04 * k, 2) for k in range(-8, 9))
"""Where the fields of a stitched sensor may join, in image widths from the middle."""

_CENTRE, _DELAY = pair("sensor.cx", "sensor.cy"), (plain("clock.offset"),)


def _steps(axes: str, along: str, *seams: float):
    """Fields of a sensor that are shifted against each other from one seam on, or from each."""
    return tuple(Term(f"detect.{axis}", along, "step", (seam,)) for seam in seams for axis in axes)


def _sloped(basis: str):
    """The local principal distance varies over the image as the height of the sensor's surface."""
    return tuple(Term("sensor.focal", driver, basis) for driver in ("image_x", "image_y"))


SENSOR: tuple[Entry, ...] = (
    Entry(
        "principal-point-walk", "the principal point walks with temperature", (51,),
        _CENTRE, ("temperature",), THERMAL, "camera",
        (1e-3, 5e-1), "turn of the camera", "a wide field, a rolled camera, an inclinometer",
        "The sensor moves against the lens as the body warms. The whole image shifts, in a "
        "direction of the individual camera.",
    ),
    Entry(
        "principal-point-quadratic", "the principal point walks out of proportion to the "
        "temperature", (51, 80),
        _CENTRE, ("temperature",), ("quadratic",), "camera",
        (1e-3, 5e-1), "turn of the camera", "a wide range of temperature",
        "The sensor moves against the lens, not quite in proportion to the temperature. Over a "
        "wide range the shift of the image is a parabola.",
    ),
    Entry(
        "principal-point-hysteresis", "the principal point does not return with the temperature",
        (51, 79),
        _CENTRE, ("temperature",), (*HYSTERESIS, "direction"), "camera",
        (1e-3, 5e-1), "backlash of the mount", "slow cycles, a rolled camera",
        "Sensor or lens stick and slip as the body warms and cools. The image shifts and returns "
        "on another path.",
    ),
    Entry(
        "principal-point-sun", "the sun on the housing shifts the image", (51, 82),
        _CENTRE, ("irradiance",), ("lag", "lag with state", "two lags"), "camera",
        (2e-5, 1e-2), "bias of the detector with the light", "shade the camera",
        "The sun heats the housing above the air and the sensor moves against the lens. The whole "
        "image shifts, later than the sun.",
    ),
    Entry(
        "self-heating", "the image shifts after power-on", (52,),
        _CENTRE, ("power-on",), WARMING_UP, "camera",
        (2e-2, 5.0), "ambient temperature, creep", "switch off and on again",
        "The camera heats itself after power-on and the sensor moves. The shift settles "
        "exponentially and returns with every power-on.",
    ),
    Entry(
        "duty-cycle", "the image shifts with the frame rate or exposure", (53,),
        _CENTRE, ("frame rate", "exposure"), THERMAL, "camera",
        (1e-4, 1.0), "ambient temperature", "hold frame rate and exposure",
        "The sensor's own heat depends on how often and how long it exposes. The image shifts with "
        "the schedule of the acquisition.",
    ),
    Entry(
        "duty-changed", "the image shifts as the camera settles at another frame rate", (53,),
        _CENTRE, ("time",), ("settling", "ramp"), "camera",
        (2e-2, 5.0), "creep of the mount", "log frame rate and exposure; hold them",
        "From one moment on the sensor exposes more or less often and settles at another "
        "temperature. The image shifts exponentially from that moment on.",
    ),
    Entry(
        "principal-point-jump", "the principal point jumps", (30, 48, 63),
        _CENTRE, ("time",), ("step",), "camera",
        (5e-2, 20.0), "slip of the mount", "a wide field, a rolled camera",
        "A lens group or the sensor jumped at one moment, as after a knock or a change of the "
        "image window. The whole image shifts.",
    ),
    Entry(
        "image-jumps", "the image shifts at random from image to image", (48,),
        (each("epoch", "sensor.cx", "sensor.cy"),), ALWAYS, ALWAYS, "camera",
        (1e-2, 20.0), "vibration of the mount, haze", "switch the stabiliser off",
        "A stabiliser, or a sensor on springs, rests at another place in every image. The whole "
        "image shifts, at random from image to image.",
    ),
    Entry(
        "principal-point-ages", "the principal point drifts with age", (51, 85),
        _CENTRE, ("time",), ("linear", "creep"), "camera",
        (1e-8, 5.0), "creep of the mount", "a rolled camera; calibrate again later",
        "Adhesive and screws around the sensor relax with time. The whole image drifts in one "
        "direction.",
    ),
    Entry(
        "principal-point-wrong", "the principal point is not that of this recording", (63,),
        _CENTRE, ALWAYS, ALWAYS, "camera",
        (2e-1, 100.0), "turn of the camera", "read the image window and binning from the device",
        "The image was cut, binned or resized after the calibration, or its pixels are counted "
        "from another corner. The whole image is off by whole or half pixels, always.",
    ),
    Entry(
        "sensor-tilt", "the sensor is tilted against the lens", (55,),
        (*pair("lens.tilt_x", "lens.tilt_y"), _sloped("linear")), ALWAYS, ALWAYS, "camera",
        (1e-4, 5e-2), "decentring, turn of the camera", "a strongly distorting lens",
        "The sensor plane is not normal to the axis. Nearly all of it is absorbed by pose and "
        "principal point; what is left is small.",
    ),
    Entry(
        "sensor-unflat", "the sensor is not flat", (54,),
        (_sloped("square"), height_map()), ALWAYS, ALWAYS, "camera",
        (1e-6, 1e-2), "decentring, higher distortion", "roll the camera",
        "The sensor surface deviates from a plane, so the local scale varies over the image. "
        "The pattern is fixed in the image.",
    ),
    Entry(
        "sensor-stitched", "the sensor is stitched", (57,),
        (
            *(_steps(axes, "column", seam) for seam in SEAMS for axes in ("uv", "u", "v")),
            *(_steps(axes, "row", 0.0) for axes in ("uv", "u", "v")),
            *(_steps("uv", "column", *two) for two in combinations(SEAMS, 2)),
        ),
        ALWAYS, ALWAYS, "camera",
        (5e-4, 1e-1), "pixel locking, unflat sensor", "move a target across the middle",
        "The sensor was exposed in two or three fields that do not quite fit, or its halves are "
        "read out apart. One part of the image is shifted against the other.",
    ),
    Entry(
        "image-resampled", "the device resamples its image from a moment on", (63,),
        (plain("sensor.focal", "sensor.cx", "sensor.cy"),), ("time",), ("step",), "camera",
        (1e-5, 1e-1), "jump of the focal length", "read the binning from the device",
        "Compression, binning or another read-out scales the image about its first pixel instead "
        "of the principal point. The image jumps in scale and place at once.",
    ),
    Entry(
        "aspect", "the pixels are not square", (56, 96),
        (
            plain("sensor.aspect"),
            plain("sensor.aspect", "sensor.skew"),
            plain("sensor.aspect", "sensor.focal"),
            (Term("detect.u", "column", "linear"),),
            (Term("detect.v", "row", "linear"),),
        ), ALWAYS, ALWAYS, "camera",
        (1e-6, 1e1), "scales of the target", "roll the target or the camera by 90 degrees",
        "The scales along rows and columns differ. Digital sensors have square pixels unless the "
        "image was resampled or its lines are timed by a wrong clock.",
    ),
    Entry(
        "skew", "the pixel grid is skewed", (56,),
        (plain("sensor.skew"),), ALWAYS, ALWAYS, "camera",
        (1e-6, 1e-2), "rolling shutter in steady motion", "a static scene",
        "The columns are not at right angles to the rows. Digital sensors have no skew unless the "
        "image was resampled.",
    ),
    Entry(
        "trigger-offset", "the exposure is not at the recorded time", (59, 62),
        _DELAY, ALWAYS, ALWAYS, "camera",
        (1e-4, 5e-2), "half the exposure time", "reverse the motion, change the exposure",
        "One camera exposes later or earlier than its time stamp says. The error is the image "
        "velocity times the delay.",
    ),
    Entry(
        "clock-drift", "the camera's clock runs wrong", (61,),
        _DELAY, ("time",), ("linear", "proportional", "ramp"), "camera",
        (1e-7, 1e-4), "trigger offset", "record for longer",
        "The camera's clock gains or loses. The delay of its exposures grows with time.",
    ),
    Entry(
        "clock-drift-heat", "the camera's clock follows the temperature", (61,),
        _DELAY, ("temperature",), ("linear", "lag", "lag with state"), "camera",
        (1e-7, 1e-2), "an interface that the processor's heat slows down",
        "a clock that all cameras share",
        "The oscillator or the electronics of the trigger change with temperature. The delay of "
        "the exposures follows the camera's own temperature.",
    ),
    Entry(
        "frame-slip", "the camera lost a frame", (60,),
        _DELAY, ("time",), ("step",), "camera",
        (4e-3, 1.0), "a single bad image", "number the frames in the device",
        "From one moment on each image is paired with the time of its neighbour. The delay jumps "
        "by whole periods of the frame rate.",
    ),
    Entry(
        "trigger-late", "the camera is triggered late from a moment on", (59,),
        _DELAY, ("time",), ("step",), "camera",
        (1e-4, 5e-2), "a lost frame", "a flash that all cameras see; number the frames",
        "A cable, a filter or a new setting delays the trigger from one moment on. What moves is "
        "seen too late by this camera, in proportion to its speed.",
    ),
    Entry(
        "exposure-delay", "the delay follows the exposure time", (62, 71),
        _DELAY, ("exposure",), ("proportional", "linear"), "camera",
        (1e-4, 2e-3), "trigger offset", "hold the exposure, reverse the motion",
        "A moving mark is seen at the middle of the exposure, while the time stamp is that of its "
        "start. The delay is about half the exposure time.",
    ),
    Entry(
        "rolling-shutter", "the shutter rolls", (58, 96),
        (plain("shutter.row_time"), plain("shutter.row_time", "clock.offset")),
        ALWAYS, ALWAYS, "camera",
        (5e-4, 1e-1), "skew of the sensor", "a static scene, motion the other way",
        "The rows are exposed one after another. Moving targets are sheared or stretched, and the "
        "sign turns with the motion.",
    ),
)  # fmt: skip
"""Named physics of sensors, shutters and clocks."""
