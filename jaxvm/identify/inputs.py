"""Inputs of a drift model: what a recording logs, on one grid of times, and what is wrong."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxvm.physics.drivers import POWER_ON, channel_kind, since
from jaxvm.recording import Recording

RANGES = {
    "temperature": 10.0,
    "humidity": 30.0,
    "pressure": 30.0,
    "irradiance": 500.0,
    "wind": 5.0,
    "gradient": 1.0,
    "exposure": 10.0,
    "frame rate": 20.0,
    "light": 1000.0,
}
"""Change of a quantity, by its kind, that may move a camera by a large drift."""

_STUCK = 10
"""Readings in a row that are the same while a sensor of the same kind moves: one that hangs."""

_GAP = 5.0
"""A pause in the log of so many usual intervals is a gap."""


@dataclass(frozen=True, eq=False)
class Inputs:
    """Courses that drive a camera.

    Attributes:
        names: of the inputs; `POWER_ON` and a camera for the time since its power-on (s).
        time: grid (s) of the log and the epochs together.
        values: one row an input, linear between the samples of the log.
        epoch: place of every epoch on the grid.
        warnings: what is wrong with the log, in words.
    """

    names: tuple[str, ...]
    time: Float[np.ndarray, " times"]
    values: Float[np.ndarray, "inputs times"]
    epoch: np.ndarray
    warnings: tuple[str, ...] = ()

    def row(self, name: str) -> Float[np.ndarray, " times"]:
        """Course of one input.

        Raises:
            ValueError: there is none of this name.
        """
        if name not in self.names:
            raise ValueError(
                f'the model is driven by "{name}", which this recording does not have '
                f"(it has: {', '.join(self.names) or 'nothing'}); log it, or identify a model anew"
            )
        return self.values[self.names.index(name)]

    @property
    def reference(self) -> Float[np.ndarray, " inputs"]:
        """Mean of every input over the epochs, from which it is counted; 0 for power."""
        return np.where(are_power(self.names), 0.0, self.values[:, self.epoch].mean(axis=1))

    def ranges(self) -> Float[np.ndarray, " inputs"]:
        """Change of every input that may bring a large drift, in its unit; 1 for power."""
        found = []
        for name, values in zip(self.names, self.values, strict=True):
            usual = RANGES.get(channel_kind(name), float(np.ptp(values[self.epoch])) or 1.0)
            found.append(usual)
        return np.where(are_power(self.names), 1.0, found)

    def only(self, names: tuple[str, ...]) -> "Inputs":
        """The inputs of these names, in their order."""
        return replace(self, names=names, values=np.stack([self.row(name) for name in names]))


def are_power(names: Sequence[str]) -> Bool[np.ndarray, " inputs"]:
    """Which inputs are the time since a power-on."""
    return np.array([name.startswith(POWER_ON) for name in names], bool)


def inputs_of(recording: Recording) -> Inputs:
    """Inputs of a recording: its logged quantities and the power of its cameras.

    Raises:
        ValueError: the epochs have no times.
    """
    if not recording.timed:
        raise ValueError("the epochs have no times; add the column t to epochs.csv")
    epochs = np.asarray(recording.time)
    logged = {} if recording.drivers is None else recording.drivers.channels
    own = epochs if recording.drivers is None else recording.drivers.time
    time = np.unique(np.concatenate([own, epochs]))
    rows = {name: np.interp(time, own, values) for name, values in logged.items()}
    for camera in recording.model.cameras:
        if camera.powered_on_s:
            rows[POWER_ON + camera.name] = since(time, np.asarray(camera.powered_on_s))
    return Inputs(
        tuple(rows),
        time,
        np.array(list(rows.values())).reshape(len(rows), len(time)),
        np.searchsorted(time, epochs),
        tuple(_complaints(recording)),
    )


def _complaints(recording: Recording) -> list[str]:
    """Gaps, sensors that hang, clocks that don't fit."""
    if recording.drivers is None:
        return []
    found = []
    time, channels = recording.drivers.time, recording.drivers.channels
    spacing = np.diff(time)
    usual = float(np.median(spacing)) if len(spacing) else 0.0
    for k in np.flatnonzero(spacing > _GAP * usual):
        if time[k + 1] > recording.time[0] and time[k] < recording.time[-1]:
            found.append(
                f"drivers have a gap from {time[k]:.6g} s to {time[k + 1]:.6g} s; what is "
                "predicted there and some time constants later is doubtful"
            )
    for name, values in channels.items():
        k, length = _longest_run(values)
        others = [v for other, v in channels.items()
                  if other != name and channel_kind(other) == channel_kind(name)]  # fmt: skip
        moved = any(np.ptp(v[k : k + length]) > 0.2 * np.ptp(v) > 0.0 for v in others)
        if length >= _STUCK and np.ptp(values) > 0.0 and length > 0.2 * len(values) and moved:
            found.append(
                f"{name} stays at {values[k]:g} from {time[k]:.6g} s to "
                f"{time[k + length - 1]:.6g} s while others change; does the sensor hang?"
            )
    return found


def _longest_run(values: np.ndarray) -> tuple[int, int]:
    """First sample and length of the longest run of equal readings."""
    ends = np.flatnonzero(np.append(np.diff(values) != 0.0, True))
    starts = np.append(0, ends[:-1] + 1)
    k = int(np.argmax(ends - starts))
    return int(starts[k]), int(ends[k] - starts[k] + 1)
