"""How long does a user wait for the first result, with nothing compiled, and later?

Whole processes of `jaxvm demo` (88,000 hypotheses, a report page): first with an empty folder for
programs, then five times with it (the median counts), and between them five times with JAX's own
cache alone, where every process traces and lowers its programs anew.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent

REPETITIONS = 5

_TRACED = """
import sys
from jaxvm.compiling import program
program.__call__ = lambda self, *args, **kwargs: self._traced(*args, **kwargs)
from jaxvm.cli import main
sys.exit(main(sys.argv[1:]))
"""

WAYS = {"kept": [sys.executable, "-m", "jaxvm.cli"], "traced": [sys.executable, "-c", _TRACED]}
"""With programs as they are, and as `equinox.filter_jit` alone."""


def seconds(way: str, work: str) -> float:
    """Of one process, with a folder for the programs of this way."""
    env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(Path(work, way))}
    began = time.perf_counter()
    command = [*WAYS[way], "demo", "--quiet"]
    subprocess.run(command, cwd=work, env=env, check=True, capture_output=True)
    return time.perf_counter() - began


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    with tempfile.TemporaryDirectory() as work:
        runs = {way: [seconds(way, work)] for way in WAYS}
        for _ in range(REPETITIONS):
            for way, own in runs.items():
                own.append(seconds(way, work))
                print(f"{way:>6} {own[-1]:.1f} s", flush=True)
    later = {way: statistics.median(own[1:]) for way, own in runs.items()}
    found = {"first_s": runs["kept"][0], "later_s": later, "runs": runs}
    (HERE / "results.json").write_text(json.dumps(found, indent=1) + "\n")
    (HERE / "results.md").write_text(
        "Seconds of whole processes of `jaxvm demo`; the later ones are medians of five.\n\n"
        "| first run, nothing compiled | later runs | the same with JAX's cache alone |\n"
        "|---|---|---|\n"
        f"| {found['first_s']:.1f} | {later['kept']:.1f} | {later['traced']:.1f} |\n"
    )


if __name__ == "__main__":
    main()
