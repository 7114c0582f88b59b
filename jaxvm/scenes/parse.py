"""The text of a network's TOML into its description: what every key may be, and its default."""

import numpy as np

from jaxvm.physics.ports import PORTS
from jaxvm.recording.entries import Entry
from jaxvm.recording.errors import RecordingError, did_you_mean, in_file
from jaxvm.recording.model import LENSES
from jaxvm.recording.texts import parse_toml
from jaxvm.scenes.deform import MODES
from jaxvm.scenes.describe import (
    Cameras,
    Description,
    LinkNoise,
    Marks,
    Temperature,
    ThermalEffect,
)
from jaxvm.scenes.layouts import LAYOUTS

_ROOT = ("name", "layout", "stations", "held", "observe", "seed", "structure", "sights", "cameras",
         "marks", "time", "deformation", "temperature", "effects", "links", "noise")  # fmt: skip

_CAMERA_PORTS = tuple(p.name for p in PORTS if p.stage in ("mount", "lens", "sensor", "detection"))
"""Ports that a temperature of a camera may drive."""


def parse_description(text: str, file: str = "scene.toml") -> Description:
    """A network from the text of its TOML.

    Raises:
        RecordingError: something in it is wrong; names the file, the line and the mend.
    """
    table = parse_toml(text, file)
    try:
        return _description(Entry(table, text), file)
    except RecordingError as problem:
        raise in_file(problem, file) from None


def _description(root: Entry, file: str) -> Description:
    root.only(_ROOT)
    name = root.choice("layout", tuple(LAYOUTS))
    layout = LAYOUTS[name]
    stations = root.count("stations", layout.stations, layout.least)
    if name == "station" and stations != 1:
        root.fail("stations", 'layout "station" is one station; give cameras.count in its place')
    structure = _structure(root.entry("structure"), name)
    sights = root.entry("sights").only(("reach_m", "both_ways", "redundancy"))
    if "redundancy" in sights and name != "random":
        sights.fail(
            "redundancy",
            f'only layout "random" draws its lines; layout "{name}" has those that sights.reach_m '
            "allows",
        )
    if "both_ways" in sights and name in ("wind-tunnel", "station", "random"):
        sights.fail("both_ways", f'lines of layout "{name}" have one direction; drop both_ways')
    observe = root.choice("observe", ("pixels", "links", "both"), "pixels")
    if name == "station" and observe == "both":
        root.fail("observe", 'layout "station" has either "pixels" or "links"; choose one')
    time = root.entry("time").only(("epochs", "interval_s"))
    epochs = time.count("epochs", 1)
    interval = time.positive("interval_s", 600.0)
    if observe == "links" and epochs > 1:
        time.fail("epochs", 'links alone have one epoch; set observe = "both" or epochs = 1')
    deformation, period = _deformation(root, epochs, interval, name)
    temperature = _temperature(root, observe)
    return Description(
        source=root,
        file=file,
        name=root.string("name", name),
        layout=name,
        stations=stations,
        held=tuple(root.names("held") or ()),
        observe=observe,
        seed=root.count("seed", 0, 0),
        structure=structure,
        reach_m=sights.positive("reach_m", 1.0) if "reach_m" in sights else None,
        both_ways=_flag(sights, "both_ways", layout.both_ways),
        redundancy=sights.positive("redundancy", 3.0),
        cameras=_cameras(root, name),
        marks=_marks(root.entry("marks"), layout.marks_m),
        epochs=epochs,
        interval_s=interval,
        deformation=deformation,
        period_s=period,
        temperature=temperature,
        effects=tuple(_effect(entry, temperature) for entry in root.listed("effects")),
        links=_links(root.entry("links")),
        pixel_px=root.entry("noise").only(("pixel_px",)).positive("pixel_px", 0.05),
    )


def _structure(entry: Entry, layout: str) -> dict[str, float]:
    sizes = LAYOUTS[layout].size
    for key in entry.table:
        if key not in sizes:
            entry.fail(
                key, f'unknown key "{key}" for layout "{layout}"; {did_you_mean(key, sizes)}'
            )
    return {
        key: entry.count(key, size) if isinstance(size, int) else entry.positive(key, size)
        for key, size in sizes.items()
    }


def _cameras(root: Entry, layout: str) -> Cameras:
    entry = root.entry("cameras").only(
        ("each", "count", "focal_px", "image_size", "lens", "distortion", "margin_px", "pose")
    )
    each = entry.choice("each", ("sight", "sector"), "sight")
    if "count" in entry and each == "sight" and layout != "station":
        entry.fail(
            "count",
            "a camera for each sight line has no number of its own; drop count or set "
            'each = "sector"',
        )
    sectors = each == "sector" and layout != "station"
    count = entry.count("count", 4 if sectors else 6, 2 if layout == "station" else 1)
    size = entry.vector("image_size", 2)
    size = np.array([2448.0, 2048.0]) if size is None else size
    if not (size == np.round(size)).all() or not (size >= 64).all():
        entry.fail("image_size", f"{entry.title('image_size')} must be two whole numbers from 64")
    if sectors and count < 3 and "focal_px" not in entry:
        entry.fail(
            "count",
            f"{count} cameras with a plane image can't look all around; give count = 4, or "
            "focal_px for less",
        )
    # Half the angle of a sector, a tenth wider.
    wide = 0.5 * size[0] / np.tan(1.1 * np.pi / max(count, 3))
    focal = entry.positive("focal_px", float(wide) if sectors else LAYOUTS[layout].focal_px)
    lens = entry.choice("lens", tuple(LENSES), "pinhole")
    distortion = entry.vector("distortion", LENSES[lens])
    margin = entry.number("margin_px", 20.0) or 0.0
    if not 0.0 <= margin < 0.5 * size.min():
        entry.fail("margin_px", f"{entry.title('margin_px')} is {margin:g}; give 0 or some pixels")
    return Cameras(
        each=each,
        count=count,
        focal_px=focal,
        image_size=(int(size[0]), int(size[1])),
        lens=lens,
        distortion=np.zeros(LENSES[lens]) if distortion is None else distortion,
        margin_px=margin,
        free=entry.choice("pose", ("known", "free"), "known") == "free",
    )


def _marks(entry: Entry, size: float) -> Marks:
    entry.only(("kind", "count", "size_m", "tilt_deg", "incidence_deg"))
    kind = entry.choice("kind", ("body", "plate", "plates"), "body")
    for key in ("tilt_deg", "incidence_deg"):
        if kind == "body" and key in entry:
            entry.fail(key, f'a body is seen from all sides; drop {key} or set kind = "plate"')
    tilt = entry.number("tilt_deg", 0.0) or 0.0
    incidence = entry.positive("incidence_deg", 65.0)
    if not abs(tilt) < incidence < 90.0:
        entry.fail(
            "tilt_deg" if "tilt_deg" in entry else "incidence_deg",
            f"plates turned by {tilt:g} degrees that are found up to {incidence:g}: "
            "tilt_deg must be below incidence_deg, and that below 90",
        )
    body = kind == "body"
    return Marks(
        kind,
        # Fewer marks than six leave a pose with two solutions.
        entry.count("count", 16 if body else 4, 6 if body else 3),
        entry.positive("size_m", size),
        float(np.radians(tilt)),
        float(np.radians(incidence)),
    )


def _deformation(root: Entry, epochs: int, interval: float, layout: str):
    entry = root.entry("deformation").only((*MODES, "period_s"))
    found = {key: entry.number(key, 0.0) or 0.0 for key in MODES}
    found = {key: size for key, size in found.items() if size != 0.0}
    # Longer than the recording: over two or four epochs of a whole period a sine may vanish.
    period = entry.positive("period_s", 1.6 * epochs * interval)
    if "deformation" not in root:
        return {}, period
    if not found:
        entry.fail(None, f"nothing moves; give {', '.join(MODES)} or drop [deformation]")
    if epochs < 2:
        entry.fail(None, "one epoch shows no deformation; give time.epochs = 2 or more")
    if layout == "station":
        entry.fail(None, 'the station of layout "station" does not deform; drop [deformation]')
    return found, period


def _temperature(root: Entry, observe: str) -> Temperature | None:
    entry = root.entry("temperature").only(
        ("mean_degC", "swing_K", "rise_K", "body_lag_s", "bodies", "every_s", "noise_K")
    )
    for key in ("temperature", "effects"):
        if key in root and observe == "links":
            root.fail(key, f'links have no cameras; drop {key} or set observe = "both"')
    if "temperature" not in root:
        return None
    numbers = {}
    for key, default in (("mean_degC", 15.0), ("swing_K", 8.0), ("rise_K", 12.0)):
        numbers[key] = entry.number(key, default)
    noise = entry.number("noise_K", 0.01) or 0.0
    if noise < 0.0:
        entry.fail("noise_K", f"noise_K is {noise:g}; give 0 or a standard deviation in K")
    # Readings in degrees Celsius outside these limits are taken for mistakes when read.
    if abs(numbers["mean_degC"]) + abs(numbers["swing_K"]) + abs(numbers["rise_K"]) > 75.0:
        entry.fail(
            None, "temperatures beyond -75 and +75 degrees Celsius; give smaller mean, swing, rise"
        )
    return Temperature(
        **numbers,
        body_lag_s=entry.positive("body_lag_s", 2400.0),
        bodies=_flag(entry, "bodies", True),
        every_s=entry.positive("every_s", 300.0),
        noise_K=noise,
    )


def _effect(entry: Entry, temperature: Temperature | None) -> ThermalEffect:
    entry.only(("port", "per_K", "driver", "lag_s", "model", "camera"))
    if temperature is None:
        entry.fail(None, f"{entry.title()} follows a temperature; add a table [temperature]")
    entry.needs("per_K", "30e-6")
    driver = entry.choice("driver", ("body", "ambient"), "body")
    if driver == "body" and not temperature.bodies:
        entry.fail(
            "driver" if "driver" in entry else None,
            f'{entry.title()} follows the bodies, which are not logged; set driver = "ambient" or '
            "temperature.bodies = true",
        )
    lag = entry.number("lag_s", 0.0) or 0.0
    if lag < 0.0:
        entry.fail("lag_s", f"{entry.title('lag_s')} is {lag:g}; give 0 or a time constant in s")
    return ThermalEffect(
        port=entry.choice("port", _CAMERA_PORTS),
        per_K=entry.number("per_K") or 0.0,
        driver=driver,
        lag_s=lag,
        model=entry.choice("model", ("known", "free", "hidden"), "hidden"),
        camera=tuple(entry.names("camera") or ()),
        entry=entry,
    )


def _links(entry: Entry) -> LinkNoise:
    entry.only(("sigma_rad", "sigma_m", "turn_factor", "depth_factor"))
    return LinkNoise(
        entry.positive("sigma_rad", 5e-5),
        entry.positive("sigma_m", 2e-4),
        entry.positive("turn_factor", 1.0),
        entry.positive("depth_factor", 1.0),
    )


def _flag(entry: Entry, key: str, default: bool) -> bool:
    value = entry.table.get(key, default)
    if not isinstance(value, bool):
        entry.fail(key, f"{entry.title(key)} is {value!r}; write true or false")
    return value
