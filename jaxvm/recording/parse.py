"""recording.toml becomes a model: every key checked, every default of the format resolved."""

from collections import Counter
from dataclasses import replace
from typing import Any, cast

import numpy as np

from jaxvm.geometry.targets import grid_points
from jaxvm.physics.drivers import OBSERVATION_DRIVERS, PLANE_BASES, PLANES
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.forms import BASES, FORMS
from jaxvm.physics.ports import PORT_INDEX
from jaxvm.recording.entries import Entry
from jaxvm.recording.errors import has_not
from jaxvm.recording.model import (
    FORMAT,
    LENSES,
    Camera,
    Closure,
    Model,
    Motion,
    Prior,
    Rangefinder,
    Station,
    Target,
    grid_names,
)

_TABLES = (
    "format",
    "name",
    "noise",
    "cameras",
    "stations",
    "targets",
    "rangefinders",
    "drivers",
    "world",
    "priors",
    "closures",
    "effects",
)
_CAMERA = (
    "station",
    "image_size",
    "lens",
    "focal_px",
    "centre_px",
    "distortion",
    "pose",
    "free",
    "powered_on_s",
)
_INTRINSICS = ("focal", "centre", "distortion")
_MOTIONS = ("static", "per-epoch")


def parse_model(table: dict[str, Any], text: str = "") -> Model:
    """The engineer's model of a parsed recording.toml.

    Args:
        table: what tomllib makes of the file.
        text: the file itself, from which errors take their line.

    Raises:
        RecordingError: something is missing, unknown or impossible; names the line and the mend.
    """
    root = Entry(table, text).only(_TABLES)
    if root.needs("format", str(FORMAT)) != FORMAT:
        root.fail(
            "format",
            f"format is {table['format']!r}, but this version reads format {FORMAT}; "
            f"set format = {FORMAT} or use a version of jaxvm for that format",
        )
    noise = root.entry("noise").only(("pixel_px", "range_m"))
    cameras = _cameras(root)
    finders = _rangefinders(root)
    targets = tuple(_target(name, entry) for name, entry in root.entries("targets").items())
    carriers = [body.station for body in (*cameras, *finders, *targets) if body.station]
    stations = _stations(root, carriers)
    # Without cameras it is a network of stations that links alone join.
    for kind, bodies in (("cameras", cameras), ("targets", targets)):
        if not bodies and (cameras or not stations):
            root.fail(None, f"there are no {kind}; add a table [{kind}.NAME]")
    up = root.entry("world").only(("up",)).vector("up", 3)
    if up is not None and not np.linalg.norm(up) > 0.0:
        root.entry("world").fail("up", "world.up has length 0; give a direction, [0.0, 0.0, 1.0]")
    model = Model(
        name=root.string("name", ""),
        cameras=cameras,
        stations=stations,
        targets=targets,
        rangefinders=finders,
        drivers={
            name: entry.only(("description",)).string("description", "")
            for name, entry in root.entries("drivers").items()
        },
        up=(0.0, 0.0, 1.0) if up is None else cast(Any, tuple((up / np.linalg.norm(up)).tolist())),
        pixel_sigma=noise.positive("pixel_px", 1.0),
        range_sigma=noise.positive("range_m", 0.001),
        closures=tuple(_closure(entry) for entry in root.listed("closures")),
    )
    _forbid_one_place(root, model)
    priors = tuple(_prior(entry, model) for entry in root.listed("priors"))
    effects = _effects(root, model)
    return replace(model, priors=priors, effects=effects)


def _cameras(root: Entry) -> tuple[Camera, ...]:
    entries = root.entries("cameras")
    station = {name: entry.string("station", name) for name, entry in entries.items()}
    pose = {name: entry.pose() for name, entry in entries.items()}
    crew = Counter(station.values())
    posed = {station[name] for name, value in pose.items() if value is not None}
    cameras, leading = [], set()
    for name, entry in entries.items():
        own = station[name]
        leads = own not in posed and own not in leading
        leading.add(own)
        cameras.append(_camera(name, entry, own, pose[name], crew[own] == 1 or leads))
    return tuple(cameras)


def _camera(name: str, entry: Entry, station: str, pose, carries_frame: bool) -> Camera:
    """`carries_frame`: without a pose of its own it is where its station is."""
    entry.only(_CAMERA)
    entry.needs("image_size", "[2448, 2048]")
    size = entry.vector("image_size", 2)
    assert size is not None
    if not (size == np.round(size)).all() or not (size >= 1).all():
        entry.fail("image_size", f"{entry.title('image_size')} must be two whole numbers from 1")
    lens = entry.choice("lens", tuple(LENSES))
    focal = _focal(entry)
    free = entry.free((*_INTRINSICS, "pose", "aspect-locked-focal"))
    if free is None:
        free = frozenset(_INTRINSICS if focal is None else ())
        if pose is None and not carries_frame:
            free |= {"pose"}
    if {"focal", "aspect-locked-focal"} <= free:
        entry.fail("free", f'{entry.title("free")} has "focal" and "aspect-locked-focal"; keep one')
    if pose is None and "pose" not in free:
        if not carries_frame:
            entry.fail(
                "free" if "free" in entry else None,
                f'camera "{name}" has no pose, and "pose" is not free, but station "{station}" '
                'carries other cameras; give its pose or add "pose" to free',
            )
        pose = np.zeros(6)
    distortion = _coefficients(entry, "distortion", lens)
    return Camera(
        name=name,
        station=station,
        image_size=(int(size[0]), int(size[1])),
        lens=lens,
        focal_px=focal,
        centre_px=entry.vector("centre_px", 2),
        distortion=distortion,
        pose=pose,
        free=free,
        powered_on_s=entry.moments("powered_on_s"),
    )


def _focal(entry: Entry) -> np.ndarray | None:
    focal = entry.vector("focal_px", 2)
    if focal is not None and not (focal > 0.0).all():
        entry.fail("focal_px", f"{entry.title('focal_px')} must be two numbers above 0")
    if focal is not None and (focal < 50.0).any():
        entry.fail(
            "focal_px",
            f"{entry.title('focal_px')} is {focal.min():g}, which looks like millimetres; "
            "give pixels: focal length divided by the size of a pixel",
        )
    return focal


def _coefficients(entry: Entry, key: str, lens: str) -> np.ndarray | None:
    value = entry.table.get(key)
    if isinstance(value, list) and len(value) != LENSES[lens]:
        fitting = [name for name, n in LENSES.items() if n == len(value)]
        other = f' or take lens = "{fitting[0]}"' if fitting else ""
        entry.fail(
            key,
            f'{entry.title(key)} has {len(value)} coefficients, but lens "{lens}" has '
            f"{LENSES[lens]}; give {LENSES[lens]}{other}",
        )
    return entry.vector(key, LENSES[lens])


def _stations(root: Entry, used: list[str]) -> tuple[Station, ...]:
    entries = root.entries("stations")
    names = list(dict.fromkeys([*used, *entries]))
    stations = []
    for name in names:
        if name not in entries:
            stations.append(Station(name, "static", np.zeros(6), frozenset()))
            continue
        entry = entries[name].only(("motion", "pose", "free"))
        motion = _motion(entry, "static")
        pose, free = entry.pose(motion == "per-epoch"), entry.free(("pose",))
        if free is None:
            free = frozenset(() if pose is not None or len(names) == 1 else ("pose",))
        if pose is None and not free:
            pose = np.zeros(6)
        stations.append(Station(name, motion, pose, free))
    return tuple(stations)


def _forbid_one_place(root: Entry, model: Model) -> None:
    """Stations that nobody listed are all at the identity: cameras on them would coincide."""
    listed = root.entries("stations")
    first: Camera | None = None
    for camera in model.cameras:
        given = "pose" in root.entry("cameras").entry(camera.name) or "pose" in camera.free
        if camera.station in listed or given:
            continue
        if first is None:
            first = camera
        elif first.station != camera.station:
            root.entry("cameras").fail(
                camera.name,
                f'cameras "{first.name}" and "{camera.name}" would both be held at the origin; '
                f'put them on one station or add [stations.{camera.station}] with free = ["pose"]',
            )


def _motion(entry: Entry, default: str | None = None) -> Motion:
    return cast(Motion, entry.choice("motion", _MOTIONS, default))


def _target(name: str, entry: Entry) -> Target:
    entry.only(("grid", "points", "station", "motion", "pose", "free"))
    names, points = _marks(entry)
    station = entry.string("station", "")
    motion = _motion(entry, "static" if station else None)
    pose, free = entry.pose(motion == "per-epoch"), entry.free(("pose", "points"))
    if free is None:
        free = frozenset(("pose",) if pose is None else ())
    if not np.isfinite(points).all():
        free |= {"points"}
    if pose is None and "pose" not in free:
        pose = np.zeros(6)
    return Target(name, names, points, motion, pose, free, station)


def _marks(entry: Entry) -> tuple[tuple[str, ...], np.ndarray]:
    if ("grid" in entry) == ("points" in entry):
        entry.fail(
            None,
            f"{entry.title()} needs either grid = {{rows, columns, spacing_m}} or points = "
            "{a = [x, y, z], ...}; give one of them",
        )
    if "grid" in entry:
        grid = entry.entry("grid").only(("rows", "columns", "spacing_m"))
        spacing = grid.positive("spacing_m")
        if spacing > 20.0:
            grid.fail(
                "spacing_m",
                f"{grid.title('spacing_m')} is {spacing:g} m, which looks like millimetres; "
                "give metres",
            )
        rows, columns = grid.count("rows"), grid.count("columns")
        return grid_names(rows, columns), grid_points(rows, columns, spacing)
    if isinstance(entry.table["points"], list):
        names = entry.names("points") or []
        points = np.full((len(names), 3), np.nan)
    else:
        below = entry.entry("points")
        names = list(below.table)
        points = np.array([below.vector(name, 3) for name in names])
    repeated = [name for name, n in Counter(names).items() if n > 1]
    if not names or repeated:
        what = f'the point "{repeated[0]}" twice' if repeated else "no point"
        entry.fail("points", f"{entry.title('points')} has {what}; each mark needs one name")
    return tuple(names), points


def _rangefinders(root: Entry) -> tuple[Rangefinder, ...]:
    finders = []
    for name, entry in root.entries("rangefinders").items():
        entry.only(("station", "pose", "free"))
        entry.needs("pose", "{turn_rad = [0, 0, 0], shift_m = [0, 0, 0]}")
        pose = entry.pose()
        assert pose is not None
        free = entry.free(("pose",)) or frozenset()
        finders.append(Rangefinder(name, entry.string("station", name), pose, free))
    return tuple(finders)


def _prior(entry: Entry, model: Model) -> Prior:
    entry.only(("parameter", "value", "sigma"))
    entry.needs("parameter", '"cameras.NAME.focal"')
    parameter = entry.string("parameter", "")
    parts = parameter.split(".")
    bodies = {
        "cameras": (model.cameras, (*_INTRINSICS, "pose")),
        "stations": (model.stations, ("pose",)),
        "targets": (model.targets, ("pose",)),
        "rangefinders": (model.rangefinders, ("pose",)),
    }
    if len(parts) != 3 or parts[0] not in bodies or parts[2] not in bodies[parts[0]][1]:
        entry.fail(
            "parameter",
            f'a prior on "{parameter}" is not possible; use cameras.NAME.focal, centre, distortion '
            "or pose, stations.NAME.pose, targets.NAME.pose or rangefinders.NAME.pose",
        )
    kind, name, quantity = parts
    named = {body.name: body for body in bodies[kind][0]}
    if name not in named:
        entry.fail("parameter", f'there is no "{name}" in [{kind}] {has_not(name, named)}')
    width = {"focal": 2, "centre": 2, "pose": 6}.get(quantity, 0)
    body = named[name]
    if isinstance(body, Camera) and quantity == "distortion":
        width = LENSES[body.lens]
    for key in ("value", "sigma"):
        entry.needs(key, f"a list of {width} numbers")
    value, sigma = entry.vector("value", width), entry.vector("sigma", width)
    assert value is not None and sigma is not None
    if not (sigma > 0.0).all():
        entry.fail("sigma", f"{entry.title('sigma')} must be {width} numbers above 0")
    return Prior(parameter, value, sigma)


def _closure(entry: Entry) -> Closure:
    entry.only(("links", "sigma_rad", "sigma_m"))
    entry.needs("links", '["ab", "bc", "-ca"]')
    names = entry.names("links")
    if not names:
        entry.fail("links", f"{entry.title('links')} is empty; name the links of the loop")
    links = tuple((n[1:], -1) if n.startswith("-") else (n, 1) for n in names)
    return Closure(links, entry.positive("sigma_rad", 1e-9), entry.positive("sigma_m", 1e-9))


def _effects(root: Entry, model: Model) -> tuple[Effect, ...]:
    known: dict[str, int] = {}
    found = []
    for entry in root.listed("effects"):
        effect = _effect(entry, model)
        if effect.shares and known.get(effect.shares) != len(effect.constants):
            entry.fail(
                "shares",
                f'{entry.title("shares")} is "{effect.shares}"; no effect before it has that name '
                "and as many constants",
            )
        known.setdefault(effect.name, len(effect.constants))
        found.append(effect)
    return tuple(found)


def _effect(entry: Entry, model: Model) -> Effect:
    keys = ("name", "catalogue_id", "driver", "form", "constants", "reference", "scope", "terms",
            "amplitudes", "spread", "shares")  # fmt: skip
    entry.only(keys)
    for key, example in (("terms", '[{port = "target.bow_x"}]'), ("amplitudes", "[0.001]")):
        entry.needs(key, example)
    form = entry.choice("form", tuple(FORMS), "constant")
    terms = tuple(_term(term) for term in entry.listed("terms"))
    constants = entry.vector("constants", len(FORMS[form].constants))
    if constants is None and FORMS[form].constants:
        names = ", ".join(c.name for c in FORMS[form].constants)
        entry.fail(None, f'{entry.title()} has form "{form}" but no constants; give {names}')
    amplitudes = entry.vector("amplitudes", len(terms) * len(FORMS[form].bases))
    assert amplitudes is not None
    return Effect(
        name=entry.string("name", "effect"),
        terms=terms,
        driver=entry.string("driver", "constant"),
        form=form,
        constants=() if constants is None else tuple(constants.tolist()),
        reference=entry.number("reference", 0.0) or 0.0,
        scope=_scope(entry.entry("scope"), model),
        amplitudes=tuple(amplitudes.tolist()),
        catalogue_id=entry.string("catalogue_id", ""),
        spread=entry.number("spread", 0.0) or 0.0,
        shares=entry.string("shares", ""),
    )


def _term(entry: Entry) -> Term:
    entry.only(("port", "driver", "basis", "constants", "weight"))
    constants = entry.table.get("constants", [])
    width = len(constants) if isinstance(constants, list) else 0
    vector = entry.vector("constants", min(width, 2))
    driver = entry.choice("driver", (*OBSERVATION_DRIVERS, *PLANES), "one")
    return Term(
        port=entry.choice("port", tuple(PORT_INDEX)),
        driver=driver,
        basis=entry.choice("basis", PLANE_BASES if driver in PLANES else tuple(BASES), "one"),
        constants=() if vector is None else tuple(vector.tolist()),
        weight=entry.number("weight", 1.0) or 0.0,
    )


def _scope(entry: Entry, model: Model) -> Scope:
    marks = [name for target in model.targets for name in target.point_names]
    known = {
        "camera": [c.name for c in model.cameras],
        "station": [s.name for s in model.stations],
        "target": [t.name for t in model.targets],
        "point": marks,
        "rangefinder": [r.name for r in model.rangefinders],
    }
    entry.only(tuple(known))
    chosen = {}
    for kind, names in known.items():
        chosen[kind] = tuple(entry.names(kind) or ())
        for name in chosen[kind]:
            if name not in names:
                entry.fail(
                    kind, f'{entry.title(kind)}: there is no {kind} "{name}" {has_not(name, names)}'
                )
    return Scope(**chosen)


def known_link(entry_text: str, model: Model, names: list[str]) -> None:
    """Check that closures speak of links that links.csv has.

    Raises:
        RecordingError: a closure names another link, or one that was measured several times.
    """
    times = Counter(names)
    for i, closure in enumerate(model.closures):
        entry = Entry({}, entry_text, ("closures", i))
        for name, _ in closure.links:
            if times[name] == 0:
                entry.fail(
                    "links",
                    f'link "{name}" of a closure is not in the links {has_not(name, times)}',
                )
            if times[name] > 1:
                entry.fail(
                    "links",
                    f'link "{name}" of a closure stands {times[name]} times in the links; '
                    "give each measurement a name of its own",
                )
