"""Photographs of a scene: what its cameras see at true values, with noise."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxvm.network.residual import predict_pixels
from jaxvm.network.scene import build
from jaxvm.physics.effects import Effect, Scope
from jaxvm.recording.errors import did_you_mean
from jaxvm.recording.model import Camera, Model, Station, Target
from jaxvm.recording.recording import Observations, Recording
from jaxvm.scenes.climate import body_of, effects_of, read, weather
from jaxvm.scenes.describe import Description
from jaxvm.scenes.equip import Candidates, Equipment, candidates, equip
from jaxvm.scenes.layouts import Structure
from jaxvm.scenes.placement import Placement, Ties, check_joined
from jaxvm.scenes.truth import Simulated, Truth

LEAST_MARKS = 6
"""Marks of a target that a view has to show: fewer leave its pose with several solutions."""

START_RAD, START_M = 0.005, 0.003
"""Standard deviations of the start values of camera poses that are free."""

_MOST_PATTERNS = 2e8
"""Most numbers in the tables that say how strongly effects act on each observation."""


@dataclass(frozen=True, eq=False)
class Seen:
    """Views with enough marks: rows of the candidates, and the view of each.

    Attributes:
        rows: the candidates that are seen.
        ties: station that sees, station that is seen, and epoch of each view.
    """

    rows: Int[np.ndarray, " n"]
    ties: Ties


def photographed(
    description: Description,
    structure: Structure,
    placement: Placement,
    drawn: np.random.Generator,
    noisy: np.random.Generator,
    noise: float,
) -> Simulated:
    """A recording of image points, with its truth.

    Args:
        description, structure, placement: the network.
        drawn: draws the temperatures, and start values of cameras.
        noisy: draws the noise of pixels and readings.
        noise: factor on both.

    Raises:
        RecordingError: effects of cameras that there are not, or too many of them; a station that
            nobody sees; more free poses than views.
    """
    equipment = equip(structure, placement, description.cameras, description.marks)
    _check_cameras(description, equipment)
    found = candidates(equipment, placement, description.cameras, description.marks.incidence)
    time = description.interval_s * np.arange(description.epochs)
    drivers = None
    if description.temperature is not None:
        names = equipment.camera_names
        drivers = weather(description.temperature, names, float(time[-1]), drawn)
    effects = _effects(description, equipment, len(found.mark))
    every = tuple(effect for own, _ in effects for effect in own)
    known = _model(description, structure, placement, equipment)
    true = Recording(
        known,
        np.arange(description.epochs),
        time,
        {},
        _observations(equipment, found, description.pixel_px),
        drivers,
    )
    pixel = _predicted(true, placement, every) if len(found.mark) else found.pixel
    seen = _seen(description, equipment, placement, found, pixel)
    check_joined(description, structure, placement, seen.ties)
    truth = Truth(
        structure.names,
        placement.vectors,
        equipment.camera_names,
        equipment.station_from_camera,
        every,
        tuple(effect.name for own, model in effects if model == "hidden" for effect in own),
    )
    error = description.pixel_px * noisy.standard_normal((len(seen.rows), 2))
    seen_pixel = pixel[seen.rows] + noise * error
    if drivers is not None and description.temperature is not None:
        drivers = read(drivers, noise * description.temperature.noise_K, noisy)
    measured = replace(
        true,
        drivers=drivers,
        observations=_rows_of(true.observations, seen.rows, seen_pixel),
    )
    stations = placement.stations(structure.names)
    recording = _engineers(description, measured, effects, stations, seen.ties, drawn)
    _check_count(description, recording, seen.ties, placement.rows)
    return Simulated(recording, truth)


def _check_cameras(description: Description, equipment: Equipment) -> None:
    names = set(equipment.camera_names)
    for effect in description.effects:
        for name in effect.camera:
            if name not in names:
                raise description.error_at(
                    effect.entry,
                    "camera",
                    f'there is no camera "{name}" for an effect; '
                    f"{did_you_mean(name, equipment.camera_names)}",
                )


def _effects(
    description: Description, equipment: Equipment, n: int
) -> list[tuple[tuple[Effect, ...], str]]:
    """The described effects on cameras, and whether the model has them."""
    found = []
    for number, planned in enumerate(description.effects, start=1):
        assert description.temperature is not None
        cameras = planned.camera or equipment.camera_names
        own = effects_of(planned, description.temperature, cameras, number)
        found.append((own, planned.model))
    if n * sum(len(own) for own, _ in found) > _MOST_PATTERNS:
        raise description.error_at(
            max(description.effects, key=lambda effect: effect.driver == "body").entry,
            None,
            f"effects that follow the bodies of {len(equipment.camera_names)} cameras are too many "
            f'for {n} image points; set driver = "ambient", or name some cameras',
        )
    return found


def _model(
    description: Description, structure: Structure, placement: Placement, equipment: Equipment
) -> Model:
    """The network with all values known and nothing free."""
    cameras, size = description.cameras, description.cameras.image_size
    names = structure.names
    focal = np.full(2, cameras.focal_px)
    centre = (np.array(size) - 1.0) / 2.0
    distortion = cameras.distortion if len(cameras.distortion) else None
    return Model(
        name=description.name,
        cameras=tuple(
            Camera(name, names[own], size, cameras.lens, focal, centre, distortion, pose)
            for name, own, pose in zip(
                equipment.camera_names,
                equipment.camera_station,
                equipment.station_from_camera,
                strict=True,
            )
        ),
        stations=tuple(
            replace(station, pose=pose, free=frozenset())
            for station, pose in zip(
                placement.stations(names), placement.vectors[:, 0], strict=True
            )
        ),
        targets=tuple(
            Target(
                name,
                equipment.point_names,
                equipment.points,
                "static",
                pose,
                frozenset(),
                names[own],
            )
            for name, own, pose in zip(
                equipment.target_names,
                equipment.target_station,
                equipment.station_from_target,
                strict=True,
            )
        ),
        pixel_sigma=description.pixel_px,
    )


def _observations(equipment: Equipment, found: Candidates, sigma: float) -> Observations:
    return Observations(
        found.epoch,
        equipment.camera[found.line],
        equipment.target[found.line],
        found.mark,
        found.pixel,
        np.full(len(found.mark), sigma),
    )


def _predicted(
    true: Recording, placement: Placement, effects: tuple[Effect, ...]
) -> Float[np.ndarray, "n 2"]:
    """Image points (px) that the network predicts at true values."""
    scene = build(true)
    world = np.array(scene.state.world_from_station)
    world[scene.station_row] = placement.vectors
    state = eqx.tree_at(lambda s: s.world_from_station, scene.state, jnp.asarray(world))
    scene = replace(scene, state=state)
    if effects:
        scene = scene.with_effects(effects)
    pixel = np.full(true.observations.pixel.shape, np.nan)
    for rows, block in zip(scene.tables, predict_pixels(scene.state, scene.network), strict=True):
        pixel[rows] = np.asarray(block)[: len(rows)]
    return pixel


def _seen(
    description: Description,
    equipment: Equipment,
    placement: Placement,
    found: Candidates,
    pixel: Float[np.ndarray, "n 2"],
) -> Seen:
    """Marks inside the images, in views that have enough of them."""
    margin, size = description.cameras.margin_px, np.array(description.cameras.image_size)
    inside = np.all((pixel >= margin) & (pixel <= size - 1.0 - margin), axis=1)
    rows = np.flatnonzero(inside)
    epochs = placement.shift.shape[1]
    key = found.line[rows] * epochs + found.epoch[rows]
    view, place, count = np.unique(key, return_inverse=True, return_counts=True)
    enough = count >= LEAST_MARKS
    line, epoch = np.divmod(view[enough], epochs)
    ties = Ties(
        equipment.camera_station[equipment.camera[line]],
        equipment.target_station[equipment.target[line]],
        epoch,
    )
    return Seen(rows[enough[place.ravel()]], ties)


def _rows_of(table: Observations, rows: Int[np.ndarray, " n"], pixel) -> Observations:
    chosen = {name: values[rows] for name, values in vars(table).items()}
    return Observations(**(chosen | {"pixel": pixel}))


def _engineers(
    description: Description,
    true: Recording,
    effects: list[tuple[tuple[Effect, ...], str]],
    stations: tuple[Station, ...],
    ties: Ties,
    rng: np.random.Generator,
) -> Recording:
    """What an engineer has of it: gauge held, the rest free, nothing that is hidden or never seen.

    Bodies that no observation has are no part of a recording.
    """
    obs, model = true.observations, true.model
    cameras, camera = np.unique(obs.camera, return_inverse=True)
    targets, target = np.unique(obs.target, return_inverse=True)
    crew = [model.cameras[k] for k in cameras]
    if description.cameras.free:
        crew = _with_free_poses(crew, {stations[k].name for k in np.unique(ties.b)}, rng)
    names = [own.name for own in crew]
    known = []
    for own, knowledge in effects:
        for effect in own if knowledge != "hidden" else ():
            scope = tuple(name for name in names if name in effect.scope.camera)
            if effect.scope.camera and not scope:
                continue
            if knowledge == "free":
                effect = effect.with_values((0.0,) * effect.n_columns, effect.constants)
            known.append(replace(effect, scope=Scope(camera=scope)))
    drivers = true.drivers
    if drivers is not None:
        unused = {body_of(c.name) for c in model.cameras} - set(map(body_of, names))
        kept = {name: v for name, v in drivers.channels.items() if name not in unused}
        drivers = replace(drivers, channels=kept)
    return replace(
        true,
        model=replace(
            model,
            cameras=tuple(crew),
            stations=stations,
            targets=tuple(model.targets[k] for k in targets),
            effects=tuple(known),
        ),
        observations=replace(obs, camera=camera.ravel(), target=target.ravel()),
        drivers=drivers,
    )


def _with_free_poses(
    cameras: list[Camera], seen: set[str], rng: np.random.Generator
) -> list[Camera]:
    """Cameras with rough start values for their poses, which are free.

    Where nobody sees the marks of a station, its first camera stays known: it is what the station
    is known by.
    """
    leading: set[str] = set()
    found = []
    for camera in cameras:
        leads = camera.station not in seen and camera.station not in leading
        leading.add(camera.station)
        assert camera.pose is not None
        astray = np.repeat([START_RAD, START_M], 3) * rng.standard_normal(6)
        turn = Rotation.from_rotvec(camera.pose[:3]) * Rotation.from_rotvec(astray[:3])
        rough = np.concatenate([turn.as_rotvec(), camera.pose[3:] + astray[3:]])
        found.append(camera if leads else replace(camera, pose=rough, free=frozenset({"pose"})))
    return found


def _check_count(description: Description, recording: Recording, ties: Ties, rows) -> None:
    """A view gives six numbers, a free pose takes six.

    Raises:
        RecordingError: there are more free poses than views.
    """
    poses = sum("pose" in camera.free for camera in recording.model.cameras)
    if not poses:
        return
    free = np.array(["pose" in station.free for station in recording.model.stations])
    poses += len(np.unique(rows[free]))
    if poses > len(ties.a):
        raise description.error(
            "cameras",
            "pose",
            f"{len(ties.a)} views can't give {poses} free poses of cameras and stations; set "
            'cameras.pose = "known" or each = "sector", or have more epochs in which stations move',
        )
