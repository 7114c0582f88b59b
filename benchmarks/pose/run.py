"""How fast and how sure are poses, against OpenCV and PoseLib, and are they at the bound?

10,000 poses of 20 marks, all from the same starts and to the same optimum (but SQPNP, which needs
no start and minimises another error), on the same machine one after the other; and 10,000 random
poses without a start. PoseLib is left out where it is not installed.

    python benchmarks/pose/run.py
"""

import argparse
import os
import sys
import time
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from results import markdown, write  # noqa: E402

from jaxvm.geometry import pose_from_vector, so3_log  # noqa: E402
from jaxvm.pose.monocular import locate, orthogonal_iteration  # noqa: E402
from jaxvm.pose.refine import refine, refine_many  # noqa: E402
from jaxvm.pose.sighting import Sighting  # noqa: E402

try:
    import poselib
except ImportError:
    poselib = None

COUNT, MARKS, FOCAL = 10_000, 20, 1000.0
ROUNDS = 15


def pictures(points, poses, sigma_px: float, rng) -> Sighting:
    """Sightings of marks [b, n, 3] at poses [b, 6]."""
    turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
    seen = np.einsum("bij,bnj->bni", turn, points) + poses[:, None, 3:]
    noise = rng.normal(size=(*seen.shape[:2], 2)) * sigma_px / FOCAL
    whitener = np.eye(2) * FOCAL / sigma_px
    return Sighting(
        jnp.asarray(points), jnp.asarray(seen[..., :2] / seen[..., 2:] + noise),
        jnp.asarray(np.broadcast_to(whitener, (*seen.shape[:2], 2, 2))),
    )  # fmt: skip


def random_poses(count: int, rng) -> np.ndarray:
    """Any attitude, 2 to 6 m away, the middle within the field of view."""
    turn = Rotation.random(count, random_state=int(rng.integers(1 << 30))).as_rotvec()
    depth = rng.uniform(2.0, 6.0, count)
    across = rng.uniform(-0.2, 0.2, (count, 2)) * depth[:, None]
    return np.column_stack([turn, across, depth])


def errors(vectors, poses) -> tuple[np.ndarray, np.ndarray]:
    """Angle (rad) and distance (m) from the truth."""
    own, true = (Rotation.from_rotvec(np.array(v)[:, :3]) for v in (vectors, poses))
    return (own * true.inv()).magnitude(), np.linalg.norm(
        np.array(vectors)[:, 3:] - poses[:, 3:], axis=1
    )


def best_of(function) -> tuple[float, object]:
    """Least seconds of several rounds, after one that is not timed."""
    result, seconds = function(), []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - began)
    return min(seconds), result


def speed(rng) -> dict:
    """Poses a second from the same starts, and how far each peer is from our optimum."""
    points = rng.uniform(-0.5, 0.5, (COUNT, MARKS, 3))
    poses = random_poses(COUNT, rng)
    seen = pictures(points, poses, 0.5, rng)
    starts = poses + rng.normal(size=poses.shape) * np.array([0.02] * 3 + [0.02] * 3)
    image = np.array(seen.image)
    pixels = image * FOCAL

    def ours():
        return jax.block_until_ready(refine_many(seen, jnp.asarray(starts)))

    def iterative():
        eye = np.eye(3)
        found = np.empty((COUNT, 6))
        for k in range(COUNT):
            turn, shift = starts[k, :3].copy(), starts[k, 3:].copy()
            _, turn, shift = cv2.solvePnP(
                points[k], image[k], eye, None, turn, shift, True, cv2.SOLVEPNP_ITERATIVE
            )
            found[k, :3], found[k, 3:] = turn.ravel(), shift.ravel()
        return found

    def sqpnp():
        eye = np.eye(3)
        found = np.empty((COUNT, 6))
        for k in range(COUNT):
            _, turn, shift = cv2.solvePnP(points[k], image[k], eye, None, flags=cv2.SOLVEPNP_SQPNP)
            found[k, :3], found[k, 3:] = turn.ravel(), shift.ravel()
        return found

    camera = {"model": "SIMPLE_PINHOLE", "width": 1, "height": 1, "params": [FOCAL, 0.0, 0.0]}

    def with_poselib():
        found = np.empty((COUNT, 6))
        quaternions = Rotation.from_rotvec(starts[:, :3]).as_quat(scalar_first=True)
        own = np.empty((COUNT, 4))
        for k in range(COUNT):
            start = poselib.CameraPose()
            start.q, start.t = quaternions[k], starts[k, 3:]
            pose, _ = poselib.refine_absolute_pose(
                pixels[k], points[k], start, camera, {"loss_type": "TRIVIAL"}
            )
            own[k], found[k, 3:] = pose.q, pose.t
        found[:, :3] = Rotation.from_quat(own, scalar_first=True).as_rotvec()
        return found

    peers = {"OpenCV ITERATIVE": iterative, "OpenCV SQPNP": sqpnp}
    if poselib is not None:
        peers["PoseLib refinement"] = with_poselib
    began = time.perf_counter()
    ours()
    compiling = time.perf_counter() - began
    seconds, found = best_of(ours)
    optimum = np.asarray(found.observer_from_target)
    angle, _ = errors(optimum, poses)
    rows = [
        {"name": "jaxvm", "poses_per_s": COUNT / seconds, "first_call_s": compiling,
         "rms_angle_urad": 1e6 * float(np.sqrt(np.mean(angle**2)))}
    ]  # fmt: skip
    for name, peer in peers.items():
        seconds, own = best_of(peer)
        angle, _ = errors(own, poses)
        off, _ = errors(own, optimum)
        rows.append(
            {"name": name, "poses_per_s": COUNT / seconds,
             "rms_angle_urad": 1e6 * float(np.sqrt(np.mean(angle**2))),
             "median_angle_from_ours_urad": 1e6 * float(np.median(off)),
             "times_slower": COUNT / seconds and rows[0]["poses_per_s"] * seconds / COUNT}
        )  # fmt: skip
    return {"rows": rows}


def success(rng) -> dict:
    """Share of random poses that are found, of those that SQPNP finds."""
    shares = {}
    for name, flat, n in (("20 marks in space", 1.0, 20), ("6 marks in space", 1.0, 6),
                          ("20 marks on a plane", 0.0, 20)):  # fmt: skip
        points = rng.uniform(-0.5, 0.5, (COUNT, n, 3)) * np.array([1.0, 1.0, flat])
        poses = random_poses(COUNT, rng)
        seen = pictures(points, poses, 0.5, rng)
        image = np.array(seen.image)
        peer = np.empty((COUNT, 6))
        for k in range(COUNT):
            _, turn, shift = cv2.solvePnP(
                points[k], image[k], np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
            )
            peer[k] = np.concatenate([turn, shift]).ravel()
        refined = refine_many(seen, jnp.asarray(peer))
        began = time.perf_counter()
        found = jax.block_until_ready(jax.jit(jax.vmap(locate))(seen))
        seconds = time.perf_counter() - began
        # Found is what has the likelihood of the refined truth, or more.
        truth = refine_many(seen, jnp.asarray(poses))
        least = np.asarray(truth.cost) * (1 + 1e-6) + 1e-6
        theirs = np.asarray(refined.cost) <= least
        own = np.asarray(found.best.cost) <= least
        shares[name] = {
            "found_by_sqpnp": int(theirs.sum()),
            "of_these_found": float(own[theirs].mean()),
            "found_of_all": float(own.mean()),
            "seconds_with_compiling": seconds,
        }
    return shares


def bound(rng) -> list[dict]:
    """RMS angle over the Cramer-Rao bound: orthogonal iteration, and refined."""
    rows = []
    count = 5000
    for scene, depth in (("plate at 5 m, tilted", None), ("marks 1.5 to 9 m away", (1.5, 9.0))):
        if depth is None:
            points = rng.uniform(-0.25, 0.25, (12, 3)) * np.array([1.0, 1.0, 0.0])
            pose = np.array([0.58, 0.0, 0.1, 0.05, -0.02, 5.0])
        else:
            far = np.linspace(*depth, 12)
            points = np.column_stack([rng.uniform(-0.25, 0.25, (12, 2)) * far[:, None], far - 5.0])
            pose = np.array([0.02, -0.03, 0.1, 0.05, -0.02, 5.0])
        poses = np.repeat(pose[None], count, axis=0)
        for sigma in (0.1, 0.3, 1.0):
            seen = pictures(np.broadcast_to(points, (count, 12, 3)), poses, sigma, rng)
            refined = jax.jit(jax.vmap(refine))(seen, jnp.asarray(poses))
            iterated = jax.jit(
                jax.vmap(lambda s, p=poses[0]: orthogonal_iteration(s, jnp.asarray(p)).pose)
            )(seen)
            turns = np.asarray(jax.vmap(so3_log)(iterated.rotation))
            exact = pictures(points[None], poses[:1], sigma, rng)
            true = pose_from_vector(jnp.asarray(pose))
            at = np.asarray(points @ true.rotation.T + true.shift)
            exact = Sighting(exact.points[0], jnp.asarray(at[:, :2] / at[:, 2:]), exact.whitener[0])
            covariance = refine(exact, jnp.asarray(pose)).covariance
            least = float(np.sqrt(np.trace(covariance[:3, :3])))
            rms = [
                float(np.sqrt(np.mean(errors(own, poses)[0] ** 2)))
                for own in (np.c_[turns, poses[:, 3:]], refined.observer_from_target)
            ]
            rows.append({"scene": scene, "sigma_px": sigma, "bound_urad": 1e6 * least,
                         "iteration_over_bound": rms[0] / least,
                         "refined_over_bound": rms[1] / least})  # fmt: skip
    return rows


def table(results: dict) -> str:
    """results.md."""
    speed = [
        [row["name"], f"{row['poses_per_s']:,.0f}", f"{row['rms_angle_urad']:.1f}"]
        for row in results["speed"]
    ]
    success = [
        [name, f"{row['found_by_sqpnp']:,}", f"{100 * row['of_these_found']:.2f} %"]
        for name, row in results["success"].items()
    ]
    bound = [
        [
            row["scene"],
            row["sigma_px"],
            f"{row['bound_urad']:.1f}",
            f"{row['iteration_over_bound']:.3f}",
            f"{row['refined_over_bound']:.3f}",
        ]
        for row in results["bound"]
    ]
    return "\n".join(
        [
            f"{results['processors']} processors, OpenCV {results['opencv']}, warm.\n",
            "10,000 poses of 20 marks, from the same starts:\n",
            markdown(["program", "poses a second", "RMS error of attitude (urad)"], speed),
            "Random poses without a start:\n",
            markdown(["marks", "found by OpenCV's SQPNP", "of these found by `locate`"], success),
            "RMS errors of attitude over the Cramér-Rao bound:\n",
            markdown(
                ["scene", "sigma (px)", "bound (urad)", "orthogonal iteration", "refined"], bound
            ),
        ]
    )


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    rng = np.random.default_rng(0)
    results = {
        "speed": speed(rng)["rows"],
        "success": success(rng),
        "bound": bound(rng),
        "processors": os.cpu_count(),
        "opencv": cv2.__version__,
    }
    figure = Figure(figsize=(8, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = [row["name"] for row in results["speed"]]
    left.barh(names, [row["poses_per_s"] for row in results["speed"]], color="#0f766e")
    left.set(xscale="log", xlabel="poses of 20 marks a second")
    left.invert_yaxis()
    for scene, marker in zip(
        dict.fromkeys(r["scene"] for r in results["bound"]), "os", strict=True
    ):
        own = [r for r in results["bound"] if r["scene"] == scene]
        sigma = [r["sigma_px"] for r in own]
        right.plot(sigma, [r["iteration_over_bound"] for r in own], marker + "--", color="#c2410c",
                   label=f"iteration, {scene}")  # fmt: skip
        right.plot(sigma, [r["refined_over_bound"] for r in own], marker + "-", color="#0f766e",
                   label=f"refined, {scene}")  # fmt: skip
    right.set(xscale="log", xlabel="noise (px)", ylabel="angle over Cramér-Rao bound")
    right.legend(fontsize=7)
    write(HERE, results, table(results), figure)


if __name__ == "__main__":
    main()
