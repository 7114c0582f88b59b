"""Ceres on a bundle adjustment problem, through pycolmap's compiled cost functions.

    python ceres_peer.py FILE --solver DENSE_SCHUR|SPARSE_SCHUR [--repeats N]

To be run by a Python that has pycolmap (which brings Ceres); it imports nothing of the project. It
prints JSON: start and final cost (half the sum of squares) and, for each repetition, the cost and
the seconds after every iteration as Ceres itself reports them. Same camera (focal length, k1, k2),
nothing held, no loss, 2 threads.
"""

import argparse
import gzip
import json
import os
import re
import tempfile

import numpy as np
import pycolmap


def read(file):
    opened = gzip.open(file, "rt") if file.endswith(".gz") else open(file)
    with opened as stream:
        values = np.array(stream.read().split(), float)
    c, p, n = values[:3].astype(int)
    observations = values[3 : 3 + 4 * n].reshape(n, 4)
    cameras = values[3 + 4 * n : 3 + 4 * n + 9 * c].reshape(c, 9)
    return observations, cameras, values[3 + 4 * n + 9 * c :].reshape(p, 3)


def rotation(turn):
    angle = np.linalg.norm(turn)
    axis = turn / angle if angle > 0 else np.zeros(3)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew


def reconstruction(observations, cameras, points):
    """The problem in COLMAP's terms: the camera looks along +z, v points down."""
    flip = np.diag([1.0, -1.0, -1.0])
    scene = pycolmap.Reconstruction()
    index, point = observations[:, 0].astype(int), observations[:, 1].astype(int)
    place = np.zeros(len(observations), int)
    for i, own in enumerate(cameras):
        camera = pycolmap.Camera(
            camera_id=i + 1, model="RADIAL", width=4000, height=4000,
            params=[own[6], 0.0, 0.0, own[7], own[8]],
        )  # fmt: skip
        scene.add_camera_with_trivial_rig(camera)
        rows = np.flatnonzero(index == i)
        place[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            image_id=i + 1, camera_id=i + 1, name=str(i), keypoints=observations[rows, 2:] * [1, -1]
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(flip @ rotation(own[:3])), flip @ own[3:6])
        scene.add_image_with_trivial_frame(image, pose)
    order = np.argsort(point, kind="stable")
    ends = np.searchsorted(point[order], np.arange(len(points) + 1))
    for k, xyz in enumerate(points):
        track = pycolmap.Track()
        for row in order[ends[k] : ends[k + 1]]:
            track.add_element(int(index[row]) + 1, int(place[row]))
        scene.add_point3D(xyz, track)
    return scene


def captured(function):
    """What a call prints to the file descriptor of standard output."""
    with tempfile.TemporaryFile() as file:
        kept = os.dup(1)
        os.dup2(file.fileno(), 1)
        try:
            function()
        finally:
            os.dup2(kept, 1)
            os.close(kept)
        file.seek(0)
        return file.read().decode()


def solve(scene, solver, iterations):
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    own = options.ceres
    own.auto_select_solver_type = False
    own.min_num_residuals_for_cpu_multi_threading = 0
    inner = own.solver_options
    inner.linear_solver_type = solver
    inner.num_threads = 2
    inner.max_num_iterations = iterations
    inner.function_tolerance = 1e-7
    inner.gradient_tolerance = 0.0
    inner.parameter_tolerance = 0.0
    inner.minimizer_progress_to_stdout = True
    inner.logging_type = "PER_MINIMIZER_ITERATION"
    config = pycolmap.BundleAdjustmentConfig()
    for image in scene.images:
        config.add_image(image)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, scene)
    found = {}

    def run():
        found["summary"] = adjuster.solve()

    text = captured(run)
    rows = []
    for line in text.splitlines():
        words = line.split()
        # iter cost cost_change |gradient| |step| tr_ratio tr_radius ls_iter iter_time total_time
        if re.fullmatch(r"\d+", words[0] if words else "") and len(words) == 10:
            # A step that is refused is listed with the cost it would have had.
            cost = float(words[1])
            rows.append([min(cost, rows[-1][0]) if rows else cost, float(words[9])])
    return rows


def main():
    asked = argparse.ArgumentParser()
    asked.add_argument("file")
    asked.add_argument("--solver", default="DENSE_SCHUR")
    asked.add_argument("--repeats", type=int, default=1)
    asked.add_argument("--iterations", type=int, default=100)
    options = asked.parse_args()
    problem = read(options.file)
    runs = [
        solve(reconstruction(*problem), options.solver, options.iterations)
        for _ in range(options.repeats)
    ]
    print(json.dumps({"ceres": pycolmap.__ceres_version__, "runs": runs}))


if __name__ == "__main__":
    main()
