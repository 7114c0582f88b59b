"""Named physics of the detection of marks in images."""

from jaxvm.physics.catalogue.entry import ALWAYS, Entry, alternatives, each, pair, plain
from jaxvm.physics.effects import Term

_SHIFT = pair("sensor.cx", "sensor.cy")


def _phase(basis: str, period: float):
    """A bias of both coordinates that is periodic in pixels, then of each alone."""
    return alternatives(*(Term(f"detect.{a}", f"pixel_{a}", basis, (period,)) for a in "uv"))


def _waves(*periods: float):
    """Biases of both coordinates with several harmonics."""
    return tuple(Term(f"detect.{a}", f"pixel_{a}", "sine", (p,)) for p in periods for a in "uv")


def _both_phases(period: float):
    """A bias of both coordinates with any phase."""
    bases = ("sine", "cosine")
    return tuple(Term(f"detect.{a}", f"pixel_{a}", b, (period,)) for b in bases for a in "uv")


DETECTION: tuple[Entry, ...] = (
    Entry(
        "pixel-locking", "the detector locks to the pixel grid", (66,),
        (*_phase("sine", 1.0), _waves(1.0, 0.5, 1.0 / 3.0)), ALWAYS, ALWAYS, "camera",
        (2e-3, 3e-1), "noise", "slow motion over a few pixels, slight defocus",
        "The centre of a mark is drawn towards pixel centres or edges. The bias has a period of "
        "one pixel.",
    ),
    Entry(
        "demosaicing", "the colour filter biases the detector", (75,),
        (*_phase("sine", 2.0), *_phase("cosine", 2.0), _both_phases(2.0)), ALWAYS, ALWAYS, "camera",
        (5e-3, 5e-1), "pixel locking", "one colour channel, a monochrome camera",
        "The colours were interpolated from every second pixel, or sharpening did the same. The "
        "bias of a mark's centre has a period of two pixels.",
    ),
    Entry(
        "light-bias", "the detector's bias follows the light", (67, 68, 69),
        _SHIFT, ("irradiance", "light"), ("linear", "lag", "lag with state"), "camera",
        (1e-6, 1e-2), "walk of the principal point", "switch a lamp at constant temperature",
        "Brightness, background and shadows move the measured centres of the marks. The shift "
        "follows the light, and not the temperature.",
    ),
    Entry(
        "side-light", "the light on a target biases its marks", (68,),
        _SHIFT, ("irradiance", "light"), ("linear", "lag", "lag with state", "turning"), "target",
        (1e-6, 1e-2), "motion of the target", "shade the target; a lamp from the other side",
        "The sunlit side of each mark is brighter and draws its measured centre. The shift grows "
        "with the light and wanders with the azimuth of the sun.",
    ),
    Entry(
        "blooming", "the marks bloom with the exposure", (69,),
        _SHIFT, ("exposure",), ("proportional", "linear"), "camera",
        (1e-5, 1.0), "heat of the sensor", "hold the exposure; darker marks",
        "Charge of overexposed marks leaks into neighbouring pixels, most often along the columns. "
        "The measured centres shift in proportion to the exposure.",
    ),
    Entry(
        "dark-current", "dark current draws the dim marks of a target", (70,),
        _SHIFT, ("temperature",), ("linear", "quadratic", "doubling"), "view",
        (1e-5, 1e-1), "motion of the target", "cool the sensor; brighter marks",
        "Dark current doubles with every few kelvin and draws the measured centres of dim marks. "
        "The marks of a badly lit target shift together as the sensor warms.",
    ),
    Entry(
        "dark-current-of-marks", "dark current draws each mark by its dimness", (70,),
        (each("mark", "sensor.cx", "sensor.cy"),), ("temperature",), ("doubling",), "view",
        (1e-4, 1.0), "displaced marks", "cool the sensor; brighter marks, all alike",
        "Dark current doubles with every few kelvin and draws the measured centres of dim marks. "
        "Marks that are not equally bright shift unequally, and faster and faster as it warms.",
    ),
    Entry(
        "mark-eccentricity", "ellipse centres are taken for mark centres", (65,),
        (plain("target.disc"),), ALWAYS, ALWAYS, "target",
        (1e-8, 1e-1), "scale of the target, marks that have a depth", "marks of two sizes",
        "The centre of a circle's image is not the image of its centre. The error points along the "
        "tilt of the target and grows with the square of the mark's size: the amplitude is the "
        "squared radius of the marks.",
    ),
)  # fmt: skip
"""Named physics of detection."""
