"""Join recordings of the same cameras and bodies into one, to be diagnosed together."""

from dataclasses import replace

import numpy as np

from jaxvm.recording.model import Model, other_bodies
from jaxvm.recording.recording import Drivers, Links, Observations, Ranges, Recording

PAUSE_S = 86_400.0
"""Pause (s) between two recordings whose clocks overlap: long enough for lags to settle."""


def join(first: Recording, second: Recording) -> Recording:
    """Both recordings as one with two sessions.

    Cameras, rangefinders and bodies of one name are the same; what is static stayed where it was,
    what moves per epoch goes on. The second recording may have further cameras after those of the
    first, and further stations; it keeps its clock where that is later, and follows after a pause
    otherwise. Of the drivers, those that both have are kept; a link that both
    have counts once. That there were two sessions is not kept in a file.

    Raises:
        ValueError: the recordings have other cameras, stations, targets, marks or rangefinders, or
            a further station is posed in each epoch.
    """
    model = _common(first.model, second.model)
    n = len(first.time)
    ends = first.time[-1] if first.drivers is None else max(first.time[-1], first.drivers.time[-1])
    begins = second.time[0]
    if second.drivers is not None:
        begins = min(begins, second.drivers.time[0])
    later = 0.0 if begins > ends else ends + PAUSE_S - begins
    # A further camera was never on before.
    before = {camera.name: camera.powered_on_s for camera in first.model.cameras}
    cameras = tuple(
        replace(
            camera,
            powered_on_s=tuple(
                sorted({*before.get(camera.name, ()), *(m + later for m in other.powered_on_s)})
            ),
        )
        for camera, other in zip(model.cameras, second.model.cameras, strict=True)
    )
    velocities = {
        name: np.concatenate([_velocity(first, name), _velocity(second, name)])
        for name in dict.fromkeys([*first.velocities, *second.velocities])
    }
    return Recording(
        model=replace(
            model,
            cameras=cameras,
            stations=_in_each_epoch(first, second, "stations")
            + model.stations[len(first.model.stations) :],
            targets=_in_each_epoch(first, second, "targets"),
        ),
        epoch_ids=np.concatenate(
            [first.epoch_ids, second.epoch_ids + first.epoch_ids.max() + 1 - second.epoch_ids.min()]
        ),
        time=np.concatenate([first.time, second.time + later]),
        velocities=velocities,
        observations=_stacked(Observations, first.observations, second.observations, n),
        drivers=_drivers(first, second, later),
        ranges=_stacked(Ranges, first.ranges, second.ranges, n),
        links=_links(first.links, second.links, n),
        timed=first.timed and second.timed,
        starts=(*first.starts, *(n + start for start in second.starts)),
    )


def _common(first: Model, second: Model) -> Model:
    """The first model, with the further cameras of the second one."""
    kinds = ("cameras", "stations", "targets", "rangefinders")
    n, m = len(first.cameras), len(first.stations)
    same = replace(second, cameras=second.cameras[:n], stations=second.stations[:m])
    if other := other_bodies(first, same, kinds):
        raise ValueError(
            f"the second recording can't be joined: {other}; give one of the same bodies, in the "
            "same order"
        )
    cameras, stations = second.cameras[n:], second.stations[m:]
    for station in stations:
        if station.pose is not None and station.pose.ndim > 1:
            raise ValueError(
                f'the second recording can\'t be joined: its further station "{station.name}" has '
                "a pose for each of its epochs, and none for those of the first; give it one pose"
            )
    further = tuple(f"cameras.{camera.name}." for camera in cameras)
    priors = tuple(prior for prior in second.priors if prior.parameter.startswith(further))
    return replace(
        first,
        cameras=(*first.cameras, *cameras),
        stations=(*first.stations, *stations),
        priors=(*first.priors, *priors),
    )


def _in_each_epoch(first: Recording, second: Recording, kind: str) -> tuple:
    """Bodies of the first recording, with the poses of both where they are given in each epoch."""
    bodies = []
    for a, b in zip(getattr(first.model, kind), getattr(second.model, kind), strict=False):
        if a.pose is not None and b.pose is not None and max(a.pose.ndim, b.pose.ndim) > 1:
            own, other = (
                np.broadcast_to(body.pose, (len(recording.time), 6))
                for body, recording in ((a, first), (b, second))
            )
            a = replace(a, pose=np.concatenate([own, other]))
        bodies.append(a)
    return tuple(bodies)


def _velocity(recording: Recording, name: str) -> np.ndarray:
    return recording.velocities.get(name, np.zeros((len(recording.time), 6)))


def _stacked(kind, first, second, epochs: int):
    if first is None or second is None:
        if second is None:
            return first
        return replace(second, epoch=second.epoch + epochs)
    second = replace(second, epoch=second.epoch + epochs)
    parts = {name: np.concatenate([getattr(first, name), getattr(second, name)])
             for name in vars(first)}  # fmt: skip
    return kind(**parts)


def _links(first: Links | None, second: Links | None, epochs: int) -> Links | None:
    if first is None or second is None:
        return first if second is None else _later(second, epochs)
    new = [k for k, name in enumerate(second.name) if name not in first.name]
    more = _later(second, epochs)
    return Links(
        name=(*first.name, *(more.name[k] for k in new)),
        from_node=[*first.from_node, *(more.from_node[k] for k in new)],
        to_node=[*first.to_node, *(more.to_node[k] for k in new)],
        pose=np.concatenate([first.pose, more.pose[new]]),
        covariance=np.concatenate([first.covariance, more.covariance[new]]),
        epoch=np.concatenate([first.epoch, more.epoch[new]]),
    )


def _later(links: Links, epochs: int) -> Links:
    return replace(links, epoch=np.where(links.epoch < 0, -1, links.epoch + epochs))


def _drivers(first: Recording, second: Recording, later: float) -> Drivers | None:
    if first.drivers is None or second.drivers is None:
        return None
    a, b = first.drivers, second.drivers
    names = [name for name in a.channels if name in b.channels]
    return Drivers(
        np.concatenate([a.time, b.time + later]),
        {name: np.concatenate([a.channels[name], b.channels[name]]) for name in names},
    )
