"""The same trajectories given to a subspace identification (N4SID, of the package nfoursid).

`pip install nfoursid`, then `python benchmarks/drift/peers.py [--count 8] [--first 3000]`

Both learn from one recording of a world of `world.py`: ours as `jaxvm identify` does, N4SID from
the same trajectories and inputs, in even steps, with the order from 1 to 6 whose simulation is best
on the last third of the recording. Both simulate another recording from its inputs alone. Writes
peers.json and results-peers.md.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
from nfoursid.nfoursid import NFourSID
from nfoursid.state_space import StateSpace
from world import FAMILIES, pair, relative

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from results import markdown  # noqa: E402

from jaxvm.identify import compensate, identify  # noqa: E402
from jaxvm.identify.inputs import inputs_of  # noqa: E402
from jaxvm.identify.model import CameraDrift  # noqa: E402
from jaxvm.physics.drivers import POWER_ON  # noqa: E402
from jaxvm.recording import read_recording  # noqa: E402


def drive(inputs, names, reference) -> np.ndarray:
    """Inputs at the epochs [epochs, inputs], from their reference; power as 0 and 1."""
    rows = []
    for name, zero in zip(names, reference, strict=True):
        x = inputs.row(name)[inputs.epoch]
        rows.append((x >= 0.0).astype(float) if name.startswith(POWER_ON) else x - zero)
    return np.array(rows).T


def n4sid(u: np.ndarray, y: np.ndarray, order: int) -> StateSpace:
    """State space of an order, from even samples."""
    frame = pd.DataFrame(np.hstack([u, y]))
    frame.columns = [*(f"u{k}" for k in range(u.shape[1])), *(f"y{k}" for k in range(y.shape[1]))]
    found = NFourSID(
        frame, list(frame.columns[u.shape[1] :]), list(frame.columns[: u.shape[1]]), 8
    )  # fmt: skip
    found.subspace_identification()
    return found.system_identification(rank=order)[0]


def simulated(model: StateSpace, u: np.ndarray) -> np.ndarray:
    """Outputs from inputs alone, settled at the first one."""
    a, b, c, d = model.a, model.b, model.c, model.d
    if np.abs(np.linalg.eigvals(a)).max() >= 1.0:
        return np.full((len(u), len(c)), np.nan)
    x = np.linalg.solve(np.eye(len(a)) - a, b @ u[0])
    out = []
    for own in u:
        out.append(c @ x + d @ own)
        x = a @ x + b @ own
    return np.array(out)


def one(family: str, seed: int) -> dict:
    train, test = pair(seed, family)
    with tempfile.TemporaryDirectory() as place:
        train.write(Path(place) / "train")
        test.write(Path(place) / "test")
        learnt, other = (read_recording(Path(place) / name) for name in ("train", "test"))
    found = identify(learnt, one_step=False)
    (own,) = found.cameras
    truth = relative(train, test)

    def rms(x) -> float:
        return float(np.sqrt(np.mean(np.sum(x**2, axis=-1))))

    ours = truth + compensate(other, found.model).correction.reshape(truth.shape)
    dynamics, courses = own.drift.dynamics, own.trajectories
    inputs, further = (inputs_of(r).only(dynamics.inputs) for r in (learnt, other))
    u, v = (drive(i, dynamics.inputs, dynamics.reference) for i in (inputs, further))
    middle, scale = u.mean(axis=0), u.std(axis=0) + 1e-9
    u, v = (u - middle) / scale, (v - middle) / scale
    y, cut = courses.mode, 2 * len(u) // 3
    errors = {}
    for order in range(1, 7):
        model = n4sid(u[:cut], y[:cut], order)
        left = simulated(model, u)[cut:] - y[cut:]
        errors[order] = np.inf if np.isnan(left).any() else float(np.mean(left**2))
    order = min(errors, key=lambda k: errors[k])
    outputs = simulated(n4sid(u, y, order), v)
    outputs = outputs - simulated(n4sid(u, y, order), u).mean(axis=0)
    ports = outputs @ courses.ports_from_mode.T
    # The drift of a linear map of ports: through our own compensation, with these ports.
    row = _with_courses(other, own.drift, ports)
    theirs = truth + row.reshape(truth.shape)
    return {
        "family": family, "seed": seed, "order": order,
        "removed": 1.0 - rms(ours) / rms(truth),
        "removed_n4sid": 1.0 - rms(theirs) / rms(truth) if np.isfinite(theirs).all() else None,
    }  # fmt: skip


def _with_courses(recording, drift: CameraDrift, ports: np.ndarray) -> np.ndarray:
    from jaxvm.identify.compensate import moved

    obs = recording.observations
    depth = np.full(len(obs.epoch), drift.depth_m)
    camera = recording.model.cameras[0]
    return -moved(camera, drift, obs.pixel, depth, ports[obs.epoch])


def table(rows: list[dict]) -> str:
    """results-peers.md."""
    lines = []
    for family in dict.fromkeys(row["family"] for row in rows):
        own = [row for row in rows if row["family"] == family]
        # A model that runs away removes nothing.
        theirs = [-np.inf if r["removed_n4sid"] is None else r["removed_n4sid"] for r in own]
        medians = np.median([r["removed"] for r in own]), np.median(theirs)
        lines.append([family, len(own), *(f"{100.0 * share:.1f} %" for share in medians)])
    head = ["family", "worlds", "drift removed, median", "by N4SID"]
    return "Both from the same trajectories.\n\n" + markdown(head, lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="compare with subspace identification")
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--first", type=int, default=3000)
    options = parser.parse_args()
    rows = []
    for family in FAMILIES:
        for seed in range(options.first, options.first + options.count):
            rows.append(one(family, seed))
            print(rows[-1], flush=True)
    (HERE / "peers.json").write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    (HERE / "results-peers.md").write_text(table(rows), encoding="utf-8")
    print(table(rows))


if __name__ == "__main__":
    main()
