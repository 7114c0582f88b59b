"""How do trials scale over devices, and what does single precision cost and gain?

    python benchmarks/monte_carlo/devices.py

The same chains as in `run.py`. Devices are forced on the processors (JAX's own
`--xla_force_host_platform_device_count`), each number of them in a process of its own; all must
give the same errors. Then chains of more and more stations in float32 against float64: trials that
do not converge, and errors in units of those foretold. Writes results-devices.json and .md.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
from run import SEED, STATIONS, TRIALS, chain, poses

from jaxvm.montecarlo import GaussNewton, network_study, run

HERE = Path(__file__).parent
DEVICES = (1, 2, 4, 8)
LONG, FEW = (3, 6, 12, 24, 48), 3_000
SETTLED = 1e-2
"""Length of a step (standard deviations) at which float32 is settled."""
ROUNDS = 5


def timed(study, trials: int, **how):
    """Median seconds of a warm run, and what it found."""
    found = run(study, SEED, trials, **how)
    seconds = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        found = run(study, SEED, trials, batch=found.batch, **how)
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds)), found


def on_devices() -> dict:
    """Of this process, which has as many devices as its environment says."""
    devices = jax.devices()
    mesh = jax.make_mesh((len(devices),), ("trials",)) if len(devices) > 1 else None
    seconds, found = timed(network_study(chain(STATIONS), poses), TRIALS, mesh=mesh)
    return {
        "devices": len(devices),
        "seconds": seconds,
        "batch": found.batch,
        "rms": np.asarray(found.statistics.rms).tolist(),
    }


def apart(devices: int) -> dict:
    """The same in a process of its own."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    flags = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
    command = [sys.executable, __file__, "--one"]
    done = subprocess.run(
        command,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"XLA_FLAGS": flags},
    )
    return json.loads(done.stdout.splitlines()[-1])


def precision(stations: int) -> dict:
    """Chains of so many stations in float64 and in float32."""
    study = network_study(chain(stations), poses, estimator=GaussNewton(SETTLED))
    double_s, double = timed(study, FEW)
    single_s, single = timed(study.in_single_precision(), FEW)
    sigma = np.sqrt(np.diagonal(study.covariance))
    free = sigma > 0.0
    off = 1.0 / np.sqrt(2 * FEW)
    ratio = {
        name: np.asarray(found.statistics.rms)[free] / sigma[free]
        for name, found in (("double", double), ("single", single))
    }
    return {
        "stations": stations,
        "double_s": double_s,
        "single_s": single_s,
        "failed_single": single.failed,
        "failed_double": double.failed,
        "worst_double": float(np.abs(ratio["double"] - 1.0).max() / off),
        "worst_single": float(np.abs(ratio["single"] - 1.0).max() / off),
        "largest_ratio_single": float(ratio["single"].max()),
    }


def table(found: dict) -> str:
    """results-devices.md."""
    lines = [
        "# Monte Carlo over devices, and in single precision",
        "",
        f"{os.cpu_count()} processors, medians of {ROUNDS} warm runs. "
        "`python benchmarks/monte_carlo/devices.py`",
        "",
        f"## {TRIALS:,} chains of {STATIONS} stations over forced devices of the same processors",
        "",
        "One device works on all processors already: what is shown is that devices cost nothing "
        f"here. The largest difference of any RMS error is {found['differ']:.1g} of itself.",
        "",
        "| devices | batch | seconds |",
        "|---|---|---|",
        *(f"| {r['devices']} | {r['batch']} | {r['seconds']:.3f} |" for r in found["devices"]),
        "",
        f"## {FEW:,} chains in float64 and in float32, Gauss-Newton settled at {SETTLED:g} sigma",
        "",
        "Worst: largest distance of a measured RMS error from the foretold one, in standard "
        "deviations of the measured one (about 3 of so many is chance).",
        "",
        "| stations | float64 | float32 | failed | worst, float64 | worst, float32 | "
        "largest RMS over foretold, float32 |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in found["precision"]:
        lines.append(
            f"| {r['stations']} | {r['double_s']:.3f} s | {r['single_s']:.3f} s | "
            f"{r['failed_single']} | {r['worst_double']:.1f} | {r['worst_single']:.1f} | "
            f"{r['largest_ratio_single']:.3f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description="Monte Carlo over devices and in float32")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    if parser.parse_args().one:
        print(json.dumps(on_devices()))
        return
    devices = [apart(number) for number in DEVICES]
    first = np.array(devices[0]["rms"])
    differ = max(
        float(np.abs(np.array(row["rms"])[first > 0] / first[first > 0] - 1.0).max())
        for row in devices
    )
    rows = []
    for stations in LONG:
        rows.append(precision(stations))
        print(rows[-1], flush=True)
    found = {"devices": devices, "differ": differ, "precision": rows}
    text = table(found)
    (HERE / "results-devices.json").write_text(json.dumps(found, indent=1) + "\n")
    (HERE / "results-devices.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
