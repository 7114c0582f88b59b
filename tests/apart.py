"""Work in a process of its own: killed, on many devices, or one of several processes.

python apart.py trials FOLDER TRIALS BATCH SECONDS_A_BATCH [PORT RANK PROCESSES]
python apart.py adjust [PORT RANK PROCESSES]
"""

import sys
import time

import jax

task, *arguments = sys.argv[1:]
processes = arguments[4 if task == "trials" else 0 :]
if processes:
    port, rank, count = map(int, processes)
    jax.distributed.initialize(f"127.0.0.1:{port}", count, rank)

import numpy as np  # noqa: E402
from networks import stereo_recording  # noqa: E402
from pose_networks import network  # noqa: E402

from jaxvm.montecarlo import montecarlo  # noqa: E402
from jaxvm.network.scene import build  # noqa: E402
from jaxvm.network.start import start  # noqa: E402
from jaxvm.solve.adjust import adjust  # noqa: E402


def trials(folder: str, number: str, batch: str, seconds: str, *_) -> None:
    edges = [(0, 1), (1, 2), (2, 3), (3, 0)]
    scene = start(build(network(edges, 4).recording), "chordal")
    found = montecarlo(
        scene,
        lambda state: {"last": state.world_from_station[-1]},
        7,
        int(number),
        int(batch),
        lambda progress: time.sleep(float(seconds)),
        folder=folder,
    )
    print(jax.device_count(), found.results.ran, len(found.errors), *found.results.statistics.rms)


def adjusted(*_) -> None:
    """States of scenes of pixels and of links: largest difference to one device."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("observations",))
    known = stereo_recording()
    for scene in (known.true_scene(known.recording), build(network().recording)):
        one, shared = adjust(scene), adjust(scene, mesh=mesh)
        states = [np.asarray(own.scene.state.flatten()) for own in (one, shared)]
        print(jax.device_count(), shared.evaluations, np.abs(states[1] - states[0]).max())


if __name__ == "__main__":
    {"trials": trials, "adjust": adjusted}[task](*arguments)
