"""Ceres on a problem of libmv, through pycolmap's compiled cost functions.

    python libmv_peer.py FILE --solver DENSE_SCHUR|SPARSE_SCHUR [--repeats N]

As `ceres_peer.py`, and with the same JSON, but for libmv's binary files: one camera (focal length,
k1, k2) that all images share, principal point held. It reads what it needs of the format by itself:
numbers with the least significant byte first, markers in pixels, k3, p1 and p2 zero.
"""

import argparse
import json

import ceres_peer
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


def main():
    asked = argparse.ArgumentParser()
    asked.add_argument("file")
    asked.add_argument("--solver", default="DENSE_SCHUR")
    asked.add_argument("--repeats", type=int, default=1)
    asked.add_argument("--iterations", type=int, default=500)
    options = asked.parse_args()
    problem = read(options.file)
    runs = [
        ceres_peer.solve(reconstruction(*problem), options.solver, options.iterations)
        for _ in range(options.repeats)
    ]
    print(json.dumps({"ceres": pycolmap.__ceres_version__, "runs": runs}))


if __name__ == "__main__":
    main()
