"""The engineer's model: which bodies there are, what is known of them and what is free.

All defaults of recording.toml are resolved here: a body that is held has a pose, and `free` says
everything that the adjustment estimates.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from jaxvm.geometry.lenses import LENS_NAMES, lens_family
from jaxvm.geometry.targets import grid_points
from jaxvm.physics.effects import Effect
from jaxvm.recording.errors import listed

FORMAT = 1

LENSES = {name: lens_family(name).n_coefficients for name in LENS_NAMES}
"""Number of distortion coefficients of each lens."""

Motion = Literal["static", "per-epoch"]

Pose = Float[np.ndarray, "6"]
"""Turn (rotation vector, rad), then shift (m): X_outer = exp(turn) @ X_inner + shift."""

Poses = Float[np.ndarray, "*epochs 6"]
"""A pose, or one in each epoch of what moves."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera on a station.

    Attributes:
        image_size: width and height (px).
        lens: a key of `LENSES`.
        focal_px, centre_px, distortion: known values or start values; None: start from the data.
        pose: station_from_camera; None: start from the data.
        free: subset of focal, aspect-locked-focal, centre, distortion, pose.
        powered_on_s: moments of power-on, on the clock of the epochs (s).
    """

    name: str
    station: str
    image_size: tuple[int, int]
    lens: str
    focal_px: Float[np.ndarray, "2"] | None = None
    centre_px: Float[np.ndarray, "2"] | None = None
    distortion: Float[np.ndarray, " n"] | None = None
    pose: Pose | None = None
    free: frozenset[str] = frozenset()
    powered_on_s: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Station:
    """What carries cameras and rangefinders; `pose` is world_from_station."""

    name: str
    motion: Motion = "static"
    pose: Poses | None = None
    free: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Target:
    """A rigid body with marks.

    Attributes:
        point_names: names of the marks.
        points: target coordinates of the marks (m); NaN where unknown.
        pose: in the world, or in the station that carries it; None: start from the data.
        free: subset of pose, points.
        station: that carries it; "" for a target that stands in the world.
    """

    name: str
    point_names: tuple[str, ...]
    points: Float[np.ndarray, "n 3"]
    motion: Motion = "static"
    pose: Poses | None = None
    free: frozenset[str] = frozenset()
    station: str = ""


@dataclass(frozen=True, eq=False)
class Rangefinder:
    """Measures along its own z axis from its origin; `pose` is station_from_rangefinder."""

    name: str
    station: str
    pose: Pose
    free: frozenset[str] = frozenset()


@dataclass(frozen=True, eq=False)
class Prior:
    """A value of a parameter that is known beforehand, with its standard deviation."""

    parameter: str
    value: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Closure:
    """A loop of links, as (name, +1 or -1 for the inverse), whose product is the identity."""

    links: tuple[tuple[str, int], ...]
    sigma_rad: float
    sigma_m: float


@dataclass(frozen=True, eq=False)
class Model:
    """Content of recording.toml with all defaults resolved.

    Attributes:
        drivers: description of each described channel of the drivers.
        up: direction against gravity in the world (unit vector).
        pixel_sigma: standard deviation of a pixel coordinate (px) where a row has none.
        range_sigma: standard deviation of a range (m) where a row has none.
        effects: physics that is in the model beyond the plain chain.
    """

    name: str
    cameras: tuple[Camera, ...]
    stations: tuple[Station, ...]
    targets: tuple[Target, ...]
    rangefinders: tuple[Rangefinder, ...] = ()
    drivers: dict[str, str] = field(default_factory=dict)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    pixel_sigma: float = 1.0
    range_sigma: float = 0.001
    priors: tuple[Prior, ...] = ()
    closures: tuple[Closure, ...] = ()
    effects: tuple[Effect, ...] = ()


def other_bodies(own: Model, other: Model, kinds: tuple[str, ...]) -> str:
    """Which bodies of some kinds another model has, in words; "" where measurements fit both.

    Measurements know bodies and marks by their order.
    """
    for kind in kinds:
        ours, theirs = ([body.name for body in getattr(m, kind)] for m in (own, other))
        if ours != theirs:
            return f"its {kind} are {listed(theirs) or 'none'}, not {listed(ours) or 'none'}"
    for a, b in zip(own.targets, other.targets, strict=True):
        if a.point_names != b.point_names:
            return f'its target "{a.name}" has other points'
    return ""


def of_epochs(model: Model, mask: Bool[np.ndarray, " epochs"]) -> Model:
    """The model of some epochs: bodies whose poses are given in each epoch keep those of them."""

    def kept(body):
        pose = body.pose
        return body if pose is None or pose.ndim == 1 else replace(body, pose=pose[mask])

    return replace(
        model,
        stations=tuple(kept(station) for station in model.stations),
        targets=tuple(kept(target) for target in model.targets),
    )


def grid_names(rows: int, columns: int) -> tuple[str, ...]:
    """Names "row/column" of the marks of a grid, row by row."""
    return tuple(f"{r}/{c}" for r in range(rows) for c in range(columns))


def model_to_toml(model: Model) -> dict[str, Any]:
    """Content of recording.toml for a model; `parse_model` gives the same model back.

    Raises:
        ValueError: a target with coordinates for some of its points only: the format has none.
    """
    table: dict[str, Any] = {"format": FORMAT}
    if model.name:
        table["name"] = model.name
    table["noise"] = {"pixel_px": float(model.pixel_sigma), "range_m": float(model.range_sigma)}
    table["cameras"] = {camera.name: camera_table(camera) for camera in model.cameras}
    table["stations"] = {
        station.name: {"motion": station.motion, **_held(station.pose, station.free)}
        for station in model.stations
    }
    table["targets"] = {
        target.name: {
            **_marks(target),
            **({"station": target.station} if target.station else {}),
            "motion": target.motion,
            **_held(target.pose, target.free),
        }
        for target in model.targets
    }
    if model.rangefinders:
        table["rangefinders"] = {
            finder.name: {"station": finder.station, **_held(finder.pose, finder.free)}
            for finder in model.rangefinders
        }
    if model.drivers:
        table["drivers"] = {name: {"description": text} for name, text in model.drivers.items()}
    table["world"] = {"up": [float(x) for x in model.up]}
    if model.priors:
        table["priors"] = [
            {"parameter": p.parameter, "value": _floats(p.value), "sigma": _floats(p.sigma)}
            for p in model.priors
        ]
    if model.closures:
        table["closures"] = [
            {
                "links": [name if sign > 0 else f"-{name}" for name, sign in closure.links],
                "sigma_rad": float(closure.sigma_rad),
                "sigma_m": float(closure.sigma_m),
            }
            for closure in model.closures
        ]
    if model.effects:
        table["effects"] = [effect.as_dict() for effect in model.effects]
    return table


def camera_table(camera: Camera) -> dict[str, Any]:
    """A camera as a table of recording.toml."""
    table: dict[str, Any] = {
        "station": camera.station,
        "image_size": [int(n) for n in camera.image_size],
        "lens": camera.lens,
    }
    for key in ("focal_px", "centre_px", "distortion"):
        value = getattr(camera, key)
        if value is not None:
            table[key] = _floats(value)
    if camera.powered_on_s:
        moments = _floats(camera.powered_on_s)
        table["powered_on_s"] = moments[0] if len(moments) == 1 else moments
    return {**table, **_held(camera.pose, camera.free)}


def _held(pose: Poses | None, free: frozenset[str]) -> dict[str, Any]:
    table: dict[str, Any] = {"free": sorted(free)}
    if pose is not None:
        table["pose"] = {"turn_rad": pose[..., :3].tolist(), "shift_m": pose[..., 3:].tolist()}
    return table


def _marks(target: Target) -> dict[str, Any]:
    known = np.isfinite(target.points).all(axis=1)
    if not known.any():
        return {"points": list(target.point_names)}
    if not known.all():
        lost = target.point_names[int(np.flatnonzero(~known)[0])]
        raise ValueError(
            f'target "{target.name}" has coordinates for some points but not for "{lost}"; '
            "give all or none"
        )
    grid = _as_grid(target)
    if grid is not None:
        return {"grid": grid}
    rows = zip(target.point_names, target.points, strict=True)
    return {"points": {name: _floats(point) for name, point in rows}}


def _as_grid(target: Target) -> dict[str, Any] | None:
    """The grid that gives exactly these names and points, if there is one."""
    row, _, column = target.point_names[-1].partition("/")
    if not (row.isdecimal() and column.isdecimal()):
        return None
    rows, columns = int(row) + 1, int(column) + 1
    if rows * columns != len(target.points) or rows * columns == 1:
        return None
    x, y, _ = target.points[1]
    spacing = float(x if columns > 1 else y)
    names, points = grid_names(rows, columns), grid_points(rows, columns, spacing)
    if names != tuple(target.point_names) or not np.array_equal(points, target.points):
        return None
    return {"rows": rows, "columns": columns, "spacing_m": spacing}


def _floats(values: Any) -> list[float]:
    return [float(x) for x in values]
