"""A second camera beside the only one: it sees the same marks at the same moments from the side.

It is one of the same make, on a tripod of its own. Nothing is known of it beforehand that was not
known of the first one, nor where it stands; what is wrong with the first one is not wrong with it.
"""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jaxvm.discover.sights import across, marks_in_world, world_from_cameras
from jaxvm.network.scene import Scene, build
from jaxvm.physics.effects import Effect
from jaxvm.physics.ports import PORT_INDEX, PORTS
from jaxvm.recording import Observations, Recording, Station
from jaxvm.recording.model import Model

ASIDE_RAD = float(np.radians(40.0))
"""Angle between the two lines of sight to the middle of the marks."""

_MOST_OBLIQUE = float(np.cos(np.radians(80.0)))
"""Least cosine between a line of sight and a target's normal at which a mark is seen."""

_OF_THE_OBJECT = ("target", "structure")
"""Stages of the chain that any camera sees alike."""


def may_have_second_camera(recording: Recording) -> bool:
    """Whether one camera that stands in the world sees all that is measured."""
    model = recording.model
    static = all(station.motion == "static" for station in model.stations)
    return len(model.cameras) == 1 and static and recording.ranges is None


def with_second_camera(scene: Scene) -> Scene:
    """The fitted scene with a second camera, which has seen what can be seen from its place.

    Its measured pixels are those of the first camera: only what a model predicts for it counts.
    Effects of the scene are not in it (`of_first_cameras`).
    """
    recording, model = scene.recording, scene.model
    (camera,) = model.cameras
    name = f"{camera.name} aside"
    pose, seen = _aside(scene)
    second = replace(
        camera, name=name, station=name, pose=pose, free=frozenset({*camera.free, "pose"})
    )
    station = Station(name, pose=np.zeros(6))
    obs = recording.observations
    also = {key: values[seen] for key, values in vars(obs).items()} | {
        "camera": np.ones(int(seen.sum()), obs.camera.dtype)
    }
    both = Observations(**{key: np.concatenate([own, also[key]]) for key, own in vars(obs).items()})
    own = f"cameras.{camera.name}."
    priors = [
        replace(prior, parameter=prior.parameter.replace(own, f"cameras.{name}.", 1))
        for prior in model.priors
        if prior.parameter.startswith(own)
    ]
    model = replace(
        model,
        cameras=(camera, second),
        stations=(*model.stations, station),
        priors=(*model.priors, *priors),
    )
    changed = build(replace(recording, model=model, observations=both), ())
    return replace(changed, state=_of_both(scene, changed, pose))


def _of_both(scene: Scene, changed: Scene, pose: Float[np.ndarray, "6"]):
    """The fitted values, and those of the first camera for the second one at its place."""
    state, blank = scene.state, changed.state
    of_camera = ("focal", "centre", "distortion")
    twice = [jnp.repeat(getattr(state, name), 2, axis=0) for name in of_camera]
    mounted = jnp.stack([state.station_from_camera[0], jnp.asarray(pose)])
    n = int(scene.station_row.max()) + 1
    stations = blank.world_from_station.at[:n].set(state.world_from_station[:n])
    return eqx.tree_at(
        lambda s: (
            *(getattr(s, name) for name in of_camera),
            s.station_from_camera,
            s.world_from_station,
            s.amplitude,
            s.constant,
        ),
        state,
        (*twice, mounted, stations, blank.amplitude, blank.constant),
    )


def _aside(scene: Scene) -> tuple[Float[np.ndarray, "6"], Bool[np.ndarray, " observations"]]:
    """Where the second camera stands (world_from_camera), and which marks are turned towards it.

    On the side from which more of them are seen.
    """
    obs = scene.recording.observations
    mark = marks_in_world(scene, np.arange(len(obs.epoch)))
    turn = Rotation.from_rotvec(scene.world_from_targets(obs.target, obs.epoch)[:, :3])
    normal = turn.apply([0.0, 0.0, 1.0])
    attitudes, places = world_from_cameras(scene)
    attitude, eye = attitudes[0], places[0]
    middle = np.median(mark, axis=0)
    _, (axis,) = across((middle - eye)[None], np.asarray(scene.model.up, float))

    def cosines(place):
        way = mark - place
        return np.sum(normal * way, axis=1) / np.linalg.norm(way, axis=1)

    front = np.sign(cosines(eye))
    found = []
    for angle in (ASIDE_RAD, -ASIDE_RAD):
        about = Rotation.from_rotvec(angle * axis)
        place = middle + about.apply(eye - middle)
        pose = np.concatenate([(about * attitude).as_rotvec(), place])
        found.append((pose, front * cosines(place) > _MOST_OBLIQUE))
    return max(found, key=lambda one: int(one[1].sum()))


def of_first_cameras(effects: Sequence[Effect], first: Model, model: Model) -> tuple[Effect, ...]:
    """Effects of a model in one that has further cameras: those do not share the first ones' own.

    What the object itself does is seen by all.
    """
    if len(model.cameras) == len(first.cameras):
        return tuple(effects)
    names = tuple(camera.name for camera in first.cameras)
    return tuple(
        effect
        if effect.scope.camera or effect.scope.station or _of_the_object(effect)
        else replace(effect, scope=replace(effect.scope, camera=names))
        for effect in effects
    )


def _of_the_object(effect: Effect) -> bool:
    return all(PORTS[PORT_INDEX[term.port]].stage in _OF_THE_OBJECT for term in effect.terms)
