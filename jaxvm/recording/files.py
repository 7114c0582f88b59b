"""Files and folders that are there complete or not at all."""

import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def new_folder(folder: str | Path) -> Iterator[Path]:
    """A folder to write into, which takes its place when the block ends without an error.

    Raises:
        FileExistsError: something is already there, and it is not an empty folder.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} is already there; choose another name or remove it")
    folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.absolute().parent))
    try:
        yield staging
        staging.chmod(0o755)
        if folder.exists():
            folder.rmdir()
        os.replace(staging, folder)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def write_files(folder: str | Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Write files into a folder; each is there complete or as it was before.

    All are written beside their places first, so that a full disk or an interruption leaves the
    old ones.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(prefix=".writing-", dir=folder))
    try:
        for name, content in contents.items():
            data = content.encode("utf-8") if isinstance(content, str) else content
            (staging / name).write_bytes(data)
        for name in contents:
            os.replace(staging / name, folder / name)
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return [folder / name for name in contents]


def json_text(content: Any) -> str:
    """A document as JSON, one key on a line; numbers that are not finite become null."""

    def sound(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: sound(one) for key, one in value.items()}
        if isinstance(value, list | tuple):
            return [sound(one) for one in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(sound(content), indent=1, allow_nan=False) + "\n"
