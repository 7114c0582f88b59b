"""Where the TOML of a network comes from: a file, or an example of the package."""

from importlib import resources
from pathlib import Path

from jaxvm.recording.errors import RecordingError, did_you_mean
from jaxvm.recording.texts import read_text
from jaxvm.scenes.describe import Description
from jaxvm.scenes.parse import parse_description


def example_names() -> tuple[str, ...]:
    """Names of the examples that come with the package."""
    files = resources.files("jaxvm.scenes").joinpath("examples").iterdir()
    return tuple(sorted(file.name[:-5] for file in files if file.name.endswith(".toml")))


def read_description(scene: str | Path, others: tuple[str, ...] = ()) -> Description:
    """A network from its TOML file, or an example by its name.

    `others` are names that whoever asks knows besides, for the mend of a wrong one.

    Raises:
        RecordingError: there is no such file or example, or something in it is wrong; names the
            file, the line and the mend.
    """
    path = Path(scene)
    name = path.name if path.is_file() else f"{scene}.toml"
    return parse_description(description_text(scene, others), name)


def description_text(scene: str | Path, others: tuple[str, ...] = ()) -> str:
    """The TOML of a network from its file, or of an example; `others` as for `read_description`.

    Raises:
        RecordingError: there is no such file or example, or it is no text.
    """
    name, path = str(scene), Path(scene)
    if name in example_names() and not path.is_file():
        file = resources.files("jaxvm.scenes").joinpath("examples", f"{name}.toml")
        return file.read_text(encoding="utf-8")
    if not path.is_file():
        mend = did_you_mean(name, (*others, *example_names()))
        raise RecordingError(
            f"{name}: there is no such file, and no example of that name; {mend} (to write a "
            'network of your own, `layout = "chain"` is enough)'
        )
    return read_text(path, path.name)
