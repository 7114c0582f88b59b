"""Trials on disk: a folder of Parquet files that a study is resumed from.

    study.json        what the study is, its key, versions
    trials-0000.parquet, trials-0001.parquet, ...

A part appears complete or not at all, so whatever ends a run, what was written counts. Columns are
`trial`, `converged`, `error.NAME[k]`, `sigma.NAME[k]` and what was noted.
"""

import json
import os
import platform
import tempfile
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Int

from jaxvm import __version__
from jaxvm.montecarlo.trials import Trial
from jaxvm.recording.files import json_text, one_sentence, write_files

_MANIFEST = "study.json"


def columns_of(numbers: Int[np.ndarray, " t"], found: Trial) -> dict[str, np.ndarray]:
    """Stacked trials as columns."""
    columns = {"trial": np.asarray(numbers, np.int64), "converged": np.asarray(found.converged)}
    for group, values in (("error", found.error), ("sigma", found.sigma)):
        for name, own in values.items():
            for k, column in enumerate(np.asarray(own).T):
                columns[f"{group}.{name}[{k}]"] = np.ascontiguousarray(column)
    return columns | {name: np.asarray(value) for name, value in found.noted.items()}


def table_of(columns: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> pa.Table:
    """Columns as a table whose metadata tell the study, as JSON under "study"."""
    return pa.table(dict(columns)).replace_schema_metadata({"study": json_text(about)})


def trial_of(columns: Mapping[str, np.ndarray]) -> tuple[Int[np.ndarray, " t"], Trial]:
    """The inverse of `columns_of`."""
    groups: dict[str, dict[str, list[np.ndarray]]] = {"error": {}, "sigma": {}}
    noted = {}
    for column, values in columns.items():
        group, _, rest = column.partition(".")
        if group in groups and rest.endswith("]"):
            groups[group].setdefault(rest[: rest.rindex("[")], []).append(values)
        elif column not in ("trial", "converged"):
            noted[column] = values
    error, sigma = (
        {name: np.stack(parts, axis=1) for name, parts in groups[group].items()}
        for group in ("error", "sigma")
    )
    return columns["trial"], Trial(error, columns["converged"].astype(bool), sigma, noted)


class Store:
    """The folder of one study."""

    def __init__(self, folder: str | Path, manifest: Mapping[str, Any]):
        """Open a folder, new or begun by the same study.

        Raises:
            FileExistsError: it holds another study, or other files.
        """
        self.folder = Path(folder)
        self.manifest = json.loads(json_text(dict(manifest)))
        place = self.folder / _MANIFEST
        if place.exists():
            there = json.loads(place.read_text(encoding="utf-8"))
            if other := _differences(there, self.manifest):
                raise FileExistsError(
                    f"{self.folder}: the trials here are of another study ({', '.join(other)}); "
                    "ask for the same, choose another folder, or remove this one"
                )
        elif self.folder.is_dir() and any(self.folder.iterdir()):
            raise FileExistsError(
                f"{self.folder} holds other files and no {_MANIFEST}; choose another folder"
            )
        else:
            write_files(self.folder, {_MANIFEST: json_text(dict(manifest))})

    def parts(self) -> list[Path]:
        """Files of trials, in the order in which they were written."""
        return sorted(self.folder.glob("trials-*.parquet"))

    def write(self, numbers: Int[np.ndarray, " t"], found: Trial) -> None:
        """Add a part; it is on the disk when this returns."""
        table = table_of(columns_of(numbers, found), self.manifest)
        with one_sentence(self.folder):
            handle, staging = tempfile.mkstemp(prefix=".writing-", dir=self.folder)
            try:
                with os.fdopen(handle, "wb") as file:
                    pq.write_table(table, file, compression="zstd")
                    file.flush()
                    os.fsync(file.fileno())
                last = self.parts()[-1:]
                number = int(last[0].stem.rpartition("-")[2]) + 1 if last else 0
                os.replace(staging, self.folder / f"trials-{number:04d}.parquet")
            except BaseException:
                Path(staging).unlink(missing_ok=True)
                raise

    def read(self) -> Iterator[tuple[Int[np.ndarray, " t"], Trial]]:
        """Trials part by part.

        Raises:
            ValueError: a part can't be read.
        """
        for part in self.parts():
            try:
                table = pq.read_table(part)
            except (OSError, pa.ArrowInvalid) as error:
                raise ValueError(
                    f"{part} can't be read ({error}); remove it, and its trials are run again"
                ) from error
            columns = {n: table[n].to_numpy(zero_copy_only=False) for n in table.column_names}
            yield trial_of(columns)


def _differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> list[str]:
    """What makes a study another one, in words."""
    theirs, ours = _parts(there), _parts(here)
    differ = [name for name in {**ours, **theirs} if theirs.get(name) != ours.get(name)]
    # A model, and the fingerprint of numbers, differ with what they were made from.
    told = [name for name in differ if name not in ("model", "numbers")] or differ[:1]
    values = {name: (str(theirs.get(name)), str(ours.get(name))) for name in told}
    return [
        f"another {name}"
        + ("" if "\n" in one + other or name == "numbers" else f": {one}, not {other}")
        for name, (one, other) in values.items()
    ]


def _parts(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """What a study is, part by part, whatever versions computed it."""
    study, key = manifest.get("study"), manifest.get("key")
    # The key that JAX makes of a seed is that number in two halves.
    seed = (key[0] << 32) + key[1] if isinstance(key, list) and len(key) == 2 else key
    return {"seed": seed, **(study if isinstance(study, dict) else {"study": study})}


def versions() -> dict[str, str]:
    """What computed: the package, what it computes with, Python."""
    computing = "jax", "jaxlib", "equinox", "optimistix", "lineax", "numpy"
    found = {name: version(name) for name in computing}
    return {"jaxvm": __version__, **found, "python": platform.python_version()}
