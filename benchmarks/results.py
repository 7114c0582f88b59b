"""What benchmarks write: tables, exponents of time, results.json, results.md and results.png."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import linregress


def exponent(sizes, seconds) -> tuple[float, float]:
    """Slope of log seconds over log sizes, and its standard deviation."""
    fit = linregress(np.log(sizes), np.log(seconds))
    return float(fit.slope), float(fit.stderr)


def markdown(head: list[str], rows: list[list[Any]]) -> str:
    """A table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines) + "\n"


def write_numbers(folder: Path, found: Any, table: str) -> None:
    """Write the numbers and their table, and print it."""
    (folder / "results.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    (folder / "results.md").write_text(table, encoding="utf-8")
    print(table)


def write(folder: Path, found: dict[str, Any], table: str, figure: Figure) -> None:
    """Write the numbers, their table and their figure, and print the table."""
    write_numbers(folder, found, table)
    figure.savefig(folder / "results.png", dpi=120)
