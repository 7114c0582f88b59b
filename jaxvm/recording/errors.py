"""Errors in recordings: one sentence that names the file, the line and the mend."""

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches

_HEADER = re.compile(r"^\s*(\[\[?)\s*(.+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(r"^([^=\[{#]+)=")
_PART = re.compile(r""""([^"]*)"|'([^']*)'|([A-Za-z0-9_\-]+)""")

TomlPath = tuple[str | int, ...]
"""Where a value stands in recording.toml, such as ("cameras", "left", "lens") or ("priors", 0)."""


class RecordingError(ValueError):
    """Something in a recording is wrong; the message names the file, the line and the mend."""


def sentence(problem: Exception) -> str:
    """A complaint as it is told: the system's own ones without their numbers, and with a mend."""
    if isinstance(problem, OSError) and problem.strerror is not None:
        return (
            f"{problem.filename}: it can't be read or written ({problem.strerror.lower()}); mend "
            "that or give another"
        )
    return str(problem)


def toml_error(text: str, path: TomlPath, problem: str) -> RecordingError:
    """Error at a table or key of recording.toml, whose line is looked up in its text."""
    line = line_of(text, path)
    place = "recording.toml" if line is None else f"recording.toml line {line}"
    return RecordingError(f"{place}: {problem}")


def in_file(problem: RecordingError, file: str) -> RecordingError:
    """An error about recording.toml, told of the file that stands in its place."""
    return RecordingError(str(problem).replace("recording.toml", file))


def line_of(text: str, path: TomlPath) -> int | None:
    """Line (from 1) of the deepest table or key on the way to `path`; None if there is none."""
    best, depth = None, 0
    table: TomlPath = ()
    seen: dict[TomlPath, int] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            table = _parts(header[2])
            if header[1] == "[[":
                seen[table] = seen.get(table, -1) + 1
                table = (*table, seen[table])
            elif table[:1] in seen:
                table = (table[0], seen[table[:1]], *table[1:])
            here = table
        elif key := _KEY.match(line):
            here = (*table, *_parts(key[1]))
        else:
            continue
        shared = _shared(here, path)
        if shared > depth:
            best, depth = number, shared
    return best


def _parts(dotted: str) -> TomlPath:
    return tuple(a or b or c for a, b, c in _PART.findall(dotted))


def _shared(here: TomlPath, path: TomlPath) -> int:
    """Length of the way that two places have in common."""
    shared = 0
    for a, b in zip(here, path, strict=False):
        if a != b:
            break
        shared += 1
    return shared


def has(names: Iterable[str]) -> str:
    """The names that would have been right, in brackets, for an error about one that is wrong."""
    known = list(names)
    return f"(it has: {listed(known)})" if known else "(it has none)"


def has_not(name: str, names: Iterable[str]) -> str:
    """The names that would have been right, and the mend: the nearest of them, if one is near."""
    known = list(names)
    near = _nearest(name, known)
    return f"{has(known)}; " + (f'did you mean "{near}"?' if near else "mend the name")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The mend for a wrong name: the nearest right one, or all of them."""
    known = list(known)
    near = _nearest(name, known)
    return f'did you mean "{near}"?' if near else f"known here: {listed(known, 30)}"


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names with commas; of very many the first."""
    more = f", and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


def _nearest(name: str, known: list[str]) -> str | None:
    return next(iter(get_close_matches(name, known, n=1, cutoff=0.6)), None)
