"""Typed access to the tables of recording.toml; whatever is wrong is said with line and mend."""

import math
from collections.abc import Collection, Sequence
from typing import Any, NoReturn

import numpy as np

from jaxvm.recording.errors import RecordingError, TomlPath, did_you_mean, toml_error


class Entry:
    """One table of recording.toml: its content, where it stands, and the text to find its lines."""

    def __init__(self, table: Any, text: str, path: TomlPath = ()):
        self.text, self.path = text, path
        if not isinstance(table, dict):
            raise toml_error(text, path, f"{self.title()} must be a table, not {table!r}")
        self.table = table

    def title(self, key: str | None = None) -> str:
        """How the table (or a key of it) is called in errors."""
        name = ""
        for part in (*self.path, *([] if key is None else [key])):
            name += f"[{part}]" if isinstance(part, int) else f"{'.' if name else ''}{part}"
        return name or "recording.toml"

    def error(self, key: str | None, problem: str) -> RecordingError:
        """Error at a key (None: at the table itself)."""
        return toml_error(self.text, (*self.path, *([] if key is None else [key])), problem)

    def fail(self, key: str | None, problem: str) -> NoReturn:
        raise self.error(key, problem)

    def __contains__(self, key: str) -> bool:
        return key in self.table

    def only(self, known: Collection[str]) -> "Entry":
        """The same entry, after a check that it has no other keys."""
        for key in self.table:
            if key not in known:
                where = f" in {self.title()}" if self.path else ""
                self.fail(key, f'unknown key "{key}"{where}; {did_you_mean(key, known)}')
        return self

    def needs(self, key: str, example: str) -> Any:
        if key not in self.table:
            name = self.title() if self.path else "it"
            self.fail(None, f"{name} has no {key}; add {key} = {example}")
        return self.table[key]

    def entry(self, key: str) -> "Entry":
        return Entry(self.table.get(key, {}), self.text, (*self.path, key))

    def entries(self, key: str) -> dict[str, "Entry"]:
        """The named tables below a key, such as all [cameras.NAME]."""
        below = self.entry(key)
        for name in below.table:
            if not name or any(c in name for c in '.:,"') or name != name.strip():
                below.fail(
                    name,
                    f'the name "{name}" has a dot, colon, comma, quote or outer space; rename it',
                )
        return {name: below.entry(name) for name in below.table}

    def listed(self, key: str) -> list["Entry"]:
        """The tables of an array of tables, such as all [[priors]]."""
        value = self.table.get(key, [])
        if not isinstance(value, list):
            self.fail(key, f"{self.title(key)} must be written as [[{key}]] tables")
        return [Entry(item, self.text, (*self.path, key, i)) for i, item in enumerate(value)]

    def string(self, key: str, default: str) -> str:
        value = self.table.get(key, default)
        if not isinstance(value, str):
            self.fail(key, f'{self.title(key)} is {value!r}; write a text in quotes, "{value}"')
        return value

    def choice(self, key: str, known: Sequence[str], default: str | None = None) -> str:
        value = default if default is not None and key not in self else None
        value = self.needs(key, f'"{known[0]}"') if value is None else value
        if not isinstance(value, str) or value not in known:
            self.fail(key, f"{self.title(key)} is {value!r}; it must be one of {', '.join(known)}")
        return value

    def number(self, key: str, default: float | None = None) -> float | None:
        if key not in self:
            return default
        return float(self._numbers(key, [self.table[key]], "a number")[0])

    def positive(self, key: str, default: float | None = None) -> float:
        value = self.needs(key, "a positive number") if default is None else None
        value = self.number(key, default)
        if value is None or not value > 0.0:
            self.fail(key, f"{self.title(key)} is {value}; it must be a number above 0")
        return value

    def count(self, key: str, default: int | float | None = None, least: int = 1) -> int:
        """A whole number of at least so many."""
        if default is None:
            self.needs(key, "a whole number")
        value = self.table.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or value < least:
            problem = f"{self.title(key)} is {value!r}; it must be a whole number from {least}"
            self.fail(key, problem)
        return value

    def vector(self, key: str, length: int) -> np.ndarray | None:
        """As many finite numbers as asked for; None where the key is absent."""
        if key not in self:
            return None
        value = self.table[key]
        wanted = f"a list of {length} numbers"
        if not isinstance(value, list) or len(value) != length:
            given = f"{len(value)} entries" if isinstance(value, list) else repr(value)
            self.fail(key, f"{self.title(key)} has {given}; it must be {wanted}")
        return self._numbers(key, value, wanted)

    def moments(self, key: str) -> tuple[float, ...]:
        """One number or a list of increasing ones; empty where the key is absent."""
        if key not in self:
            return ()
        value = self.table[key]
        wanted = "a number, or a list of increasing ones"
        moments = self._numbers(key, value if isinstance(value, list) else [value], wanted)
        if (np.diff(moments) <= 0.0).any():
            self.fail(key, f"{self.title(key)} is {value}; it must be {wanted}")
        return tuple(moments.tolist())

    def names(self, key: str) -> list[str] | None:
        if key not in self:
            return None
        value = self.table[key]
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            self.fail(key, f'{self.title(key)} must be a list of texts in quotes, ["a", "b"]')
        return value

    def free(self, known: Sequence[str]) -> frozenset[str] | None:
        """What the adjustment estimates of this body; None where the engineer leaves it open."""
        names = self.names("free")
        if names is None:
            return None
        for name in names:
            if name not in known:
                self.fail(
                    "free",
                    f'"{name}" in {self.title("free")} is nothing that can be free; '
                    f"{did_you_mean(name, known)}",
                )
        return frozenset(names)

    def pose(self, moves: bool = False) -> np.ndarray | None:
        """Turn (rad) and shift (m) in one vector; what moves may have one such row an epoch."""
        if "pose" not in self:
            return None
        entry = self.entry("pose").only(("turn_rad", "shift_m"))
        for key in ("turn_rad", "shift_m"):
            entry.needs(key, "[0.0, 0.0, 0.0]")
        turn, shift = (entry._triples(key, moves) for key in ("turn_rad", "shift_m"))
        if turn.shape != shift.shape:
            entry.fail(
                "shift_m",
                f"{entry.title('turn_rad')} has {np.size(turn) // 3} rows and "
                f"{entry.title('shift_m')} {np.size(shift) // 3}; give both for every epoch",
            )
        length = float(np.max(np.linalg.norm(np.atleast_2d(turn), axis=1)))
        if length > 2.0 * math.pi:
            entry.fail(
                "turn_rad",
                f"{entry.title('turn_rad')} has length {length:.4g}, more than 2 pi; "
                "a rotation vector in rad is needed, convert it if this is in degrees",
            )
        return np.concatenate([turn, shift], axis=-1)

    def _triples(self, key: str, many: bool) -> np.ndarray:
        """Three numbers, or a list of such rows where there may be many."""
        value = self.table[key]
        nested = many and isinstance(value, list) and value and isinstance(value[0], list)
        wanted = "a list of 3 numbers" + (", or one such list for every epoch" if many else "")
        found = []
        for row in value if nested else [value]:
            if not isinstance(row, list) or len(row) != 3:
                given = f"{len(row)} entries" if isinstance(row, list) else repr(row)
                self.fail(key, f"{self.title(key)} has {given}; it must be {wanted}")
            found.append(self._numbers(key, row, wanted))
        return np.array(found) if nested else found[0]

    def _numbers(self, key: str, values: list, wanted: str) -> np.ndarray:
        for value in values:
            if isinstance(value, bool) or not isinstance(value, int | float):
                self.fail(key, f"{self.title(key)} has {value!r}; it must be {wanted}")
            if not math.isfinite(value):
                self.fail(key, f"{self.title(key)} has {value}; it must be {wanted}, all finite")
        return np.array(values, float)
