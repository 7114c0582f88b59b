"""Named physics of rangefinders."""

from jaxvm.physics.catalogue.entry import ALWAYS, THERMAL, Entry, pair, plain
from jaxvm.physics.effects import Term

_INDEX, _SCALE = (plain("range.offset"),), (plain("range.scale"),)

UNITS_M = tuple(1.0 / (0.05 + 0.1 * k) for k in range(100))
"""Half wavelengths of the modulation (m) that a cyclic error is looked for with, 20 m to 0.1 m.

Over a metre of distances neighbours differ by a tenth of a cycle.
"""

RANGE: tuple[Entry, ...] = (
    Entry(
        "range-index", "the rangefinder has an index error", (86, 91),
        _INDEX, ALWAYS, ALWAYS, "rangefinder",
        (5e-5, 1e-2), "scale of the rangefinder", "several distances, another surface",
        "The zero point of the rangefinder is off, or its light enters the surface it measures. "
        "All distances are wrong by the same amount.",
    ),
    Entry(
        "range-penetration", "the beam enters the surface", (91,),
        ((Term("range.offset"), Term("range.offset", "incidence", "square")),),
        ALWAYS, ALWAYS, "rangefinder",
        (5e-5, 1e-2), "index error", "tilt the surface; an opaque one",
        "The light turns back within a foil, a foam or a plastic. Its way there is longer the more "
        "aslant it enters, on top of a part that is always the same.",
    ),
    Entry(
        "range-drift", "the rangefinder's index drifts with temperature", (87,),
        _INDEX, ("temperature",), THERMAL, "rangefinder",
        (5e-6, 1e-3), "motion of the target", "a fixed baseline",
        "The electronics of the rangefinder warm up and its zero point moves. All distances drift "
        "alike.",
    ),
    Entry(
        "range-warm-up", "the rangefinder's index settles", (87,),
        _INDEX, ("time",), ("linear", "onset", "creep"), "rangefinder",
        (1e-8, 1e-2), "motion of the target", "a fixed baseline, switch off and on again",
        "The rangefinder heats itself and its zero point settles. All distances drift alike, ever "
        "more slowly.",
    ),
    Entry(
        "range-jump", "the rangefinder's index jumps", (86, 91),
        _INDEX, ("time",), ("step",), "rangefinder",
        (1e-4, 2e-2), "motion of the target", "a fixed baseline",
        "The surface, the prism constant or the set-up of the rangefinder changed at one moment. "
        "All distances jump alike.",
    ),
    Entry(
        "range-scale", "the rangefinder's scale is off", (88,),
        _SCALE, ("constant", "quantity"), ("constant", "linear"), "rangefinder",
        (1e-7, 1e-3), "refractive index of the air", "a known baseline, a weather log",
        "The frequency of the rangefinder or the index of the air is wrong. The error grows with "
        "distance.",
    ),
    Entry(
        "range-air", "the air changes the scale of the distances", (19,),
        _SCALE, ("temperature", "pressure", "humidity"), ("linear",), "rangefinder",
        (5e-9, 3e-6), "frequency of the rangefinder", "a known baseline, a weather log",
        "Light is slower in cold and dense air, about 1 ppm per kelvin and 0.3 ppm per hPa. A "
        "distance that is not corrected for the weather follows it in proportion.",
    ),
    Entry(
        "range-cyclic", "the rangefinder has a cyclic error", (89,),
        tuple(tuple(Term("range.offset", "range", basis, (unit,)) for basis in ("sine", "cosine"))
              for unit in UNITS_M),
        ALWAYS, ALWAYS, "rangefinder",
        (5e-5, 5e-3), "noise of the rangefinder", "many distances over one modulation length",
        "Light or signal that leaks inside the rangefinder disturbs the phase that it measures. "
        "The error repeats with every half wavelength of the modulation.",
    ),
    Entry(
        "range-beam", "the beam does not meet where it is believed to", (90,),
        ((Term("range.offset", "incidence", "linear"),), *pair("mount.turn_x", "mount.turn_y")),
        ALWAYS, ALWAYS, "rangefinder",
        (5e-5, 2e-2), "index error", "tilt the plate",
        "The beam leaves the rangefinder beside its calibrated place or at another angle. On a "
        "tilted surface this lengthens or shortens the distance.",
    ),
)  # fmt: skip
"""Named physics of rangefinders."""
