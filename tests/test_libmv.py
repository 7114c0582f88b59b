"""Problems of libmv: the numbers of a file come out as its format says, what is wrong is said."""

import struct

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxvm.network.scene import build
from jaxvm.network.start import start
from jaxvm.recording import RecordingError, convert, find_data, read_recording
from jaxvm.recording.libmv import import_libmv, libmv_poses
from jaxvm.solve.adjust import adjust
from jaxvm.solve.problem import scene_problem

PIXELS = [400.0, 320.0, 240.0]
RADIAL = [-0.05, 0.01, 0.0, 0.0, 0.0]
ALL_FIVE = [-0.05, 0.01, -0.002, 0.001, -0.003]


def problem(seed=0, intrinsics=(*PIXELS, *RADIAL), noise=0.0):
    """A camera that moves about points: cameras, points and markers as lists of the file's rows.

    Numbers have gaps and no order; a marker has no camera, another one no point.
    """
    rng = np.random.default_rng(seed)
    images, tracks = rng.permutation(np.arange(5, 29, 3)), rng.permutation(np.arange(2, 62, 2))
    points = rng.uniform(-1.0, 1.0, (len(tracks), 3))
    turns = Rotation.from_rotvec(rng.normal(0.0, 0.15, (len(images), 3))).as_matrix()
    shifts = np.array([0.0, 0.0, 5.0]) + rng.normal(0.0, 0.3, (len(images), 3))
    turns, shifts, points = (np.float32(a).astype(float) for a in (turns, shifts, points))
    markers = [(99, int(tracks[0]), 1.0, 2.0), (int(images[0]), 98, 3.0, 4.0)]
    for image, turn, shift in zip(images, turns, shifts, strict=True):
        for track, point in zip(tracks, points, strict=True):
            if rng.uniform() < 0.7:
                pixel = projected(intrinsics, turn @ point + shift) + rng.normal(0.0, noise, 2)
                markers.append((int(image), int(track), *pixel))
    cameras = [(int(i), *t.T.ravel(), *s) for i, t, s in zip(images, turns, shifts, strict=True)]
    return cameras, [(int(t), *p) for t, p in zip(tracks, points, strict=True)], markers


def projected(intrinsics, point):
    """The formula of the format, written out: a polynomial, and Brown's decentring."""
    f, cx, cy, k1, k2, k3, p1, p2 = intrinsics
    x, y = point[:2] / point[2]
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
    return np.array([f * u + cx, f * v + cy])


def written(cameras, points, markers, intrinsics=(*PIXELS, *RADIAL), order="<", space=b"P"):
    """The bytes of a file."""
    parts = [b"v" if order == "<" else b"V", space, struct.pack(f"{order}8f", *intrinsics)]
    for rows, kind in ((cameras, "i12f"), (points, "i3f"), (markers, "2i2f")):
        parts.append(struct.pack(f"{order}i", len(rows)))
        parts += [struct.pack(order + kind, *row) for row in rows]
    return b"".join(parts)


def at_poses_of_file(file, **options):
    """The scene that the file describes, poses too."""
    scene = build(import_libmv(file, **options))
    poses = jnp.asarray(libmv_poses(file))
    poses = scene.state.world_from_station.at[: len(poses)].set(poses)
    return scene.with_state(eqx.tree_at(lambda s: s.world_from_station, scene.state, poses))


def rms(scene):
    """Root of the mean squared residual of a coordinate (px)."""
    least = scene_problem(scene)
    count = 2 * len(scene.recording.observations.pixel)
    return float(np.sqrt(2.0 * least.cost(jnp.zeros(least.n)) / count))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    "distortion, lens",
    [(RADIAL, "radial"), (ALL_FIVE, "opencv5"), ([*ALL_FIVE[:2], 0.0, 0.001, 0.002], "opencv4")],
)
def test_residuals_are_those_of_the_format(tmp_path, order, distortion, lens):
    intrinsics = (*PIXELS, *distortion)
    cameras, points, markers = problem(intrinsics=intrinsics)
    file = tmp_path / "exact.bin"
    file.write_bytes(written(cameras, points, markers, intrinsics, order))
    recording = import_libmv(file)
    assert recording.model.cameras[0].lens == lens
    assert recording.model.cameras[0].image_size == (640, 480)
    assert recording.epoch_ids.tolist() == sorted(row[0] for row in cameras)
    obs = recording.observations
    names = np.array(recording.model.targets[0].point_names)[obs.point]
    # The markers without a camera and without a point are left out.
    found = list(zip(recording.epoch_ids[obs.epoch], names.astype(int), strict=True))
    assert found == [marker[:2] for marker in markers[2:]]
    # Markers are rounded to 32 bits, half of 2^-15 px.
    assert rms(at_poses_of_file(file)) < 3e-5
    off = [(i, t, u + 0.25, v) for i, t, u, v in markers]
    off[-1] = (*off[-1][:2], 700.0, 100.0)
    file.write_bytes(written(cameras, points, off[:-1], intrinsics, order))
    assert rms(at_poses_of_file(file)) == pytest.approx(0.25 / np.sqrt(2.0), rel=1e-3)
    file.write_bytes(written(cameras, points, off, intrinsics, order))
    assert import_libmv(file).model.cameras[0].image_size == (700, 480)


def test_markers_on_the_plane_are_thousandths(tmp_path):
    intrinsics = (1.0, 0.0, 0.0, *[0.0] * 5)
    cameras, points, markers = problem(intrinsics=intrinsics)
    file = tmp_path / "plane.bin"
    markers = [(i, t, u, v + 0.001) for i, t, u, v in markers]
    file.write_bytes(written(cameras, points, markers, intrinsics, space=b"N"))
    assert rms(at_poses_of_file(file)) == pytest.approx(np.sqrt(0.5), rel=1e-3)
    # Intrinsics are free where markers are pixels, or where it is asked for.
    assert import_libmv(file).model.cameras[0].free == frozenset()
    assert import_libmv(file, refine=True).model.cameras[0].free
    said = convert(file, tmp_path / "folder")
    assert "8 epochs" in said
    again, first = read_recording(tmp_path / "folder").observations, import_libmv(file).observations
    assert np.allclose(again.pixel, first.pixel) and np.array_equal(again.point, first.point)


def test_an_adjustment_finds_what_was_hidden(tmp_path):
    cameras, points, markers = problem(noise=0.3)
    file = tmp_path / "hidden.bin"
    wrong = (PIXELS[0] * 1.01, *PIXELS[1:], 0.0, 0.0, 0.0, 0.0, 0.0)
    file.write_bytes(written(cameras, points, markers, wrong))
    scene = at_poses_of_file(file)
    found = adjust(scene, check=False)
    assert found.converged
    # Seven of the unknowns are not determined, so they are no unknowns.
    count, unknowns = 2 * (len(markers) - 2), 6 * len(cameras) + 3 * len(points) + 3 - 7
    assert 2.0 * found.cost / 0.3**2 == pytest.approx(count - unknowns, abs=4 * np.sqrt(2 * count))
    assert rms(scene) > 2.0 * 0.3
    from_images = adjust(start(build(import_libmv(file))), check=False)
    assert from_images.cost == pytest.approx(found.cost, rel=1e-9)


def changed(rows, k, column, value):
    return [
        tuple(value if (i, j) == (k, column) else x for j, x in enumerate(row))
        for i, row in enumerate(rows)
    ]


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda c, p, m: b"", "begins with b''"),
        (lambda c, p, m: b"49 7776 31843", "begins with b'49', not with v or V and P or N"),
        (lambda c, p, m: written(c, p, m, space=b"X"), "begins with b'vX'"),
        (lambda c, p, m: written(c, p, m)[:20], "its intrinsics go to byte 34; is the file whole"),
        (lambda c, p, m: written(c, p, m)[:100], "ends at byte 100, but its 8 cameras go to"),
        (lambda c, p, m: written(c, p, m)[:-1], r"but its \d+ markers go to byte"),
        (lambda c, p, m: written(c, p, m) + b"0", "but the file at byte"),
        (lambda c, p, m: written(c, [], m), "it has 0 points"),
        (lambda c, p, m: written(c, p, m, (0.0, *[0.0] * 7)), "the first positive"),
        (lambda c, p, m: written(c[:1], p, m[:1]), "no marker has a camera and a point"),
        (lambda c, p, m: written([*c, c[0]], p, m), r"camera 9 \(image \d+\) is there already"),
        (lambda c, p, m: written(c, p, [*m, m[3]]), r"marker \d+ \(image \d+, track \d+\) is th"),
        (lambda c, p, m: written(c, changed(p, 2, 0, -1), m), "point 3 .* has a negative number"),
        (lambda c, p, m: written(c, changed(p, 1, 2, np.inf), m), "place that is no number"),
        (lambda c, p, m: written(changed(c, 1, 3, 2.0), p, m), "camera 2 .* no rotation"),
    ],
)
def test_wrong_files_are_refused(tmp_path, change, words):
    file = tmp_path / "wrong.bin"
    file.write_bytes(change(*problem()))
    with pytest.raises(RecordingError, match=words):
        import_libmv(file)


@pytest.mark.parametrize(
    "name, before, after", [("problem_02", 5219.638, 5207.924), ("problem_03", 297.9947, 297.0424)]
)
def test_real_problems_end_where_a_peer_does(name, before, after):
    """Costs of Ceres 2.2: the same unknowns from the same start."""
    file = find_data(f"libmv-ba/{name}.bin")
    if file is None:
        pytest.skip(f"libmv-ba/{name}.bin is not there: set JAXVM_DATA")
    scene = at_poses_of_file(file)
    found = adjust(scene, check=False, damping=1e-4)
    assert found.converged
    assert found.cost_before == pytest.approx(before, rel=2e-7)
    assert found.cost == pytest.approx(after, rel=2e-7)
    assert all(np.isfinite(block).all() for block in found.residuals().pixels)
