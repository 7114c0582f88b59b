"""Lenses against OpenCV, their own inverse, and finite differences."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvm.geometry import LENS_NAMES, BrownConrady, KannalaBrandt, lens_family, project, unproject
from jaxvm.geometry.lenses import tilt

FOCAL = np.array([2000.0, 2011.0])
CENTRE = np.array([1231.0, 1018.0])
SIZE = np.array([2448, 2048])
K = np.array([[FOCAL[0], 0.0, CENTRE[0]], [0.0, FOCAL[1], CENTRE[1]], [0.0, 0.0, 1.0]])
FISHEYE_FOCAL = np.array([700.0, 704.0])

# An industrial lens of 12 mm: barrel of some per cent in the corner, a sensor tilted by half a
# degree. In OpenCV's order.
BROWN = [
    -0.11,
    0.07,
    4e-4,
    -3e-4,
    -0.02,
    0.05,
    -0.01,
    0.003,
    9e-4,
    -5e-4,
    7e-4,
    2e-4,
    0.008,
    -0.011,
]
FISHEYE = np.array([0.02, -0.006, 0.002, -0.0003])
PERSPECTIVE = [name for name in LENS_NAMES if name not in ("fisheye", "radial")]


def coefficients(name):
    family = lens_family(name)
    return FISHEYE if name == "fisheye" else np.array(BROWN[: family.n_coefficients])


def focal(name):
    return FISHEYE_FOCAL if name == "fisheye" else FOCAL


N = 226  # points or pixels in every batch, so that each lens is compiled once
_batches = {}


def batched(name):
    """(project, unproject) of up to N points or pixels, compiled once for each lens."""

    def filled(function):
        compiled = jax.jit(jax.vmap(function, (None, 0)))
        return lambda c, x: compiled(c, np.resize(x, (N, x.shape[1])))[: len(x)]

    if name not in _batches:
        family, f = lens_family(name), focal(name)
        _batches[name] = (
            filled(lambda c, p: project(family, f, CENTRE, c, p)),
            filled(lambda c, x: unproject(family, f, CENTRE, c, x)),
        )
    return _batches[name]


def whole_image(n=15):
    """Pixels of a grid over the whole image, to the outermost rows and columns, and the centre."""
    u, v = np.meshgrid(np.linspace(0, SIZE[0] - 1, n), np.linspace(0, SIZE[1] - 1, n))
    return np.vstack([np.stack([u.ravel(), v.ravel()], axis=1), CENTRE])


def points_before_camera():
    """Points at distances from 0.3 to 60 m that fill the image of a perspective lens, and more."""
    tangent = (whole_image() - CENTRE) / FOCAL * 1.05
    depth = np.geomspace(0.3, 60.0, len(tangent))
    return np.hstack([tangent, np.ones((len(tangent), 1))]) * depth[:, None]


def points_around_fisheye(largest=1.5):
    """Points from near the axis to `largest` (rad) from it."""
    theta = np.linspace(1e-6, largest, 200)
    azimuth = np.linspace(0.0, 40.0, 200)
    x, y = np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth)
    return np.stack([x, y, np.cos(theta)], axis=1) * np.linspace(0.2, 30.0, 200)[:, None]


@pytest.mark.parametrize("name", PERSPECTIVE)
def test_perspective_lenses_project_like_opencv(name):
    c, points = coefficients(name), points_before_camera()
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, c if len(c) else None)[0]
    np.testing.assert_allclose(batched(name)[0](c, points), expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", PERSPECTIVE)
def test_perspective_lenses_undistort_like_opencv(name):
    c, pixels = coefficients(name), whole_image()
    # OpenCV stops after 5 steps unless it is told otherwise.
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 1000, 1e-13)
    expected = cv2.undistortPoints(
        pixels[:, None], K, c if len(c) else np.zeros(5), R=np.eye(3), P=K, criteria=criteria
    )[:, 0]
    rays = np.asarray(batched(name)[1](c, pixels))
    got = FOCAL * rays[:, :2] / rays[:, 2:] + CENTRE
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9)


def test_the_radial_lens_is_opencvs_with_two_coefficients():
    """And what lies behind the camera is imaged through its centre."""
    c, points = coefficients("opencv4")[:2], points_before_camera()
    got = batched("radial")[0](c, points)
    same = batched("opencv4")[0](np.append(c, np.zeros(2)), points)
    np.testing.assert_allclose(got, same, rtol=1e-13)
    np.testing.assert_allclose(batched("radial")[0](c, -points), got, rtol=1e-12)


def test_fisheye_projects_like_opencv():
    points = points_around_fisheye()
    matrix = np.diag([*FISHEYE_FOCAL, 1.0])
    matrix[:2, 2] = CENTRE
    expected = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, FISHEYE
    )[0][:, 0]
    got = batched("fisheye")[0](FISHEYE, points)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-9)


def test_fisheye_sees_beyond_90_degrees():
    """By hand at 100 degrees from the axis; OpenCV stops at 90."""
    theta = np.radians(100.0)
    powers = theta ** np.array([2, 4, 6, 8])
    radius = theta * (1.0 + FISHEYE @ powers)
    point = 3.0 * np.array([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)])
    expected = CENTRE + FISHEYE_FOCAL * radius * np.array([0.6, 0.8])
    np.testing.assert_allclose(batched("fisheye")[0](FISHEYE, point[None])[0], expected, rtol=1e-14)


@pytest.mark.parametrize("name", LENS_NAMES)
def test_projecting_an_unprojected_pixel_gives_the_pixel(name):
    c, pixels = coefficients(name), whole_image()
    forward, backward = batched(name)
    rays = np.asarray(backward(c, pixels))
    assert np.all(np.isfinite(rays))
    np.testing.assert_allclose(forward(c, rays), pixels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(forward(c, 7.0 * rays), pixels, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", LENS_NAMES)
def test_unprojecting_a_projected_point_gives_its_direction(name):
    c = coefficients(name)
    points = points_around_fisheye(1.9) if name == "fisheye" else points_before_camera()
    forward, backward = batched(name)
    rays = np.array(backward(c, forward(c, points)))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    expected = points / np.linalg.norm(points, axis=1)[:, None]
    # 1e-9 px is 1e-12 rad here.
    np.testing.assert_allclose(rays, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", PERSPECTIVE)
def test_points_behind_or_beside_a_perspective_camera_have_no_pixel(name):
    points = np.array([[0.1, 0.2, -1.0], [0.0, 0.0, -2.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert np.all(np.isnan(batched(name)[0](coefficients(name), points)))


def test_a_pixel_outside_the_image_circle_has_no_ray():
    """With k1 = -0.3 the image ends at a radius of 0.7027; no ray reaches any pixel outside.

    The polynomial reaches those radii on the other side of the axis, where r (1 - 0.3 r^2) has
    changed its sign; that is no ray.
    """
    radii = np.repeat([0.71, 0.75, 0.8, 0.9, 1.1, 1.5, 2.0, 3.0], 12)
    azimuth = np.tile(2 * np.pi * np.arange(12) / 12 + 0.1, 8)
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    pixels = CENTRE + radii[:, None] * FOCAL * around
    rays = np.asarray(batched("opencv4")[1](np.array([-0.3, 0.0, 0.0, 0.0]), pixels))
    got = ~np.isnan(rays[:, 0])
    assert not np.any(got), f"rays at radii {set(radii[got].tolist())}, e.g. {rays[got][0]}"


def test_pixels_just_inside_the_image_circle_have_the_inner_ray():
    """Of the two rays at a radius just below 0.7027 the lens sees the inner one."""
    radii = np.array([0.3, 0.5, 0.6, 0.68, 0.7, 0.7025])
    pixels = CENTRE + radii[:, None] * FOCAL * [0.6, -0.8]
    rays = np.asarray(batched("opencv4")[1](np.array([-0.3, 0.0, 0.0, 0.0]), pixels))
    inner = [min(r.real for r in np.roots([-0.3, 0, 1, -x]) if r.real > 0) for x in radii]
    np.testing.assert_allclose(rays[:, :2], np.outer(inner, [0.6, -0.8]), atol=1e-9)


def test_a_fisheye_pixel_farther_out_than_180_degrees_has_no_ray():
    """Without distortion the image of the direction straight back is a circle of radius pi."""
    radii = np.array([3.0, 3.2, 4.0, 6.0])
    pixels = CENTRE + radii[:, None] * FISHEYE_FOCAL * [0.6, 0.8]
    rays = np.asarray(batched("fisheye")[1](np.zeros(4), pixels))
    assert np.all(np.isfinite(rays[0]))
    assert np.all(np.isnan(rays[1:])), "a ray that is not imaged at the pixel it was taken from"


def test_a_fisheye_pixel_beyond_the_largest_radius_has_no_ray():
    """theta (1 - 0.1 theta^2) is at most 1.217 for a ray that the lens sees."""
    radii = np.array([1.2, 1.3, 1.5, 2.0, 3.0])
    pixels = CENTRE + radii[:, None] * FISHEYE_FOCAL * [0.6, 0.8]
    rays = np.asarray(batched("fisheye")[1](np.array([-0.1, 0.0, 0.0, 0.0]), pixels))
    assert np.all(np.isfinite(rays[0]))
    assert np.all(np.isnan(rays[1:]))


def test_a_point_straight_behind_a_fisheye_is_not_in_the_middle_of_the_image():
    """Near the axis behind the camera the radius is 180 degrees; on it there is no direction."""
    middle = batched("fisheye")[0](FISHEYE, np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))
    assert np.all(np.isnan(middle))


def fourth_order(function, x, steps):
    """Derivative of `function`, which takes a batch, by five-point central differences."""
    x = np.asarray(x, float)
    moves = np.eye(len(x)) * steps
    at = [np.asarray(function(x + s * moves)) for s in (1.0, -1.0, 2.0, -2.0)]
    rows = (8.0 * (at[0] - at[1]) - (at[2] - at[3])) / 12.0
    return (rows / np.reshape(steps * np.ones(len(x)), (-1, *[1] * (rows.ndim - 1)))).T


@pytest.mark.parametrize(
    ("way", "name"),
    [
        ("project", "opencv14"),
        ("project", "fisheye"),
        ("unproject", "opencv8"),
        ("unproject", "fisheye"),
    ],
)
def test_derivatives_equal_finite_differences(name, way):
    """With respect to the point or pixel, the focal lengths, the centre and the coefficients.

    The inverse is an iteration; its derivative must be that of the solution.
    """
    family, c, f = lens_family(name), coefficients(name), focal(name)
    function, n, step = (project, 3, 1e-4) if way == "project" else (unproject, 2, 0.2)

    def of_all(x):
        return function(family, x[n : n + 2], x[n + 2 : n + 4], x[n + 4 :], x[:n])

    places = [[0.5, -0.9, 2.0], [0.0, 0.0, 2.0], [-1.5, 0.2, 2.5]]
    if way == "unproject":
        places = [[30.0, 1900.0], list(CENTRE), [2000.0, 700.0]]
    if name == "fisheye" and way == "project":
        places.append([1.5, 1.0, -0.2])
    derivatives = [jax.jit(jax.jacrev(of_all))]
    if way == "project":
        derivatives.append(jax.jit(jax.jacfwd(of_all)))
    batch = jax.jit(jax.vmap(of_all))
    for place in places:
        x = np.concatenate([place, f, CENTRE, c])
        # A fisheye's k4 acts with the eighth power of up to 1.7 rad.
        small = 1e-6 if name == "fisheye" else 1e-4
        steps = np.concatenate([np.full(n, step), [0.2] * 4, np.full(len(c), small)])
        expected = fourth_order(batch, x, steps)
        # Each column by its largest entry, or, where all are 0 on the axis, by one px (or 1e-3).
        scale = np.maximum(np.abs(expected).max(axis=0), 1.0 if way == "project" else 1e-3)
        for derivative in derivatives:
            got = np.asarray(derivative(x))
            # On the axis a fisheye's ray has another length: compare what the lens sees of it.
            if way == "unproject" and name == "fisheye" and place == list(CENTRE):
                assert np.all(np.isfinite(got))
                np.testing.assert_allclose(got[:2, :2], np.diag(1.0 / f), rtol=1e-12)
                continue
            np.testing.assert_allclose(got / scale, expected / scale, atol=1e-7)


@pytest.mark.parametrize("name", ["opencv14", "fisheye"])
def test_extra_coefficients_add_to_the_lens_own(name):
    family, c = lens_family(name), jnp.asarray(coefficients(name))
    extra = jnp.array([0.03, -0.02, 0.01, 2e-4, -5e-4, 0.004, 0.003])
    ray = jnp.array([0.4, -0.3, 1.1])
    got = family.distort(c, ray, extra=extra)
    if name == "opencv14":
        own = c.at[jnp.array([0, 1, 4, 2, 3, 12, 13])].add(extra)
        np.testing.assert_allclose(got, family.distort(own, ray), rtol=1e-14)
    else:
        own = c.at[:3].add(extra[:3])
        only_radial = family.distort(c, ray, extra=extra.at[3:].set(0.0))
        np.testing.assert_allclose(only_radial, family.distort(own, ray), rtol=1e-14)
        x, y = np.asarray(only_radial)
        r2 = x * x + y * y
        decentred = np.array(
            [
                x + 2 * 2e-4 * x * y - 5e-4 * (r2 + 2 * x * x),
                y + 2e-4 * (r2 + 2 * y * y) - 2 * 5e-4 * x * y,
            ]
        )
        np.testing.assert_allclose(got, tilt(0.004, 0.003, decentred), rtol=1e-14)


@pytest.mark.parametrize("tilts", [(0.1, 0.0), (0.0, -0.2), (0.15, 0.25)])
def test_tilt_is_where_the_ray_meets_the_turned_sensor(tilts):
    """The ray (x, y, 1) meets the plane through (0, 0, 1); OpenCV's signs, up to the turn in it.

    OpenCV keeps the point as seen along the tilted plane's own normal from the same distance.
    """
    (a, b), point = tilts, np.array([0.3, -0.2])
    rx = np.array([[1, 0, 0], [0, np.cos(a), np.sin(a)], [0, -np.sin(a), np.cos(a)]])
    ry = np.array([[np.cos(b), 0, -np.sin(b)], [0, 1, 0], [np.sin(b), 0, np.cos(b)]])
    r = ry @ rx  # its rows are the axes of the tilted sensor
    hit = np.append(point, 1.0) / (r[2] @ np.append(point, 1.0)) * r[2, 2]
    expected = r[:2] @ (hit - [0.0, 0.0, 1.0])
    np.testing.assert_allclose(tilt(a, b, jnp.asarray(point)), expected, rtol=1e-13)


def test_family_by_name():
    for name in LENS_NAMES:
        assert lens_family(name).name == name
    assert isinstance(lens_family("fisheye"), KannalaBrandt)
    assert lens_family("opencv8") == BrownConrady(8)
    assert [lens_family(name).n_coefficients for name in LENS_NAMES] == [
        0, 2, 4, 5, 8, 12, 14, 4
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["opencv6", "Fisheye", "", "opencv", "tele"])
def test_an_unknown_lens_is_refused_with_the_known_names(name):
    with pytest.raises(ValueError) as caught:
        lens_family(name)
    message = str(caught.value)
    assert f'"{name}"' in message
    assert all(known in message for known in LENS_NAMES)


def test_a_number_of_coefficients_that_opencv_does_not_have_is_refused():
    with pytest.raises(ValueError, match="not 6"):
        BrownConrady(6)
