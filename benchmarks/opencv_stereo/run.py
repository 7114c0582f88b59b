"""Does the diagnosis find what a pinhole lacks on a real stereo rig, and how good does it get?

13 pairs of photographs of a chessboard (OpenCV's samples). The model given is two pinholes without
distortion; what is missing has to be found. The held-out error is compared with OpenCV's
stereoCalibrate (five distortion coefficients a camera) fitted to the same pairs; in both cases only
the pose of the board is fitted in a held-out pair.

    python benchmarks/opencv_stereo/run.py

results.json and results.md are written here.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import tomli_w
from scipy.optimize import least_squares

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from results import markdown, write_numbers  # noqa: E402

from jaxvm.discover import diagnose  # noqa: E402
from jaxvm.recording import find_data, read_recording  # noqa: E402
from jaxvm.report import summary, write_report  # noqa: E402

ROWS, COLUMNS, SPACING_M = 6, 9, 0.025
EVERY = 3
SIZE = (640, 480)


def corners(folder: Path) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Corners (px) of every pair in which both cameras show the whole board."""
    found = {}
    for left in sorted(folder.glob("left*.jpg")):
        number = int(left.stem.removeprefix("left"))
        pair = []
        for side in ("left", "right"):
            image = cv2.imread(str(folder / f"{side}{number:02d}.jpg"), cv2.IMREAD_GRAYSCALE)
            ok, pixels = cv2.findChessboardCorners(image, (COLUMNS, ROWS))
            if ok:
                rule = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
                pixels = cv2.cornerSubPix(image, pixels, (5, 5), (-1, -1), rule)
                pair.append(pixels.reshape(-1, 2).astype(float))
        if len(pair) == 2:
            found[number] = (pair[0], pair[1])
    return found


def board() -> np.ndarray:
    """Marks of the board (m), row by row."""
    grid = np.mgrid[0:COLUMNS, 0:ROWS].T.reshape(-1, 2) * SPACING_M
    return np.column_stack([grid, np.zeros(len(grid))])


def write_recording(pairs, folder: Path) -> None:
    """The rig as a recording: two pinholes, nothing else known."""
    rows = [
        (number, camera, "board", f"{k // COLUMNS}/{k % COLUMNS}", u, v)
        for number, pair in pairs.items()
        for camera, pixels in zip(("left", "right"), pair, strict=True)
        for k, (u, v) in enumerate(pixels)
    ]
    columns = ["epoch", "camera", "target", "point", "u", "v"]
    pd.DataFrame(rows, columns=columns).to_csv(folder / "observations.csv", index=False)
    pd.DataFrame({"epoch": list(pairs)}).to_csv(folder / "epochs.csv", index=False)
    camera = {"station": "rig", "image_size": list(SIZE), "lens": "pinhole"}
    model = {
        "format": 1,
        "name": "opencv-stereo",
        "noise": {"pixel_px": 0.1},
        "cameras": {
            "left": camera | {"free": ["focal", "centre"]},
            "right": camera | {"free": ["focal", "centre", "pose"]},
        },
        "targets": {
            "board": {
                "grid": {"rows": ROWS, "columns": COLUMNS, "spacing_m": SPACING_M},
                "motion": "per-epoch",
                "free": ["pose"],
            }
        },
    }
    (folder / "recording.toml").write_text(tomli_w.dumps(model), encoding="utf-8")


def opencv_heldout(pairs) -> tuple[float, float]:
    """RMS (px, one coordinate) of stereoCalibrate on its own pairs, and on the held-out ones."""
    numbers = list(pairs)
    fitted = [n for k, n in enumerate(numbers) if k % EVERY != EVERY - 1]
    held = [n for n in numbers if n not in fitted]
    points = board().astype(np.float32)
    objects = [points] * len(fitted)
    images = [[pairs[n][side].astype(np.float32) for n in fitted] for side in (0, 1)]
    inner = [cv2.calibrateCamera(objects, own, SIZE, None, None)[1:3] for own in images]
    (k1, d1), (k2, d2) = inner
    done = cv2.stereoCalibrate(
        objects, images[0], images[1], k1, d1, k2, d2, SIZE,
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 500, 1e-10),
    )  # fmt: skip
    rms, k1, d1, k2, d2, turn, shift = done[:7]

    def errors(pose, pair):
        left = cv2.projectPoints(points, pose[:3], pose[3:], k1, d1)[0].reshape(-1, 2)
        rotation = turn @ cv2.Rodrigues(pose[:3])[0]
        moved = turn @ pose[3:] + shift.ravel()
        right = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], moved, k2, d2)[0]
        return np.concatenate([left - pair[0], right.reshape(-1, 2) - pair[1]]).ravel()

    square = []
    for number in held:
        pair = pairs[number]
        _, rvec, tvec = cv2.solvePnP(points, pair[0], k1, d1)
        start = np.concatenate([rvec.ravel(), tvec.ravel()])
        best = least_squares(errors, start, args=(pair,), x_scale="jac", xtol=1e-12)
        square.append(best.fun**2)
    return float(rms) / np.sqrt(2.0), float(np.sqrt(np.mean(square)))


def table(results: dict) -> str:
    """results.md."""
    rows = [
        ["two pinholes, as given", 0, "", f"{results['plain_heldout_px']:.3f}"],
        [
            "with what was found",
            results["coefficients_added"],
            "",
            f"{results['model_heldout_px']:.3f}",
        ],
        [
            "and what neighbouring marks of an image foretell of each other",
            results["coefficients_added"],
            f"{results['fitted_px']:.3f}",
            f"{results['heldout_px']:.3f}",
        ],
        [
            f"cv2.stereoCalibrate ({results['opencv']})",
            results["opencv_coefficients"],
            f"{results['opencv_fitted_px']:.3f}",
            f"{results['opencv_heldout_px']:.3f}",
        ],
    ]
    head = ["model", "coefficients of the lenses and more", "fitted (px)", "held-out (px)"]
    found = "; ".join(results["findings"])
    return f"{results['pairs']} pairs. Found: {found}.\n\n{markdown(head, rows)}"


def main() -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args()
    data = find_data("opencv-stereo")
    if data is None:
        print("opencv-stereo is not here; set JAXVM_DATA to the folder that has it")
        sys.exit(0)
    pairs = corners(data)
    with tempfile.TemporaryDirectory() as folder:
        write_recording(pairs, Path(folder))
        found = diagnose(read_recording(folder), every=EVERY)
    write_report(found, HERE / "report", data_only=True)
    print(summary(found))
    peer = opencv_heldout(pairs)
    results = {
        "pairs": len(pairs),
        "plain_heldout_px": found.plain.heldout_rms_px,
        # Without what neighbouring marks foretell of each other.
        "model_heldout_px": found.signal.gain.before_px
        if found.signal
        else found.final.heldout_rms_px,
        "heldout_px": found.final.heldout_rms_px,
        "fitted_px": found.final.rms_px,
        "findings": [f.effect.name for f in found.findings],
        "coefficients_added": sum(f.effect.n_columns for f in found.findings),
        "opencv_fitted_px": peer[0],
        "opencv_heldout_px": peer[1],
        "opencv_coefficients": 10,
        "opencv": cv2.__version__,
    }
    write_numbers(HERE, results, table(results))


if __name__ == "__main__":
    main()
