"""Named physics of targets, of their marks, and of what carries them."""

from jaxvm.physics.catalogue.entry import (
    ALWAYS,
    CHANGING,
    HYSTERESIS,
    SETTLING,
    THERMAL,
    Entry,
    alternatives,
    axes,
    each,
    pair,
    plain,
)
from jaxvm.physics.effects import Term

_MARK = (
    plain("target.point_x", "target.point_y", "target.point_z"),
    plain("target.point_x", "target.point_y"),
    plain("target.point_z"),
)
_PLACE = (
    *axes("structure.shift", "structure.turn"),
    *(plain(f"target.point_{axis}") for axis in "xyz"),
)
"""Where a target is: in the world, and along its own axes, as a plate slides in its plane."""

TARGET: tuple[Entry, ...] = (
    Entry(
        "target-bow", "the target is bent out of plane", (5,),
        pair("target.bow_x", "target.bow_y"), ALWAYS, ALWAYS, "target",
        (5e-5, 1e-2), "lens distortion", "move and roll the target in the image",
        "The plate is not flat: its middle stands off the plane through its edges. Seen obliquely "
        "this shifts the inner marks; the pattern is fixed to the plate, not to the image.",
    ),
    Entry(
        "target-sags", "the target sags under its own weight", (5, 31),
        alternatives(Term("target.bow_x", "target_up_z", "linear"),
                     Term("target.bow_y", "target_up_z", "linear")),
        ALWAYS, ALWAYS, "target",
        (1e-5, 5e-3), "bow of the target", "hold the target upright and flat",
        "A plate that is held flat bends under its weight, one that stands upright does not. The "
        "bow goes with the component of gravity across the plate and turns with its attitude.",
    ),
    Entry(
        "target-bend-asymmetric", "the target is bent to an S", (6,),
        alternatives(Term("target.point_z", "target_x", "cube"),
                     Term("target.point_z", "target_y", "cube")),
        ALWAYS, ALWAYS, "target",
        (5e-5, 1e-2), "bow of the target, lens distortion", "move and roll the target in the image",
        "One half of the plate stands up and the other down, as where it is screwed to a base that "
        "is not flat. The deflection grows with the third power of the distance from the middle.",
    ),
    Entry(
        "target-twist", "the target is twisted", (6,),
        (plain("target.twist"),), ALWAYS, ALWAYS, "target",
        (5e-5, 1e-2), "bow of the target", "view the target from more directions",
        "Opposite corners of the plate stand off its plane in opposite directions. The plate is a "
        "saddle instead of a plane.",
    ),
    Entry(
        "target-bends", "the target bends with its surroundings", (7,),
        pair("target.bow_x", "target.bow_y"),
        ("temperature", "humidity", "irradiance", "quantity"),
        (*THERMAL, *CHANGING, *HYSTERESIS), "target",
        (1e-8, 1e-3), "drift of the lens distortion", "watch a second target",
        "One-sided warming or moisture bends the plate. The bow follows the driver, often late.",
    ),
    Entry(
        "target-expansion", "the target grows and shrinks", (1,),
        (plain("target.scale"),), ("temperature", "irradiance"), THERMAL, "target",
        (1e-6, 1e-4), "drift of the focal length, distance", "watch a second target of other stuff",
        "The plate expands with temperature. All cameras see its marks move radially about its "
        "centre, in proportion to its size and not to its distance.",
    ),
    Entry(
        "target-swells", "the target swells with moisture", (2,),
        (plain("target.scale"),), ("humidity",), (*THERMAL, *HYSTERESIS), "target",
        (5e-7, 3e-4), "thermal expansion", "log humidity and temperature",
        "The plate takes up moisture and grows alike along and across. It follows the humidity by "
        "hours and need not return on the same path.",
    ),
    Entry(
        "target-growth-anisotropic", "the target grows differently along and across", (2,),
        pair("target.scale_x", "target.scale_y"), ("humidity", "temperature"),
        (*THERMAL, *HYSTERESIS), "target",
        (5e-7, 3e-4), "thermal expansion, aspect", "roll the target; log humidity",
        "Paper, wood and laminates take up moisture and grow more across the grain than along it. "
        "The two scales of the plate then differ.",
    ),
    Entry(
        "target-scale-lags", "the target's scale follows the rate of the temperature", (97,),
        (plain("target.scale"),), ("temperature",), CHANGING, "target",
        (1e-7, 1e-4), "thermal expansion, drift of the focal length",
        "a sensor on the target itself",
        "The logged temperature is not that of the plate or of the scale bar, which warm up later. "
        "While the temperature changes the scale is wrong in proportion to its rate.",
    ),
    Entry(
        "target-scale", "the target's scale is wrong", (3, 64),
        (plain("target.scale"),), ALWAYS, ALWAYS, "target",
        (5e-5, 1e-2), "baseline or range scale", "measure a length on the target",
        "All distances on the plate are in error by one factor, as with a wrong print scale. It "
        "shows only where something else fixes the scale.",
    ),
    Entry(
        "target-print", "the target's x and y scales differ", (4,),
        pair("target.scale_x", "target.scale_y"), ALWAYS, ALWAYS,
        "target", (5e-5, 1e-2), "aspect of the camera", "turn the target by 90 degrees",
        "The printer's feed stretched the pattern in one direction. The plate's marks are "
        "compressed along one of its axes.",
    ),
    Entry(
        "target-spheres", "the marks have a depth", (15,),
        ((Term("target.point_z", "incidence", "linear"),),), ALWAYS, ALWAYS, "target",
        (5e-6, 5e-3), "scale of the target", "view the target from more directions",
        "The optical centre of thick, domed or spherical marks does not lie in the plate. It moves "
        "off the mark's place with the angle at which the mark is seen.",
    ),
    Entry(
        "marks-of-other-depth", "the marks stand at different depths", (15,),
        (each("mark", "target.point_z"),), ALWAYS, ALWAYS, "target",
        (5e-6, 5e-3), "a bent plate", "view the target from more directions; measure its marks",
        "Marks of another make, thicker or domed, have their optical centre before or behind the "
        "plate. They stand off while the marks beside them don't.",
    ),
    Entry(
        "corner-bias", "neighbouring corners are biased to opposite sides", (73,),
        alternatives(Term("target.point_x", "checker", "linear"),
                     Term("target.point_y", "checker", "linear")),
        ALWAYS, ALWAYS, "target",
        (1e-6, 1e-3), "marks out of place", "another detector, another print, other light",
        "Spread ink, blur or a wrong white balance moves the corners of a chessboard towards its "
        "dark or its bright fields. From one corner to the next the side changes.",
    ),
    Entry(
        "mark-displaced", "a mark sits in another place", (8,),
        _MARK, ALWAYS, ALWAYS, "mark",
        (1e-5, 1e-2), "detection bias", "look with another camera",
        "One mark was displaced, re-stuck or measured wrongly. All cameras see it off its place, "
        "at all times.",
    ),
    Entry(
        "mark-restuck", "a mark was displaced during the recording", (8,),
        _MARK, ("time",), ("step",), "mark",
        (1e-5, 1e-2), "an obstacle before the mark", "look with another camera",
        "One mark was knocked off and stuck on again, or slipped at one moment. All cameras see it "
        "jump, and the marks around it stay.",
    ),
    Entry(
        "mark-creeps", "a mark creeps on its adhesive", (9,),
        _MARK, ("time",), ("onset", "creep", "settling"), "mark",
        (1e-6, 1e-3), "deformation of the target", "fix the mark mechanically",
        "The adhesive under one mark yields and lets it slide ever more slowly. The marks around "
        "it stay where they are.",
    ),
    Entry(
        "mark-moves-with-heat", "a mark moves with temperature", (9,),
        _MARK, ("temperature",), ("linear",), "mark",
        (1e-7, 1e-3), "deformation of the target", "fix the mark mechanically",
        "Holder or adhesive of one mark expand and carry it. The marks around it stay where they "
        "are.",
    ),
    Entry(
        "hand-over-plate", "two faces of a plate move against each other", (36,),
        _PLACE, ("temperature", "irradiance"), THERMAL, "face",
        (1e-9, 1e-2), "motion of the plate", "watch both faces from one station",
        "A plate that two stations see from two sides hands the pose over from one to the other. "
        "Its faces move against each other with temperature, and all that follows is off.",
    ),
    Entry(
        "target-moved", "the target was knocked out of place", (10,),
        _PLACE, ("time",), ("step",), "target",
        (1e-5, 5e-2), "the station moved", "watch further reference targets",
        "A target that was taken as fixed changed its place at one moment. Every camera that sees "
        "it says so, and other targets don't.",
    ),
    Entry(
        "target-settles", "the target creeps out of place", (10, 14),
        _PLACE, ("time",), SETTLING, "target",
        (1e-7, 5e-2), "the station settles", "watch further reference targets",
        "A target that was taken as fixed moves slowly, as where the arm that carries it sags. "
        "Every camera that sees it says so.",
    ),
    Entry(
        "target-thermal-motion", "the target moves with its surroundings", (11, 12, 36),
        _PLACE, ("temperature", "irradiance", "humidity", "quantity"), THERMAL, "target",
        (1e-9, 1e-2), "the station moves", "watch further reference targets",
        "The pillar, wall or cover that carries the target moves with temperature or sun. Every "
        "camera that sees the target says so.",
    ),
    Entry(
        "target-vibrates", "the target oscillates", (13,),
        _PLACE, ("time",), ("periodic",), "target",
        (1e-6, 5e-2), "vibration of the mount", "a second camera on the same station",
        "The structure that carries the target swings. Every camera that sees it says so; the "
        "period may be an alias, as the recording has few images in each swing.",
    ),
)  # fmt: skip
"""Named physics of targets."""
