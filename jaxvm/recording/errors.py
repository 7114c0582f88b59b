"""Errors in recordings: one sentence that names the file, the line and the mend."""

import re
from collections.abc import Iterable
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


def has(names: Iterable[str], most: int = 12) -> str:
    """The names that would have been right, in brackets, for an error about one that is wrong."""
    known = list(names)
    if not known:
        return "(it has none)"
    more = f", and {len(known) - most} more" if len(known) > most else ""
    return f"(it has: {', '.join(known[:most])}{more})"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The mend for a wrong name: the nearest right one, or all of them."""
    known = list(known)
    near = get_close_matches(name, known, n=1, cutoff=0.6)
    return f'did you mean "{near[0]}"?' if near else f"known here: {', '.join(known)}"
