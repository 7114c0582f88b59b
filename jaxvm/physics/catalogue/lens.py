"""Named physics of lenses: principal distance, distortion, decentring, pupil."""

from jaxvm.physics.catalogue.entry import (
    ALWAYS,
    HYSTERESIS,
    THERMAL,
    WARMING_UP,
    Entry,
    Terms,
    each,
    pair,
    plain,
)
from jaxvm.physics.effects import Term

_FOCAL = (plain("sensor.focal"),)
_RADIAL = (plain("lens.k1"), (Term("sensor.focal", "radius", "square"),))
"""By the tangent of the field angle, and in the image: towards 90 degrees these are not alike."""

_DECENTRING = pair("lens.p1", "lens.p2")
_INTRINSICS = plain("sensor.focal", "sensor.cx", "sensor.cy")
_DOME = (
    plain("medium.dome_x", "medium.dome_y", "medium.dome_z"),
    plain("medium.dome_x", "medium.dome_y"),
    *_DECENTRING,
    _INTRINSICS,
)


def _rings(count: int) -> Terms:
    """Bumps of the principal distance over the radius, from the axis to the corner."""
    width = 1.0 / (count - 1)
    return tuple(Term("sensor.focal", "radius", "bump", (k * width, width)) for k in range(count))


RINGS, FINE_RINGS = _rings(7), _rings(16)
"""Free-form curves of the principal distance over the radius."""

_COMA = (Term("sensor.focal", "radius", "linear"),)
"""A shift along the radius by its square."""

_RADIAL_FIXED = (
    tuple(Term("sensor.focal", "radius", basis) for basis in ("square", "fourth", "sixth")),
    *((Term("sensor.focal", "radius", basis),) for basis in ("square", "fourth", "sixth")),
    plain("lens.k1", "lens.k2", "lens.k3"),
    plain("lens.k1"),
    plain("lens.k2"),
    plain("lens.k3"),
    _COMA,
    RINGS,
    FINE_RINGS,
)

LENS: tuple[Entry, ...] = (
    Entry(
        "focal-drift", "the focal length drifts with temperature", (39, 85),
        _FOCAL, ("temperature",), (*THERMAL, "ageing"), "camera",
        (5e-7, 2e-4), "growth of the target, shift along the axis", "targets at two ranges",
        "The principal distance changes as lens and body expand. All targets grow about the "
        "principal point, at every range.",
    ),
    Entry(
        "device-compensates", "the device changes its own focal length with temperature", (93, 94),
        _FOCAL, ("temperature",), (*THERMAL, "staircase"), "camera",
        (1e-4, 1e-2), "thermal drift of the focal length",
        "log the device's intrinsics with every frame; switch its compensation off",
        "The firmware rescales the image by a table of temperatures, and nobody logs it. The "
        "principal distance changes by far more than lens and body can expand, or the other way.",
    ),
    Entry(
        "focal-sun", "the focal length follows the sun", (39, 82),
        _FOCAL, ("irradiance",), THERMAL, "camera",
        (1e-10, 1e-5), "a window that heats unevenly", "shade the camera; log its temperature",
        "The sun warms lens and body beyond the temperature of the air. The principal distance "
        "changes later than the sunlight by the time that the lens takes.",
    ),
    Entry(
        "focal-quadratic", "the focal length drifts out of proportion to the temperature",
        (39, 80),
        _FOCAL, ("temperature",), ("quadratic", "parabola"), "camera",
        (5e-7, 1e-3), "a thermal drift with a lag", "a wide range of temperature",
        "Lens and body expand, and the glass changes its index, not quite in proportion to the "
        "temperature. Over a wide range the drift of the principal distance is a parabola.",
    ),
    Entry(
        "focal-hysteresis", "the focal length does not return with the temperature",
        (39, 79, 95),
        _FOCAL, ("temperature",), (*HYSTERESIS, "direction"), "camera",
        (5e-7, 1e-3), "a slow thermal lag", "slow cycles; always approach from one side",
        "Elements of the lens or its focus drive have backlash. The principal distance depends on "
        "the direction from which the temperature came.",
    ),
    Entry(
        "focal-pressure", "the focal length follows the air pressure", (41,),
        _FOCAL, ("pressure",), ("linear", "lag"), "camera",
        (1e-8, 5e-6), "thermal drift of the focal length", "log barometer and temperature",
        "The air between the lens elements changes its index with pressure. The principal distance "
        "follows the barometer or the altitude.",
    ),
    Entry(
        "focal-warm-up", "the focal length settles after power-on", (52,),
        _FOCAL, ("power-on",), WARMING_UP, "camera",
        (1e-5, 1e-2), "ambient temperature", "switch off and on again",
        "The camera heats itself after power-on and its principal distance settles. It starts "
        "again with every power-on.",
    ),
    Entry(
        "focal-jump", "the focal length jumps", (48, 50, 93, 94),
        _FOCAL, ("time",), ("step",), "camera",
        (1e-5, 5e-2), "motion along the axis", "lock the focus; log the device's intrinsics",
        "Focus or zoom moved, a filter was inserted, or the device changed its own calibration at "
        "one moment. All targets grow or shrink about the principal point at once.",
    ),
    Entry(
        "focal-breathing", "the focal length swings", (48,),
        _FOCAL, ("time",), ("periodic",), "camera",
        (1e-5, 2e-2), "a periodic temperature", "lock the focus",
        "Autofocus hunts, or a heater or cooler cycles. All targets grow and shrink about the "
        "principal point with one period.",
    ),
    Entry(
        "focal-hunts", "the focal length differs from image to image", (48,),
        (each("epoch", "sensor.focal"),), ALWAYS, ALWAYS, "camera",
        (1e-5, 2e-2), "motion along the axis", "lock the focus",
        "The autofocus, or a loose focus ring, takes another place in every image. All targets "
        "grow or shrink about the principal point, at random from image to image.",
    ),
    Entry(
        "focal-wrong", "the focal length is not that of this recording", (94,),
        (*_FOCAL, _INTRINSICS), ALWAYS, ALWAYS, "camera",
        (1e-4, 5e-2), "scale or distance of the targets", "calibrate in the state of the recording",
        "The principal distance that was given belongs to another focus, temperature, medium or "
        "device. All targets are too large or too small about the principal point, always.",
    ),
    Entry(
        "lateral-colour", "the image scale follows the colour of the light", (49,),
        _FOCAL, ("light",), ("linear",), "camera",
        (1e-9, 1e-5), "thermal drift of the focal length", "light of one colour, a filter",
        "The lens has another scale for each colour, and the light changes its colour with its "
        "strength. All targets grow about the principal point as the light changes.",
    ),
    Entry(
        "marks-of-other-colour", "the image scale differs from mark to mark", (49,),
        (each("mark", "sensor.focal"),), ALWAYS, ALWAYS, "target",
        (1e-5, 1e-2), "displaced marks", "marks of one colour, a filter, other distances",
        "The lens has another scale for each colour, and the marks are not of one colour. Some "
        "marks are imaged farther from the centre of the image than others beside them.",
    ),
    Entry(
        "distortion-drift", "the distortion drifts with temperature", (43,),
        _RADIAL, ("temperature",), THERMAL, "camera",
        (1e-6, 1e-3), "drift of the focal length", "targets out to the edge of the field",
        "The lens distorts differently when warm. The edge of the field moves more than in "
        "proportion.",
    ),
    Entry(
        "defocus-drift", "the spots grow as the lens defocuses with temperature", (40, 72),
        (*_RADIAL, _COMA), ("temperature",), THERMAL, "camera",
        (1e-6, 1e-3), "drift of the distortion", "record the size of the spots",
        "The lens leaves its focus as it warms, and lopsided spots grow. Their centroids move "
        "along the radius, as if the distortion changed.",
    ),
    Entry(
        "distortion-warm-up", "the distortion settles after power-on", (43,),
        _RADIAL, ("power-on",), WARMING_UP, "camera",
        (1e-5, 1e-2), "settling of the focal length", "targets out to the edge of the field",
        "The camera heats its lens after power-on and the distortion settles. The edge of the "
        "field moves more than in proportion.",
    ),
    Entry(
        "distortion-jump", "the distortion jumps", (48,),
        _RADIAL, ("time",), ("step",), "camera",
        (1e-5, 1e-1), "jump of the focal length", "lock the focus",
        "Focus, zoom or a stabilising group changed at one moment. The edge of the field jumps "
        "more than in proportion.",
    ),
    Entry(
        "distortion-with-range", "the distortion depends on the range", (44,),
        (
            (Term("lens.k1", "inverse_range", "linear"),),
            (Term("sensor.focal", "radius2_over_range", "linear"),),
            # Over the slanted range, unlike over the depth, a scale is a distortion, too.
            (Term("sensor.focal", "inverse_range", "linear"),),
        ), ALWAYS, ALWAYS, "camera",
        (1e-5, 1e-1), "rays that do not meet in one point", "near and far targets",
        "A lens distorts near targets differently from far ones (Brown's variation of distortion). "
        "The rings of residuals change with one over the range.",
    ),
    Entry(
        "radial-beyond-model", "radial distortion beyond the lens model", (42,),
        _RADIAL_FIXED,
        ALWAYS, ALWAYS, "camera",
        (1e-6, 5e-1), "bow of the target", "roll the target in the image",
        "The lens model has too few radial terms for this lens. Rings of residuals about the "
        "axis stay fixed in the image.",
    ),
    Entry(
        "coma", "the spots are smeared outward", (72,),
        _RADIAL_FIXED, ALWAYS, ALWAYS, "camera",
        (1e-6, 5e-2), "radial distortion", "another aperture or focus; look at the spots",
        "Coma or defocus makes the image of a mark lopsided, more so towards the edge. Its "
        "centroid moves along the radius, as if the lens distorted.",
    ),
    Entry(
        "decentring", "decentring distortion beyond the lens model", (45,),
        _DECENTRING, ALWAYS, ALWAYS, "camera",
        (1e-6, 1e-2), "tilt of the sensor", "targets over the whole field",
        "The lens elements do not share one axis. The residuals are quadratic in the image and "
        "not symmetric.",
    ),
    Entry(
        "window-off-centre", "a dome or a wedged window stands off the axis", (21,),
        _DOME, ALWAYS, ALWAYS, "camera",
        (1e-5, 3e-2), "decentring of the lens", "take the window away, or turn it",
        "The camera does not sit in the middle of its dome, by so much where that has a radius of "
        "70 mm, or its window is a wedge. The image is bent to one side, like that of a lens whose "
        "elements do not share one axis.",
    ),
    Entry(
        "decentring-drift", "the decentring drifts with temperature", (46,),
        _DECENTRING, ("temperature",), THERMAL, "camera",
        (1e-7, 1e-4), "turn and principal point together", "targets over the whole field",
        "A lens element moves sideways as the barrel warms. The image shifts with the square of "
        "the field angle.",
    ),
    Entry(
        "decentring-jump", "the decentring jumps", (21, 30),
        _DECENTRING, ("time",), ("step",), "camera",
        (1e-6, 1e-2), "jump of the principal point", "targets over the whole field",
        "A lens element, or the camera behind its dome, moved sideways at one moment. The image "
        "jumps with the square of the field angle.",
    ),
    Entry(
        "entrance-pupil", "the rays do not meet in one point", (47,),
        (plain("lens.entrance"),), ALWAYS, ALWAYS, "camera",
        (5e-5, 3e-2), "lens distortion", "near and far targets",
        "The entrance pupil of a wide lens moves with the field angle. Distortion then depends on "
        "the distance.",
    ),
    Entry(
        "lens-play", "the lens has play", (30,),
        ((Term("sensor.cx", "up_x", "linear"), Term("sensor.cy", "up_y", "linear")),),
        ALWAYS, ALWAYS, "camera",
        (5e-2, 10.0), "turn of the camera", "roll the camera",
        "A loose thread or lens group hangs downwards, whatever the attitude of the camera. The "
        "principal point follows gravity in the image.",
    ),
)  # fmt: skip
"""Named physics of lenses."""
