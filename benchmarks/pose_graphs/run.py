"""Published pose graphs against GTSAM: the same optimum, in how much time?

    python -m venv peer && peer/bin/pip install gtsam==4.3 numpy
    python benchmarks/pose_graphs/run.py --peer peer/bin/python

Rounds of ours and GTSAM's alternate. Both start from the same poses (the file's, which are the
odometry, or each program's own chordal start), take full Gauss-Newton steps and stop where the cost
changes by less than 1e-5 of itself; both times are warm and contain everything from the graph and
its start to the optimum (ours the sparsity pattern, too), but neither reading the file nor the
chordal start, which is timed apart. Our poses are judged by GTSAM's own error function. Writes
results.json and results.md beside this file.
"""

import argparse
import json
import os
import statistics
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxvm.network.chordal import chordal_poses
from jaxvm.network.estimate import estimated_model
from jaxvm.network.relations import held_poses, link_relations, pose_graph
from jaxvm.network.scene import Scene, build
from jaxvm.network.start import start
from jaxvm.recording import Recording, find_data
from jaxvm.recording.g2o import import_g2o, write_g2o
from jaxvm.solve.large import minimise_large, scaled_large
from jaxvm.solve.problem import Problem, scene_problem
from jaxvm.solve.sparse import Pattern, SparseFactors

HERE = Path(__file__).parent
CASES = [
    ("sphere2500", "odometry", False),
    ("sphere2500", "chordal", False),
    ("parking-garage", "odometry", False),
    ("parking-garage", "chordal", False),
    ("torus3D", "chordal", False),
    ("cubicle", "given", True),
    ("cubicle", "chordal", True),
]
"""Graph, start, and whether isotropic weights replace the file's."""

ISOTROPIC = np.diag(1.0 / np.repeat([400.0, 100.0], 3))
RTOL = 1e-5


def graph_of(name: str, isotropic: bool) -> Recording:
    """A graph as a recording of links."""
    file = find_data(f"pose-graphs/{name}.g2o.gz")
    if file is None:
        raise SystemExit(f"pose-graphs/{name}.g2o.gz is not there: set JAXVM_DATA")
    recording = import_g2o(file, mend=True)
    links = recording.links
    assert links is not None
    if isotropic:
        links = replace(links, covariance=np.broadcast_to(ISOTROPIC, links.covariance.shape))
    return replace(recording, links=links)


def chordal_seconds(scene: Scene) -> float:
    """Time of the chordal start alone, its graph being there (as for GTSAM's)."""
    graph, _ = pose_graph(scene, link_relations(scene), held_poses(scene, given=False))
    chordal_poses(graph, np.zeros((1, 6)))
    began = time.perf_counter()
    chordal_poses(graph, np.zeros((1, 6)))
    return time.perf_counter() - began


def optimised(problem: Problem):
    """From the graph and its start to the optimum."""
    pattern = Pattern.of(problem)
    factors = SparseFactors(pattern)
    scaled, normal = scaled_large(problem, pattern)
    fit = minimise_large(scaled, normal, factors, "gauss-newton", rtol=RTOL)
    return scaled, fit


def timed(problem: Problem, repeats: int) -> list[float]:
    """Seconds of several runs."""
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        optimised(problem)
        seconds.append(time.perf_counter() - began)
    return seconds


def peer(python: Path, *arguments: str) -> dict:
    """Answer of gtsam_peer.py."""
    command = [str(python), "-B", str(HERE / "gtsam_peer.py"), *arguments]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def case(python: Path, name: str, begin: str, isotropic: bool, rounds: int) -> dict:
    """Both programs on one graph from one start."""
    recording = graph_of(name, isotropic)
    scene = start(build(recording), "chordal" if begin == "chordal" else "given")
    problem = scene_problem(scene)
    scaled, fit = optimised(problem)
    also = ["--isotropic"] if isotropic else []
    ours, theirs, steps = [], [], 0
    for _ in range(rounds):
        ours += timed(problem, 2)
        found = peer(
            python, "solve", name, "--start", begin, "--method", "gauss-newton", "--repeats", "2",
            *also,
        )  # fmt: skip
        theirs.append(found["time"]["median_s"])
        steps = found["iterations"]
    model = estimated_model(scene.with_state(scaled.state(jnp.asarray(fit.x))))
    with tempfile.TemporaryDirectory() as folder:
        poses = Path(folder) / "poses.g2o"
        write_g2o(replace(recording, model=model, links=None), poses)
        judged = peer(python, "judge", name, str(poses), *also)
    return {
        "graph": name + (" (isotropic)" if isotropic else ""),
        "start": begin,
        "ours": {
            "seconds": statistics.median(ours),
            "fastest": min(ours),
            "steps": fit.accepted,
            "chordal_seconds": chordal_seconds(scene) if begin == "chordal" else 0.0,
        },
        "gtsam": {"seconds": statistics.median(theirs), "fastest": min(theirs), "steps": steps},
        "chi2_log": judged["chi2_log"],
        "chi2_g2o": judged["chi2_g2o"],
        "gtsam_chi2_log": found["chi2_log"],
        "why": fit.why,
    }


def table(rows: list[dict]) -> str:
    """Results in Markdown."""
    lines = [
        "| graph | start | chi-square (log), ours | GTSAM | (g2o), ours | steps, ours | GTSAM | "
        "seconds, ours | GTSAM | ratio |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        ours, theirs = row["ours"], row["gtsam"]
        lines.append(
            f"| {row['graph']} | {row['start']} | {row['chi2_log']:.8g} | "
            f"{row['gtsam_chi2_log']:.8g} | {row['chi2_g2o']:.8g} | {ours['steps']} | "
            f"{theirs['steps']} | {ours['seconds']:.3f} | {theirs['seconds']:.3f} | "
            f"{theirs['seconds'] / ours['seconds']:.2f} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--peer", type=Path, required=True, help="python with gtsam")
    asked.add_argument("--rounds", type=int, default=5)
    options = asked.parse_args()
    load = os.getloadavg()[0]
    rows = [case(options.peer, *one, rounds=options.rounds) for one in CASES]
    (HERE / "results.json").write_text(
        json.dumps({"cores": os.cpu_count(), "load_before": load, "rows": rows}, indent=1) + "\n"
    )
    (HERE / "results.md").write_text(table(rows))
    print(table(rows))


if __name__ == "__main__":
    main()
