"""Text files, and TOML in them: what can't be read is said with its line."""

import re
import tomllib
from pathlib import Path
from typing import Any

from jaxvm.recording.errors import RecordingError

_AT = re.compile(r" \(at (?:line (\d+), column (\d+)|end of document)\)$")


def parse_toml(text: str, name: str) -> dict[str, Any]:
    """The table that a text in TOML makes; `name` is how errors call it.

    Raises:
        RecordingError: it is not TOML; names the line.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as problem:
        said = str(problem)
        place = _AT.search(said)
        line = place[1] if place and place[1] else max(len(text.splitlines()), 1)
        column = f" in column {place[2]}" if place and place[2] else ""
        words = _AT.sub("", said)
        raise RecordingError(
            f"{name} line {line}: this is not valid TOML ({words[:1].lower()}{words[1:]}{column}); "
            "mend it"
        ) from None


def read_text(file: Path, name: str) -> str:
    """The text in a file; `name` is how errors call it.

    Raises:
        RecordingError: it is not in UTF-8; names the line.
    """
    try:
        return file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise not_utf8(file, name) from None


def not_utf8(file: Path, name: str) -> RecordingError:
    """Error about a file that can't be decoded, with the line at which that begins."""
    for number, line in enumerate(file.read_bytes().split(b"\n"), start=1):
        try:
            line.decode("utf-8")
        except UnicodeDecodeError as problem:
            byte = f"the byte {line[problem.start]:#04x}"
            return RecordingError(
                f"{name} line {number}: {byte} is not text in UTF-8; save the file as UTF-8"
            )
    raise AssertionError(f"{name} is in UTF-8")
