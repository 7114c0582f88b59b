"""What does an accelerator gain, and are its numbers the processors' numbers?

    python benchmarks/accelerator/run.py [--quick] [--only WORK ...] [--out FOLDER] [--beside FILE]

On a machine with an accelerator (and a jaxlib that knows it) the same work runs on it and on the
processors of that machine: Monte Carlo of relay chains and of single poses in float64 and float32,
adjustment of blocks of images, adjustment of a relay network in one program, SPGD of many chains,
scoring of hypotheses, a diagnosis.
Each in a process of its own, warm, medians; compiling stands apart. What each found (costs, RMS
errors) is compared. Without an accelerator the processors' column alone is filled, beside the other
column of an earlier run where one is given. Writes results.json, results.md and results.png.
"""

import argparse
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import results  # noqa: E402

ROUNDS = 3

SETTLED = 1e-2
"""Length of a step (standard deviations) at which float32 is settled (as in
`../monte_carlo/devices.py`)."""


def of(folder: str, file: str) -> Any:
    """A module of another benchmark: many are called run.py."""
    spec = importlib.util.spec_from_file_location(f"{folder}_{file}", HERE.parent / folder / file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def timed(work: Callable[[], object]) -> dict:
    """Seconds of the first run and the median of warm ones."""
    seconds = []
    for _ in range(1 + ROUNDS):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return {"first_s": seconds[0], "seconds": statistics.median(seconds[1:])}


def studied(study, trials: int) -> dict:
    """A Monte Carlo study, in batches of a size found by measuring."""
    from jaxvm.montecarlo import run

    first = run(study, 0, trials)
    told = timed(lambda: run(study, 0, trials, batch=first.batch))
    rms = np.asarray(first.statistics.rms)
    return told | {
        "first_s": first.seconds,
        "batch": first.batch,
        "failed": first.failed,
        "found": rms[rms > 0.0].tolist(),
    }


def chains(trials: int, stations: int, single: bool = False, descend: bool = False) -> dict:
    """Relay chains, each adjusted from its pixels, or descended by SPGD."""
    from jaxvm.montecarlo import GaussNewton, Spgd, network_study

    own = of("monte_carlo", "run.py")
    estimator = Spgd() if descend else GaussNewton(SETTLED)
    study = network_study(own.chain(stations), own.poses, estimator=estimator)
    return studied(study.in_single_precision() if single else study, trials)


def poses(trials: int, single: bool = False) -> dict:
    """Poses of targets of 20 points, from their global starts."""
    from jaxvm.montecarlo import pose_study

    points = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))
    study = pose_study(of("monte_carlo", "run.py").Twenty(jax.numpy.asarray(points)))
    return studied(study.in_single_precision() if single else study, trials)


def adjusted(scene, **how) -> dict:
    """An adjustment, again and again from the same start."""
    from jaxvm.solve.adjust import adjust

    last = adjust(scene, check=False, **how)
    told = timed(lambda: adjust(scene, check=False, **how))
    return told | {
        "first_s": last.seconds,
        "evaluations": last.evaluations,
        "found": [last.cost],
    }


def block(cameras: int, points: int, views: float) -> dict:
    """A simulated block of images: what is left after the points are eliminated is factorised on
    the host."""
    from jaxvm.network.scene import build
    from jaxvm.recording.bal import import_bal

    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "block.txt"
        of("bundle_adjustment", "simulated.py").write(file, cameras, points, views)
        scene = build(import_bal(file))
    return adjusted(scene, rtol=1e-7, damping=1e-4)


def relay(stations: int) -> dict:
    """A relay chain adjusted in one program on the device, nothing on the host."""
    from jaxvm.network.scene import build
    from jaxvm.network.start import start
    from jaxvm.scenes import parse_description, simulate_network

    text = f'layout = "chain"\nstations = {stations}\n'
    made = simulate_network(parse_description(text), 0)
    mesh = jax.make_mesh((jax.device_count(),), ("observations",))
    return adjusted(start(build(made.recording)), mesh=mesh)


def scoring(epochs: int, hypotheses: int) -> dict:
    """Hypotheses scored on the deformation scene: tangents on the device, products on the host."""
    benchmark = of("scoring", "run.py")
    benchmark.ROUNDS, benchmark.REFITS = 2, 1
    found = benchmark.score(epochs, hypotheses)
    told = {name: found[name] for name in ("first_s", "seconds", "residuals")}
    return told | benchmark.refit(epochs, hypotheses)


def diagnosis() -> dict:
    """A station's hours, diagnosed again and again: of the sealed benchmark's world, 40,000
    residuals, a focal length that drifts with temperature."""
    sys.path.insert(0, str(HERE.parent / "sealed"))
    from world import record

    from jaxvm.discover import diagnose
    from jaxvm.recording import read_recording

    with tempfile.TemporaryDirectory() as place:
        hidden = ("focal-grows-with-heat",)
        record("station", 1001, hidden, size="large").write(Path(place, "recording"))
        recording = read_recording(Path(place, "recording"))
    last = diagnose(recording)
    told = timed(lambda: diagnose(recording))
    found = [last.plain.chi2_per_dof, last.final.chi2_per_dof]
    found += [size for one in last.findings for size in one.final_stds]
    return told | {"first_s": last.seconds, "found": found}


WORK: dict[str, tuple[str, Callable[[], dict]]] = {
    "chains": ("10,000 chains of 6 stations, float64", lambda: chains(10_000, 6)),
    "many-chains": ("100,000 chains of 6 stations, float64", lambda: chains(100_000, 6)),
    "short-chains": ("100,000 chains of 3 stations, float64", lambda: chains(100_000, 3)),
    "short-chains-single": (
        "100,000 chains of 3 stations, float32",
        lambda: chains(100_000, 3, single=True),
    ),
    "spgd": ("256 chains of 3 stations by SPGD", lambda: chains(256, 3, descend=True)),
    "poses": ("200,000 poses from 20 points, float64", lambda: poses(200_000)),
    "poses-single": ("200,000 poses from 20 points, float32", lambda: poses(200_000, single=True)),
    "relay": ("a chain of 48 stations adjusted in one program", lambda: relay(48)),
    "block-16": ("block of 16 cameras, 22,106 points", lambda: block(16, 22_106, 3.8)),
    "block-257": ("block of 257 cameras, 65,132 points", lambda: block(257, 65_132, 3.5)),
    "block-961": ("block of 961 cameras, 187,103 points", lambda: block(961, 187_103, 9.0)),
    "scoring": ("10,000 hypotheses on 100,000 residuals", lambda: scoring(240, 10_000)),
    "diagnosis": ("diagnosis of 40,000 residuals", diagnosis),
}
"""What is done, by name."""

QUICK = ("short-chains", "short-chains-single", "relay", "block-16")


def apart(name: str, platform: str, longest: float, **env: str) -> dict:
    """A piece of work on a platform, in a process of its own."""
    # OpenBLAS as jaxvm sets it where NumPy is not there before.
    own = {"JAX_PLATFORMS": platform, "OPENBLAS_NUM_THREADS": "1"} | env
    try:
        done = subprocess.run(
            [sys.executable, __file__, "--one", name],
            check=True,
            capture_output=True,
            text=True,
            timeout=longest,
            env=os.environ | own,
        )
    except subprocess.TimeoutExpired:
        return {"why": f"given up after {longest:.0f} s"}
    except subprocess.CalledProcessError as problem:
        return {"why": problem.stderr.strip()[-1500:]}
    return json.loads(done.stdout.splitlines()[-1])


def compiled(names, platform: str, longest: float) -> dict[str, dict]:
    """All work at the same time: what the compiler makes stays in JAX's cache on disk."""
    with ThreadPoolExecutor(len(names)) as pool:
        few = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        found = pool.map(lambda name: apart(name, platform, longest, **few), names)
        return dict(zip(names, found, strict=True))


def differ(row: dict) -> float | None:
    """Largest relative difference of what the two found."""
    both = [row[side].get("found") for side in ("accelerator", "processors")]
    if None in both:
        return None
    a, b = (np.asarray(one) for one in both)
    return float(np.abs(a / b - 1.0).max()) if a.shape == b.shape else float("inf")


def table(found: dict) -> str:
    """results.md."""
    other = found.get("jax_accelerator", found["jax"])
    where = " of another machine" if "jax_accelerator" in found else " of the same machine"
    lines = [
        "# On an accelerator",
        "",
        f"{found['accelerator'] or 'No accelerator'} (jax {other}) against {found['processors']} "
        f"processors{where} (jax {found['jax']}), warm, medians of {ROUNDS}; first: compiling, "
        "too, all work at the same time. `python benchmarks/accelerator/run.py`",
        "",
        "| work | accelerator | first | processors | first | times as fast | numbers differ by |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in found["rows"]:
        cells, seconds = [row["what"]], []
        for side in ("accelerator", "processors"):
            own = row[side]
            seconds.append(own.get("seconds"))
            cells += (
                [f"{own['seconds']:.3f} s", f"{own['first_s']:.1f} s"]
                if "seconds" in own
                else [own.get("why", "")[:60], ""]
            )
        gain = seconds[1] / seconds[0] if None not in seconds else None
        cells.append("" if gain is None else f"{gain:.1f}")
        off = differ(row)
        cells.append("" if off is None else f"{off:.1g}")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def draw(found: dict) -> Figure:
    """results.png."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    rows = found["rows"][::-1]
    names = {"processors": f"{found['processors']} processors", "accelerator": found["accelerator"]}
    for k, side in enumerate(names):
        seconds = [row[side].get("seconds", np.nan) for row in rows]
        axis.barh(np.arange(len(rows)) + 0.4 * k, seconds, 0.4, label=names[side])
    axis.set_yticks(np.arange(len(rows)) + 0.2, [row["what"] for row in rows])
    # While nothing is measured yet there is no logarithm.
    known = any("seconds" in row[side] for row in rows for side in names)
    axis.set(xscale="log" if known else "linear", xlabel="seconds, warm")
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description="time an accelerator against the processors")
    parser.add_argument("--quick", action="store_true", help="little work, nothing written")
    parser.add_argument("--only", nargs="+", choices=list(WORK), default=None)
    parser.add_argument("--longest", type=float, default=300.0, help="seconds of one piece of work")
    parser.add_argument("--out", type=Path, default=HERE, help="folder of the results")
    parser.add_argument("--beside", type=Path, help="results.json of a machine with an accelerator")
    parser.add_argument("--one", choices=list(WORK), default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(WORK[options.one][1]()))
        return
    # Of another process: one that has the device takes most of its memory.
    asked = "import jax; d = jax.devices()[0]; print(jax.default_backend(), d.device_kind, sep='|')"
    told = subprocess.run([sys.executable, "-c", asked], check=True, stdout=subprocess.PIPE)
    platform, kind = told.stdout.decode().strip().splitlines()[-1].split("|")
    platform = "cuda" if platform == "gpu" else platform
    there = platform != "cpu"
    found = {
        "accelerator": kind if there else None,
        "processors": os.cpu_count(),
        "jax": jax.__version__,
    }
    names = options.only or (QUICK if options.quick else tuple(WORK))
    found["rows"] = [{"what": WORK[n][0], "accelerator": {}, "processors": {}} for n in names]
    if options.beside:
        other = json.loads(options.beside.read_text())
        found |= {"accelerator": other["accelerator"], "jax_accelerator": other["jax"]}
        known = {row["what"]: row["accelerator"] for row in other["rows"]}
        for row in found["rows"]:
            row["accelerator"] = known.get(row["what"], {})
    sides = {"accelerator": platform} if there else {}
    for side, where in (sides | {"processors": "cpu"}).items():
        first = compiled(names, where, options.longest)
        for name, row in zip(names, found["rows"], strict=True):
            own = first[name]
            if "seconds" in own:
                own = apart(name, where, options.longest) | {"first_s": own["first_s"]}
            row[side] = own
            print(json.dumps({name: {side: own}}), flush=True)
            if not options.quick:
                # What is done so far stays if the machine is taken away.
                results.write(options.out, found, table(found), draw(found))
    if options.quick:
        print(table(found))


if __name__ == "__main__":
    main()
