"""Files and folders that are there complete or not at all, and places where they can't be."""

import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

Place = Literal["folder", "new", "file"]
"""A folder that may hold files, what is not there yet (or an empty folder), a file to replace."""


def check_place(place: str | Path, kind: Place) -> None:
    """Refuse a place that can't be written to; commands ask before they work for hours.

    Raises:
        OSError: something else is there, or nothing can be written there; names the mend.
    """
    place = Path(place)
    if kind == "new" and os.path.lexists(place) and not _empty_folder(place):
        raise FileExistsError(f"{place} is already there; choose another name or remove it")
    if kind == "folder" and os.path.lexists(place) and not place.is_dir():
        raise FileExistsError(f"{place} is a file, not a folder; choose another name")
    if kind == "file" and place.is_dir():
        raise IsADirectoryError(f"{place} is a folder, not a file; choose another name")
    around = place.parents if kind == "file" else (place, *place.parents)
    above = next(folder for folder in around if os.path.lexists(folder))
    if not above.is_dir():
        raise NotADirectoryError(
            f"{place} can't be written, for {above} is a file, not a folder; choose another place"
        )
    try:
        # Permissions do not tell: some places take nothing even from those who may write.
        tempfile.TemporaryDirectory(prefix=".writing-", dir=above).cleanup()
    except OSError:
        raise OSError(
            f"{place} can't be written, for the folder {above.absolute()} takes no files; choose "
            "another place"
        ) from None


@contextmanager
def new_folder(folder: str | Path) -> Iterator[Path]:
    """A folder to write into, which takes its place when the block ends without an error.

    Raises:
        OSError: something is already there, and it is not an empty folder; or it can't be written.
    """
    check_place(folder, "new")
    with _staged(Path(folder)) as staging:
        yield staging


def write_files(folder: str | Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Write files into a folder; each is there complete or as it was before.

    All are written beside their places first, so that a full disk or an interruption leaves the
    old ones.

    Raises:
        OSError: the folder is a file, or can't be written.
    """
    folder = Path(folder)
    check_place(folder, "folder")
    for name in contents:
        if (folder / name).is_dir():
            raise IsADirectoryError(
                f"{folder / name} is a folder, not a file; remove it or choose another place"
            )
    with _staged(folder) as staging:
        for name, content in contents.items():
            data = content.encode("utf-8") if isinstance(content, str) else content
            (staging / name).write_bytes(data)
    return [folder / name for name in contents]


@contextmanager
def one_sentence(place: Path) -> Iterator[None]:
    """Complaints of the system while `place` is written, without names of files on the way there.

    Raises:
        OSError: the system complains.
    """
    try:
        yield
    except OSError as problem:
        if problem.strerror is None:
            raise
        raise OSError(
            f"{place} can't be written ({problem.strerror.lower()}); mend that or choose another "
            "place"
        ) from None


@contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """A folder whose content goes into `folder` in the end: at once where that is new."""
    with one_sentence(folder):
        beside = folder if folder.is_dir() else folder.absolute().parent
        beside.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=".writing-", dir=beside))
        try:
            yield staging
            if folder.is_dir():
                for file in staging.iterdir():
                    os.replace(file, folder / file.name)
            else:
                staging.chmod(0o755)
                os.replace(staging, folder)
        finally:
            shutil.rmtree(staging, ignore_errors=True)


def _empty_folder(place: Path) -> bool:
    return place.is_dir() and not any(place.iterdir())


def json_text(content: Any) -> str:
    """A document as JSON, one key on a line; numbers that are not finite become null."""

    def sound(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: sound(one) for key, one in value.items()}
        if isinstance(value, list | tuple):
            return [sound(one) for one in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(sound(content), indent=1, allow_nan=False) + "\n"
