"""What a recording may have, but hardly on purpose: hints that forbid nothing."""

import numpy as np

from jaxvm.physics.drivers import CHANNEL_UNITS, channel_unit
from jaxvm.recording.recording import Recording

_LONG = 100.0
"""A log that is so many times as long as the epochs is suspected to be in another unit."""


def hints(recording: Recording) -> list[str]:
    """A sentence for whatever looks like a mistake and need not be one, with its mend."""
    return [*_log_of_another_unit(recording), *_channels_without_unit(recording)]


def unseen_epochs(recording: Recording) -> int:
    """How many epochs have no image point."""
    return len(recording.time) - len(np.unique(recording.observations.epoch))


def _log_of_another_unit(recording: Recording) -> list[str]:
    drivers, time = recording.drivers, recording.time
    if drivers is None or len(time) < 2:
        return []
    log, epochs = (float(t[-1] - t[0]) for t in (drivers.time, time))
    if log <= _LONG * epochs:
        return []
    return [
        f"drivers run for {log / 3600.0:.4g} h, epochs for {epochs / 3600.0:.4g} h; t is in "
        "seconds in both: divide that of the drivers by 1000 if it is in milliseconds"
    ]


def _channels_without_unit(recording: Recording) -> list[str]:
    channels = () if recording.drivers is None else recording.drivers.channels
    without = [name for name in channels if channel_unit(name) is None]
    if not without:
        return []
    return [
        f"drivers have no unit at the end of {', '.join(without)}, and what has no unit names no "
        f"physics; rename them, {without[0]}_degC for instance ({', '.join(CHANNEL_UNITS)})"
    ]
