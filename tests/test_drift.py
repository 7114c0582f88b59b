"""Drift of an image: closed forms, couplings and rank (MATHEMATICS 1.1 to 1.4)."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxvm.geometry import lens_family
from jaxvm.identify.couplings import absorbed, couplings
from jaxvm.identify.drift import (
    EXTRINSIC,
    CameraState,
    drift_columns,
    exact_drift,
    linear_drift,
    similarity_columns,
    similarity_of,
)

K1 = (-0.1, 0.0, 0.0, 0.0)


def camera(lens="pinhole", coefficients=()) -> CameraState:
    own = coefficients or (0.0,) * lens_family(lens).n_coefficients
    focal, centre = jnp.array([1000.0, 1000.0]), jnp.array([640.0, 480.0])
    return CameraState(focal, centre, jnp.array(own), lens_family(lens))


def field(h: float, depths=(2.0,), tilt=(0.0, 0.0), n: int = 11):
    """Points of planes that fill a square field with half-angle tangent h."""
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-h, h, n)] * 2))
    normal = Rotation.from_euler("xy", tilt, degrees=True).apply([0.0, 0.0, 1.0])
    planes = []
    for depth in depths:
        z = normal[2] * depth / (normal[0] * x + normal[1] * y + normal[2])
        planes.append(np.column_stack([x * z, y * z, z]))
    return jnp.asarray(np.concatenate(planes))


def test_columns_of_a_pinhole_are_the_closed_form():
    rng = np.random.default_rng(0)
    own = camera()
    points = np.column_stack([rng.uniform(-1, 1, (50, 2)), rng.uniform(2, 5, 50)])
    z = points[:, 2]
    x, y = points[:, 0] / z, points[:, 1] / z
    one, zero, f = np.ones(50), np.zeros(50), 1000.0
    du = [x, zero, one, zero, -f * x * y, f * (1 + x**2), -f * y, f / z, zero, -f * x / z]
    dv = [zero, y, zero, one, -f * (1 + y**2), f * x * y, f * x, zero, f / z, -f * y / z]
    expected = np.stack([np.stack(du, axis=1), np.stack(dv, axis=1)], axis=1)
    np.testing.assert_allclose(drift_columns(own, jnp.asarray(points)), expected, atol=1e-9)


def test_the_linear_model_errs_by_the_square_of_the_change():
    own, points = camera("opencv5", (-0.2, 0.05, 1e-3, -5e-4, 0.01)), field(0.4, n=11)
    change = np.array([3.0, 2.0, 1.0, -2.0, 2e-3, -1e-3, 1e-4, 1e-4, 1e-3]
                      + [1e-3, -2e-3, 3e-3, 1e-3, 2e-3, -4e-3])  # fmt: skip
    errors = [
        np.abs(linear_drift(own, points, s * change) - exact_drift(own, points, s * change)).max()
        for s in (1.0, 0.1, 0.01)
    ]
    assert errors[0] > 1e-3
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 100.0, rtol=0.2)


@pytest.mark.parametrize("h", [0.05, 0.1])
def test_the_simplified_model_of_a_narrow_field(h):
    """What it leaves out is at most h^2 f w."""
    own, points, turn = camera(), field(h, (2.0,)), 1e-3
    change = np.array([0.5, -0.3, 0.2, 0.1, turn, -turn, 2e-3, 1e-4, -2e-4, 3e-4])
    simple = similarity_columns(own, points) @ similarity_of(own, jnp.asarray(2.0), change)
    error = np.abs(simple - linear_drift(own, points, jnp.asarray(change)))
    bound = 1000.0 * h**2 * 2 * turn  # both turns
    assert 0.2 * bound < error.max() < 1.01 * bound


@pytest.mark.parametrize("tilt, rank", [((0, 0), 7), ((30, 0), 8), ((30, 20), 8)])
def test_one_view_of_a_plane_shows_eight_combinations(tilt, rank):
    own = camera()
    found = couplings(np.asarray(drift_columns(own, field(0.3, (5.0,), tilt, 15))), own.parameters)
    assert found.rank == rank
    assert f"{rank} of 10 changes" in found.words()


def cosine(a, b) -> float:
    a, b = np.ravel(a), np.ravel(b)
    return abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b)


@pytest.mark.parametrize(
    "h, cx_turn, p2_turn, turn_shift",
    [(0.05, (1.0, 1.0), 0.760, (1.0, 0.774)), (0.3, (0.9989, 0.9989), 0.786, (0.9989, 0.773)),
     (0.8, (0.965, 0.965), 0.894, (0.965, 0.747))],
)  # fmt: skip
def test_table_of_couplings(h, cx_turn, p2_turn, turn_shift):
    own = camera("opencv4")
    at = own.parameters.index
    for k, depths in enumerate([(2.0,), (2.0, 20.0)]):
        columns = np.asarray(drift_columns(own, field(h, depths)))
        column = dict(zip(own.parameters, np.moveaxis(columns, 2, 0), strict=True))
        focal = column["fx"] + column["fy"]
        apart = (1.0, 0.774)[k]
        assert cosine(focal, column["shift_z"]) == pytest.approx(apart, abs=1e-3)
        assert cosine(focal, column["distortion_1"]) == pytest.approx(0.923, abs=2e-3)
        found = couplings(columns, own.parameters).cosine
        assert abs(found[at("cx"), at("turn_y")]) == pytest.approx(cx_turn[k], abs=2e-3)
        assert abs(found[at("cx"), at("shift_x")]) == pytest.approx(apart, abs=1e-3)
        assert abs(found[at("turn_y"), at("shift_x")]) == pytest.approx(turn_shift[k], abs=2e-3)
        k1, k2 = at("distortion_1"), at("distortion_2")
        assert abs(found[k1, k2]) == pytest.approx(0.963, abs=2e-3)
        p2 = abs(found[at("distortion_4"), at("turn_y")])
        assert p2 == pytest.approx(p2_turn, abs=3e-3)


@pytest.mark.parametrize(
    "depths, tilt, f, cx, k1",
    [((2.0,), (0, 0), 0.009, 0.004, 0.40), ((2.0,), (30, 20), 0.096, 0.029, 0.40),
     ((2.0, 20.0), (0, 0), 0.633, 0.034, 0.70)],
)  # fmt: skip
def test_what_a_free_pose_leaves(depths, tilt, f, cx, k1):
    own = camera("opencv4", K1)
    columns = np.asarray(drift_columns(own, field(0.3, depths, tilt)))
    columns = np.concatenate([columns.T[:1].T + columns.T[1:2].T, columns], axis=2)
    left = absorbed(columns, ("f", *own.parameters), EXTRINSIC)
    assert left["f"] == pytest.approx(f, rel=0.12)
    assert left["cx"] == pytest.approx(cx, rel=0.12)
    assert left["distortion_1"] == pytest.approx(k1, rel=0.03)


def test_coupling_over_a_full_square():
    """Focal length and k1: E r^4 / sqrt(E r^2 E r^6) = 28/45 / sqrt(2/3 24/35)."""
    own = camera("opencv4")
    columns = np.asarray(drift_columns(own, field(0.3, n=201)))
    expected = (28 / 45) / np.sqrt(2 / 3 * 24 / 35)
    own_cosine = cosine(columns[..., 0] + columns[..., 1], columns[..., 4])
    assert own_cosine == pytest.approx(expected, abs=5e-4)


def test_what_does_not_show_is_refused():
    with pytest.raises(ValueError, match="don't show fx, turn_y: leave it out"):
        couplings(np.array([[[0.0, 1.0, 0.0]]]), ("fx", "cx", "turn_y"))
