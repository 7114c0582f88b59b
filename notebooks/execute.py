"""Execute every notebook here, two at a time, from a fresh kernel; an error stops the run.

Without --keep they are only checked.
"""

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent


def execute(path: Path, keep: bool) -> str:
    """Execute one notebook; its name and seconds."""
    began = time.perf_counter()
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": FOLDER}}
    )
    client.execute()
    if keep:
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)
        nbformat.write(notebook, path)
    return f"{path.name}: {time.perf_counter() - began:.0f} s"


def main() -> None:
    """Read the command line and execute them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", action="store_true", help="write the outputs into the notebooks")
    keep = parser.parse_args().keep
    with ProcessPoolExecutor(2) as pool:
        for line in pool.map(partial(execute, keep=keep), sorted(FOLDER.glob("*.ipynb"))):
            print(line, flush=True)


if __name__ == "__main__":
    main()
