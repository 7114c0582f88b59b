"""Named physics between target and lens: air and windows."""

from jaxvm.physics.catalogue.entry import ALWAYS, CHANGING, THERMAL, Entry, each, pair, plain
from jaxvm.physics.catalogue.maps import image_map
from jaxvm.physics.effects import Term

_AIR = ("constant", "gradient", "temperature", "irradiance")
_AIR_FORMS = ("constant", "linear", "proportional", "lag", "lag with state")
_LAYERS = (Term("medium.layers_up"), Term("medium.layers_up", "height", "linear"))
"""Warm air over the ground: rays that pass lower bend more."""

_WALLS = tuple(
    (Term(f"medium.layers_{axis}"), Term(f"medium.layers_{axis}", f"level_{axis}", "linear"))
    for axis in "xy"
)
"""Warm air along a wall: rays that pass nearer bend more."""

_OFF_CENTRE = (plain("sensor.focal"), plain("sensor.focal", "sensor.cx", "sensor.cy"))
"""A weak lens, on the axis of the camera or beside it."""

MEDIUM: tuple[Entry, ...] = (
    Entry(
        "air-bending", "the air bends the rays", (16,),
        (_LAYERS, plain("medium.layers_up")),
        _AIR, _AIR_FORMS, "station",
        (1e-10, 1e-5), "turn of the mount", "watch targets at several ranges",
        "A gradient of temperature makes a gradient of the refractive index, and rays become "
        "arcs. The shift grows with the square of the distance.",
    ),
    Entry(
        "air-bending-lateral", "the air bends the rays sideways", (17,),
        (*_WALLS, *pair("medium.layers_x", "medium.layers_y")), _AIR, _AIR_FORMS, "station",
        (1e-10, 1e-5), "yaw of the mount", "watch targets at several ranges",
        "A warm wall, a heater or a sunlit side makes the air warmer on one side of the path. "
        "Rays bend away from the warm side, by the square of the distance.",
    ),
    Entry(
        "haze", "the air shimmers", (18, 98),
        (each("epoch", "medium.bend_u", "medium.bend_v"),), ALWAYS, ALWAYS, "camera",
        (1e-8, 1e-4), "a stabiliser, vibration of the mount", "record at night; shorten the path",
        "Turbulence of warm air tilts the rays at random, alike for neighbouring marks of one "
        "image. It grows with the length of the path and with the sun.",
    ),
    Entry(
        "window", "a plane window stands before the lens", (20,),
        (plain("medium.window"),), ALWAYS, ALWAYS, "camera",
        (5e-4, 3e-2), "lens distortion, entrance pupil", "near and far targets",
        "A glass plate shifts rays without turning them. Near targets seem nearer and the field "
        "slightly distorted.",
    ),
    Entry(
        "window-inserted", "a window or filter was put before the lens", (50,),
        (plain("medium.window"),), ("time",), ("step",), "camera",
        (5e-4, 3e-2), "slip of the mount along the axis", "near and far targets",
        "A cover glass or a filter came before the lens, or went, at one moment. From then on near "
        "targets seem nearer and the field slightly distorted.",
    ),
    Entry(
        "window-wedge", "the window is a wedge", (21,),
        pair("medium.wedge_x", "medium.wedge_y"), ALWAYS, ALWAYS, "camera",
        (1e-5, 2e-2), "turn of the camera, decentring of the lens", "turn the window",
        "The faces of the window are not parallel and turn all rays by about half their angle. It "
        "looks like a turn of the camera, but for what the slant of the rays adds at the edge.",
    ),
    Entry(
        "window-refitted", "a wedged window was turned or put before the lens", (21,),
        pair("medium.wedge_x", "medium.wedge_y"), ("time",), ("step",), "camera",
        (1e-5, 2e-2), "slip of the mount", "take the window away; an inclinometer on the camera",
        "A window whose faces are not parallel turns all rays by about half its angle. Put in, "
        "taken out or turned at one moment it makes everything jump as if the camera had turned.",
    ),
    Entry(
        "wet-glass", "a film or drops on the glass bend the image from a moment on", (23,),
        (image_map(),), ("time",), ("step",), "camera",
        (1e-3, 5.0), "a jump of the distortion", "wipe the glass; look at the image",
        "Rain, dew or dirt on the front glass displaces the image smoothly, here one way and there "
        "another. It came, or went, at one moment.",
    ),
    Entry(
        "window-lens-power", "the sun makes the window a lens", (22,),
        _OFF_CENTRE, ("irradiance",), THERMAL, "camera",
        (1e-9, 1e-5), "thermal drift of the focal length", "shade the window",
        "The sun heats the window unevenly and its middle gets another index and thickness than "
        "its edge. The window acts as a weak lens that follows the sun.",
    ),
    Entry(
        "window-heats", "the window is a lens while it warms", (22,),
        _OFF_CENTRE, ("temperature",), CHANGING, "camera",
        (1e-6, 5e-4), "thermal drift of the focal length", "hold the temperature: it goes away",
        "While the temperature changes, middle and edge of the window or of the lens are not "
        "equally warm. The glass is a weak lens in proportion to the rate.",
    ),
)  # fmt: skip
"""Named physics of air and windows."""
