"""What the trials of a study found: columns, statistics, tables, files."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
from jaxtyping import Float, Int

from jaxvm.montecarlo.statistics import Statistics
from jaxvm.montecarlo.store import Store, columns_of, table_of, trial_of
from jaxvm.montecarlo.trials import Trial
from jaxvm.recording.files import json_text


@dataclass(frozen=True, eq=False)
class Results:
    """What the trials of a study found.

    Attributes:
        names: of the numbers whose errors were counted, `NAME[k]`.
        statistics: of the errors of the trials that converged.
        done, failed: trials that are there, and those of them that did not converge.
        ran: trials of this run; the others were in the folder.
        trials: how many were asked for.
        seconds, compiling: of this run.
        batch: trials at a time in the end.
        about: the study, its key, versions.
        store: where they are on disk, if anywhere.
    """

    names: tuple[str, ...]
    statistics: Statistics
    done: int
    failed: int
    ran: int
    trials: int
    seconds: float
    compiling: float
    batch: int
    about: dict[str, Any]
    store: Store | None
    _kept: tuple[tuple[Int[np.ndarray, " t"], Trial], ...]

    @property
    def complete(self) -> bool:
        """Whether all trials are there; a run that was stopped is resumed from its folder."""
        return self.done >= self.trials

    def parts(self) -> Iterator[tuple[Int[np.ndarray, " t"], Trial]]:
        """Numbers of trials and what they found, part by part."""
        yield from self._kept if self.store is None else self.store.read()

    @cached_property
    def columns(self) -> dict[str, np.ndarray]:
        """All trials as columns, in the order of their numbers (`jaxvm.montecarlo.store`).

        A folder may hold more than this run asked for; they do not count here either.
        """
        parts = [columns_of(numbers, found) for numbers, found in self.parts()]
        if not parts:
            return {"trial": np.zeros(0, int), "converged": np.zeros(0, bool)}
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        numbers, order = np.unique(joined["trial"], return_index=True)
        order = order[numbers < self.trials]
        return {name: values[order] for name, values in joined.items()}

    def frame(self) -> pd.DataFrame:
        """All trials, those that failed too, as a table."""
        return pd.DataFrame(self.columns)

    @property
    def errors(self) -> Float[np.ndarray, "t m"]:
        """Errors of the trials that converged, in the order of `names`."""
        columns, ok = self.columns, self.columns["converged"]
        return np.stack([columns[f"error.{name}"][ok] for name in self.names], axis=1)

    @property
    def failures(self) -> Int[np.ndarray, " failed"]:
        """Numbers of the trials that did not converge: `study.batch(key, numbers, None)` runs them
        again."""
        return self.columns["trial"][~self.columns["converged"]]

    def table(self, level: float = 0.95) -> pd.DataFrame:
        """A row for each number: mean, RMS with its interval, quantiles, coverage."""
        found = self.statistics
        low, high = found.interval(level)
        frame = pd.DataFrame({"quantity": self.names, "mean": found.mean, "rms": found.rms})
        frame["low"], frame["high"] = low, high
        for share in (0.05, 0.5, 0.95):
            frame[f"q{100 * share:02.0f}"] = found.quantile(share)
        frame["coverage_90"] = found.coverage(0.9)
        return frame

    def summary(self) -> str:
        """A few lines."""
        trials = f"trials             {self.done} of {self.trials}, of which failed {self.failed}"
        if self.ran == 0:
            return f"{trials}; all of them were there already, none was run"
        running = max(self.seconds - self.compiling, 1e-9)
        rate = self.ran / running
        return (
            f"{trials}\ntime               {self.seconds:.2f} s, of which compiling"
            f" {self.compiling:.2f} s; batches of {self.batch}, {rate:.4g} a second"
        )

    def to_xarray(self):
        """All trials as an `xarray.Dataset` over the dimension `trial`.

        Raises:
            ModuleNotFoundError: xarray is not installed (`pip install jaxvm[netcdf]`).
        """
        import xarray  # pyright: ignore[reportMissingImports]

        numbers, found = trial_of(self.columns)
        variables: dict[str, Any] = {
            "converged": ("trial", found.converged),
            **{name: ("trial", values) for name, values in found.noted.items()},
        }
        for group, values in (("error", found.error), ("sigma", found.sigma)):
            for name, own in values.items():
                variables[f"{group}_{name}"] = (("trial", f"{name}_component"), own)
        return xarray.Dataset(variables, {"trial": numbers}, {"study": json_text(self.about)})

    def save(self, path: str | Path) -> Path:
        """Write all trials to one file, `.parquet` or `.nc` (NetCDF).

        The file tells the study (a network's model among it), its key and what versions computed
        it: JSON under "study" in the metadata of the table, or in the attributes of the dataset.

        Raises:
            ValueError: another kind of file.
        """
        path = Path(path)
        if path.suffix == ".parquet":
            pq.write_table(table_of(self.columns, self.about), path)
        elif path.suffix == ".nc":
            self.to_xarray().to_netcdf(path, engine="h5netcdf")
        else:
            raise ValueError(f"{path}: trials are written as .parquet or .nc")
        return path
