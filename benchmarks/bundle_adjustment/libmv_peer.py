"""Ceres on a problem of libmv, through pycolmap's compiled cost functions.

    python libmv_peer.py FILE --solver DENSE_SCHUR|SPARSE_SCHUR [--repeats N]

To be run by a Python that has pycolmap (which brings Ceres); it imports nothing of the project.
One camera (focal length, k1, k2) that all images share, principal point held, no loss, 2 threads.
It reads what it needs of the format by itself: numbers with the least significant byte first,
markers in pixels, k3, p1 and p2 zero. It prints JSON: for each repetition the cost (half the sum of
squares) and the seconds after every iteration, as Ceres itself reports them.
"""

import argparse
import json
import os
import re
import tempfile

import numpy as np
import pycolmap

LISTS = (
    [("image", "<i4"), ("turn", "<f4", (3, 3)), ("shift", "<f4", 3)],
    [("track", "<i4"), ("place", "<f4", 3)],
    [("image", "<i4"), ("track", "<i4"), ("pixel", "<f4", 2)],
)


def read(file):
    with open(file, "rb") as stream:
        data = stream.read()
    intrinsics = np.frombuffer(data, "<f4", 8, 2).astype(float)
    if data[:2] != b"vP" or intrinsics[5:].any():
        raise SystemExit(f"{file}: this peer knows markers in pixels with k1 and k2 alone")
    lists, at = [], 34
    for fields in LISTS:
        (count,) = np.frombuffer(data, "<i4", 1, at)
        lists.append(np.frombuffer(data, fields, count, at + 4))
        at += 4 + lists[-1].nbytes
    return intrinsics, *lists


def reconstruction(intrinsics, cameras, points, markers):
    """The problem in COLMAP's terms."""
    scene = pycolmap.Reconstruction()
    size = (2.0 * intrinsics[1:3]).round().astype(int)
    camera = pycolmap.Camera(
        camera_id=1, model="RADIAL", width=size[0], height=size[1], params=intrinsics[:5]
    )
    scene.add_camera_with_trivial_rig(camera)
    place = np.zeros(len(markers), int)
    for row in cameras:
        own = np.flatnonzero(markers["image"] == row["image"])
        place[own] = np.arange(len(own))
        number = int(row["image"])
        image = pycolmap.Image(
            image_id=number,
            camera_id=1,
            name=str(number),
            keypoints=markers["pixel"][own].astype(float),
        )
        turn = pycolmap.Rotation3d(row["turn"].T.astype(float))
        scene.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(turn, row["shift"].astype(float))
        )
    for row in points:
        track = pycolmap.Track()
        for k in np.flatnonzero(markers["track"] == row["track"]):
            track.add_element(int(markers["image"][k]), int(place[k]))
        scene.add_point3D(row["place"].astype(float), track)
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
    asked.add_argument("--iterations", type=int, default=500)
    options = asked.parse_args()
    problem = read(options.file)
    runs = [
        solve(reconstruction(*problem), options.solver, options.iterations)
        for _ in range(options.repeats)
    ]
    print(json.dumps({"ceres": pycolmap.__ceres_version__, "runs": runs}))


if __name__ == "__main__":
    main()
