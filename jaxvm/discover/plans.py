"""Plans: further recordings that could be made with the same cameras and bodies.

A plan changes what an engineer can change (distance, attitude, motion, temperature, power, a second
camera) in a recording that was made, and predicts the images with the fitted model. Nothing is
measured here; what the plan would decide is computed from its geometry alone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxvm.discover.second_camera import (
    may_have_second_camera,
    of_first_cameras,
    with_second_camera,
)
from jaxvm.discover.sights import across, marks_in_camera, middle_of_cameras, unit
from jaxvm.geometry.lenses import lens_family
from jaxvm.network.residual import predict_pixels
from jaxvm.network.scene import Scene, build
from jaxvm.network.views import rays_of_pixels
from jaxvm.physics.drivers import air_and_bodies, channel_kind
from jaxvm.recording import Drivers, Recording
from jaxvm.recording.join import PAUSE_S
from jaxvm.recording.model import Target

_SAME_RAY_RAD = 0.02
"""Angle within which the ray of a pixel leads to its mark: far more than an effect turns it."""

_NEAREST = 0.45
"""Depth to which a plan may bring a mark, over that of the nearest one in the recording."""


@dataclass(frozen=True)
class Plan:
    """One kind of further recording.

    Attributes:
        key: stable name.
        words: what to do, for an engineer.
        poses: changes the poses [targets, epochs, 6] of the targets that move, from the middles of
            their marks (target coordinates), the eye that sees them and the upward direction.
        recording: changes the circumstances (drivers, velocities, power).
        scene: changes with what is measured; the fitted scene without its effects.
    """

    key: str
    words: str
    poses: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None
    recording: Callable[[Recording], Recording] | None = None
    scene: Callable[[Scene], Scene] | None = None


@dataclass(frozen=True)
class Planned:
    """A planned recording as a scene, and the weights of what would be seen."""

    scene: Scene
    weights: tuple[np.ndarray, ...]


def _distance(factor: float):
    def change(poses, middles, eye, up):
        moved = poses.copy()
        moved[:, :, 3:] = eye + factor * (poses[:, :, 3:] - eye)
        return moved

    return change


def _turned(angles: Callable[[int], np.ndarray], axis: str):
    """Turn targets about the line of sight, or about the upward axis across it."""

    def change(poses, middles, eye, up):
        moved = poses.copy()
        for target in range(len(poses)):
            before = Rotation.from_rotvec(poses[target, :, :3])
            middle = before.apply(middles[target]) + poses[target, :, 3:]
            sight = middle - eye
            about = unit(sight) if axis == "sight" else across(sight, up)[1]
            turned = Rotation.from_rotvec(angles(len(sight))[:, None] * about) * before
            moved[target, :, :3] = turned.as_rotvec()
            moved[target, :, 3:] = middle - turned.apply(middles[target])
        return moved

    return change


def _swept(poses, middles, eye, up):
    """Targets sweep over the field in a Lissajous figure, up to 0.35 rad off their places."""
    moved = poses.copy()
    n = poses.shape[1]
    phase = 2.0 * np.pi * np.arange(n) / n
    for target in range(len(poses)):
        sight = poses[target, :, 3:] - eye
        side, upward = across(sight, up)
        about = 0.35 * (np.sin(3.0 * phase)[:, None] * upward + np.sin(2.0 * phase)[:, None] * side)
        moved[target, :, 3:] = eye + Rotation.from_rotvec(about).apply(sight)
    return moved


def _cycle(recording: Recording) -> Recording:
    """Temperatures go up by twice the span seen and return, within a third of the time.

    Bodies can't be told what to do: where the air's temperature is known, they follow it as before.
    """
    drivers = recording.drivers
    assert drivers is not None
    time, channels = drivers.time, dict(drivers.channels)
    # The log may begin long before the first image.
    first, last = recording.time[[0, -1]]
    share = (time - first) / max(last - first, 1e-9)
    up = np.clip(np.minimum(share / 0.3, (0.8 - share) / 0.3), 0.0, 1.0)
    air, bodies = air_and_bodies(channels)
    led = bodies if air else ()
    for name in channels:
        if _warms(name) and name not in led:
            channels[name] = channels[name].mean() + 2.0 * np.ptp(channels[name]) * up
    for name in led:
        channels[name] = _following(time, drivers.channels[air], channels[name], channels[air])
    return replace(recording, drivers=Drivers(time, channels))


def _following(time, air, body, new_air) -> np.ndarray:
    """The temperature of a body when the air's is another one.

    A first-order lag, dT/dt = k (air - T) + q, whose k and q are fitted to what was seen in its
    integrated form.
    """
    step = np.diff(time)

    def integral(values):
        return np.append(0.0, np.cumsum(0.5 * (values[1:] + values[:-1]) * step))

    design = np.stack([integral(air - body), time - time[0]], axis=1)
    rate = np.linalg.lstsq(design, body - body[0], rcond=None)[0][0]
    # The change of the air alone is added, so that what warms the body otherwise stays.
    kept = np.exp(-max(rate, 0.0) * step)
    change, added = new_air - air, np.zeros(len(time))
    added[0] = change[0] if rate > 0.0 else 0.0
    for k in range(len(step)):
        middle = 0.5 * (change[k] + change[k + 1])
        added[k + 1] = kept[k] * added[k] + (1.0 - kept[k]) * middle
    return body + added


def _warms(name: str) -> bool:
    return channel_kind(name) == "temperature"


def _reversed(recording: Recording) -> Recording:
    faster = {name: -2.0 * values for name, values in recording.velocities.items()}
    return replace(recording, velocities=faster)


def _restarted(recording: Recording) -> Recording:
    middle = float(0.5 * (recording.time[0] + recording.time[-1]))
    cameras = tuple(
        replace(c, powered_on_s=tuple(sorted((*c.powered_on_s, middle)))) if c.powered_on_s else c
        for c in recording.model.cameras
    )
    return replace(recording, model=replace(recording.model, cameras=cameras))


def _longer(recording: Recording) -> Recording:
    """The same course of everything at half the speed."""

    def later(time):
        return recording.time[0] + 2.0 * (time - recording.time[0])

    drivers = recording.drivers
    if drivers is not None:
        drivers = replace(drivers, time=later(drivers.time))
    slower = {name: 0.5 * values for name, values in recording.velocities.items()}
    return replace(recording, time=later(recording.time), drivers=drivers, velocities=slower)


PLANS: tuple[Plan, ...] = (
    Plan("nearer", "the moving targets at half the distance", poses=_distance(0.5)),
    Plan("farther", "the moving targets at 2.5 times the distance", poses=_distance(2.5)),
    Plan(
        "roll",
        "the moving targets rolled by 90 degrees about the line of sight for half of the time",
        poses=_turned(lambda n: np.where(np.arange(n) < n // 2, 0.0, np.pi / 2), "sight"),
    ),
    Plan(
        "tilt",
        "the moving targets tilted by 40 degrees to one side and to the other",
        poses=_turned(lambda n: np.where(np.arange(n) % 2, 0.7, -0.7), "up"),
    ),
    Plan("field", "the moving targets swept over the whole image", poses=_swept),
    Plan("cycle", "a faster cycle of heating and cooling that returns", recording=_cycle),
    Plan("reverse", "the motion the other way and twice as fast", recording=_reversed),
    Plan("restart", "the cameras switched off and on again in the middle", recording=_restarted),
    Plan("longer", "the same for twice as long", recording=_longer),
    Plan(
        "camera",
        "a second camera that sees the same from 40 degrees to the side",
        scene=with_second_camera,
    ),
)
"""Further recordings that are weighed, in the order of their cost."""


def possible(plan: Plan, recording: Recording) -> bool:
    """Whether a plan can be made with what a recording has."""
    if plan.poses is not None:
        return any(map(_moves, recording.model.targets))
    if plan.key == "camera":
        return may_have_second_camera(recording)
    if plan.key == "cycle":
        return recording.drivers is not None and any(map(_warms, recording.drivers.channels))
    if plan.key == "reverse":
        return bool(recording.velocities)
    if plan.key == "restart":
        return any(camera.powered_on_s for camera in recording.model.cameras)
    return recording.timed


def _moves(target: Target) -> bool:
    """Whether a target goes where one likes: in the world, for itself, and not on a station."""
    return target.motion == "per-epoch" and not target.station


def planned(plan: Plan, scene: Scene, another_day: bool = False) -> Planned:
    """The scene of a planned recording: the fitted cameras and bodies under other conditions.

    Marks that would leave the image or the field of the lens, or come too near, have weight zero.

    Args:
        plan: what is changed.
        scene: the fitted model of the first recording.
        another_day: what went on with time has gone on since the first recording; otherwise its
            clock starts anew.
    """
    changed = _changed(plan, scene) if plan.scene is None else plan.scene(scene)
    if another_day:
        changed = _on_another_day(changed)
    effects = of_first_cameras(scene.fitted_effects(), scene.model, changed.model)
    changed = changed.with_effects(effects, scene.room)
    tables = zip(changed.tables, predict_pixels(changed.state, changed.network), strict=True)
    nearest = _nearest(scene)
    weights = [
        _seen(changed, rows, np.asarray(pixels)[: len(rows)], nearest).astype(float)
        for rows, pixels in tables
    ]
    return Planned(changed, tuple(weights))


def _changed(plan: Plan, scene: Scene) -> Scene:
    """The fitted values under the circumstances and at the poses of a plan, without effects."""
    recording = scene.recording
    if plan.recording is not None:
        recording = plan.recording(recording)
    changed = build(recording, ())
    state = scene.state if plan.poses is None else _with_poses(plan, scene)
    blank = changed.state
    state = eqx.tree_at(
        lambda s: (s.amplitude, s.constant), state, (blank.amplitude, blank.constant)
    )
    return replace(changed, state=state)


def _on_another_day(scene: Scene) -> Scene:
    """The same scene with its clock as after the first recording and the pause before the next."""
    channels = scene.network.channels
    if "time" not in channels.names:
        return scene
    row = channels.index("time")
    later = scene.recording.time[-1] - scene.recording.time[0] + PAUSE_S
    values = channels.values.at[row].add(later)
    network = eqx.tree_at(lambda n: n.channels.values, scene.network, values)
    return replace(scene, network=network)


def _with_poses(plan: Plan, scene: Scene):
    assert plan.poses is not None
    table = np.array(scene.state.carrier_from_target)
    targets = enumerate(scene.model.targets)
    moving = [i for i, target in targets if _moves(target)]
    rows = scene.target_row[moving]
    up = np.asarray(scene.model.up, float)
    middles = [scene.model.targets[i].points for i in moving]
    middles = np.array([0.5 * (p.min(axis=0) + p.max(axis=0)) for p in middles])
    table[rows] = plan.poses(table[rows], middles, middle_of_cameras(scene), up)
    return eqx.tree_at(lambda s: s.carrier_from_target, scene.state, jnp.asarray(table))


def _nearest(scene: Scene) -> float:
    """Least depth of a mark that a plan may bring about (m).

    A tilted board whose middle is at half the distance would reach through the camera, and there
    everything tells itself from everything.
    """
    depths = [marks_in_camera(scene, rows)[:, 2] for rows in scene.tables]
    seen = [depth[depth > 0.0] for depth in depths if (depth > 0.0).any()]
    return _NEAREST * float(min(map(np.min, seen), default=0.0))


def _seen(scene: Scene, rows: np.ndarray, pixels: np.ndarray, nearest: float) -> np.ndarray:
    """Whether the marks of observations (one family of lenses) are seen at predicted pixels.

    They are inside the image, no nearer to the camera than a plan may bring them, and the lens
    leads back from the pixel to the mark: beyond its field a polynomial folds what is far outside
    back into the image.
    """
    camera = scene.recording.observations.camera[rows]
    if not len(camera):
        return np.zeros(0, bool)
    cameras, state = scene.model.cameras, scene.state
    sizes = np.array([c.image_size for c in cameras], float)[camera]
    inside: Any = np.all((pixels > 0.0) & (pixels < sizes - 1.0), axis=1)
    marks = marks_in_camera(scene, rows)
    focal, centre, distortion = (
        np.asarray(v)[camera] for v in (state.focal, state.centre, state.distortion)
    )
    where = np.where(inside[:, None], pixels, 0.0)
    back = rays_of_pixels(lens_family(cameras[camera[0]].lens), focal, centre, distortion, where)
    cosine = np.sum(unit(back) * unit(marks), axis=1)
    return inside & (marks[:, 2] > nearest) & (cosine > np.cos(_SAME_RAY_RAD))
