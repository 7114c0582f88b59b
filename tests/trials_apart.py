"""Trials in a process of its own: killed, on many devices, or one of several processes.

python trials_apart.py FOLDER TRIALS BATCH [SECONDS_A_BATCH [PORT RANK PROCESSES]]
"""

import sys
import time

import jax

arguments = sys.argv[1:]
if len(arguments) > 4:
    port, rank, processes = map(int, arguments[4:7])
    jax.distributed.initialize(f"127.0.0.1:{port}", processes, rank)

from pose_networks import network  # noqa: E402

from jaxvm.montecarlo import montecarlo  # noqa: E402
from jaxvm.network.scene import build  # noqa: E402
from jaxvm.network.start import start  # noqa: E402

if __name__ == "__main__":
    edges = [(0, 1), (1, 2), (2, 3), (3, 0)]
    scene = start(build(network(edges, 4).recording), "chordal")
    found = montecarlo(
        scene,
        lambda state: {"last": state.world_from_station[-1]},
        7,
        int(arguments[1]),
        int(arguments[2]),
        lambda progress: time.sleep(float(arguments[3]) if len(arguments) > 3 else 0.0),
        folder=arguments[0],
    )
    print(jax.device_count(), found.results.ran, len(found.errors), *found.results.statistics.rms)
