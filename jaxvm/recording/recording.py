"""A recording in memory: the engineer's model and the measurements, names turned into indices."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxvm.physics.drivers import build_channels
from jaxvm.physics.effects import Channels
from jaxvm.recording.model import Model, of_epochs


@dataclass(frozen=True, eq=False)
class Observations:
    """Points of targets in images.

    Attributes:
        epoch: row of the recording's epochs.
        camera, target: place in the model's cameras and targets.
        point: place in the target's points.
        pixel: u, v (px); (0, 0) is the centre of the top-left pixel.
        sigma: standard deviation of u and of v (px).
    """

    epoch: Int[np.ndarray, " n"]
    camera: Int[np.ndarray, " n"]
    target: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    pixel: Float[np.ndarray, "n 2"]
    sigma: Float[np.ndarray, " n"]


def no_observations() -> Observations:
    """The empty table of a network that is given by links alone."""
    none = np.zeros(0, int)
    return Observations(none, none, none, none, np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Drivers:
    """Logged channels, sampled at their own times (s, clock of the epochs)."""

    time: Float[np.ndarray, " samples"]
    channels: dict[str, Float[np.ndarray, " samples"]]


@dataclass(frozen=True, eq=False)
class Ranges:
    """Distances (m) from rangefinders to a point, or to the plane z = 0 of a target (point -1)."""

    epoch: Int[np.ndarray, " n"]
    rangefinder: Int[np.ndarray, " n"]
    target: Int[np.ndarray, " n"]
    point: Int[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class Links:
    """Relative poses that were measured or calibrated.

    Attributes:
        from_node, to_node: ("camera" | "station" | "target", place in the model).
        pose: from_from_to as turn (rad) and shift (m).
        covariance: of the twist log(measured^-1 . true), turn (rad) then shift (m), in to's axes.
        epoch: row of the recording's epochs; -1 where the link belongs to none.
    """

    name: tuple[str, ...]
    from_node: list[tuple[str, int]]
    to_node: list[tuple[str, int]]
    pose: Float[np.ndarray, "n 6"]
    covariance: Float[np.ndarray, "n 6 6"]
    epoch: Int[np.ndarray, " n"]

    @property
    def sigma(self) -> Float[np.ndarray, "n 6"]:
        """Standard deviations of turn (rad) and shift (m)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def uncorrelated(
    sigma_rad: Float[np.ndarray, " n"], sigma_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 6 6"]:
    """Covariances of links whose turns (rad) and shifts (m) are equally good in all directions."""
    variance = np.repeat(np.stack([sigma_rad, sigma_m], axis=1) ** 2, 3, axis=1)
    return variance[:, :, None] * np.eye(6)


@dataclass(frozen=True, eq=False)
class Recording:
    """The engineer's model and everything that was measured.

    Attributes:
        epoch_ids: the epochs' own numbers, as in epochs.csv.
        time: of the epochs (s), strictly increasing; their order where no clock was recorded.
        velocities: by target, velocity of its origin (m/s) and angular rate (rad/s), world axes.
        timed: whether `time` was recorded; otherwise only the order of the epochs is known.
        starts: first epoch of each session; several where recordings were joined.
    """

    model: Model
    epoch_ids: Int[np.ndarray, " epochs"]
    time: Float[np.ndarray, " epochs"]
    velocities: dict[str, Float[np.ndarray, "epochs 6"]]
    observations: Observations
    drivers: Drivers | None = None
    ranges: Ranges | None = None
    links: Links | None = None
    timed: bool = True
    starts: tuple[int, ...] = (0,)

    def channels(self) -> Channels:
        """What effects may follow in time: the recorded channels, and those made of them."""
        model = self.model
        return build_channels(
            self.time,
            {} if self.drivers is None else self.drivers.channels,
            None if self.drivers is None else self.drivers.time,
            {c.name: c.powered_on_s for c in model.cameras if c.powered_on_s},
            self.timed,
            self.time[list(self.starts)],
            tuple(camera.name for camera in model.cameras),
        )

    def select_epochs(self, mask: Bool[np.ndarray, " epochs"]) -> "Recording":
        """The same recording with the epochs where `mask` is true.

        Drivers keep all their samples. Links of other epochs go, and closures through them.

        Raises:
            ValueError: the mask is not one boolean for each epoch, or selects none.
        """
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != self.time.shape:
            raise ValueError(
                f"the mask has shape {mask.shape} and type {mask.dtype}; "
                f"it needs one bool for each of the {len(self.time)} epochs"
            )
        if not mask.any():
            raise ValueError("the mask selects no epoch; set at least one entry")
        row = np.where(mask, np.cumsum(mask) - 1, -1)
        links, model = self.links, of_epochs(self.model, mask)
        if links is not None:
            kept = (links.epoch < 0) | mask[np.maximum(links.epoch, 0)]
            lost = {name for name, keep in zip(links.name, kept, strict=True) if not keep}
            links = _of_rows(links, kept, row)
            closures = tuple(
                c for c in model.closures if not any(name in lost for name, _ in c.links)
            )
            model = replace(model, closures=closures)
        return replace(
            self,
            model=model,
            epoch_ids=self.epoch_ids[mask],
            time=self.time[mask],
            observations=_of_rows(self.observations, mask[self.observations.epoch], row),
            velocities={name: values[mask] for name, values in self.velocities.items()},
            ranges=None
            if self.ranges is None
            else _of_rows(self.ranges, mask[self.ranges.epoch], row),
            links=links,
            starts=tuple(sorted({int(np.sum(mask[:start])) for start in self.starts
                                 if mask[start:].any()})),
        )  # fmt: skip


def _of_rows(table, kept: np.ndarray, row: np.ndarray):
    """The kept rows of a table, with epochs renumbered."""
    parts = {}
    for name, values in vars(table).items():
        if isinstance(values, np.ndarray):
            parts[name] = values[kept]
        else:
            parts[name] = type(values)(v for v, keep in zip(values, kept, strict=True) if keep)
    parts["epoch"] = np.where(parts["epoch"] < 0, -1, row[parts["epoch"]])
    return type(table)(**parts)
