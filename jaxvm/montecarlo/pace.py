"""How many trials at a time: found by measuring, on trials that count.

Whether a batch fits the cache depends on the machine and on the program; so larger and larger ones
are tried until they gain nothing more, where what is left to do pays for compiling them and memory
holds them. The first is the smaller, the more numbers a trial has.
"""

import resource
from pathlib import Path

import jax

_FIRST, _FACTOR = 64, 4
_FIRST_ON_ACCELERATORS = 4096
"""A batch of an accelerator takes as long as one of a single trial until it is full."""

_CACHED, _SHARE_OF_ROOM = 16e6, 0.02
"""Bytes of a study's own numbers, times the trials of its first batch: what a processor's cache
holds, and a share of the memory that is free, for what trials compute is many times as much."""

_LARGEST = 1 << 16
_GAIN = 1.05
"""A larger batch is worth its memory when it is so many times as fast."""

_WORTH = 5.0
"""So many times what the last program took to compile must be left to do."""


class Pace:
    """Chooses the size of the next batch.

    Attributes:
        batch: trials of the next batch; a multiple of the devices.
        found: whether it stays what it is.
    """

    def __init__(
        self, batch: int | None, devices: int = 1, trials: int = _LARGEST, own_bytes: int = 0
    ):
        """`batch` fixes it; None lets it be found, with so many bytes of numbers for each trial."""
        self._devices = devices
        self.found = batch is not None
        on_host = jax.default_backend() == "cpu"
        begin = _FIRST if on_host else _FIRST_ON_ACCELERATORS
        bound = min(_SHARE_OF_ROOM * _room(), _CACHED if on_host else float("inf"))
        if own_bytes * begin > bound:
            begin = max(int(bound / own_bytes), 1)
        first = min(begin * devices, max(trials, 1))
        self.batch = self._whole(first if batch is None else batch)
        self._seconds: dict[int, float] = {}  # of a trial, the best of each size
        self._before, self._compiling = 0, 0.0
        self._memory = _peak()

    def note(self, seconds: float, compiling: float, left: int) -> None:
        """Learn what the last batch took, and choose the next one for what is left to do."""
        if self.found:
            return
        own = max(seconds - compiling, 1e-9) / self.batch
        fresh = self.batch not in self._seconds
        self._seconds[self.batch] = min(own, self._seconds.get(self.batch, own))
        if fresh:
            # The first run of a program warms up; the second one counts.
            self._compiling = compiling
            return
        if self._before and self._seconds[self.batch] * _GAIN > self._seconds[self._before]:
            self.batch, self.found = self._before, True
            return
        larger = self._whole(self.batch * _FACTOR)
        grown = _FACTOR * max(_peak() - self._memory, 0)
        cheap = left * self._seconds[self.batch] > _WORTH * self._compiling
        if larger > _LARGEST or 2 * larger > left or not cheap or grown > 0.5 * _room():
            self.found = True
            return
        self._before, self.batch = self.batch, larger

    def _whole(self, batch: int) -> int:
        return -(-batch // self._devices) * self._devices


def _peak() -> int:
    """Most bytes that the device (or this process, where the device is the processor) has used."""
    statistics = jax.local_devices()[0].memory_stats()
    if statistics is not None and "peak_bytes_in_use" in statistics:
        return statistics["peak_bytes_in_use"]
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _room() -> float:
    """Bytes that are still free there; endless where nobody tells."""
    statistics = jax.local_devices()[0].memory_stats()
    if statistics is not None and "bytes_limit" in statistics:
        return statistics["bytes_limit"] - statistics["bytes_in_use"]
    told = Path("/proc/meminfo")
    if not told.exists():
        return float("inf")
    free = next(line for line in told.read_text().splitlines() if line.startswith("MemAvailable"))
    return 1024.0 * int(free.split()[1])
