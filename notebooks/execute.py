"""Execute every notebook here in place: all cells from a fresh kernel; an error stops the run.

`python notebooks/execute.py --keep` writes the outputs into the notebooks; without it they are only
checked. Two run at a time.
"""

import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent


def execute(path: Path) -> str:
    """Execute one notebook; its name and seconds."""
    began = time.perf_counter()
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook, timeout=1800, kernel_name="python3", resources={"metadata": {"path": FOLDER}}
    )
    client.execute()
    if "--keep" in sys.argv:
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)
        nbformat.write(notebook, path)
    return f"{path.name}: {time.perf_counter() - began:.0f} s"


def main() -> None:
    with ProcessPoolExecutor(2) as pool:
        for line in pool.map(execute, sorted(FOLDER.glob("*.ipynb"))):
            print(line, flush=True)


if __name__ == "__main__":
    main()
