"""The catalogue: known physics by the name that an engineer uses.

An entry says where an effect enters (terms: ports and patterns), what may drive it, in which forms,
what kind of entity has it, how large it plausibly is, what it is mistaken for and what separates
it. Adding named physics is adding an entry; nothing else knows the names.
"""

from dataclasses import dataclass

from jaxvm.physics.effects import Term


@dataclass(frozen=True)
class Entry:
    """One named effect.

    Attributes:
        id: stable key.
        physics: the finding in words.
        groups: alternatives of terms that share one amplitude vector; the first is the fullest.
        drivers: kinds of time-like drivers: "constant", "quantity", "time", "power-on".
        forms: forms that the course may take.
        entity: what has it: "camera", "station", "target", "mark" or "rangefinder".
        plausible: smallest and largest size that is met in practice, in the unit of the first port
            (per unit of the driver where it has one).
        mistaken_for: what looks alike.
        separate_by: the recording that tells them apart.
        explanation: two sentences for an engineer.
    """

    id: str
    physics: str
    groups: tuple[tuple[Term, ...], ...]
    drivers: tuple[str, ...]
    forms: tuple[str, ...]
    entity: str
    plausible: tuple[float, float]
    mistaken_for: str
    separate_by: str
    explanation: str


def _terms(*ports: str) -> tuple[Term, ...]:
    return tuple(Term(port) for port in ports)


def _axes(prefix: str) -> tuple[tuple[Term, ...], ...]:
    """A vector port: all three components together, then each alone."""
    names = [f"{prefix}_{a}" for a in "xyz"]
    return (_terms(*names), *(_terms(name) for name in names))


def _pair(a: str, b: str) -> tuple[tuple[Term, ...], ...]:
    return (_terms(a, b), _terms(a), _terms(b))


_THERMAL = ("linear", "lag", "two lags")

CATALOGUE: tuple[Entry, ...] = (
    Entry(
        "target-bow", "the target is bent out of plane",
        _pair("target.bow_x", "target.bow_y"), ("constant",), ("constant",), "target",
        (5e-5, 1e-2), "lens distortion", "move and roll the target in the image",
        "The plate is not flat: its middle stands off the plane through its edges. Seen obliquely "
        "this shifts the inner marks; the pattern is fixed to the plate, not to the image.",
    ),
    Entry(
        "target-twist", "the target is twisted",
        (_terms("target.twist"),), ("constant",), ("constant",), "target",
        (5e-5, 1e-2), "bow of the target", "view the target from more directions",
        "Opposite corners of the plate stand off its plane in opposite directions. The plate is a "
        "saddle instead of a plane.",
    ),
    Entry(
        "target-bends", "the target bends with its surroundings",
        _pair("target.bow_x", "target.bow_y"), ("quantity",), _THERMAL, "target",
        (1e-6, 1e-3), "drift of the lens distortion", "watch a second target",
        "One-sided warming or moisture bends the plate. The bow follows the driver, often late.",
    ),
    Entry(
        "target-expansion", "the target grows and shrinks",
        (_terms("target.scale"),), ("quantity",), _THERMAL, "target",
        (1e-6, 1e-4), "drift of the focal length, distance", "watch a second target of other stuff",
        "The plate expands with temperature. All cameras see its marks move radially about its "
        "centre, in proportion to its size and not to its distance.",
    ),
    Entry(
        "target-growth-anisotropic", "the target grows differently along and across",
        (_terms("target.scale_x", "target.scale_y"), _terms("target.scale_x"),
         _terms("target.scale_y")), ("quantity",), _THERMAL, "target",
        (5e-7, 3e-4), "thermal expansion, aspect", "roll the target; log humidity",
        "Paper, wood and laminates take up moisture and grow more across the grain than along it. "
        "The two scales of the plate then differ.",
    ),
    Entry(
        "target-scale", "the target's scale is wrong",
        (_terms("target.scale"),), ("constant",), ("constant",), "target",
        (5e-5, 1e-2), "baseline or range scale", "measure a length on the target",
        "All distances on the plate are in error by one factor, as with a wrong print scale. It "
        "shows only where something else fixes the scale.",
    ),
    Entry(
        "target-print", "the target's x and y scales differ",
        (_terms("target.scale_x"), _terms("target.scale_y")), ("constant",), ("constant",),
        "target", (5e-5, 1e-2), "aspect of the camera", "turn the target by 90 degrees",
        "The printer's feed stretched the pattern in one direction. The plate's marks are "
        "compressed along one of its axes.",
    ),
    Entry(
        "mark-displaced", "a mark sits in another place",
        (_terms("target.point_x", "target.point_y"),), ("constant",), ("constant",), "mark",
        (1e-5, 1e-2), "detection bias", "look with another camera",
        "One mark was displaced, re-stuck or measured wrongly. All cameras see it off its place, "
        "at all times.",
    ),
    Entry(
        "target-moved", "the target was knocked out of place",
        (*_axes("structure.shift"), *_axes("structure.turn")), ("time",), ("step",), "target",
        (1e-5, 5e-2), "the station moved", "watch further reference targets",
        "A target that was taken as fixed changed its place at one moment. Every camera that sees "
        "it says so, and other targets don't.",
    ),
    Entry(
        "target-settles", "the target creeps out of place",
        (*_axes("structure.shift"), *_axes("structure.turn")), ("time",),
        ("linear", "onset", "creep", "ramp"), "target", (1e-7, 5e-2), "the station settles",
        "watch further reference targets",
        "A target that was taken as fixed moves slowly. Every camera that sees it says so.",
    ),
    Entry(
        "target-thermal-motion", "the target moves with its surroundings",
        (*_axes("structure.shift"), *_axes("structure.turn")), ("quantity",), _THERMAL, "target",
        (1e-7, 1e-2), "the station moves", "watch further reference targets",
        "The pillar or wall that carries the target moves with temperature or sun. Every camera "
        "that sees the target says so.",
    ),
    Entry(
        "air-bending", "the air bends the rays",
        (_terms("medium.bend_v", "medium.bend_u"), _terms("medium.bend_v"),
         _terms("medium.bend_u")), ("quantity", "constant"), ("linear", "lag", "constant"),
        "station", (1e-8, 1e-5), "turn of the mount", "watch targets at several ranges",
        "A gradient of temperature makes a gradient of the refractive index, and rays become "
        "arcs. The shift grows with the square of the distance.",
    ),
    Entry(
        "window", "a plane window stands before the lens",
        (_terms("medium.window"),), ("constant",), ("constant",), "camera",
        (5e-4, 3e-2), "lens distortion, entrance pupil", "near and far targets",
        "A glass plate shifts rays without turning them. Near targets seem nearer and the field "
        "slightly distorted.",
    ),
    Entry(
        "trigger-offset", "the exposure is not at the recorded time",
        (_terms("clock.offset"),), ("constant",), ("constant",), "camera",
        (1e-4, 5e-2), "half the exposure time", "reverse the motion, change the exposure",
        "One camera exposes later or earlier than its time stamp says. The error is the image "
        "velocity times the delay.",
    ),
    Entry(
        "clock-drift", "the camera's clock runs wrong",
        (_terms("clock.offset"),), ("time",), ("linear",), "camera",
        (1e-7, 1e-4), "trigger offset", "record for longer",
        "The camera's clock gains or loses. The delay of its exposures grows with time.",
    ),
    Entry(
        "rolling-shutter", "the shutter rolls",
        (_terms("shutter.row_time"),), ("constant",), ("constant",), "camera",
        (5e-4, 1e-1), "skew of the sensor", "a static scene, motion the other way",
        "The rows are exposed one after another. Moving targets are sheared or stretched, and the "
        "sign turns with the motion.",
    ),
    Entry(
        "mount-turn", "the camera turns in its mount with temperature",
        _axes("mount.turn"), ("quantity",), _THERMAL, "camera",
        (5e-7, 2e-4), "walk of the principal point", "roll the camera, add an inclinometer",
        "The mount distorts with temperature and turns the camera. All targets shift in the "
        "image alike, at every range.",
    ),
    Entry(
        "mount-hysteresis", "the camera turns in its mount with backlash",
        _axes("mount.turn"), ("quantity",), ("hysteresis", "direction"), "camera",
        (5e-7, 2e-4), "a slow thermal lag", "slow cycles: a lag shrinks, backlash does not",
        "Stick and slip in the mount make it return on another path than it went. The turn "
        "depends on the direction of the temperature's change.",
    ),
    Entry(
        "mount-creep", "the mount creeps",
        _axes("mount.turn"), ("time",), ("onset", "creep", "linear"), "camera",
        (1e-9, 1e-2), "thermal lag", "let the temperature return: creep does not",
        "The mount relaxes after it was set up. The camera turns ever more slowly in one "
        "direction.",
    ),
    Entry(
        "mount-slip", "the mount slips",
        _axes("mount.turn"), ("time",), ("step",), "camera",
        (5e-6, 5e-3), "the structure moved", "a second camera on the same station",
        "The camera turned in its mount at one moment. Everything it sees jumps between two "
        "epochs.",
    ),
    Entry(
        "mount-vibration", "the camera oscillates in its mount",
        _axes("mount.turn"), ("time",), ("periodic",), "camera",
        (1e-6, 1e-3), "vibration of the target", "a second camera on the same station",
        "Something shakes or heats the mount periodically. All targets swing in the image alike.",
    ),
    Entry(
        "bracket-growth", "the camera's bracket grows with temperature",
        _axes("mount.shift"), ("quantity",), _THERMAL, "camera",
        (2e-7, 2e-4), "motion of the structure", "near and far targets",
        "The bracket between station and camera expands and carries the camera with it. Near "
        "targets shift more than far ones.",
    ),
    Entry(
        "camera-displaced", "the camera was displaced",
        _axes("mount.shift"), ("time",), ("step",), "camera",
        (1e-5, 2e-2), "the structure moved", "a second camera on the same station",
        "The camera moved at one moment without turning. Near targets jump more than far ones.",
    ),
    Entry(
        "station-turn", "the station turns",
        _axes("station.turn"), ("quantity", "time"), ("linear", "lag", "step", "onset", "periodic"),
        "station", (5e-8, 5e-3), "refraction, motion of the targets", "an inclinometer",
        "The pillar or tripod under all cameras turns. Every camera of the station agrees.",
    ),
    Entry(
        "station-shift", "the station moves",
        _axes("station.shift"), ("quantity", "time"), ("linear", "lag", "step", "onset"),
        "station", (1e-7, 5e-2), "motion of the targets", "further reference targets",
        "The pillar or tripod under all cameras moves. Every camera of the station agrees, near "
        "targets most.",
    ),
    Entry(
        "focal-drift", "the focal length drifts with temperature",
        (_terms("sensor.focal"),), ("quantity",), _THERMAL, "camera",
        (5e-7, 1e-3), "growth of the target, shift along the axis", "targets at two ranges",
        "The principal distance changes as lens and body expand. All targets grow about the "
        "principal point, at every range.",
    ),
    Entry(
        "focal-warm-up", "the focal length settles after power-on",
        (_terms("sensor.focal"),), ("power-on", "time"), ("onset",), "camera",
        (1e-5, 1e-2), "ambient temperature", "switch off and on again",
        "The camera heats itself after power-on and its principal distance settles. It starts "
        "again with every power-on.",
    ),
    Entry(
        "principal-point-walk", "the principal point walks with temperature",
        _pair("sensor.cx", "sensor.cy"), ("quantity",), _THERMAL, "camera",
        (1e-3, 5e-1), "turn of the camera", "a wide field, a rolled camera, an inclinometer",
        "The sensor moves against the lens as the body warms. The whole image shifts, in a "
        "direction of the individual camera.",
    ),
    Entry(
        "self-heating", "the image shifts after power-on",
        _pair("sensor.cx", "sensor.cy"), ("power-on",), ("onset",), "camera",
        (2e-2, 5.0), "ambient temperature, creep", "switch off and on again",
        "The camera heats itself after power-on and the sensor moves. The shift settles "
        "exponentially and returns with every power-on.",
    ),
    Entry(
        "principal-point-jump", "the principal point jumps",
        _pair("sensor.cx", "sensor.cy"), ("time",), ("step",), "camera",
        (5e-2, 20.0), "slip of the mount", "a wide field, a rolled camera",
        "A lens group or the sensor jumped at one moment, as after a knock or a change of the "
        "image window. The whole image shifts.",
    ),
    Entry(
        "distortion-drift", "the distortion drifts with temperature",
        (_terms("lens.k1"),), ("quantity",), _THERMAL, "camera",
        (1e-6, 1e-3), "drift of the focal length", "targets out to the edge of the field",
        "The lens distorts differently when warm. The edge of the field moves more than in "
        "proportion.",
    ),
    Entry(
        "decentring-drift", "the decentring drifts with temperature",
        _pair("lens.p1", "lens.p2"), ("quantity",), _THERMAL, "camera",
        (1e-7, 1e-4), "turn and principal point together", "targets over the whole field",
        "A lens element moves sideways as the barrel warms. The image shifts with the square of "
        "the field angle.",
    ),
    Entry(
        "radial-beyond-model", "radial distortion beyond the lens model",
        ((Term("sensor.focal", "radius", "square"), Term("sensor.focal", "radius", "fourth"),
          Term("sensor.focal", "radius", "sixth")), _terms("lens.k1", "lens.k2", "lens.k3"),
         _terms("lens.k1"), _terms("lens.k2"), _terms("lens.k3")),
        ("constant",), ("constant",), "camera",
        (1e-6, 5e-1), "bow of the target", "roll the target in the image",
        "The lens model has too few radial terms for this lens. Rings of residuals about the "
        "axis stay fixed in the image.",
    ),
    Entry(
        "decentring", "decentring distortion beyond the lens model",
        _pair("lens.p1", "lens.p2"), ("constant",), ("constant",), "camera",
        (1e-6, 1e-2), "tilt of the sensor", "targets over the whole field",
        "The lens elements do not share one axis. The residuals are quadratic in the image and "
        "not symmetric.",
    ),
    Entry(
        "sensor-tilt", "the sensor is tilted against the lens",
        _pair("lens.tilt_x", "lens.tilt_y"), ("constant",), ("constant",), "camera",
        (1e-4, 5e-2), "decentring, turn of the camera", "a strongly distorting lens",
        "The sensor plane is not normal to the axis. Nearly all of it is absorbed by pose and "
        "principal point; what is left is small.",
    ),
    Entry(
        "entrance-pupil", "the rays do not meet in one point",
        (_terms("lens.entrance"),), ("constant",), ("constant",), "camera",
        (5e-5, 3e-2), "lens distortion", "near and far targets",
        "The entrance pupil of a wide lens moves with the field angle. Distortion then depends on "
        "the distance.",
    ),
    Entry(
        "aspect", "the pixels are not square",
        (_terms("sensor.aspect"),), ("constant",), ("constant",), "camera",
        (1e-6, 1e-2), "scales of the target", "roll the target or the camera by 90 degrees",
        "The scales along rows and columns differ. Digital sensors have square pixels unless the "
        "image was resampled.",
    ),
    Entry(
        "skew", "the pixel grid is skewed",
        (_terms("sensor.skew"),), ("constant",), ("constant",), "camera",
        (1e-6, 1e-2), "rolling shutter in steady motion", "a static scene",
        "The columns are not at right angles to the rows. Digital sensors have no skew unless the "
        "image was resampled.",
    ),
    Entry(
        "sensor-unflat", "the sensor is not flat",
        ((Term("sensor.focal", "image_x", "linear"), Term("sensor.focal", "image_y", "linear")),
         (Term("sensor.focal", "image_x", "square"), Term("sensor.focal", "image_y", "square"))),
        ("constant",), ("constant",), "camera",
        (1e-6, 1e-2), "decentring, higher distortion", "roll the camera",
        "The sensor surface deviates from a plane, so the local scale varies over the image. "
        "The pattern is fixed in the image.",
    ),
    Entry(
        "pixel-locking", "the detector locks to the pixel grid",
        ((Term("detect.u", "pixel_u", "sine", (1.0,)), Term("detect.v", "pixel_v", "sine", (1.0,))),
         (Term("detect.u", "pixel_u", "sine", (1.0,)),),
         (Term("detect.v", "pixel_v", "sine", (1.0,)),)),
        ("constant",), ("constant",), "camera",
        (2e-3, 3e-1), "noise", "slow motion over a few pixels, slight defocus",
        "The centre of a mark is drawn towards pixel centres or edges. The bias has a period of "
        "one pixel.",
    ),
    Entry(
        "mark-eccentricity", "ellipse centres are taken for mark centres",
        ((Term("detect.u", "incidence_u"), Term("detect.v", "incidence_v")),),
        ("constant",), ("constant",), "camera",
        (5e-3, 5.0), "displaced marks", "marks of two sizes",
        "The centre of a circle's image is not the image of its centre. The error points along "
        "the tilt of the target and grows with the square of the mark's size.",
    ),
    Entry(
        "range-index", "the rangefinder has an index error",
        (_terms("range.offset"),), ("constant",), ("constant",), "rangefinder",
        (5e-5, 1e-2), "scale of the rangefinder", "several distances",
        "The zero point of the rangefinder is off. All distances are wrong by the same amount.",
    ),
    Entry(
        "range-drift", "the rangefinder's index drifts with temperature",
        (_terms("range.offset"),), ("quantity",), _THERMAL, "rangefinder",
        (5e-6, 1e-3), "motion of the target", "a fixed baseline",
        "The electronics of the rangefinder warm up and its zero point moves. All distances drift "
        "alike.",
    ),
    Entry(
        "range-scale", "the rangefinder's scale is off",
        (_terms("range.scale"),), ("constant", "quantity"), ("constant", "linear"), "rangefinder",
        (1e-7, 1e-3), "refractive index of the air", "a known baseline, a weather log",
        "The frequency of the rangefinder or the index of the air is wrong. The error grows with "
        "distance.",
    ),
)  # fmt: skip
"""Named physics. `PHYSICS` numbers and sizes: see the sources in the documentation."""

BY_ID: dict[str, Entry] = {entry.id: entry for entry in CATALOGUE}


def entries_for(terms: tuple[Term, ...], driver_kind: str, form: str) -> tuple[Entry, ...]:
    """The entries that a combination of terms, kind of driver and form belongs to."""
    return tuple(
        entry
        for entry in CATALOGUE
        if terms in entry.groups and driver_kind in entry.drivers and form in entry.forms
    )
