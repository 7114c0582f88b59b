"""Tables of a recording, from csv or parquet, with the line of every row kept for errors."""

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int

from jaxvm.recording.errors import RecordingError, did_you_mean, has, has_not
from jaxvm.recording.texts import not_utf8

_RAGGED = re.compile(r"Expected (\d+) fields in line (\d+), saw (\d+)")


class Table:
    """One table as texts or numbers, and where each row stands.

    Attributes:
        file: name of the file, for errors.
        frame: the columns.
        line: line of each row in the file (csv) or its number from 1 (parquet).
    """

    def __init__(self, file: str, frame: pd.DataFrame, line: np.ndarray, word: str = "line"):
        self.file, self.frame, self.line, self.word = file, frame, line, word

    def __len__(self) -> int:
        return len(self.frame)

    def error(self, row: int | None, problem: str) -> RecordingError:
        """Error at a row (None: at the header)."""
        place = f"{self.word} {1 if row is None else self.line[row]}"
        return RecordingError(f"{self.file} {place}: {problem}")

    def check(self, good: Bool[np.ndarray, " n"], problem) -> None:
        """Raise at the first bad row; `problem(row)` says what is wrong, and the mend."""
        if not good.all():
            row = int(np.flatnonzero(~good)[0])
            more = int(np.sum(~good)) - 1
            also = f" (and {more} more row{'s' if more > 1 else ''})" if more else ""
            raise self.error(row, problem(row) + also)

    def needs(self, required: Iterable[str], optional: Iterable[str] = ()) -> None:
        """Check the header: every required column, and none that is not known."""
        required, known = tuple(required), (*required, *optional)
        for name in required:
            if name not in self.frame:
                raise self.error(
                    None,
                    f'column "{name}" is missing {has(self.frame.columns)}; '
                    f"the header must be {','.join(required)}",
                )
        for name in self.frame.columns:
            if name not in known:
                raise self.error(None, f'unknown column "{name}"; {did_you_mean(str(name), known)}')

    def numbers(self, column: str, meaning: str) -> Float[np.ndarray, " n"]:
        """A column of finite numbers."""
        raw = self.frame[column]
        values = np.asarray(pd.to_numeric(raw, errors="coerce"), float)
        self.check(
            np.isfinite(values),
            lambda row: (
                f"{column} is {_shown(raw.iloc[row])}; it must be {meaning}, "
                "mend it or drop the row"
            ),
        )
        return values

    def whole(self, column: str, meaning: str) -> Int[np.ndarray, " n"]:
        """A column of whole numbers."""
        values = self.numbers(column, meaning)
        self.check(
            values == np.round(values),
            lambda row: f"{column} is {values[row]:g}; it must be {meaning}",
        )
        return values.astype(int)

    def texts(self, column: str) -> np.ndarray:
        """A column of names, without outer spaces."""
        return self.frame[column].astype(str).str.strip().to_numpy(object)

    def places(self, column: str, names: Iterable[str], where: str) -> Int[np.ndarray, " n"]:
        """A column of names as places among the known ones."""
        known = {name: place for place, name in enumerate(names)}
        texts = self.texts(column)
        place = np.array([known.get(text, -1) for text in texts], int)
        self.check(
            place >= 0,
            lambda row: (
                f'{column} "{texts[row]}" is not in {where} {has_not(str(texts[row]), known)}'
            ),
        )
        return place


def read_table(folder: Path, name: str, required: bool) -> Table | None:
    """Table `name` from name.csv or name.parquet; None where an optional one is absent.

    Raises:
        RecordingError: it is missing, there twice, empty or not a table.
    """
    csv, parquet = folder / f"{name}.csv", folder / f"{name}.parquet"
    if csv.exists() and parquet.exists():
        raise RecordingError(
            f"{name}.csv and {name}.parquet are both in {folder}; keep one of them"
        )
    if parquet.exists():
        try:
            frame = pd.read_parquet(parquet)
        except Exception as problem:
            raise RecordingError(
                f"{parquet.name}: this is not a parquet file ({_first_line(problem)}); "
                "write it with pandas.DataFrame.to_parquet"
            ) from None
        return Table(parquet.name, frame, np.arange(len(frame)) + 1, "row")
    if not csv.exists():
        if required:
            raise RecordingError(
                f"{name}.csv: there is no such file in {folder}; add {name}.csv or {name}.parquet"
            )
        return None
    return read_csv(csv)


def read_csv(file: Path) -> Table:
    """A table from a csv: fields with commas, numbers with points, in UTF-8.

    Raises:
        RecordingError: it is empty, or no such table; names the line.
    """
    try:
        with file.open(encoding="utf-8-sig") as lines:
            _commas(file.name, lines.readline())
        # Everything as text: a wrong number is then found with its line, whatever it is.
        frame = pd.read_csv(
            file, dtype=str, keep_default_na=False, na_filter=False, skip_blank_lines=False,
            skipinitialspace=True, encoding="utf-8-sig",
        )  # fmt: skip
    except pd.errors.EmptyDataError:
        raise RecordingError(f"{file.name} line 1: the file is empty; write a header") from None
    except UnicodeDecodeError:
        raise not_utf8(file, file.name) from None
    except pd.errors.ParserError as problem:
        ragged = _RAGGED.search(str(problem))
        place = f" line {ragged[2]}" if ragged else ""
        said = f"{ragged[3]} fields, the header {ragged[1]}" if ragged else _first_line(problem)
        raise RecordingError(
            f"{file.name}{place}: {said}; every line needs as many fields as the header"
        ) from None
    if not isinstance(frame.index, pd.RangeIndex):
        raise RecordingError(
            f"{file.name} line 2: it has more fields than the header; name every column, and write "
            "numbers with a decimal point"
        )
    frame.columns = [str(column).strip() for column in frame.columns]
    line = np.arange(len(frame)) + 2
    # Short rows are filled with NaN by the parser even without a filter for NaN.
    frame = frame.fillna("")
    filled = (frame != "").any(axis=1).to_numpy()
    return Table(file.name, frame.loc[filled].reset_index(drop=True), line[filled])


def _commas(file: str, header: str) -> None:
    """Refuse what spreadsheets of many countries write: there the comma is the decimal sign."""
    for sign, word in ((";", '";"'), ("\t", "tabs")):
        if sign in header and "," not in header:
            raise RecordingError(
                f"{file} line 1: its fields are separated by {word}; save it with commas between "
                "fields, and decimal points in numbers"
            )


def _shown(value) -> str:
    text = str(value)
    return "empty" if text.strip() == "" else text if text.lower() != "nan" else "NaN"


def _first_line(problem: Exception) -> str:
    return str(problem).strip().splitlines()[0].removeprefix("Error tokenizing data. C error: ")
