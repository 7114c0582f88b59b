"""The tables of a network: names and indices of a recording become slots of the flat state."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxvm.geometry.lenses import lens_family
from jaxvm.geometry.targets import checker
from jaxvm.network.factors import (
    ClosureFactor,
    EdgeFactor,
    LinkFactor,
    PixelFactor,
    PriorFactor,
    RangeFactor,
)
from jaxvm.network.tiles import Tiles
from jaxvm.network.unknowns import placed_epochs
from jaxvm.physics.blocks import rounded
from jaxvm.physics.chain import Circumstances

if TYPE_CHECKING:
    from jaxvm.network.scene import Scene


class Tables:
    """Turns the names and indices of a recording into slots of the flat state."""

    def __init__(self, scene: Scene):
        self.scene = scene
        self.recording = scene.recording
        self.model = scene.model
        self.layout = scene.network.layout
        self.channels = scene.network.channels
        self.station_row = scene.station_row
        self.target_row = scene.target_row
        self.first_point = scene.first_point
        places = scene.station_places
        self.station_of = np.array([places[c.station] for c in self.model.cameras], int)
        self.station_of_finder = np.array([places[r.station] for r in self.model.rangefinders], int)

    @cached_property
    def _extent(self) -> tuple[np.ndarray, np.ndarray]:
        """Middle and half size of all targets (m); along z the middle of a plate is its plane.

        Marks on posts stand off the plane z = 0, and the plate grows where it is.
        """
        # A target whose marks are unknown has no middle and no size yet.
        points = [
            t.points if np.isfinite(t.points).all() else np.zeros((1, 3))
            for t in self.model.targets
        ]
        low, high = (np.array([end(p, axis=0) for p in points]) for end in (np.min, np.max))
        half = 0.5 * (high - low)[:, :2]
        middle = 0.5 * (low + high)
        middle[:, 2] = np.clip(0.0, low[:, 2], high[:, 2])
        return middle, np.where(half > 0, half, 1.0)

    @cached_property
    def _checker(self) -> np.ndarray:
        """+1 and -1 in turn over the marks of grids, one target after the other."""
        # Many targets of a network are alike.
        known: dict[bytes, np.ndarray] = {}
        parts = [np.zeros(0)]
        for target in self.model.targets:
            key = target.points.tobytes()
            if key not in known:
                known[key] = checker(target.points)
            parts.append(known[key])
        return np.concatenate(parts)

    @cached_property
    def along_beam(self) -> np.ndarray:
        """Place of each camera along the beam of its station."""
        mounted = np.asarray(self.scene.state.station_from_camera)
        return along_beam(self.station_of, mounted[:, 3:])

    def circumstances(self, epoch, target, point, pixel, height, along_beam) -> Circumstances:
        velocity = np.zeros((len(epoch), 6))
        for name, values in self.recording.velocities.items():
            own = target == [t.name for t in self.model.targets].index(name)
            velocity[own] = values[epoch[own]]
        return Circumstances(
            *map(
                jnp.asarray,
                (
                    pixel,
                    height,
                    self._extent[0][target],
                    self._extent[1][target],
                    self._checker[point],
                    point.astype(float),
                    epoch.astype(float),
                    along_beam,
                    velocity,
                ),
            )
        )

    def pixel_tables(self):
        """One table for each family of lenses; rows sorted so that equal slots are neighbours."""
        obs = self.recording.observations
        lenses = [c.lens for c in self.model.cameras]
        tables, factors = [], []
        up_x, up_y, up_z = map(float, self.model.up)
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
            chosen = _padded(chosen)
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
                self._carriers(target, epoch),
                self.layout.slots("carrier_from_target", self.target_row[target, epoch]),
                self.layout.slots("point", point),
            ]
            height = np.array([c.image_size[1] for c in self.model.cameras], float)[camera]
            sigma = np.repeat(obs.sigma[chosen][:, None], 2, axis=1)
            *shared, _ = slots
            factors.append(
                PixelFactor(
                    family=family,
                    up=(up_x, up_y, up_z),
                    slots=jnp.asarray(np.concatenate(slots, axis=1)),
                    sigma=jnp.asarray(sigma),
                    weight=jnp.asarray(np.arange(len(chosen)) < real, float),
                    real=jnp.asarray(real),
                    circumstances=self.circumstances(
                        epoch, target, point, obs.pixel[chosen], height, self.along_beam[camera]
                    ),
                    view=jnp.asarray(self.channels.view(camera, epoch)),
                    pattern=jnp.zeros((len(chosen), 0)),
                    tiles=Tiles.of(np.concatenate(shared, axis=1)),
                )
            )
        return tuple(tables), tuple(factors)

    def ranges(self) -> RangeFactor | None:
        ranges = self.recording.ranges
        if ranges is None or len(ranges.epoch) == 0:
            return None
        real = len(ranges.epoch)
        chosen = _padded(np.arange(real))
        n, epoch, target = len(chosen), ranges.epoch[chosen], ranges.target[chosen]
        finder, mark = ranges.rangefinder[chosen], ranges.point[chosen]
        point = self.first_point[target] + np.maximum(mark, 0)
        station = self.station_of_finder[finder]
        slots = [
            self.layout.slots("station_from_rangefinder", finder),
            self.layout.slots("world_from_station", self.station_row[station, epoch]),
            self._carriers(target, epoch),
            self.layout.slots("carrier_from_target", self.target_row[target, epoch]),
            self.layout.slots("point", point),
        ]
        placed = self._placed(station, target, epoch) & (np.arange(n) < real)
        return RangeFactor(
            real=jnp.asarray(real),
            slots=jnp.asarray(np.concatenate(slots, axis=1)),
            sigma=jnp.asarray(ranges.sigma[chosen, None]),
            weight=jnp.asarray(placed, float),
            circumstances=self.circumstances(
                epoch, target, point, np.zeros((n, 2)), np.ones(n), np.full(n, np.nan)
            ),
            to_plane=jnp.asarray(mark < 0, float),
            measured=jnp.asarray(ranges.distance[chosen]),
            view=jnp.asarray(self.channels.view(0, epoch)),
            pattern=jnp.zeros((n, 0)),
        )

    def _placed(self, station, target, epoch) -> np.ndarray:
        """Which ranges have an instrument and a target that are somewhere (`placed_epochs`)."""
        placed, places = placed_epochs(self.scene), self.scene.station_places
        # What the world carries is where it is.
        stations = np.concatenate(
            [placed["station"], np.ones((1, placed["station"].shape[1]), bool)]
        )
        carrier = np.array([places.get(t.station, -1) for t in self.model.targets], int)[target]
        return stations[station, epoch] & stations[carrier, epoch] & placed["target"][target, epoch]

    def _carriers(self, target, epoch) -> np.ndarray:
        """Slots of what carries targets: their stations, or the world."""
        row = self.scene.carrier_rows(target, epoch)
        slots = self.layout.slots("world_from_station", np.maximum(row, 0))
        world = self.layout.slots("identity", np.zeros(1, int))
        return np.where(row[:, None] < 0, world, slots)

    def _nodes(self, nodes: list[tuple[str, int]], epoch: np.ndarray) -> np.ndarray:
        """Slots of nodes: carrier, then body on the carrier."""
        kind = np.array([kind for kind, _ in nodes], object)
        number = np.array([number for _, number in nodes], int)
        epoch = np.maximum(epoch, 0)
        slots = np.tile(self.layout.slots("identity", np.zeros(1, int)), (len(nodes), 2))
        for name in ("camera", "station", "target"):
            own = np.flatnonzero(kind == name)
            which, when = number[own], epoch[own]
            if name == "station":
                row = self.station_row[which, when]
                slots[own, :6] = self.layout.slots("world_from_station", row)
            elif name == "camera":
                row = self.station_row[self.station_of[which], when]
                slots[own, :6] = self.layout.slots("world_from_station", row)
                slots[own, 6:] = self.layout.slots("station_from_camera", which)
            else:
                slots[own, :6] = self._carriers(which, when)
                slots[own, 6:] = self.layout.slots(
                    "carrier_from_target", self.target_row[which, when]
                )
        return slots

    def _split_links(self):
        links = self.recording.links
        closed = {name for closure in self.model.closures for name, _ in closure.links}
        inside = [] if links is None else [name in closed for name in links.name]
        return links, np.array(inside, bool)

    def links(self) -> LinkFactor | None:
        """Every link joins its bodies. Links of a closure are adjusted on their own, too."""
        links = self.recording.links
        if links is None or len(links.name) == 0:
            return None
        ends = [self._nodes(nodes, links.epoch) for nodes in (links.from_node, links.to_node)]
        identity = self.layout.slots("identity", np.zeros(1, int))
        if all((slots[:, 6:] == identity).all() for slots in ends):
            ends = [slots[:, :6] for slots in ends]
        return LinkFactor(
            slots=jnp.asarray(np.concatenate(ends, axis=1)),
            sigma=jnp.ones((len(links.name), 6)),
            weight=jnp.ones(len(links.name)),
            measured=jnp.asarray(links.pose),
            root=jnp.asarray(information_root(links.covariance)),
        )

    def closed_links(self) -> tuple[EdgeFactor | None, ClosureFactor | None]:
        links, inside = self._split_links()
        rows = np.flatnonzero(inside)
        if links is None or len(rows) == 0:
            return None, None
        place = {links.name[i]: k for k, i in enumerate(rows)}
        edges = EdgeFactor(
            slots=jnp.asarray(self.layout.slots("link", np.arange(len(rows)))),
            sigma=jnp.ones((len(rows), 6)),
            weight=jnp.ones(len(rows)),
            measured=jnp.asarray(links.pose[rows]),
            root=jnp.asarray(information_root(links.covariance[rows])),
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
        sigma = np.repeat([[c.sigma_rad, c.sigma_m] for c in closures], 3, axis=1)
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
            bodies = {
                "cameras": self.model.cameras,
                "stations": self.model.stations,
                "rangefinders": self.model.rangefinders,
            }
            body = [b.name for b in bodies.get(kind, self.model.targets)].index(name)
            width = len(prior.value)
            if kind == "cameras":
                table = "station_from_camera" if quantity == "pose" else quantity
                rows = np.array([body])
            elif kind == "rangefinders":
                table, rows = "station_from_rangefinder", np.array([body])
            else:
                of_body = self.station_row if kind == "stations" else self.target_row
                table = "world_from_station" if kind == "stations" else "carrier_from_target"
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


def _padded(rows: Int[np.ndarray, " real"]) -> Int[np.ndarray, " observations"]:
    """Rows of a table, the last one again and again up to a round number."""
    return np.append(rows, np.full(rounded(len(rows)) - len(rows), rows[-1]))


def information_root(covariance: Float[np.ndarray, "n 6 6"]) -> Float[np.ndarray, "n 6 6"]:
    """Upper triangles R with R^T R = C^-1."""
    flipped = np.linalg.cholesky(covariance[:, ::-1, ::-1])[:, ::-1, ::-1]
    return np.linalg.inv(flipped)


def along_beam(
    station: Int[np.ndarray, " cameras"], place: Float[np.ndarray, "cameras 3"]
) -> Float[np.ndarray, " cameras"]:
    """Place of each camera along the beam of its station, from -1 to 1 over the station's cameras.

    The beam is the direction in which the cameras stand apart most, its middle the middle between
    the outermost ones. NaN where a station has one camera, or all in one place.
    """
    found = np.full(len(station), np.nan)
    order = np.argsort(station, kind="stable")
    _, first = np.unique(station[order], return_index=True)
    for own in np.split(order, first[1:]):
        if len(own) < 2:
            continue
        apart = place[own] - place[own].mean(axis=0)
        along = apart @ np.linalg.svd(apart)[2][0]
        if np.ptp(along) > 0.0:
            found[own] = 2.0 * (along - along.min()) / np.ptp(along) - 1.0
    return found
