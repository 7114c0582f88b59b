"""Monte Carlo of relay chains, each adjusted from its pixels, against loops over Ceres and GTSAM.

    python benchmarks/monte_carlo/run.py [--gtsam PYTHON] [--ceres PROGRAM] [--rounds 5]

PYTHON is one that has gtsam (`gtsam_peer.py`); PROGRAM is built from `peer/` (C++, Ceres' own
automatic derivatives; `cmake -S benchmarks/monte_carlo/peer -B build && cmake --build build`, with
the distribution's libceres-dev). All adjust the same measurements from the same start and must
agree; rounds are interleaved, medians count, compiling stands apart. Then how time grows with the
number of trials and the length of the chain, what the size of a batch does to poses from 20 points,
and how much memory is taken. Writes results.json, results.md and results.png.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from jaxvm.geometry.poses import pose_from_vector, vector_from_pose
from jaxvm.montecarlo import network_study, pose_study, run
from jaxvm.network.draw import drawn
from jaxvm.network.scene import Scene, build
from jaxvm.pose.precision import Setup
from jaxvm.scenes import parse_description, simulate_network

sys.path.insert(0, str(Path(__file__).parents[1]))
import results

HERE = Path(__file__).parent
TRIALS, STATIONS, SEED = 10_000, 6, 0
MANY = (1_000, 3_000, 10_000, 30_000, 100_000)
LONG = (3, 6, 12, 24, 48)
BATCHES = (64, 256, 500, 1_024, 4_096, 10_000)


def poses(state):
    """The quantity: all poses of stations."""
    return {"station": state.world_from_station}


def chain(stations: int) -> Scene:
    """A relay chain at its true state: each station sees 16 marks on the next, 10 m away."""
    made = simulate_network(
        parse_description(f'layout = "chain"\nstations = {stations}\n'), noise=0.0
    )
    scene = build(made.recording)
    return scene.with_state(made.truth.state(scene))


def write(scene: Scene, trials: int, folder: Path) -> None:
    """What the peers read: structure, start, and the pixels of our trials 0 to `trials` - 1."""
    factor, flat = scene.network.pixels[0], np.asarray(scene.state.flatten())
    slots = np.asarray(factor.slots)[: factor.n_real]
    numbers = {int(at): k for k, at in enumerate(np.unique(slots[:, [10, 16]]))}
    rows = []
    for own, sigma in zip(slots, np.asarray(factor.sigma), strict=False):
        values = flat[own]
        camera = pose_from_vector(jnp.asarray(values[4:10])).inverse()
        mark = pose_from_vector(jnp.asarray(values[22:28])).apply(jnp.asarray(values[28:31]))
        ends = [numbers[int(own[10])], numbers[int(own[16])]]
        rows.append(
            np.concatenate(
                [ends, values[:4], sigma[:1], np.ravel(camera.rotation), camera.shift, mark]
            )
        )
    start = np.array([flat[at : at + 6] for at in numbers])
    np.concatenate([[len(numbers), len(rows)], np.ravel(rows)]).tofile(folder / "structure")
    start.tofile(folder / "start")
    key = jax.random.key(SEED)

    @jax.jit
    @jax.vmap
    def pixels(number):
        own = drawn(scene.network, scene.state, jax.random.fold_in(key, number))
        return own.pixels[0].circumstances.pixel

    drawn_pixels = np.asarray(pixels(jnp.arange(trials)))[:, : factor.n_real]
    drawn_pixels.tofile(folder / "pixels")


def ours(study, trials: int, batch: int | None = None) -> tuple[dict, object]:
    """Seconds of a warm run, and what it found."""
    found = run(study, SEED, trials, batch=batch)
    row = {"seconds": found.seconds - found.compiling, "batch": found.batch}
    return row | {"compiling": found.compiling, "failed": found.failed}, found


def said(command: list[str]) -> dict:
    """What a peer prints last."""
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def off(found: np.ndarray, true: np.ndarray, errors: np.ndarray) -> float:
    """Largest distance of a peer's poses from ours, in standard deviations of the poses."""
    own = np.asarray(true)[None] + errors
    both = [jax.vmap(jax.vmap(pose_from_vector))(jnp.asarray(p)) for p in (own, found)]
    between = jax.vmap(jax.vmap(lambda a, b: vector_from_pose(a.inverse() @ b)))(*both)
    spread = errors.std(axis=0)
    return float(np.nanmax(np.abs(between)[:, 1:] / spread[1:]))


def against(options) -> dict:
    """Ten thousand chains of six stations, by all."""
    scene = chain(STATIONS)
    study = network_study(scene, poses)
    true = np.asarray(scene.state.world_from_station)
    free = np.flatnonzero(np.isfinite(true).all(axis=1))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write(scene, TRIALS, folder)
        files = [str(folder / name) for name in ("structure", "pixels", "start", "ceres")]
        rounds = {"jaxvm": [], "Ceres": [], "GTSAM": []}
        first, found = ours(study, TRIALS)
        costs = {"jaxvm": float(found.columns["cost"].sum())}
        for _ in range(options.rounds):
            rounds["jaxvm"].append(ours(study, TRIALS, found.batch)[0]["seconds"])
            if options.ceres:
                told = said([str(options.ceres), *files])
                rounds["Ceres"].append(told["seconds"][0])
                costs["Ceres"] = told["cost"]
            if options.gtsam:
                told = said(
                    [str(options.gtsam), "-B", str(HERE / "gtsam_peer.py"), place, str(TRIALS)]
                )
                rounds["GTSAM"].append(told["seconds"])
                costs["GTSAM"] = told["cost"]
            print({name: own[-1:] for name, own in rounds.items()}, flush=True)
        errors = found.errors.reshape(TRIALS, -1, 6)[:, free]
        apart = {
            name: off(np.fromfile(folder / file).reshape(TRIALS, -1, 6), true[free], errors)
            for name, file in (("Ceres", "ceres"), ("GTSAM", "gtsam"))
            if rounds[name]
        }
    seconds = {name: float(np.median(own)) for name, own in rounds.items() if own}
    return {
        "trials": TRIALS,
        "stations": STATIONS,
        "observations": int(scene.network.pixels[0].n_real),
        "first": first,
        "batch": found.batch,
        "seconds": seconds,
        "rounds": rounds,
        "costs": costs,
        "off_in_deviations": apart,
        "factor": {name: own / seconds["jaxvm"] for name, own in seconds.items()},
    }


def growth() -> dict:
    """Time over trials and over the length of the chain, warm."""
    study = network_study(chain(STATIONS), poses)
    trials, lengths = [], []
    for number in MANY:
        ours(study, min(number, 3_000), 256)
        trials.append({"trials": number} | ours(study, number, 256)[0])
        print(trials[-1], flush=True)
    for stations in LONG:
        own = network_study(chain(stations), poses)
        ours(own, 600, 64)
        lengths.append({"stations": stations} | ours(own, 3_000, 64)[0])
        print(lengths[-1], flush=True)
    return {
        "trials": trials,
        "lengths": lengths,
        "of_trials": results.exponent(MANY, [row["seconds"] for row in trials]),
        "of_lengths": results.exponent(LONG, [row["seconds"] for row in lengths]),
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


class Twenty(eqx.Module):
    """Targets of 20 points before a camera, turned at random."""

    points: jax.Array

    def __call__(self, key) -> Setup:
        pose = jnp.concatenate([0.4 * jax.random.normal(key, (3,)), jnp.array([0.0, 0.0, 10.0])])
        return Setup(self.points, pose, jnp.asarray(2_000.0), jnp.asarray(0.2))


def batches() -> list[dict]:
    """Poses of 20 points in batches of all sizes, and of the size that is found."""
    points = jnp.asarray(np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3)))
    study = pose_study(Twenty(points))
    rows = []
    for batch in (*BATCHES, None):
        # The warm run has as many trials: a size that is found depends on them.
        for _ in range(2):
            before = time.perf_counter()
            row, _ = ours(study, 10_000, batch)
        rows.append({"asked": batch} | row | {"wall": time.perf_counter() - before})
        print(rows[-1], flush=True)
    return rows


def table(found: dict) -> str:
    """results.md."""
    a, g = found["against"], found["growth"]
    lines = [
        "# Monte Carlo",
        "",
        f"{found['processors']} processors, medians of {len(a['rounds']['jaxvm'])} interleaved "
        "rounds, compiling apart. `python benchmarks/monte_carlo/run.py --gtsam PYTHON --ceres "
        "PROGRAM`",
        "",
        f"## {a['trials']:,} relay chains of {a['stations']} stations, {a['observations']} image "
        "points each, adjusted from pixels",
        "",
        "| loop | seconds | a chain | times as long | sum of costs | farthest pose from ours |",
        "|---|---|---|---|---|---|",
    ]
    words = {
        "jaxvm": f"jaxvm, batches of {a['batch']} (found by measuring; first run compiles "
        f"{a['first']['compiling']:.1f} s)",
        "Ceres": "Ceres 2.1 in C++, one problem after the other",
        "GTSAM": "GTSAM 4.3 from Python, NumPy for all marks of a link at once",
    }
    for name, seconds in a["seconds"].items():
        distance = a["off_in_deviations"].get(name)
        far = "" if distance is None else f"{distance:.1g} of its sigma"
        lines.append(
            f"| {words[name]} | {seconds:.3f} | {1e6 * seconds / a['trials']:.0f} us | "
            f"{a['factor'][name]:.1f} | {a['costs'][name]:.3f} | {far} |"
        )
    lines += [
        "",
        "## Growth",
        "",
        "Time ~ trials^{:.2f} ± {:.2f}; ~ stations^{:.2f} ± {:.2f} at 3,000 trials. ".format(
            *g["of_trials"], *g["of_lengths"]
        )
        + f"Peak memory of the process {g['memory_mb']:.0f} MB.",
        "",
        "| trials (6 stations) | seconds | stations (3,000 trials) | seconds |",
        "|---|---|---|---|",
    ]
    for many, long in zip(g["trials"], g["lengths"], strict=True):
        lines.append(
            f"| {many['trials']:,} | {many['seconds']:.3f} | {long['stations']} | "
            f"{long['seconds']:.3f} |"
        )
    lines += [
        "",
        "## 10,000 poses from 20 points, from their global starts",
        "",
        "| batch | seconds |",
        "|---|---|",
    ]
    for row in found["batches"]:
        asked = f"found: {row['batch']}" if row["asked"] is None else f"{row['asked']:,}"
        lines.append(f"| {asked} | {row['seconds']:.2f} |")
    return "\n".join(lines) + "\n"


def draw(found: dict) -> Figure:
    """results.png."""
    figure = Figure(figsize=(11, 3), layout="constrained")
    loops, trials, lengths, sizes = figure.subplots(1, 4)
    a, g = found["against"], found["growth"]
    bars = loops.barh(list(a["seconds"]), list(a["seconds"].values()))
    loops.bar_label(bars, fmt="%.2f s", padding=3)
    loops.set(xlabel="seconds", title=f"{a['trials']:,} chains")
    loops.set_xlim(right=1.35 * max(a["seconds"].values()))
    for axis, rows, name, title in (
        (trials, g["trials"], "trials", f"6 stations: n^{g['of_trials'][0]:.2f}"),
        (lengths, g["lengths"], "stations", f"3,000 trials: n^{g['of_lengths'][0]:.2f}"),
    ):
        axis.loglog([row[name] for row in rows], [row["seconds"] for row in rows], "o-")
        axis.set(xlabel=name, ylabel="seconds", title=title)
    lengths.set_xticks(LONG, [str(n) for n in LONG])
    lengths.minorticks_off()
    own = [row for row in found["batches"] if row["asked"] is not None]
    sizes.semilogx([r["asked"] for r in own], [r["seconds"] for r in own], "o-")
    chosen = found["batches"][-1]
    sizes.plot(chosen["batch"], chosen["seconds"], "*", markersize=12, color="C1")
    sizes.set(xlabel="batch (star: found)", ylabel="seconds", title="10,000 poses of 20 points")
    sizes.set_ylim(bottom=0.0)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description="time Monte Carlo studies against loops")
    parser.add_argument("--gtsam", type=Path, default=None, help="a Python that has gtsam")
    parser.add_argument("--ceres", type=Path, default=None, help="the program built from peer/")
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    found = {
        "processors": os.cpu_count(),
        "against": against(options),
        "growth": growth(),
        "batches": batches(),
    }
    results.write(HERE, found, table(found), draw(found))


if __name__ == "__main__":
    main()
