"""Running a study: batches, devices, a folder that a run is resumed from, progress."""

import json
import os
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh
from jaxtyping import Bool, Int, PRNGKeyArray

from jaxvm.compiling import compile_seconds
from jaxvm.montecarlo.pace import Pace
from jaxvm.montecarlo.results import Results
from jaxvm.montecarlo.statistics import Statistics
from jaxvm.montecarlo.store import Store, versions
from jaxvm.montecarlo.trials import AXIS, Study, Traced, Trial

_FLUSH_SECONDS, _FLUSH_SHARE = 1.0, 0.02
"""Trials are written after a second, later on after a fiftieth of the time that has gone by: so
much work a kill may cost, and a long run has some hundred files."""


_SIZES: dict[str, int] = {}
"""Sizes of batches that this process has found, by what studies say of themselves."""


@dataclass(frozen=True)
class Progress:
    """How far a run has come.

    Attributes:
        done, trials, failed: trials done so far (those found in the folder too), of how many, and
            how many of them did not converge.
        rate: trials per second of this run.
        remaining: seconds that it will take at this rate.
        batch: trials at a time.
    """

    done: int
    trials: int
    failed: int
    rate: float
    remaining: float
    batch: int

    def __str__(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        return (
            f"{self.done} of {self.trials} trials{failed}, {self.rate:.3g} a second, "
            f"{_duration(self.remaining)} left"
        )


def run(
    study: Study,
    seed: int | PRNGKeyArray,
    trials: int,
    *,
    folder: str | Path | None = None,
    batch: int | None = None,
    mesh: Mesh | None = None,
    progress: Callable[[Progress], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Results:
    """Run the trials 0 to `trials` - 1 of a study.

    Trial k is the same whatever the number of trials, the batch and the devices, but for rounding.
    With more than one process (`jax.distributed`) all of them call this; the first one writes.

    Args:
        study: see `jaxvm.montecarlo.trials`.
        seed: of all randomness: a number or a key.
        trials: how many.
        folder: where trials are written; a run that was stopped or killed there goes on. Without
            it they stay in memory.
        batch: trials at a time; found by measuring if not given, once for a study in a process.
        mesh: devices to share trials out to, one axis `trials`; all there are by default.
        progress: told after each batch.
        stop: asked after each batch whether to stop. An interruption (Ctrl-C) stops, too; what is
            done is written, and returned.

    Raises:
        FileExistsError: the folder holds another study, or other files.
        ValueError: fewer than one trial or batch.
    """
    if trials < 1 or (batch is not None and batch < 1):
        raise ValueError("at least one trial, and one in a batch, are due")
    key = jax.random.key(seed) if isinstance(seed, int) else seed
    if mesh is None and jax.device_count() > 1:
        mesh = Mesh(np.array(jax.devices()), (AXIS,))
    about = {
        "study": study.about(),
        "key": np.asarray(jax.random.key_data(key)).tolist(),
        "versions": versions(),
    }
    first = jax.process_index() == 0
    store = Store(folder, about) if folder is not None and first else None
    gathered = _Gathered(store, trials)
    left = np.flatnonzero(~_agreed(gathered.there))
    asked = json.dumps([study.about(), 1 if mesh is None else mesh.size], default=str)
    known = _SIZES.get(asked, len(left) + 1)
    if batch is None:
        batch = getattr(study, "together", known if known <= len(left) else None)
    measured = batch is None
    devices = 1 if mesh is None else mesh.size
    pace = Pace(batch, devices, len(left), getattr(study, "own_bytes", 0))
    # A processor works at several batches at a time: none keeps all of its cores busy.
    cores = os.cpu_count() or 1 if mesh is None and isinstance(study, Traced) and _on_host() else 1
    began, compiled, so_far = time.perf_counter(), compile_seconds(), gathered.done
    pool, waiting, at = ThreadPoolExecutor(cores), deque[_Batch](), 0
    try:
        while at < len(left) or waiting:
            size = int(_agreed(np.array(pace.batch)))
            while at < len(left) and len(waiting) < (cores if pace.found else 1):
                numbers = left[at : at + size]
                at += len(numbers)
                # All batches have the same size; the last one repeats its last trial.
                filled = np.concatenate([numbers, np.full(size - len(numbers), numbers[-1])])
                work = partial(study.batch, key, filled, mesh)
                waiting.append(_Batch(numbers, work if cores == 1 else pool.submit(work).result))
            numbers, work = waiting.popleft()
            before, compiling = time.perf_counter(), compile_seconds()
            found = _first(_fetched(work()), len(numbers))
            now = time.perf_counter()
            undone = len(left) - at + sum(len(other.numbers) for other in waiting)
            pace.batch = size
            pace.note(now - before, compile_seconds() - compiling, undone)
            gathered.add(numbers, found, now - began)
            if progress is not None and first:
                running = now - began - (compile_seconds() - compiled)
                rate = (gathered.done - so_far) / max(running, 1e-9)
                told = Progress(gathered.done, trials, gathered.failed, rate, undone / rate, size)
                progress(told)
            if _agreed(np.array(stop is not None and stop())):
                break
    except KeyboardInterrupt:
        pass
    finally:
        pool.shutdown(cancel_futures=True)
        gathered.flush()
    if measured and pace.found:
        _SIZES[asked] = pace.batch
    return Results(
        names=gathered.names,
        statistics=gathered.statistics,
        done=gathered.done,
        failed=gathered.failed,
        ran=gathered.done - so_far,
        trials=trials,
        seconds=time.perf_counter() - began,
        compiling=compile_seconds() - compiled,
        batch=pace.batch,
        about=about,
        store=store,
        _kept=tuple(gathered.kept),
    )


class _Batch(NamedTuple):
    """Trials that are under way, and what waits for them."""

    numbers: Int[np.ndarray, " t"]
    work: Callable[[], Trial]


class _Gathered:
    """Trials that are there: counted, and written or kept."""

    def __init__(self, store: Store | None, trials: int):
        self.store = store
        self.there: Bool[np.ndarray, " trials"] = np.zeros(trials, bool)
        self.done = self.failed = 0
        self.names: tuple[str, ...] = ()
        self.statistics = Statistics(0)
        self.kept: list[tuple[np.ndarray, Trial]] = []  # since the last flush, or all
        self._flushed = 0.0
        for numbers, found in store.read() if store is not None else ():
            self._count(numbers, found)

    def add(self, numbers: np.ndarray, found: Trial, seconds: float) -> None:
        self._count(numbers, found)
        self.kept.append((numbers, found))
        if seconds - self._flushed > max(_FLUSH_SECONDS, _FLUSH_SHARE * seconds):
            self.flush()
            self._flushed = seconds

    def flush(self) -> None:
        if self.store is None or not self.kept:
            return
        numbers = np.concatenate([numbers for numbers, _ in self.kept])
        found = jax.tree.map(lambda *parts: np.concatenate(parts), *(f for _, f in self.kept))
        self.store.write(numbers, found)
        self.kept.clear()

    def _count(self, numbers: np.ndarray, found: Trial) -> None:
        parts = {name: np.asarray(e) for name, e in found.error.items()}
        errors = np.concatenate(list(parts.values()), axis=1)
        sigma = np.concatenate(
            [
                np.asarray(found.sigma.get(name, np.full_like(e, np.nan)))
                for name, e in parts.items()
            ],
            axis=1,
        )
        if not self.names:
            self.names = tuple(
                f"{name}[{k}]" for name, e in parts.items() for k in range(e.shape[1])
            )
            self.statistics = Statistics(len(self.names))
        # More may be in the folder than this run asks for, and some of it twice.
        own, index = np.unique(numbers, return_index=True)
        index = index[own < len(self.there)]
        index = index[~self.there[numbers[index]]]
        self.there[numbers[index]] = True
        good = np.asarray(found.converged)[index]
        self.done += len(index)
        self.failed += int((~good).sum())
        self.statistics.add(errors[index][good], sigma[index][good])


def _first(found: Trial, n: int) -> Trial:
    return jax.tree.map(lambda leaf: leaf[:n], found)


def _fetched(found: Trial) -> Trial:
    """On the host, whole, in every process."""
    if jax.process_count() > 1:
        found = multihost_utils.process_allgather(found, tiled=True)
    return jax.tree.map(np.asarray, found)


def _on_host() -> bool:
    return jax.default_backend() == "cpu"


def _agreed(value: np.ndarray) -> np.ndarray:
    """What the first process says."""
    if jax.process_count() == 1:
        return value
    return np.asarray(multihost_utils.broadcast_one_to_all(value))


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.1f} h"
