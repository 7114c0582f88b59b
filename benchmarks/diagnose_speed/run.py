"""How long does the diagnosis of a recording of about 40,000 residuals take, warm?

Large station recordings of the sealed benchmark's independent world (two cameras, hours, reference
and moving targets), each with one hidden effect or none. Each is diagnosed in one process that has
diagnosed it once before; the second time counts. results.json and results.md are written here.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parent), str(HERE.parent / "sealed")]

# jaxvm first, as in `jaxvm diagnose`: it sets the threads of NumPy's BLAS before NumPy is there.
from jaxvm.discover import diagnose  # noqa: E402, I001
from jaxvm.recording import read_recording  # noqa: E402
from results import markdown, write_numbers  # noqa: E402
from world import record  # noqa: E402

HIDDEN = (
    (),
    ("focal-grows-with-heat",),
    ("mount-slips",),
    ("principal-point-walks-with-lag",),
    ("target-bow",),
    ("range-index-wrong",),
    ("mount-creeps",),
)
"""One recording each; none is drawn by what it takes."""


def table(results: dict) -> str:
    """results.md."""
    rows = [
        [
            ", ".join(row["hidden"]) or "nothing",
            f"{row['residuals']:,}",
            f"{row['hypotheses']:,}",
            f"{row['first_s']:.1f}",
            f"{row['warm_s']:.1f}",
            ", ".join(row["findings"]) or "nothing",
        ]
        for row in results["runs"]
    ]
    head = ["hidden", "residuals", "hypotheses", "first (s)", "warm (s)", "found"]
    return (
        f"{results['processors']} processors; median of the warm runs "
        f"{results['median_s']:.1f} s.\n\n{markdown(head, rows)}"
    )


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as work:
        for number, hidden in enumerate(HIDDEN):
            folder = Path(work, str(number))
            record("station", 1000 + number, hidden, size="large").write(folder)
            recording = read_recording(folder)
            seconds = []
            for _ in range(2):
                began = time.perf_counter()
                found = diagnose(recording)
                seconds.append(time.perf_counter() - began)
            ranges = recording.ranges
            rows.append(
                {
                    "hidden": hidden,
                    "residuals": 2 * len(recording.observations.epoch)
                    + (0 if ranges is None else len(ranges.epoch)),
                    "first_s": seconds[0],
                    "warm_s": seconds[1],
                    "hypotheses": found.n_hypotheses,
                    "findings": [finding.effect.name for finding in found.findings],
                }
            )
            print(json.dumps(rows[-1]), flush=True)
    warm = [row["warm_s"] for row in rows]
    results = {"runs": rows, "median_s": statistics.median(warm), "processors": os.cpu_count()}
    write_numbers(HERE, results, table(results))


if __name__ == "__main__":
    main()
