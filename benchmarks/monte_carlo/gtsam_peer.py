"""Relay chains adjusted one after the other by GTSAM: the loop that a Python user writes.

    python gtsam_peer.py FOLDER TRIALS

FOLDER holds what run.py wrote (`structure`, `pixels`, `start`; raw float64, as for
peer/chains.cpp). GTSAM has no factor for a camera on one station that sees a mark on another, so
each link is a `CustomFactor` whose residuals and derivatives NumPy computes for all its marks at
once. Prints the seconds, the costs' sum and the evaluations as JSON; poses go to FOLDER/gtsam,
[trials, stations, 6].
"""

import json
import sys
import time
from pathlib import Path

import gtsam
import numpy as np


def read(folder: Path):
    """Counts, rows, pixels and the start."""
    raw = np.fromfile(folder / "structure")
    stations, rows = int(raw[0]), raw[2:].reshape(int(raw[1]), -1)
    pixels = np.fromfile(folder / "pixels").reshape(-1, len(rows), 2)
    return stations, rows, pixels, np.fromfile(folder / "start").reshape(stations, 6)


def pose(vector: np.ndarray) -> gtsam.Pose3:
    """Pose3 of turn and shift."""
    return gtsam.Pose3(gtsam.Rot3.Expmap(vector[:3]), vector[3:])


def hat(points: np.ndarray) -> np.ndarray:
    """Cross-product matrices of points, [n, 3, 3]."""
    x, y, z = points.T
    none = np.zeros_like(x)
    return np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)


def link(keys: tuple[int, int], rows: np.ndarray, pixels: np.ndarray):
    """Factor of all marks that one camera sees on another station."""
    focal, centre, sigma = rows[0, 2:4], rows[0, 4:6], rows[0, 6]
    rotation, shift, marks = rows[0, 7:16].reshape(3, 3), rows[0, 16:19], rows[:, 19:22]

    def error(this, values, jacobians):
        station, carrier = values.atPose3(keys[0]), values.atPose3(keys[1])
        turn, other = station.rotation().matrix(), carrier.rotation().matrix()
        world = marks @ other.T + carrier.translation()
        seen = (world - station.translation()) @ turn
        camera = seen @ rotation.T + shift
        depth = camera[:, 2:]
        off = (focal * camera[:, :2] / depth + centre - pixels) / sigma
        if jacobians is not None:
            slope = np.zeros((len(marks), 2, 3))
            slope[:, 0, 0] = focal[0] / depth[:, 0]
            slope[:, 1, 1] = focal[1] / depth[:, 0]
            slope[:, :, 2] = -focal * camera[:, :2] / depth**2
            slope = slope @ rotation / sigma
            # GTSAM's tangent: turn and shift in the axes of the pose itself.
            own = np.concatenate([slope @ hat(seen), -slope], axis=2)
            away = slope @ turn.T @ other
            theirs = np.concatenate([-away @ hat(marks), away], axis=2)
            jacobians[0] = own.reshape(-1, 6)
            jacobians[1] = theirs.reshape(-1, 6)
        return off.ravel()

    model = gtsam.noiseModel.Unit.Create(2 * len(marks))
    return gtsam.CustomFactor(model, list(keys), error)


def main() -> None:
    folder, trials = Path(sys.argv[1]), int(sys.argv[2])
    stations, rows, pixels, start = read(folder)
    ends = rows[:, :2].astype(int)
    links, number = np.unique(ends, axis=0, return_inverse=True)
    own = [np.flatnonzero(number.ravel() == k) for k in range(len(links))]
    first = [pose(vector) for vector in start]
    held = gtsam.noiseModel.Constrained.All(6)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-8)
    found, cost, evaluations = np.empty((trials, stations, 6)), 0.0, 0
    began = time.perf_counter()
    for trial in range(trials):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.add(gtsam.PriorFactorPose3(0, first[0], held))
        for (a, b), members in zip(links, own, strict=True):
            graph.add(link((int(a), int(b)), rows[members], pixels[trial, members]))
        for k, own_pose in enumerate(first):
            values.insert(k, own_pose)
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters)
        result = optimiser.optimize()
        cost += optimiser.error()
        evaluations += optimiser.iterations()
        for k in range(stations):
            solved = result.atPose3(k)
            found[trial, k, :3] = gtsam.Rot3.Logmap(solved.rotation())
            found[trial, k, 3:] = solved.translation()
    seconds = time.perf_counter() - began
    found.tofile(folder / "gtsam")
    print(json.dumps({"seconds": seconds, "cost": cost, "iterations": evaluations}))


if __name__ == "__main__":
    main()
