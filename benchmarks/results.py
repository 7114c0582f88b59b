"""What benchmarks of growing problems write: exponents of time, results.json, .md and .png."""

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


def write(folder: Path, found: dict[str, Any], table: str, figure: Figure) -> None:
    """Write the numbers, their table and their figure, and print the table."""
    (folder / "results.json").write_text(json.dumps(found, indent=1) + "\n")
    (folder / "results.md").write_text(table)
    figure.savefig(folder / "results.png", dpi=120)
    print(table)
