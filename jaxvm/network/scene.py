"""Scene: a recording as a network of tables, with the state that the engineer's model gives.

`build` turns a `Recording` into a `Scene`; nothing is estimated here. Names and indices are kept so
that every result can say of which camera, target and epoch it speaks.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxvm.geometry.matrices import matrices, vectors
from jaxvm.network.binding import bind
from jaxvm.network.network import Network
from jaxvm.network.state import N_DISTORTION, Layout, State
from jaxvm.network.tables import Tables
from jaxvm.network.unknowns import Unknowns, free_unknowns
from jaxvm.physics.blocks import rounded
from jaxvm.physics.effects import Effect, capacity, tabulate
from jaxvm.recording import Recording


@dataclass(frozen=True)
class Scene:
    """A recording ready for the residual: network, state, unknowns, and the names behind them.

    Attributes:
        recording: the recording it was built from.
        effects: physics in the model beyond the plain chain.
        network: tables of observations.
        state: present values; start values or an adjusted result.
        unknowns: which parameters are free.
        tables: for each pixel table, the rows of `recording.observations` it holds.
        station_row, target_row: row of the pose tables, by body and epoch.
        first_point: first row of each target in the table of points.
    """

    recording: Recording
    effects: tuple[Effect, ...]
    network: Network
    state: State
    unknowns: Unknowns
    tables: tuple[np.ndarray, ...]
    station_row: np.ndarray
    target_row: np.ndarray
    first_point: np.ndarray

    @property
    def model(self):
        """The engineer's model."""
        return self.recording.model

    def with_state(self, state: State) -> "Scene":
        """The same scene at other values; the drivers of its effects are computed anew."""
        return bind(replace(self, state=state))

    def with_effects(self, effects: tuple[Effect, ...], room: tuple[int, int] | None = None):
        """The same scene and values with other physics; all amplitudes are free.

        `room` asks for at least that many columns and constants, so that models with few and with
        many effects are the same compiled program.
        """
        columns, constants = np.maximum(capacity(effects), room or (0, 1))
        table, amplitude, constant = tabulate(
            effects, self.network.channels, int(columns), int(constants)
        )
        state = eqx.tree_at(
            lambda s: (s.amplitude, s.constant),
            self.state,
            (jnp.asarray(amplitude), jnp.asarray(constant)),
        )
        network = eqx.tree_at(lambda n: n.effects, self.network, table)
        network = replace(network, layout=Layout.of(state))
        scene = replace(self, effects=effects, state=state, network=network)
        return bind(replace(scene, unknowns=free_unknowns(scene)))

    @property
    def room(self) -> tuple[int, int]:
        """Columns and constants that there is room for."""
        return self.network.effects.n_columns, self.state.constant.shape[0]

    @cached_property
    def station_places(self) -> dict[str, int]:
        """Place of each station in the model, by name."""
        return {station.name: i for i, station in enumerate(self.model.stations)}

    def world_from_targets(
        self, target: Int[np.ndarray, " n"], epoch: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 6"]:
        """Present poses of targets in the world, whatever carries them."""
        pose = np.array(self.state.carrier_from_target)[self.target_row[target, epoch]]
        row = self.carrier_rows(target, epoch)
        carrier = np.array(self.state.world_from_station)[np.maximum(row, 0)]
        carrier[row < 0] = 0.0
        turn, own = Rotation.from_rotvec(carrier[:, :3]), Rotation.from_rotvec(pose[:, :3])
        shift = turn.apply(pose[:, 3:]) + carrier[:, 3:]
        return np.concatenate([(turn * own).as_rotvec(), shift], axis=1)

    def camera_from_targets(
        self,
        camera: Int[np.ndarray, " n"],
        target: Int[np.ndarray, " n"],
        epoch: Int[np.ndarray, " n"],
    ) -> Float[np.ndarray, "n 6"]:
        """Present poses of targets before cameras."""
        station = np.array([self.station_places[c.station] for c in self.model.cameras], int)
        row = self.station_row[station[camera], epoch]
        world_from_camera = matrices(np.asarray(self.state.world_from_station)[row]) @ matrices(
            np.asarray(self.state.station_from_camera)[camera]
        )
        world_from_target = matrices(self.world_from_targets(target, epoch))
        return vectors(np.linalg.inv(world_from_camera) @ world_from_target)

    def view_name(self, camera: int, target: int, epoch: int) -> str:
        """What is seen in one image, in words."""
        name = f"{self.model.cameras[camera].name} sees {self.model.targets[target].name}"
        several = len(self.recording.epoch_ids) > 1
        return f"{name}, epoch {self.recording.epoch_ids[epoch]}" if several else name

    def carrier_rows(
        self, target: Int[np.ndarray, " n"], epoch: Int[np.ndarray, " n"]
    ) -> Int[np.ndarray, " n"]:
        """Row of world_from_station for the station that carries a target; -1 for the world."""
        places = self.station_places
        carrier = np.array([places.get(t.station, -1) for t in self.model.targets], int)
        own = carrier[target]
        return np.where(own < 0, -1, self.station_row[own, epoch])

    def places(self) -> tuple[tuple[slice, slice], ...]:
        """Columns and constants of each effect, in the tables of amplitudes and constants."""
        found, column, first = [], 0, 0
        for effect in self.effects:
            n, m = effect.n_columns, len(effect.constants)
            found.append((slice(column, column + n), slice(first, first + m)))
            column, first = column + n, first + m
        return tuple(found)

    def fitted_effects(self) -> tuple[Effect, ...]:
        """The effects with the amplitudes and constants of the present state."""
        amplitude, constant = np.asarray(self.state.amplitude), np.asarray(self.state.constant)
        return tuple(
            effect.with_values(amplitude[columns], constant[constants])
            for effect, (columns, constants) in zip(self.effects, self.places(), strict=True)
        )


def build(recording: Recording, effects: tuple[Effect, ...] | None = None) -> Scene:
    """Scene of a recording, at the values that its model gives (nothing estimated yet).

    `effects` replace those that the model itself has.
    """
    model = recording.model
    effects = model.effects if effects is None else effects
    n_epochs = len(recording.time)
    station_row = _pose_rows([s.motion for s in model.stations], n_epochs)
    target_row = _pose_rows([t.motion for t in model.targets], n_epochs)
    counts = [len(t.points) for t in model.targets]
    first_point = np.concatenate([[0], np.cumsum(counts)]).astype(int)
    state = _given_state(recording, station_row, target_row)
    layout = Layout.of(state)
    channels = recording.channels()
    empty, _, _ = tabulate((), channels, 0, 1)
    nothing = np.zeros(0, int)
    scene = Scene(
        recording,
        (),
        Network((), None, None, None, None, None, empty, channels, layout),
        state,
        Unknowns(nothing, nothing, 0, 0, 0, (), nothing, nothing),
        (),
        station_row,
        target_row,
        first_point,
    )
    index = Tables(scene)
    tables, pixels = index.pixel_tables()
    edges, closures = index.closed_links()
    network = replace(
        scene.network,
        pixels=pixels,
        ranges=index.ranges(),
        links=index.links(),
        edges=edges,
        closures=closures,
    )
    return replace(scene, network=network, tables=tables).with_effects(effects)


def _pose_rows(motions: list[str], n_epochs: int) -> np.ndarray:
    """Row of a pose table for each body and epoch: one row when static, one an epoch otherwise."""
    rows, first = [], 0
    for motion in motions:
        moving = motion == "per-epoch"
        rows.append(first + (np.arange(n_epochs) if moving else np.zeros(n_epochs, int)))
        first = rows[-1][-1] + 1
    return np.array(rows, int).reshape(len(motions), n_epochs)


def _given_state(recording, station_row, target_row) -> State:
    model = recording.model

    def poses(bodies, row):
        n = int(row.max()) + 1 if row.size else 0
        # Spare rows, so that some epochs more or less are no other program.
        table = np.zeros((rounded(n) if n > len(bodies) else n, 6))
        for body, rows in zip(bodies, row, strict=True):
            if body.pose is not None:
                table[np.unique(rows)] = body.pose
        return table

    cameras = model.cameras
    n = len(cameras)
    focal, centre, distortion = np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, N_DISTORTION))
    mounted = np.zeros((n, 6))
    for i, camera in enumerate(cameras):
        size = np.asarray(camera.image_size, float)
        focal[i] = size.max() if camera.focal_px is None else camera.focal_px
        centre[i] = (size - 1.0) / 2.0 if camera.centre_px is None else camera.centre_px
        if camera.distortion is not None:
            distortion[i, : len(camera.distortion)] = camera.distortion
        if camera.pose is not None:
            mounted[i] = camera.pose
    closed = {name for closure in model.closures for name, _ in closure.links}
    links = recording.links
    named = [] if links is None else [i for i, name in enumerate(links.name) if name in closed]
    finders = [r.pose for r in model.rangefinders]
    return State(
        focal=jnp.asarray(focal),
        centre=jnp.asarray(centre),
        distortion=jnp.asarray(distortion),
        station_from_camera=jnp.asarray(mounted),
        world_from_station=jnp.asarray(poses(model.stations, station_row)),
        carrier_from_target=jnp.asarray(poses(model.targets, target_row)),
        point=jnp.asarray(
            _in_room(np.concatenate([np.zeros((0, 3)), *(t.points for t in model.targets)]))
        ),
        station_from_rangefinder=jnp.asarray(np.reshape(finders, (-1, 6)).astype(float)),
        link=jnp.asarray(np.zeros((0, 6)) if links is None or not named else links.pose[named]),
        amplitude=jnp.zeros(0),
        constant=jnp.ones(1),
        identity=jnp.zeros((1, 6)),
    )


def _in_room(points: np.ndarray) -> np.ndarray:
    """Points with spare rows, so that some marks more or less are no other program."""
    spare = -len(points) % 32
    return np.concatenate([points, np.zeros((spare, 3))])
