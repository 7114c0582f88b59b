"""Blocks of images: the Schur complement against the dense arrow, and a peer's optimum."""

import importlib.util
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from networks import free_points_recording

from jaxvm.network.scene import build
from jaxvm.recording import RecordingError, find_data
from jaxvm.recording.bal import import_bal, write_bal
from jaxvm.solve import large, schur, schur_pattern
from jaxvm.solve.adjust import adjust
from jaxvm.solve.buckets import CORES, Products
from jaxvm.solve.problem import normal_at, scaled, scene_problem
from jaxvm.solve.robust import HuberLoss, SquaredLoss
from jaxvm.solve.schur import SchurFactors, schur_normal
from jaxvm.solve.schur_pattern import SchurPattern


def block(n_cameras=7, n_points=60, seed=0, noise=0.5):
    """A ring of cameras about points; each camera sees some of them. In the file's conventions."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (n_points, 3))
    cameras, camera, point, pixel = [], [], [], []
    for i in range(n_cameras):
        angle = 2 * np.pi * i / n_cameras
        turn = np.array([0.0, angle, 0.0]) + rng.normal(0, 0.02, 3)
        shift = np.array([0.0, 0.0, -6.0]) + rng.normal(0, 0.1, 3)
        own = np.concatenate([turn, shift, [800.0 + 5 * i, -0.02, 0.003]])
        cameras.append(own)
        for k in np.flatnonzero(rng.uniform(size=n_points) < 0.5):
            camera.append(i)
            point.append(k)
            pixel.append(projected(own, points[k]) + rng.normal(0, noise, 2))
    return np.array(camera), np.array(point), np.array(pixel), np.array(cameras), points


def projected(camera, point):
    """The formula of the format (Agarwal et al. 2010), written out."""
    turn, shift, (f, k1, k2) = camera[:3], camera[3:6], camera[6:]
    angle = np.linalg.norm(turn)
    axis = turn / angle
    rotated = (
        np.cos(angle) * point
        + np.sin(angle) * np.cross(axis, point)
        + (1 - np.cos(angle)) * axis * (axis @ point)
    )
    x, y, z = rotated + shift
    p = -np.array([x, y]) / z
    return f * (1 + k1 * (p @ p) + k2 * (p @ p) ** 2) * p


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    file = tmp_path_factory.mktemp("bal") / "block.txt.gz"
    rng = np.random.default_rng(1)
    camera, point, pixel, cameras, points = block()
    start = cameras + rng.normal(0, 1, cameras.shape) * [*[1e-3] * 3, *[1e-2] * 3, 1.0, 1e-3, 1e-4]
    write_bal(file, camera, point, pixel, start, points + rng.normal(0, 1e-2, points.shape))
    return build(import_bal(file))


def test_the_cost_is_that_of_the_format(tmp_path):
    camera, point, pixel, cameras, points = block(noise=0.0)
    write_bal(tmp_path / "exact.txt", camera, point, pixel, cameras, points)
    problem = scene_problem(build(import_bal(tmp_path / "exact.txt")))
    assert float(problem.cost(jnp.zeros(problem.n))) < 1e-15 * len(pixel)
    write_bal(tmp_path / "off.txt", camera, point, pixel + 0.25, cameras, points)
    problem = scene_problem(build(import_bal(tmp_path / "off.txt")))
    assert float(problem.cost(jnp.zeros(problem.n))) == pytest.approx(0.0625 * len(pixel), rel=1e-9)


@pytest.mark.parametrize("reduced", ["dense", "sparse"])
@pytest.mark.parametrize("loss", [SquaredLoss(), HuberLoss(1.0)])
@pytest.mark.parametrize("which", ["block", "free points"])
def test_steps_are_those_of_the_dense_arrow(scene, which, loss, reduced):
    if which == "free points":
        # Several epochs: a view has many packets, points and poses are of several kinds.
        scene = free_points_recording().true_scene()
    problem = scene_problem(scene, loss)
    problem, dense = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    pattern = SchurPattern.of(problem, share=np.inf, dense=reduced == "dense")
    assert pattern is not None
    normal = schur_normal(problem, pattern, jnp.zeros(problem.n))
    assert normal.cost == pytest.approx(float(dense.cost), rel=1e-12)
    np.testing.assert_allclose(normal.gradient, dense.gradient, atol=1e-9)
    np.testing.assert_allclose(normal.diagonal(), dense.hessian.diagonal(), atol=1e-9)
    damping = 1e-3
    diagonal = np.asarray(dense.hessian.diagonal())
    matrix = np.array(dense.hessian.as_matrix())
    matrix += np.diag(np.where(diagonal > 0.0, damping * diagonal, 1.0))
    factors = SchurFactors(pattern)
    assert factors.factorise(normal, damping)
    found = np.asarray(factors.solve(normal.gradient))
    expected = np.linalg.solve(matrix, np.asarray(dense.gradient))
    np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    # Other units: the same step.
    scale = np.random.default_rng(2).uniform(0.5, 2.0, problem.n)
    other = normal.rescaled(scale)
    factors.factorise(other, damping)
    again = scale * np.asarray(factors.solve(other.gradient))
    np.testing.assert_allclose(again, found, rtol=1e-7, atol=1e-9 * np.abs(found).max())


@pytest.mark.parametrize("reduced", ["dense", "sparse"])
def test_adjustments_end_at_the_same_cost(scene, monkeypatch, reduced):
    options = dict(check=False, damping=1e-4, rtol=1e-12)
    dense = adjust(scene, **options)
    monkeypatch.setattr(large, "_WIDE", 0)
    if reduced == "sparse":
        monkeypatch.setattr(large, "_DENSE", 10)
        monkeypatch.setattr(large, "_MOSTLY_LOCAL", 0.0)
    monkeypatch.setattr(SchurPattern.of.__func__, "__defaults__", (np.inf, True))
    problem = scene_problem(scene)
    prepared = large.prepared(problem)
    assert isinstance(prepared[2], SchurFactors)
    assert prepared[1].pattern.triangle.dense == (reduced == "dense")
    found = adjust(scene, **options)
    assert found.converged and dense.converged
    assert found.cost == pytest.approx(dense.cost, rel=1e-9)
    assert found.cost < 0.05 * found.cost_before


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """A simulated block of the benchmark, made by its own formulas: true and at its start."""
    place = Path(__file__).parents[1] / "benchmarks" / "bundle_adjustment" / "simulated.py"
    spec = importlib.util.spec_from_file_location("simulated_blocks", place)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    folder = tmp_path_factory.mktemp("simulated")
    camera, point, pixel, cameras, points = module.block(16, 4000, 4.0, 3)
    write_bal(folder / "true.txt", camera, point, pixel, cameras, points)
    module.write(folder / "start.txt", 16, 4000, 4.0, 3)
    return {name: build(import_bal(folder / f"{name}.txt")) for name in ("true", "start")}


def test_a_simulated_block_has_the_noise_that_it_was_given(simulated):
    problem = scene_problem(simulated["true"])
    pixel = simulated["true"].recording.observations.pixel
    chi_square = 2.0 * float(problem.cost(jnp.zeros(problem.n))) / 0.5**2
    # Pixels are true to half a pixel; chi-square of 2 n values within five standard deviations.
    assert abs(chi_square - pixel.size) < 5.0 * np.sqrt(2.0 * pixel.size)
    seen = np.bincount(simulated["true"].recording.observations.point, minlength=4000)
    assert seen.min() >= 2 and seen.mean() == pytest.approx(4.0, rel=0.3)


def test_a_table_of_several_pieces_and_shares(simulated, monkeypatch):
    """Normal equations and steps of the dense arrow again, on 16,000 rows at the start."""
    monkeypatch.setattr(schur_pattern, "_SHARE", 1000)
    problem = scene_problem(simulated["start"])
    problem, dense = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    pattern = SchurPattern.of(problem, share=np.inf)
    assert len(pattern.pairs) == CORES
    assert pattern.views[0].own.size >= 2 * schur._PIECE
    normal = schur_normal(problem, pattern, jnp.zeros(problem.n))
    assert normal.cost == pytest.approx(float(dense.cost), rel=1e-11)
    np.testing.assert_allclose(normal.diagonal(), dense.hessian.diagonal(), rtol=1e-9)
    scale = np.abs(dense.gradient).max()
    np.testing.assert_allclose(normal.gradient, dense.gradient, atol=1e-10 * scale)
    factors = SchurFactors(pattern)
    assert factors.factorise(normal, 1e-2)
    step = np.asarray(factors.solve(normal.gradient))
    damped = dense.hessian.mv(jnp.asarray(step)) + 1e-2 * dense.hessian.diagonal() * step
    np.testing.assert_allclose(damped, dense.gradient, atol=1e-8 * scale)


def test_a_long_list_is_not_filled_up_with_empty_ones():
    """One pair of views that has more points in common than a piece holds."""
    n, each = 5000, np.arange(5000)
    products = Products.of(np.zeros(n, int), 1, each, each, n)
    assert [left.shape for left in products.left] == [(1, 1, n)]
    values = jnp.asarray(np.random.default_rng(0).normal(size=(n, 3, 2)))
    expected = np.einsum("nia,nib->ab", values, values)
    np.testing.assert_allclose(products(values)[0], expected, rtol=1e-11)


def test_an_indefinite_matrix_is_no_step(scene):
    problem = scene_problem(scene)
    pattern = SchurPattern.of(problem, share=np.inf)
    normal = schur_normal(problem, pattern, jnp.zeros(problem.n))
    spoilt = replace(normal, shared=-normal.shared)
    assert not SchurFactors(pattern).factorise(spoilt, 1e-3)


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda text: text[: len(text) // 2], "is the file whole"),
        (lambda text: text.replace("7 60", "7 one", 1), "no bundle adjustment problem"),
        (lambda text: "0 1 2\n", "line 1: give the numbers"),
        (lambda text: text.replace("\n0 ", "\n9 ", 1), "line 2: camera 9 is not among the 7"),
    ],
)
def test_wrong_files_are_named(tmp_path, change, words):
    file = tmp_path / "bad.txt"
    write_bal(file, *block())
    file.write_text(change(file.read_text()))
    with pytest.raises(RecordingError, match=words):
        import_bal(file)


def test_a_real_block_ends_where_a_peer_does():
    """trafalgar-21: Ceres 2.1 ends at 30378.65, from 4413239."""
    file = find_data("bal/trafalgar-21-11315-pre.txt.gz")
    if file is None:
        pytest.skip("bal/trafalgar-21-11315-pre.txt.gz is not there: set JAXVM_DATA")
    found = adjust(build(import_bal(file)), check=False, damping=1e-4, rtol=1e-7)
    assert found.cost_before == pytest.approx(4413239.314, rel=1e-9)
    assert found.converged and found.cost < 30378.66


def test_where_little_is_left_out_the_arrow_is_taken():
    """All points in all images: every pair of views meets in every point."""
    problem = scene_problem(free_points_recording().true_scene())
    assert SchurPattern.of(problem) is None
