"""Scene: a recording as a network of tables, with the state that the engineer's model gives.

`build` turns a `Recording` into a `Scene`; nothing is estimated here. Names and indices are kept so
that every result can say of which camera, target and epoch it speaks.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxvm.geometry.lenses import lens_family
from jaxvm.network.factors import (
    ClosureFactor,
    EdgeFactor,
    LinkFactor,
    PixelFactor,
    PriorFactor,
    RangeFactor,
    rounded,
)
from jaxvm.network.residual import Network, parts_of
from jaxvm.network.state import N_DISTORTION, Layout, State
from jaxvm.network.unknowns import Unknowns, arrange, local_groups
from jaxvm.physics.chain import Circumstances, Sight
from jaxvm.physics.drivers import all_observation_drivers, build_channels, pattern
from jaxvm.physics.effects import Effect, Scope, capacity, courses, tabulate
from jaxvm.physics.forms import FORMS
from jaxvm.physics.ports import PORTS, PortValues
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
        return _bind(replace(self, state=state))

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
        network = _relaid(network, self.network.layout, Layout.of(state))
        scene = replace(self, effects=effects, state=state, network=network)
        return _bind(replace(scene, unknowns=_unknowns(scene)))

    def fitted_effects(self) -> tuple[Effect, ...]:
        """The effects with the amplitudes and constants of the present state."""
        result, column, first = [], 0, 0
        amplitude, constant = np.asarray(self.state.amplitude), np.asarray(self.state.constant)
        for effect in self.effects:
            n, m = effect.n_columns, len(effect.constants)
            values = amplitude[column : column + n], constant[first : first + m]
            result.append(effect.with_values(*values))
            column, first = column + n, first + m
        return tuple(result)


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
    channels = build_channels(
        recording.time,
        {} if recording.drivers is None else recording.drivers.channels,
        None if recording.drivers is None else recording.drivers.time,
        {c.name: c.powered_on_s for c in model.cameras if c.powered_on_s is not None},
        recording.timed,
    )
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
    index = _Index(scene)
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
        table = np.zeros((int(row.max()) + 1 if row.size else 0, 6))
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
        world_from_target=jnp.asarray(poses(model.targets, target_row)),
        point=jnp.asarray(np.concatenate([t.points for t in model.targets])),
        station_from_rangefinder=jnp.asarray(np.reshape(finders, (-1, 6)).astype(float)),
        link=jnp.asarray(np.zeros((0, 6)) if not named else links.pose[named]),
        amplitude=jnp.zeros(0),
        constant=jnp.ones(1),
        identity=jnp.zeros((1, 6)),
    )


class _Index:
    """Turns the names and indices of a recording into slots of the flat state."""

    def __init__(self, scene: Scene):
        self.recording = scene.recording
        self.model = scene.model
        self.layout = scene.network.layout
        self.station_row = scene.station_row
        self.target_row = scene.target_row
        self.first_point = scene.first_point
        names = [s.name for s in self.model.stations]
        self.station_of = np.array([names.index(c.station) for c in self.model.cameras], int)
        self.station_of_finder = np.array(
            [names.index(r.station) for r in self.model.rangefinders], int
        )
        points = [t.points for t in self.model.targets]
        self.centre = np.array([(p.min(0) + p.max(0)) / 2 for p in points])
        half = np.array([np.ptp(p, axis=0)[:2] / 2 for p in points])
        self.half_size = np.where(half > 0, half, 1.0)

    def circumstances(self, epoch, target, pixel, height) -> Circumstances:
        velocity = np.zeros((len(epoch), 6))
        for name, values in self.recording.velocities.items():
            own = target == [t.name for t in self.model.targets].index(name)
            velocity[own] = values[epoch[own]]
        return Circumstances(
            *map(
                jnp.asarray,
                (pixel, height, self.centre[target], self.half_size[target], velocity),
            )
        )

    def pixel_tables(self):
        """One table for each family of lenses; rows sorted so that equal slots are neighbours."""
        obs = self.recording.observations
        lenses = [c.lens for c in self.model.cameras]
        tables, factors = [], []
        for lens in dict.fromkeys(lenses):
            family = lens_family(lens)
            of_lens = np.array([name == lens for name in lenses])
            chosen = np.flatnonzero(of_lens[obs.camera])
            order = np.lexsort(
                (obs.point[chosen], obs.target[chosen], obs.camera[chosen], obs.epoch[chosen])
            )
            chosen = chosen[order]
            if len(chosen) == 0:
                continue
            real = len(chosen)
            tables.append(chosen)
            chosen = np.append(chosen, np.full(rounded(real) - real, chosen[-1]))
            camera, target = obs.camera[chosen], obs.target[chosen]
            epoch, point = obs.epoch[chosen], self.first_point[target] + obs.point[chosen]
            slots = [
                self.layout.slots("focal", camera),
                self.layout.slots("centre", camera),
                self.layout.slots("distortion", camera, family.n_coefficients),
                self.layout.slots("station_from_camera", camera),
                self.layout.slots(
                    "world_from_station", self.station_row[self.station_of[camera], epoch]
                ),
                self.layout.slots("world_from_target", self.target_row[target, epoch]),
                self.layout.slots("point", point),
            ]
            height = np.array([c.image_size[1] for c in self.model.cameras], float)[camera]
            sigma = np.repeat(obs.sigma[chosen][:, None], 2, axis=1)
            factors.append(
                PixelFactor(
                    family=family,
                    slots=jnp.asarray(np.concatenate(slots, axis=1)),
                    sigma=jnp.asarray(sigma),
                    weight=jnp.asarray(np.arange(len(chosen)) < real, float),
                    real=jnp.asarray(real),
                    circumstances=self.circumstances(epoch, target, obs.pixel[chosen], height),
                    epoch=jnp.asarray(epoch),
                    pattern=jnp.zeros((len(chosen), 0)),
                )
            )
        return tuple(tables), tuple(factors)

    def ranges(self) -> RangeFactor | None:
        ranges = self.recording.ranges
        if ranges is None or len(ranges.epoch) == 0:
            return None
        to_plane = ranges.point < 0
        point = self.first_point[ranges.target] + np.maximum(ranges.point, 0)
        station = self.station_of_finder[ranges.rangefinder]
        slots = [
            self.layout.slots("station_from_rangefinder", ranges.rangefinder),
            self.layout.slots("world_from_station", self.station_row[station, ranges.epoch]),
            self.layout.slots("world_from_target", self.target_row[ranges.target, ranges.epoch]),
            self.layout.slots("point", point),
        ]
        n = len(ranges.epoch)
        return RangeFactor(
            slots=jnp.asarray(np.concatenate(slots, axis=1)),
            sigma=jnp.asarray(ranges.sigma[:, None]),
            weight=jnp.ones(n),
            circumstances=self.circumstances(
                ranges.epoch, ranges.target, np.zeros((n, 2)), np.ones(n)
            ),
            to_plane=jnp.asarray(to_plane, float),
            measured=jnp.asarray(ranges.distance),
            epoch=jnp.asarray(ranges.epoch),
            pattern=jnp.zeros((n, 0)),
        )

    def _node(self, kind: str, number: int, epoch: int) -> np.ndarray:
        """Slots of a node: carrier, then body on the carrier."""
        epoch = max(epoch, 0)
        identity = self.layout.slots("identity", np.zeros(1, int))[0]
        if kind == "camera":
            row = self.station_row[self.station_of[number], epoch]
            carrier = self.layout.slots("world_from_station", np.array([row]))[0]
            body = self.layout.slots("station_from_camera", np.array([number]))[0]
            return np.concatenate([carrier, body])
        rows, table = {
            "station": (self.station_row, "world_from_station"),
            "target": (self.target_row, "world_from_target"),
        }[kind]
        own = self.layout.slots(table, np.array([rows[number, epoch]]))[0]
        return np.concatenate([own, identity])

    def _split_links(self):
        links = self.recording.links
        closed = {name for closure in self.model.closures for name, _ in closure.links}
        inside = [] if links is None else [name in closed for name in links.name]
        return links, np.array(inside, bool)

    def links(self) -> LinkFactor | None:
        links, inside = self._split_links()
        rows = np.flatnonzero(~inside)
        if links is None or len(rows) == 0:
            return None
        slots = [
            np.concatenate(
                [
                    self._node(*links.from_node[i], links.epoch[i]),
                    self._node(*links.to_node[i], links.epoch[i]),
                ]
            )
            for i in rows
        ]
        return LinkFactor(
            slots=jnp.asarray(np.stack(slots)),
            sigma=jnp.asarray(_pose_sigma(links.sigma_rad[rows], links.sigma_m[rows])),
            weight=jnp.ones(len(rows)),
            measured=jnp.asarray(links.pose[rows]),
        )

    def closed_links(self) -> tuple[EdgeFactor | None, ClosureFactor | None]:
        links, inside = self._split_links()
        rows = np.flatnonzero(inside)
        if links is None or len(rows) == 0:
            return None, None
        place = {links.name[i]: k for k, i in enumerate(rows)}
        edges = EdgeFactor(
            slots=jnp.asarray(self.layout.slots("link", np.arange(len(rows)))),
            sigma=jnp.asarray(_pose_sigma(links.sigma_rad[rows], links.sigma_m[rows])),
            weight=jnp.ones(len(rows)),
            measured=jnp.asarray(links.pose[rows]),
        )
        closures = self.model.closures
        longest = max(len(closure.links) for closure in closures)
        identity = self.layout.slots("identity", np.zeros(1, int))[0]
        slots = np.tile(identity, (len(closures), longest))
        forward = np.ones((len(closures), longest))
        for i, closure in enumerate(closures):
            for k, (name, sign) in enumerate(closure.links):
                own = self.layout.slots("link", np.array([place[name]]))[0]
                slots[i, 6 * k : 6 * k + 6] = own
                forward[i, k] = sign
        sigma = _pose_sigma(
            np.array([c.sigma_rad for c in closures]), np.array([c.sigma_m for c in closures])
        )
        return edges, ClosureFactor(
            slots=jnp.asarray(slots),
            sigma=jnp.asarray(sigma),
            weight=jnp.ones(len(closures)),
            forward=jnp.asarray(forward),
        )

    def priors(self) -> PriorFactor | None:
        slots, expected, sigma = [], [], []
        for prior in self.model.priors:
            kind, name, quantity = prior.parameter.split(".")
            bodies = {"cameras": self.model.cameras, "stations": self.model.stations}
            body = [b.name for b in bodies.get(kind, self.model.targets)].index(name)
            width = len(prior.value)
            if kind == "cameras":
                table = "station_from_camera" if quantity == "pose" else quantity
                rows = np.array([body])
            else:
                of_body = self.station_row if kind == "stations" else self.target_row
                table = "world_from_station" if kind == "stations" else "world_from_target"
                rows = np.unique(of_body[body])
            slots.append(self.layout.slots(table, rows, width).ravel())
            expected.append(np.tile(prior.value, len(rows)))
            sigma.append(np.tile(prior.sigma, len(rows)))
        if not slots:
            return None
        flat = np.concatenate(slots)
        return PriorFactor(
            slots=jnp.asarray(flat[:, None]),
            sigma=jnp.asarray(np.concatenate(sigma)[:, None]),
            weight=jnp.ones(len(flat)),
            expected=jnp.asarray(np.concatenate(expected)),
        )


def _pose_sigma(sigma_rad: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
    return np.concatenate(
        [np.repeat(sigma_rad[:, None], 3, axis=1), np.repeat(sigma_m[:, None], 3, axis=1)], axis=1
    )


def _relaid(network: Network, old: Layout, new: Layout) -> Network:
    """The network for a state whose effect tables changed in size: slots behind them move."""
    moved = new.offset("identity") - old.offset("identity")

    def shift(slots):
        return jnp.where(slots >= old.offset("identity"), slots + moved, slots)

    for name in ("links", "closures"):
        factor = getattr(network, name)
        if factor is not None:
            network = eqx.tree_at(
                lambda n, name=name: getattr(n, name).slots, network, shift(factor.slots)
            )
    return replace(network, layout=new)


def _unknowns(scene: Scene) -> Unknowns:
    """Free parameters of the engineer's model, plus all amplitudes and refinable constants."""
    model, layout = scene.model, scene.network.layout
    n_epochs = len(scene.recording.time)
    free = np.zeros(layout.size, bool)
    tie = np.arange(layout.size)
    factor = np.ones(layout.size)
    label = [""] * layout.size
    by_epoch, by_point = np.full(layout.size, -1), np.full(layout.size, -1)

    def release(slots, names):
        free[slots] = True
        for slot, name in zip(np.ravel(slots), names, strict=True):
            label[slot] = name

    pose_parts = [f"turn {a}" for a in "xyz"] + [f"shift {a}" for a in "xyz"]
    for i, camera in enumerate(model.cameras):
        own = np.array([i])
        focal = layout.slots("focal", own)[0]
        if "focal" in camera.free:
            release(focal, [f"camera {camera.name}: focal {a}" for a in "xy"])
        if "aspect-locked-focal" in camera.free:
            release(focal, [f"camera {camera.name}: focal"] * 2)
            tie[focal[1]] = focal[0]
            ratio = np.asarray(scene.state.focal[i])
            factor[focal[1]] = ratio[1] / ratio[0]
        if "centre" in camera.free:
            slots = layout.slots("centre", own)[0]
            release(slots, [f"camera {camera.name}: centre {a}" for a in "xy"])
        n = lens_family(camera.lens).n_coefficients
        if "distortion" in camera.free and n:
            slots = layout.slots("distortion", own, n)[0]
            release(slots, [f"camera {camera.name}: distortion {k + 1}" for k in range(n)])
        if "pose" in camera.free:
            slots = layout.slots("station_from_camera", own)[0]
            release(slots, [f"camera {camera.name} in its station: {p}" for p in pose_parts])

    ids = scene.recording.epoch_ids
    bodies = [
        ("station", model.stations, scene.station_row, "world_from_station"),
        ("target", model.targets, scene.target_row, "world_from_target"),
    ]
    for kind, of_kind, rows, table in bodies:
        for i, body in enumerate(of_kind):
            if "pose" not in body.free:
                continue
            moving = body.motion == "per-epoch"
            seen = _epochs_seen(scene, kind, i)
            for epoch in range(n_epochs) if moving else (0,):
                if moving and not seen[epoch]:
                    continue
                slots = layout.slots(table, rows[i, epoch : epoch + 1])[0]
                when = f" at epoch {ids[epoch]}" if moving else ""
                release(slots, [f"{kind} {body.name}{when}: {p}" for p in pose_parts])
                if moving:
                    by_epoch[slots] = epoch
    for i, target in enumerate(model.targets):
        if "points" in target.free:
            rows = np.arange(scene.first_point[i], scene.first_point[i + 1])
            slots = layout.slots("point", rows)
            names = [f"point {p} of target {target.name}: {a}" for p in target.point_names
                     for a in "xyz"]  # fmt: skip
            release(slots, names)
            by_point[slots] = rows[:, None]
    for i, finder in enumerate(model.rangefinders):
        if "pose" in finder.free:
            slots = layout.slots("station_from_rangefinder", np.array([i]))[0]
            release(slots, [f"rangefinder {finder.name}: {p}" for p in pose_parts])
    links = layout.all("link")
    release(links, [f"link {k // 6}: {pose_parts[k % 6]}" for k in range(len(links))])
    idle = _release_effects(scene, layout, release, factor)
    group = local_groups(layout, {"epochs": by_epoch, "points": by_point}, free)
    momentary = np.flatnonzero(free & (by_epoch >= 0))
    return arrange(free, group, tie, factor, tuple(label), idle, momentary)


def _release_effects(scene: Scene, layout: Layout, release, factor) -> np.ndarray:
    """Give every column and constant an unknown; returns the positions that stay idle.

    Spare columns and constants that can't be refined have an unknown too, so that the sizes of a
    problem depend on the room for effects and not on the effects.
    """
    amplitude, constant = layout.all("amplitude"), layout.all("constant")[:-1]
    release(amplitude, ["spare amplitude"] * len(amplitude))
    release(constant, ["spare constant"] * len(constant))
    busy = np.zeros(layout.size, bool)
    column, first = 0, 0
    for effect in scene.effects:
        form = FORMS[effect.form]
        n, m = effect.n_columns, len(effect.constants)
        release(amplitude[column : column + n], [f"{effect.name}: amplitude"] * n)
        release(
            constant[first : first + m],
            [f"{effect.name}: {form.constants[k].name}" for k in range(m)],
        )
        busy[amplitude[column : column + n]] = True
        refined = [first + k for k in range(m) if form.constants[k].refined]
        busy[constant[refined]] = True
        column, first = column + n, first + m
    # The unknown of a constant is its relative change.
    factor[constant] = np.asarray(scene.state.constant)[:-1]
    slots = np.concatenate([amplitude, constant])
    return slots[~busy[slots]]


def _epochs_seen(scene: Scene, kind: str, number: int) -> np.ndarray:
    """Epochs in which a moving body is touched by any observation."""
    obs, model = scene.recording.observations, scene.model
    seen = np.zeros(len(scene.recording.time), bool)
    names = [s.name for s in model.stations]
    station_of = np.array([names.index(c.station) for c in model.cameras])
    own = obs.target == number if kind == "target" else station_of[obs.camera] == number
    seen[obs.epoch[own]] = True
    links = scene.recording.links
    if links is not None:
        for nodes in (links.from_node, links.to_node):
            for node, epoch in zip(nodes, links.epoch, strict=True):
                if node == (kind, number):
                    seen[max(epoch, 0)] = True
    return seen


def _bind(scene: Scene) -> Scene:
    """Compute the patterns of the effects over the tables, at the present geometry."""
    network = scene.network
    n_columns = network.effects.n_columns
    pixels = []
    for factor, rows in zip(network.pixels, scene.tables, strict=True):
        patterns = np.zeros((factor.slots.shape[0], n_columns))
        if scene.effects:
            drivers = observation_driver_table(scene, factor, rows)
            column = 0
            for effect in scene.effects:
                inside = in_scope(scene, effect.scope, rows)
                for term in effect.terms:
                    n = len(FORMS[effect.form].bases)
                    own = np.asarray(pattern(term, drivers))[: len(rows)] * inside
                    patterns[: len(rows), column : column + n] = own[:, None]
                    column += n
        pixels.append(eqx.tree_at(lambda f: f.pattern, factor, jnp.asarray(patterns)))
    network = eqx.tree_at(lambda n: n.pixels, network, tuple(pixels))
    if network.ranges is not None:
        patterns = np.zeros((len(network.ranges.epoch), n_columns))
        column = 0
        for effect in scene.effects:
            inside = ranges_in_scope(scene, effect.scope)
            for term in effect.terms:
                n = len(FORMS[effect.form].bases)
                # A pattern over the image says nothing about a rangefinder's beam.
                patterns[:, column : column + n] = (inside * (term.driver == "one"))[:, None]
                column += n
        network = eqx.tree_at(lambda n: n.ranges.pattern, network, jnp.asarray(patterns))
    return replace(scene, network=_with_amplitude_priors(scene, network))


def _with_amplitude_priors(scene: Scene, network: Network) -> Network:
    """Priors that keep every amplitude of physical size, so that none is undetermined.

    The width is the largest plausible perturbation of the port over the largest value that the
    column takes; against any real evidence it weighs nothing.
    """
    n_columns = network.effects.n_columns
    given = _Index(scene).priors()
    if n_columns == 0:
        return replace(network, priors=given)
    reach = np.zeros(n_columns)
    tables = [*network.pixels, *([] if network.ranges is None else [network.ranges])]
    for factor in tables:
        reach = np.maximum(reach, np.abs(np.asarray(factor.pattern)).max(axis=0, initial=0.0))
    own = np.asarray(_courses(network.effects, scene.state.constant, network.channels))
    reach = reach * np.abs(own).max(axis=1)
    largest = np.abs(np.asarray(network.effects.ports)).T > 0
    limit = np.where(largest, np.array([port.largest for port in PORTS])[:, None], 0.0).max(axis=0)
    used = (reach > 0) & (limit > 0)
    slots = network.layout.all("amplitude")
    sigma = np.where(used, limit, 1.0) / np.where(used, reach, 1.0)
    own_priors = PriorFactor(
        slots=jnp.asarray(slots[:, None]),
        sigma=jnp.asarray(sigma[:, None]),
        weight=jnp.asarray(used, float),
        expected=jnp.zeros(n_columns),
    )
    if given is None:
        return replace(network, priors=own_priors)
    both = jax.tree.map(lambda a, b: jnp.asarray(np.concatenate([a, b])), given, own_priors)
    return replace(network, priors=both)


_courses = eqx.filter_jit(courses)


def observation_driver_table(scene: Scene, factor: PixelFactor, rows: np.ndarray):
    """Observation-like drivers of a pixel table at the scene's present state."""
    sizes = np.array([c.image_size for c in scene.model.cameras], float)
    padded = np.append(rows, np.full(factor.slots.shape[0] - len(rows), rows[-1]))
    size = jnp.asarray(sizes[scene.recording.observations.camera[padded]])
    up = jnp.asarray(scene.model.up, float)
    return _driver_table(factor, scene.state.flatten(), size, up)


@eqx.filter_jit
def _driver_table(factor: PixelFactor, flat, size, up):
    own = parts_of(factor, flat)
    plain = jax.vmap(lambda o, at: factor.local(o, at, PortValues()) + at.pixel)
    predicted = plain(own, factor.circumstances)
    return all_observation_drivers(Sight(*own), factor.circumstances, predicted, size, up)


def in_scope(scene: Scene, scope: Scope, rows: np.ndarray) -> np.ndarray:
    """1.0 for the observations (rows of the recording) that a scope touches."""
    obs, model = scene.recording.observations, scene.model
    if scope.rangefinder:
        return np.zeros(len(rows))
    camera_ok = np.array(
        [
            (not scope.camera or c.name in scope.camera)
            and (not scope.station or c.station in scope.station)
            for c in model.cameras
        ]
    )
    target_ok = np.array([not scope.target or t.name in scope.target for t in model.targets])
    inside = camera_ok[obs.camera[rows]] & target_ok[obs.target[rows]]
    if scope.point:
        names = np.concatenate([np.array(t.point_names, object) for t in model.targets])
        mine = np.isin(names.astype(str), scope.point)
        inside &= mine[scene.first_point[obs.target[rows]] + obs.point[rows]]
    return inside.astype(float)


def ranges_in_scope(scene: Scene, scope: Scope) -> np.ndarray:
    """1.0 for the ranges that a scope touches."""
    ranges, model = scene.recording.ranges, scene.model
    if ranges is None or scope.camera or scope.point:
        return np.zeros(0 if ranges is None else len(ranges.epoch))
    finder_ok = np.array(
        [
            (not scope.rangefinder or r.name in scope.rangefinder)
            and (not scope.station or r.station in scope.station)
            for r in model.rangefinders
        ]
    )
    target_ok = np.array([not scope.target or t.name in scope.target for t in model.targets])
    return (finder_ok[ranges.rangefinder] & target_ok[ranges.target]).astype(float)
