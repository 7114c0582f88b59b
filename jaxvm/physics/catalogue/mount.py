"""Named physics of mounts and stations: what carries the cameras."""

from jaxvm.physics.catalogue.entry import (
    ALWAYS,
    CHANGING,
    HYSTERESIS,
    SETTLING,
    THERMAL,
    WARMING_UP,
    Entry,
    axes,
)
from jaxvm.physics.effects import Term

_TURN, _SHIFT = axes("mount.turn"), axes("mount.shift")
_OPPOSED = (
    tuple(Term(f"mount.turn_{axis}", "along_beam", "linear") for axis in "xy"),
    *((Term(f"mount.turn_{axis}", "along_beam", "linear"),) for axis in "xyz"),
)
"""Turns in proportion to the place on the beam: against each other at its ends."""

_STATION = axes("station.turn", "station.shift")

MOUNT: tuple[Entry, ...] = (
    Entry(
        "mount-turn", "the camera turns in its mount with temperature", (25,),
        _TURN, ("temperature",), THERMAL, "camera",
        (5e-7, 2e-4), "walk of the principal point", "roll the camera, add an inclinometer",
        "The mount distorts with temperature and turns the camera. All targets shift in the "
        "image alike, at every range.",
    ),
    Entry(
        "mount-turn-quadratic", "the camera turns in its mount, more when far from its mean "
        "temperature", (25, 80),
        _TURN, ("temperature",), ("quadratic",), "camera",
        (5e-7, 2e-4), "walk of the principal point", "a wide range of temperature",
        "Parts of different stuff distort the mount out of proportion when the temperature goes "
        "far. All targets shift in the image alike, at every range.",
    ),
    Entry(
        "mount-hysteresis", "the camera turns in its mount with backlash", (25, 79),
        _TURN, ("temperature",), (*HYSTERESIS, "direction"), "camera",
        (5e-7, 2e-4), "a slow thermal lag", "slow cycles: a lag shrinks, backlash does not",
        "Stick and slip in the mount make it return on another path than it went. The turn "
        "depends on the direction of the temperature's change.",
    ),
    Entry(
        "camera-on-bent-beam", "the beam under the camera bends in the sun", (27, 81),
        _TURN, ("gradient", "irradiance"), THERMAL, "camera",
        (1e-9, 1e-3), "ageing of the station's calibration", "log both sides of the beam",
        "One side of the beam that carries the camera is warmer than the other, and it bends. The "
        "cameras of one station turn against each other, and back in the evening.",
    ),
    Entry(
        "beam-warms-unevenly", "the beam under the camera bends while it warms", (27,),
        _TURN, ("temperature",), (*CHANGING, "direction"), "camera",
        (1e-7, 1e-3), "backlash of the mount", "hold the temperature: the turn goes away",
        "While the temperature changes, surface and core or the two sides of the beam differ, and "
        "it bends. The turn follows the rate of the temperature and changes sign with it.",
    ),
    Entry(
        "mount-lags", "the camera turns while its mount lags behind its surroundings", (25, 81),
        _TURN, ("temperature",), CHANGING, "camera",
        (1e-7, 2e-4), "a beam that bends while it warms", "log the temperature of the mount itself",
        "The mount turns the camera by the difference between its own temperature, which nobody "
        "logs, and that of its surroundings. The turn is there while the temperature changes.",
    ),
    Entry(
        "station-beam-bends", "the beam between the cameras of a station bends", (27,),
        _OPPOSED, ("irradiance", "gradient", "temperature"),
        (*THERMAL, *CHANGING, "direction"), "station",
        (1e-9, 1e-3), "turn of one mount", "log both sides of the beam",
        "One side of the beam that carries the cameras is warmer than the other, and it bends. The "
        "cameras at its ends turn against each other, those in its middle do not.",
    ),
    Entry(
        "mount-turn-sun", "the camera turns in its mount in the sun", (25, 82),
        _TURN, ("irradiance",), THERMAL, "camera",
        (1e-9, 1e-5), "the beam under the camera bends", "shade the mount alone",
        "The sun warms the mount beyond the temperature of the air, and it distorts. All targets "
        "shift in the image alike, later than the sunlight by the time that the mount takes.",
    ),
    Entry(
        "mount-loaded", "the camera turns with a load or with its neighbour", (37,),
        _TURN, ("quantity", "neighbour"), THERMAL, "camera",
        (1e-9, 1e-2), "turn with temperature", "change that quantity alone",
        "A load bends the mount, or the heat of a neighbouring device reaches it. The turn follows "
        "a recorded quantity that is no temperature of its own.",
    ),
    Entry(
        "mount-warm-up", "the camera turns in its mount after power-on", (25, 52),
        _TURN, ("power-on",), WARMING_UP, "camera",
        (1e-5, 2e-3), "shift of the sensor, creep", "switch off and on again",
        "The camera heats its own mount and turns in it. The turn settles exponentially and "
        "returns with every power-on.",
    ),
    Entry(
        "mount-creep", "the mount creeps", (28,),
        _TURN, ("time",), SETTLING, "camera",
        (1e-9, 1e-2), "thermal lag", "let the temperature return: creep does not",
        "The mount relaxes after it was set up. The camera turns ever more slowly in one "
        "direction.",
    ),
    Entry(
        "mount-slip", "the mount slips", (29,),
        _TURN, ("time",), ("step",), "camera",
        (5e-6, 5e-3), "the structure moved", "a second camera on the same station",
        "The camera turned in its mount at one moment. Everything it sees jumps between two "
        "epochs.",
    ),
    Entry(
        "mount-vibration", "the camera oscillates in its mount", (32,),
        _TURN, ("time",), ("periodic",), "camera",
        (1e-6, 1e-3), "vibration of the target", "a second camera on the same station",
        "Something shakes or heats the mount periodically. All targets swing in the image alike.",
    ),
    Entry(
        "mount-wind", "the wind turns the camera", (33,),
        _TURN, ("wind",), ("square", "proportional", "linear", "quadratic"), "camera",
        (1e-8, 1e-4), "vibration of the mount", "shelter the camera",
        "The wind pushes the camera on its mount or tripod, about with the square of its speed. "
        "All targets shift in the image alike.",
    ),
    Entry(
        "gravity-sag", "the mount sags under the camera", (31,),
        ((Term("mount.turn_x", "up_y", "linear"), Term("mount.turn_y", "up_x", "linear")),),
        ALWAYS, ALWAYS, "camera",
        (1e-6, 5e-4), "decentring", "look up and down, roll the camera",
        "The weight of camera and lens bends the mount. The sag goes with sine and cosine of the "
        "attitude and repeats with it.",
    ),
    Entry(
        "pair-calibration", "the camera's place on its station is wrong", (21, 35),
        (*_TURN, *_SHIFT), ALWAYS, ALWAYS, "camera",
        (5e-6, 2e-2), "noise of the links", "calibrate the pair again",
        "The calibrated pose between this camera and its station is wrong or aged; a wedge in the "
        "window does the same. Every loop through the pair fails to close by the same amount.",
    ),
    Entry(
        "bracket-growth", "the camera's bracket grows with temperature", (26,),
        _SHIFT, ("temperature",), THERMAL, "camera",
        (2e-7, 2e-4), "motion of the structure", "near and far targets",
        "The bracket between station and camera expands and carries the camera with it. Near "
        "targets shift more than far ones.",
    ),
    Entry(
        "bracket-hysteresis", "the camera's bracket moves with backlash", (26, 79),
        _SHIFT, ("temperature",), (*HYSTERESIS, "direction"), "camera",
        (2e-7, 2e-4), "a slow thermal lag", "slow cycles: a lag shrinks, backlash does not",
        "Joints of the bracket stick and slip as it grows and shrinks. The camera's place depends "
        "on the direction of the temperature's change.",
    ),
    Entry(
        "camera-creeps", "the camera creeps out of place", (28,),
        _SHIFT, ("time",), SETTLING, "camera",
        (1e-9, 2e-2), "motion of the structure", "a second camera on the same station",
        "The bracket yields slowly and the camera moves without turning. Near targets shift more "
        "than far ones.",
    ),
    Entry(
        "camera-displaced", "the camera was displaced", (29,),
        _SHIFT, ("time",), ("step",), "camera",
        (1e-5, 2e-2), "the structure moved", "a second camera on the same station",
        "The camera moved at one moment without turning. Near targets jump more than far ones.",
    ),
    Entry(
        "station-turn", "the station turns", (11, 12),
        axes("station.turn"), ("temperature", "irradiance", "wind", "quantity"), THERMAL, "station",
        (1e-9, 5e-3), "refraction, motion of the targets", "an inclinometer",
        "The pillar or tripod under all cameras turns with temperature, sun or load. Every camera "
        "of the station agrees.",
    ),
    Entry(
        "station-shift", "the station moves", (11, 12),
        axes("station.shift"), ("temperature", "irradiance", "quantity"), THERMAL, "station",
        (1e-9, 5e-2), "motion of the targets", "further reference targets",
        "The pillar or tripod under all cameras moves with temperature, sun or load. Every camera "
        "of the station agrees, near targets most.",
    ),
    Entry(
        "station-settles", "the station settles", (34,),
        _STATION, ("time",), SETTLING, "station",
        (1e-9, 5e-2), "creep of one mount", "a second camera on the station",
        "Tripod or ground yield after the set-up, ever more slowly. All cameras of the station "
        "turn or move together.",
    ),
    Entry(
        "station-jump", "the station was knocked", (29,),
        _STATION, ("time",), ("step",), "station",
        (5e-6, 5e-2), "the targets moved", "further reference targets",
        "The tripod or pillar was pushed at one moment. All cameras of the station jump together.",
    ),
    Entry(
        "station-sways", "the station sways", (11,),
        _STATION, ("time",), ("periodic",), "station",
        (5e-8, 5e-2), "motion of the targets", "an inclinometer, further reference targets",
        "Tide, traffic or the daily course of the sun tilt the ground periodically. All cameras of "
        "the station swing together.",
    ),
)  # fmt: skip
"""Named physics of mounts and stations."""
