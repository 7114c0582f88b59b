"""How long does a user wait for the first result, with nothing compiled, and later?

Whole processes from the shell's prompt: `jaxvm demo`, and `jaxvm diagnose` of a short recording of
an independent world. First with an empty folder for programs, then five times with it (the median
counts), and five times with JAX's own cache, by which every process traces and lowers anew.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent / "sealed")]

from world import record  # noqa: E402

REPETITIONS = 5

_TRACED = """
import sys
import equinox as eqx
import jaxvm.compiling as compiling
compiling.program.__call__ = lambda self, *args, **kwargs: self._traced(*args, **kwargs)
from jaxvm.cli import main
sys.exit(main(sys.argv[1:]))
"""

WAYS = {"kept": [sys.executable, "-m", "jaxvm.cli"], "traced": [sys.executable, "-c", _TRACED]}
"""With programs as they are, and as `equinox.filter_jit` alone."""


def seconds(command: list[str], work: str, cache: str) -> float:
    """Of one process."""
    env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    began = time.perf_counter()
    subprocess.run(command, cwd=work, env=env, check=True, capture_output=True)
    return time.perf_counter() - began


def measured(arguments: list[str], work: str) -> dict[str, object]:
    """First run in an empty folder, then medians of interleaved runs."""
    folders = {way: tempfile.mkdtemp(dir=work) for way in WAYS}
    runs = {way: [seconds([*WAYS[way], *arguments], work, cache)] for way, cache in folders.items()}
    for _ in range(REPETITIONS):
        for way, cache in folders.items():
            runs[way].append(seconds([*WAYS[way], *arguments], work, cache))
    return {
        "first_s": runs["kept"][0],
        "next_s": statistics.median(runs["kept"][1:]),
        "traced_s": statistics.median(runs["traced"][1:]),
        "runs": runs,
    }


def main() -> None:
    found = {}
    with tempfile.TemporaryDirectory() as work:
        record("board", 5, ("focal-grows-with-heat",)).write(Path(work, "board"))
        for name, arguments in {
            "jaxvm demo": ["demo", "--quiet"],
            "jaxvm diagnose, a board before one camera": ["diagnose", "board", "--quiet"],
        }.items():
            found[name] = measured(arguments, work)
            print(name, json.dumps(found[name]), flush=True)
    (HERE / "results.json").write_text(json.dumps(found, indent=1) + "\n")
    lines = [
        "Seconds of whole processes, medians of five but for the first run.",
        "",
        "| command | first run, nothing compiled | later runs | with JAX's cache alone |",
        "|---|---|---|---|",
        *(
            f"| `{name}` | {own['first_s']:.1f} | {own['next_s']:.1f} | {own['traced_s']:.1f} |"
            for name, own in found.items()
        ),
    ]
    (HERE / "results.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
