"""Every port of the chain: its derivative, and its sign and unit against a calculation by hand."""

import itertools
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxvm.geometry import lens_family
from jaxvm.physics.chain import (
    Aim,
    Circumstances,
    Sight,
    predict_pixel,
    predict_range,
)
from jaxvm.physics.ports import N_PORTS, PORT_INDEX, PORTS, STAGES, PortValues

NAMES = [port.name for port in PORTS]

# --- a general situation --------------------------------------------------------------------------

COEFFICIENTS = {
    "opencv14": [-0.11, 0.07, 4e-4, -3e-4, -0.02, 0.05, -0.01, 0.003, 9e-4, -5e-4, 7e-4, 2e-4]
    + [0.008, -0.011],
    "fisheye": [0.02, -0.006, 0.002, -0.0003],
}
POSES = {  # nothing is parallel to anything
    "station_from_camera": [0.1, -0.2, 0.15, 0.2, -0.1, 0.3],
    "world_from_station": [-0.2, 0.3, -0.4, 1.0, 2.0, -0.5],
    "world_from_carrier": [-0.1, 0.2, 0.05, 0.4, -0.3, 0.2],
    "carrier_from_target": [0.36, 0.23, 0.27, 3.4, 1.8, 5.1],
}
GENERAL = Circumstances(
    pixel=np.array([1500.0, 300.0]),
    image_height=np.array(2048.0),
    target_centre=np.array([0.55, 0.35, 0.0]),
    target_half_size=np.array([0.6, 0.4]),
    checker=np.array(1.0),
    mark=np.array(3.0),
    epoch=np.array(7.0),
    along_beam=np.array(-1.0),
    velocity=np.array([0.7, -0.4, 0.5, 0.3, -0.2, 0.4]),
)
POINT = np.array([0.83, 0.21, 0.0])
FOCAL, CENTRE = np.array([2000.0, 2011.0]), np.array([1231.0, 1018.0])


def pixel_of(name, point=POINT):
    """Predicted pixel in the general situation as a function of the ports."""
    sight = Sight(
        focal=FOCAL,
        centre=CENTRE,
        distortion=np.array(COEFFICIENTS[name]),
        point=point,
        **{key: np.array(value) for key, value in POSES.items()},
    )
    sight, at = jax.tree.map(jnp.asarray, (sight, GENERAL))
    return lambda values: predict_pixel(lens_family(name), sight, at, PortValues(values))


def ranges():
    """Predicted ranges to the mark and to the plane as a function of the ports."""
    aim = Aim(
        station_from_rangefinder=POSES["station_from_camera"],
        world_from_station=POSES["world_from_station"],
        world_from_carrier=POSES["world_from_carrier"],
        carrier_from_target=POSES["carrier_from_target"],
        point=POINT,
    )
    aim = Aim(*(jnp.asarray(value, float) for value in aim))
    at = jax.tree.map(jnp.asarray, GENERAL)
    both = jax.vmap(predict_range, (None, None, 0, None))
    return lambda values: both(aim, at, jnp.array([0.0, 1.0]), PortValues(values))


PREDICTIONS = {
    "opencv14": lambda: pixel_of("opencv14"),
    "fisheye": lambda: pixel_of("fisheye"),
    "ranges": ranges,
}
LARGEST = np.array([port.largest for port in PORTS])
DISC = PORT_INDEX["target.disc"]
# At zero, and somewhere where every port is at a part of its largest value; but for the size of
# marks, which derivatives by other ports leave out (see the test of discs below).
AT = {"zero": np.zeros(N_PORTS), "all": 0.2 * LARGEST * np.cos(1.0 + 2.0 * np.arange(N_PORTS))}
AT["all"][DISC] = 0.0


@pytest.fixture(scope="module")
def derivatives():
    """(derivative, differences) of each prediction at each place, all ports at once."""
    steps = 1e-2 * LARGEST
    moves = np.diag(steps)
    result = {}
    for which, make in PREDICTIONS.items():
        function = make()
        derivative = jax.jit(jax.jacrev(function))
        batch = jax.jit(jax.vmap(function))
        for place, values in AT.items():
            at = [np.asarray(batch(values + s * moves)) for s in (1.0, -1.0, 2.0, -2.0)]
            # Five points: the error is of the fourth order in the step.
            slope = (8.0 * (at[0] - at[1]) - (at[2] - at[3])) / (12.0 * steps[:, None])
            result[which, place] = np.asarray(derivative(values)), slope.T
    return result


@pytest.mark.parametrize("name", NAMES)
def test_derivative_of_every_prediction_equals_finite_differences(name, derivatives):
    j = PORT_INDEX[name]
    for key, (derivative, slope) in derivatives.items():
        # The change that the port's largest value makes, to 1e-6 px or 1e-9 m and 1e-6 of itself.
        expected = slope[:, j] * LARGEST[j]
        tolerance = (1e-9 if key[0] == "ranges" else 1e-6) + 1e-6 * np.abs(expected).max()
        got = derivative[:, j] * LARGEST[j]
        assert np.all(np.isfinite(got)), key
        assert np.abs(got - expected).max() < tolerance, key


@pytest.mark.parametrize("name", NAMES)
def test_no_port_is_without_effect(name, derivatives):
    """A port that is read nowhere, or is multiplied away, would show here."""
    j = PORT_INDEX[name]

    def moved(which):
        return np.abs(derivatives[which, "zero"][0][:, j]) * LARGEST[j]

    if PORTS[j].stage == "range":
        assert moved("ranges").min() > 1e-3  # m, both to the mark and to the plane
    else:
        assert moved("opencv14").max() > 0.1  # px
        assert moved("fisheye").max() > 0.1


@pytest.mark.parametrize("which", PREDICTIONS)
def test_ports_at_zero_are_the_plain_model(which):
    function = PREDICTIONS[which]()
    zero, plain = jax.jit(lambda values: (function(values), function(None)))(np.zeros(N_PORTS))
    np.testing.assert_allclose(zero, plain, rtol=1e-14)


def test_names_stages_and_numbers():
    assert len(set(NAMES)) == N_PORTS == len(PORTS)
    assert {port.stage for port in PORTS} == set(STAGES)
    order = [STAGES.index(port.stage) for port in PORTS]
    assert order == sorted(order)
    values = PortValues(jnp.arange(float(N_PORTS)))
    assert [float(values[name]) for name in NAMES] == list(range(N_PORTS))
    assert PortValues()["lens.k1"] == 0.0
    first = PORT_INDEX["mount.turn_x"]
    assert np.array_equal(values.axes("mount.turn"), [first, first + 1, first + 2])


# --- sign and unit, by hand -----------------------------------------------------------------------
#
# The bench: a pinhole camera of principal distance F px in the world's origin, its axes (x right,
# y down, z forward) those of the world. A frontal target at depth Z, shifted sideways, its axes
# those of the world too. Everything below is written with these numbers and without the package.

F, CX, CY, ROWS = 2000.0, 1200.0, 1000.0, 2000.0
Z = 5.0
QUARTER = np.pi / 2


@dataclass
class Bench:
    """One situation; a mark at `point` on a target whose origin is at `origin` in the world."""

    point: tuple = (0.4, 0.3, 0.0)
    origin: tuple = (0.2, -0.5, Z)
    target_turn: tuple = (0.0, 0.0, 0.0)
    centre: tuple = (0.1, 0.1, 0.0)
    half_size: tuple = (0.5, 0.4)
    velocity: tuple = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    row: float = 1000.0
    station: tuple = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    camera: tuple = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass
class Case:
    """A value of the port, and what the hand calculation says of the pixel or the range."""

    value: float
    expected: np.ndarray | tuple | float
    bench: Bench = field(default_factory=Bench)
    rtol: float = 1e-9


def seen(x, y, z):
    """Pixel of a point at (x, y, z) before the bench's camera."""
    return np.array([CX + F * x / z, CY + F * y / z])


# The default mark is here, and its image at tangents (TX, TY).
X, Y = 0.6, -0.2
TX, TY = X / Z, Y / Z
R2 = TX**2 + TY**2
PLAIN = seen(X, Y, Z)

HAND = {}


def hand(name, unit):
    """Register the hand calculation of a port; the unit is that in which it was done."""

    def register(function):
        assert name not in HAND
        HAND[name] = unit, function
        return function

    return register


@hand("target.scale", "1")
def _():
    # The mark is 0.3 m right and 0.2 m below the target's centre (0.1, 0.1).
    e = 1e-3
    yield Case(e, PLAIN + [F * 0.3 * e / Z, F * 0.2 * e / Z])
    # In the centre nothing moves.
    yield Case(e, seen(0.3, -0.4, Z), Bench(point=(0.1, 0.1, 0.0)))
    # A mark 0.5 m behind the centre moves back as well.
    grown = seen(X + 0.3 * e, Y + 0.2 * e, Z + 0.5 * (1 + e))
    yield Case(e, grown, Bench(point=(0.4, 0.3, 0.5)))


@hand("target.scale_x", "1")
def _():
    yield Case(2e-3, PLAIN + [F * 0.3 * 2e-3 / Z, 0.0])
    # The target's own x axis: turned by a quarter about z it is the image's v.
    turned = Bench(target_turn=(0.0, 0.0, QUARTER))
    yield Case(2e-3, seen(0.2 - 0.3, -0.5 + 0.4 + 0.3 * 2e-3, Z), turned)


@hand("target.scale_y", "1")
def _():
    yield Case(2e-3, PLAIN + [0.0, F * 0.2 * 2e-3 / Z])


@hand("target.bow_x", "m")
def _():
    # In the middle the mark is h farther along the target's z, which here points away.
    h = 0.02
    yield Case(h, seen(0.3, -0.2, Z + h), Bench(point=(0.1, 0.3, 0.0)))
    # At both x edges (0.1 +- 0.5) nothing; half-way three quarters.
    yield Case(h, seen(0.8, -0.2, Z), Bench(point=(0.6, 0.3, 0.0)))
    yield Case(h, seen(-0.2, -0.2, Z), Bench(point=(-0.4, 0.3, 0.0)))
    yield Case(h, seen(0.55, -0.2, Z + 0.75 * h), Bench(point=(0.35, 0.3, 0.0)))


@hand("target.bow_y", "m")
def _():
    h = 0.02
    yield Case(h, seen(X, -0.4, Z + h), Bench(point=(0.4, 0.1, 0.0)))
    yield Case(h, seen(X, 0.0, Z), Bench(point=(0.4, 0.5, 0.0)))
    yield Case(h, seen(X, -0.2, Z + 0.75 * h), Bench(point=(0.4, 0.3, 0.0)))


@hand("target.twist", "m")
def _():
    # Corners of the target: right below and left above rise by h, the other two fall.
    h = 0.02
    for a, b in ((1, 1), (-1, -1), (1, -1), (-1, 1)):
        x, y = 0.1 + 0.5 * a, 0.1 + 0.4 * b
        yield Case(h, seen(0.2 + x, -0.5 + y, Z + a * b * h), Bench(point=(x, y, 0.0)))


@hand("target.point_x", "m")
def _():
    yield Case(1e-3, PLAIN + [F * 1e-3 / Z, 0.0])
    turned = Bench(target_turn=(0.0, 0.0, QUARTER))
    yield Case(1e-3, seen(0.2 - 0.3, -0.5 + 0.401, Z), turned)


@hand("target.point_y", "m")
def _():
    yield Case(1e-3, PLAIN + [0.0, F * 1e-3 / Z])
    turned = Bench(target_turn=(0.0, 0.0, QUARTER))
    yield Case(1e-3, seen(0.2 - 0.301, -0.5 + 0.4, Z), turned)


@hand("target.point_z", "m")
def _():
    yield Case(0.02, seen(X, Y, Z + 0.02))
    # A target that faces the other way (half a turn about its y) has its z towards the camera.
    back = Bench(target_turn=(0.0, np.pi, 0.0))
    yield Case(0.02, seen(0.2 - 0.4, Y, Z - 0.02), back)


@hand("structure.shift_x", "m")
def _():
    # The world's axis, whatever way the target is turned.
    yield Case(0.1, PLAIN + [F * 0.1 / Z, 0.0])
    yield Case(0.1, seen(0.2 - 0.3 + 0.1, -0.1, Z), Bench(target_turn=(0.0, 0.0, QUARTER)))


@hand("structure.shift_y", "m")
def _():
    yield Case(0.1, PLAIN + [0.0, F * 0.1 / Z])
    yield Case(0.1, seen(0.2 - 0.3, 0.0, Z), Bench(target_turn=(0.0, 0.0, QUARTER)))


@hand("structure.shift_z", "m")
def _():
    yield Case(0.1, seen(X, Y, Z + 0.1))
    yield Case(0.1, seen(0.2 - 0.4, Y, Z + 0.1), Bench(target_turn=(0.0, np.pi, 0.0)))


@hand("structure.turn_x", "rad")
def _():
    # About the target's origin: the arm (0.4, 0.3, 0); y turns towards z.
    w = 0.05
    yield Case(w, seen(X, -0.5 + 0.3 * np.cos(w), Z + 0.3 * np.sin(w)))
    # About the world's x, also where the target's own x points along the world's y.
    turned = Bench(target_turn=(0.0, 0.0, QUARTER))
    yield Case(w, seen(0.2 - 0.3, -0.5 + 0.4 * np.cos(w), Z + 0.4 * np.sin(w)), turned)


@hand("structure.turn_y", "rad")
def _():
    w = 0.05  # z turns towards x, so x turns towards -z
    yield Case(w, seen(0.2 + 0.4 * np.cos(w), Y, Z - 0.4 * np.sin(w)))


@hand("structure.turn_z", "rad")
def _():
    w = 0.05
    c, s = np.cos(w), np.sin(w)
    yield Case(w, seen(0.2 + 0.4 * c - 0.3 * s, -0.5 + 0.4 * s + 0.3 * c, Z))


@hand("clock.offset", "s")
def _():
    # Later by 20 ms: 0.5 m/s to the right have carried the target 10 mm on.
    yield Case(0.02, seen(X + 0.01, Y, Z), Bench(velocity=(0.5, 0, 0, 0, 0, 0)))
    # 2 rad/s about the world's z through the target's origin.
    c, s = np.cos(0.04), np.sin(0.04)
    spinning = Bench(velocity=(0, 0, 0, 0, 0, 2.0))
    yield Case(0.02, seen(0.2 + 0.4 * c - 0.3 * s, -0.5 + 0.4 * s + 0.3 * c, Z), spinning)
    yield Case(0.02, PLAIN)  # a target at rest


@hand("shutter.row_time", "s")
def _():
    # Of 2000 rows read in T = 50 ms, the last is exposed T/2 after the middle (less half a row's
    # time), the first as much before it, and the middle between rows 999 and 1000 not at all.
    for row, share in ((1999.0, 0.49975), (0.0, -0.49975), (999.5, 0.0), (1499.5, 0.25)):
        moving = Bench(velocity=(0.4, 0, 0, 0, 0, 0), row=row)
        yield Case(0.05, seen(X + 0.4 * 0.05 * share, Y, Z), moving)


@hand("target.disc", "m²")
def _():
    # The rim of a disc of radius 4 cm on a leaning plate, projected: the middle of that ellipse.
    radius = 0.04
    angle = 2.0 * np.pi * np.arange(360) / 360
    rim = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    for turn in ((0.0, 0.0, 0.0), (0.6, 0.0, 0.0), (0.0, -0.8, 0.0)):
        for x, y in ((0.0, 0.0), (1.5, -1.0)):
            at = np.array([x, y, Z]) + rim @ Rotation.from_rotvec(turn).as_matrix().T
            image = (at[:, :2] / at[:, 2:] - [x / Z, y / Z]) * Z / radius
            conic = np.column_stack([image**2, image[:, 0] * image[:, 1], image])
            a, b, c, d, e = np.linalg.lstsq(conic, np.ones(360), rcond=None)[0]
            off = np.linalg.solve([[2.0 * a, c], [c, 2.0 * b]], [-d, -e])
            middle = seen(x, y, Z) + F * off * radius / Z
            leaning = Bench(origin=(x, y, Z), point=(0, 0, 0), target_turn=turn)
            # The chain goes to the second order in R / Z = 0.01.
            yield Case(radius**2, middle, leaning, rtol=1e-3)

    # On the axis it is f R^2 sin i cos i / Z^2 along the tilt; MATHEMATICS 1.9 has three of them.
    for f, radius, z, degrees, published in (
        (2500.0, 0.025, 2.0, 45.0, 0.195),
        (2500.0, 0.010, 2.0, 30.0, 0.027),
        (8000.0, 0.050, 20.0, 45.0, 0.025),
    ):
        i = np.radians(degrees)
        leaning = Bench(origin=(0, 0, z), point=(0, 0, 0), target_turn=(i, 0, 0))
        off = radius**2 * np.sin(i) * np.cos(i) / z**2
        assert f * off == pytest.approx(published, abs=5e-4)
        yield Case(radius**2, (CX, CY - F * off), leaning, rtol=1e-3)


@hand("medium.bend_u", "rad/m")
def _():
    # On the axis L = Z: k L^2 / 2 = 25 mm for k = 2e-5 at 50 m, that is k Z F / 2 = 1 px.
    k = 2e-5
    far = Bench(origin=(0.0, 0.0, 50.0), point=(0.0, 0.0, 0.0))
    yield Case(k, (CX + 1.0, CY), far)
    # Off the axis the square of the path is X^2 + Y^2 + Z^2.
    yield Case(k, seen(X + 0.5 * k * (X**2 + Y**2 + Z**2), Y, Z))


@hand("medium.bend_v", "rad/m")
def _():
    far = Bench(origin=(0.0, 0.0, 50.0), point=(0.0, 0.0, 0.0))
    yield Case(2e-5, (CX, CY + 1.0), far)


# The bench's world has its z axis upwards, which is the camera's axis; x and y are level.


@hand("medium.layers_up", "rad/m")
def _():
    # On the axis the mark moves along the line of sight alone; beside it by k L^2 / 2 along z.
    k = 2e-5
    yield Case(k, (CX, CY), Bench(origin=(0.0, 0.0, 50.0), point=(0.0, 0.0, 0.0)))
    yield Case(k, seen(X, Y, Z + 0.5 * k * (X**2 + Y**2 + Z**2)))
    # A camera that looks level has the world's z upwards in its image, which is -v.
    level = Bench(origin=(0.0, 50.0, 0.0), point=(0, 0, 0), camera=(-QUARTER, 0, 0, 0, 0, 0))
    yield Case(k, (CX, CY - 1.0), level)


@hand("medium.layers_x", "rad/m")
def _():
    k = 2e-5
    yield Case(k, (CX + 1.0, CY), Bench(origin=(0.0, 0.0, 50.0), point=(0.0, 0.0, 0.0)))
    # Two cameras back to back see the same air on opposite sides.
    back = Bench(origin=(0.0, 0.0, -50.0), point=(0, 0, 0), camera=(0, np.pi, 0, 0, 0, 0))
    yield Case(k, (CX - 1.0, CY), back)


@hand("medium.layers_y", "rad/m")
def _():
    far = Bench(origin=(0.0, 0.0, 50.0), point=(0.0, 0.0, 0.0))
    yield Case(2e-5, (CX, CY + 1.0), far)


@hand("medium.dome_x", "m")
def _():
    yield from through_dome(np.array([1.0, 0.0, 0.0]))


@hand("medium.dome_y", "m")
def _():
    yield from through_dome(np.array([0.0, 1.0, 0.0]))


@hand("medium.dome_z", "m")
def _():
    yield from through_dome(np.array([0.0, 0.0, 1.0]))


def through_dome(side):
    # From the pinhole through two spheres about a point c beside it: Snell's law at both, with the
    # normals from c. The mark lies on the ray that leaves, near or far.
    inner, outer, n = 0.07, 0.074, 1.52
    cases = itertools.product(((0.0, 0.0), (0.3, -0.2), (-0.5, 0.6)), (2e-3, 2e-2), (0.3, 20.0))
    for (x, y), size, far in cases:
        c = size * side
        way = np.array([x, y, 1.0]) / np.sqrt(1.0 + x * x + y * y)
        at = np.zeros(3)
        for radius, ratio in ((inner, 1.0 / n), (outer, n)):
            along = (at - c) @ way
            at = at + way * (np.sqrt(along**2 - (at - c) @ (at - c) + radius**2) - along)
            normal = (at - c) / radius
            cosine = way @ normal
            inside = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
            way = ratio * way + (inside - ratio * cosine) * normal
        mark = Bench(origin=tuple(at + far * way), point=(0, 0, 0))
        yield Case(size, (CX + F * x, CY + F * y), mark, rtol=1e-3)


@hand("medium.window", "m")
def _():
    # Trace the ray from the pinhole: at the angle i through Z - d of air, at the angle r, with
    # sin i = 1.52 sin r, through d of glass. Bisect for the i that ends at the mark.
    d, n = 1e-3, 1.52
    for x, y in ((0.6, -0.2), (2.5, 2.0)):
        lateral = np.hypot(x, y)
        low, high = 0.0, 1.2
        for _step in range(100):
            i = 0.5 * (low + high)
            reached = (Z - d) * np.tan(i) + d * np.tan(np.arcsin(np.sin(i) / n))
            low, high = (i, high) if reached < lateral else (low, i)
        expected = np.array([CX, CY]) + F * np.tan(i) * np.array([x, y]) / lateral
        # The chain takes the angle of the line to the mark for the ray's: equal to first order
        # in d, and to d/Z = 2e-4 of the effect here.
        yield Case(d, expected, Bench(origin=(x, y, Z), point=(0, 0, 0)), rtol=3e-4)


@hand("medium.wedge_x", "rad")
def _():
    yield from through_wedge(np.array([1.0, 0.0]))


@hand("medium.wedge_y", "rad")
def _():
    yield from through_wedge(np.array([0.0, 1.0]))


def through_wedge(side):
    # From the pinhole through a thin plate of n = 1.52: its near face is normal to the axis, its
    # far face leans by w. Snell's law in vectors gives where the ray of an image point goes.
    w, n = 1e-4, 1.52
    for x, y in ((0.0, 0.0), (0.3, -0.2), (-0.5, 0.6)):
        aim = np.array([x, y, 1.0]) / np.sqrt(1.0 + x * x + y * y)
        glass = np.append(aim[:2] / n, np.sqrt(1.0 - aim[:2] @ aim[:2] / n**2))
        face = np.append(np.sin(w) * side, np.cos(w))
        inside = glass @ face
        out = n * glass + (np.sqrt(1.0 - n**2 * (1.0 - inside**2)) - n * inside) * face
        mark = tuple(Z * out / out[2])
        yield Case(w, (CX + F * x, CY + F * y), Bench(origin=mark, point=(0, 0, 0)), rtol=1e-3)


# The body turns, so what it sees turns the other way. Distances are those in the body's axes.


@hand("station.turn_x", "rad")
def _():
    # +x: y turns towards z, so the axis of view rises and the mark sinks in the image.
    w = 0.01
    yield Case(w, (CX, CY + F * np.tan(w)), Bench(origin=(0, 0, Z), point=(0, 0, 0)))
    # About the station's origin, 1 m behind the camera.
    before = Bench(origin=(0, 0, 6.0), point=(0, 0, 0), camera=(0, 0, 0, 0, 0, 1.0))
    yield Case(w, seen(0, 6.0 * np.sin(w), 6.0 * np.cos(w) - 1.0), before)


@hand("station.turn_y", "rad")
def _():
    w = 0.01
    yield Case(w, (CX - F * np.tan(w), CY), Bench(origin=(0, 0, Z), point=(0, 0, 0)))
    before = Bench(origin=(0, 0, 6.0), point=(0, 0, 0), camera=(0, 0, 0, 0, 0, 1.0))
    yield Case(w, seen(-6.0 * np.sin(w), 0, 6.0 * np.cos(w) - 1.0), before)
    # The station's own y axis is the camera's -x where the camera has rolled a quarter on it.
    rolled = Bench(origin=(0, 0, Z), point=(0, 0, 0), camera=(0, 0, QUARTER, 0, 0, 0))
    yield Case(w, (CX, CY + F * np.tan(w)), rolled)


@hand("station.turn_z", "rad")
def _():
    w = 0.01
    yield Case(w, seen(X * np.cos(w) + Y * np.sin(w), -X * np.sin(w) + Y * np.cos(w), Z))


@hand("station.shift_x", "m")
def _():
    yield Case(0.02, PLAIN - [F * 0.02 / Z, 0])
    # A station that is rolled by a quarter has its x axis along the world's y; its camera sees the
    # world's (x, y) as (y, -x).
    yield Case(0.02, seen(Y - 0.02, -X, Z), Bench(station=(0, 0, QUARTER, 0, 0, 0)))
    # The same roll of the camera on the station: now it is seen along -v.
    yield Case(0.02, seen(Y, -(X - 0.02), Z), Bench(camera=(0, 0, QUARTER, 0, 0, 0)))


@hand("station.shift_y", "m")
def _():
    yield Case(0.02, PLAIN - [0, F * 0.02 / Z])
    yield Case(0.02, seen(Y, -X - 0.02, Z), Bench(station=(0, 0, QUARTER, 0, 0, 0)))


@hand("station.shift_z", "m")
def _():
    yield Case(0.02, seen(X, Y, Z - 0.02))


@hand("mount.turn_x", "rad")
def _():
    w = 0.01
    yield Case(w, (CX, CY + F * np.tan(w)), Bench(origin=(0, 0, Z), point=(0, 0, 0)))
    # About the camera's own centre, wherever it sits on the station.
    before = Bench(origin=(0, 0, 6.0), point=(0, 0, 0), camera=(0, 0, 0, 0, 0, 1.0))
    yield Case(w, (CX, CY + F * np.tan(w)), before)


@hand("mount.turn_y", "rad")
def _():
    w = 0.01
    yield Case(w, (CX - F * np.tan(w), CY), Bench(origin=(0, 0, Z), point=(0, 0, 0)))
    # A distant mark moves by -F w.
    distant = Bench(origin=(0, 0, 1e5), point=(0, 0, 0), camera=(0, 0, 0, 0.3, 0.2, 1.0))
    plain = seen(-0.3, -0.2, 1e5 - 1.0)
    yield Case(1e-4, plain - [F * 1e-4, 0], distant, rtol=1e-6)
    # The camera's own y axis, also where the camera has rolled.
    rolled = Bench(origin=(0, 0, Z), point=(0, 0, 0), camera=(0, 0, QUARTER, 0, 0, 0))
    yield Case(w, (CX - F * np.tan(w), CY), rolled)


@hand("mount.turn_z", "rad")
def _():
    w = 0.01
    yield Case(w, seen(X * np.cos(w) + Y * np.sin(w), -X * np.sin(w) + Y * np.cos(w), Z))


@hand("mount.shift_x", "m")
def _():
    yield Case(0.02, PLAIN - [F * 0.02 / Z, 0])
    # Along the camera's own axis, also where the camera has rolled on the station.
    yield Case(0.02, seen(Y - 0.02, -X, Z), Bench(camera=(0, 0, QUARTER, 0, 0, 0)))


@hand("mount.shift_y", "m")
def _():
    yield Case(0.02, PLAIN - [0, F * 0.02 / Z])
    yield Case(0.02, seen(Y, -X - 0.02, Z), Bench(camera=(0, 0, QUARTER, 0, 0, 0)))


@hand("mount.shift_z", "m")
def _():
    yield Case(0.02, seen(X, Y, Z - 0.02))


WIDE = Bench(origin=(2.0, -1.5, Z), point=(0, 0, 0))  # tangents 0.4 and -0.3, radius 0.5


def at_tangents(x, y):
    return np.array([CX + F * x, CY + F * y])


@hand("lens.k1", "1")
def _():
    yield Case(0.01, at_tangents(0.4 * (1 + 0.01 * 0.25), -0.3 * (1 + 0.01 * 0.25)), WIDE)


@hand("lens.k2", "1")
def _():
    yield Case(0.01, at_tangents(0.4 * (1 + 0.01 / 16), -0.3 * (1 + 0.01 / 16)), WIDE)


@hand("lens.k3", "1")
def _():
    yield Case(0.01, at_tangents(0.4 * (1 + 0.01 / 64), -0.3 * (1 + 0.01 / 64)), WIDE)


@hand("lens.p1", "1")
def _():
    # OpenCV's p1: (2 p x y, p (r^2 + 2 y^2))
    p = 1e-3
    yield Case(p, at_tangents(0.4 + 2 * p * 0.4 * -0.3, -0.3 + p * (0.25 + 2 * 0.09)), WIDE)


@hand("lens.p2", "1")
def _():
    # OpenCV's p2: (p (r^2 + 2 x^2), 2 p x y)
    p = 1e-3
    yield Case(p, at_tangents(0.4 + p * (0.25 + 2 * 0.16), -0.3 + 2 * p * 0.4 * -0.3), WIDE)


@hand("lens.tilt_x", "rad")
def _():
    # The sensor turned about +x is the plane z = 1 + y tan w; the ray l (0.4, -0.3, 1) meets it at
    # l = 1 / (1 + 0.3 tan w), and along the slope lengths are measured on the sensor.
    w = 0.02
    length = 1.0 / (1.0 + 0.3 * np.tan(w))
    yield Case(w, at_tangents(0.4 * length, -0.3 * length / np.cos(w)), WIDE)


@hand("lens.tilt_y", "rad")
def _():
    # Turned about +y it is the plane z = 1 - x tan w.
    w = 0.02
    length = 1.0 / (1.0 + 0.4 * np.tan(w))
    yield Case(w, at_tangents(0.4 * length / np.cos(w), -0.3 * length), WIDE)


@hand("lens.entrance", "m")
def _():
    # The pupil comes nearer to the mark by e theta^2; none on the axis.
    e, theta = 0.01, np.arctan(0.5)
    yield Case(e, seen(2.0, -1.5, Z - e * theta**2), WIDE)
    yield Case(e, (CX, CY), Bench(origin=(0, 0, Z), point=(0, 0, 0)))


@hand("sensor.focal", "1")
def _():
    yield Case(1e-3, PLAIN + [F * TX * 1e-3, F * TY * 1e-3])


@hand("sensor.aspect", "1")
def _():
    yield Case(1e-3, PLAIN + [F * TX * 1e-3, 0])


@hand("sensor.cx", "px")
def _():
    yield Case(1.0, PLAIN + [1, 0])


@hand("sensor.cy", "px")
def _():
    yield Case(1.0, PLAIN + [0, 1])


@hand("sensor.skew", "1")
def _():
    # A row at v = F y below the middle is sheared by s F y to the right.
    yield Case(1e-3, PLAIN + [F * TY * 1e-3, 0])


@hand("detect.u", "px")
def _():
    yield Case(0.5, PLAIN + [0.5, 0])


@hand("detect.v", "px")
def _():
    yield Case(0.5, PLAIN + [0, 0.5])


DISTANCE = np.sqrt(X**2 + Y**2 + Z**2)


@hand("range.offset", "m")
def _():
    yield Case(0.01, DISTANCE + 0.01)


@hand("range.scale", "1")
def _():
    yield Case(1e-3, DISTANCE * 1.001)


def _bench_arrays(bench):
    sight = Sight(
        focal=(F, F),
        centre=(CX, CY),
        distortion=np.zeros(0),
        station_from_camera=bench.camera,
        world_from_station=bench.station,
        world_from_carrier=np.zeros(6),
        carrier_from_target=(*bench.target_turn, *bench.origin),
        point=bench.point,
    )
    at = Circumstances(
        (CX, bench.row), ROWS, bench.centre, bench.half_size, 1.0, 0.0, 0.0, 0.0, bench.velocity
    )
    return (
        Sight(*(np.asarray(x, float) for x in sight)),
        Circumstances(*(np.asarray(x, float) for x in at)),
    )


@jax.jit
def bench_pixel(sight, at, values):
    return predict_pixel(lens_family("pinhole"), sight, at, PortValues(values))


@jax.jit
def bench_range(sight, at, values, to_plane):
    aim = Aim(*sight[3:])
    return predict_range(aim, at, to_plane, PortValues(values))


@pytest.mark.parametrize("name", NAMES)
def test_sign_and_unit_by_hand(name):
    unit, cases = HAND[name]
    port = PORTS[PORT_INDEX[name]]
    assert port.unit == unit
    for case in cases():
        assert abs(case.value) <= port.largest
        sight, at = _bench_arrays(case.bench)
        values = np.zeros(N_PORTS)
        # Read before `values` changes: a program may still be looking at this memory.
        plain = np.asarray(bench_pixel(sight, at, values))
        values[PORT_INDEX[name]] = case.value
        if port.stage == "range":
            got = bench_range(sight, at, values, 0.0)
            np.testing.assert_allclose(got, case.expected, rtol=1e-13)
            continue
        got = np.asarray(bench_pixel(sight, at, values) - plain)
        expected = np.asarray(case.expected) - np.asarray(plain)
        tolerance = 1e-9 + case.rtol * np.abs(expected).max()
        np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance)


def test_the_bench_is_what_the_hand_calculations_assume():
    sight, at = _bench_arrays(Bench())
    np.testing.assert_allclose(bench_pixel(sight, at, np.zeros(N_PORTS)), PLAIN, rtol=1e-15)


@pytest.mark.parametrize(
    ("name", "value", "to_mark", "to_plane"),
    [
        # The beam goes along +z from the origin to the frontal plane at Z.
        ("station.shift_z", 0.02, np.sqrt(X**2 + Y**2 + (Z - 0.02) ** 2), Z - 0.02),
        ("mount.shift_z", 0.02, np.sqrt(X**2 + Y**2 + (Z - 0.02) ** 2), Z - 0.02),
        ("structure.shift_z", 0.1, np.sqrt(X**2 + Y**2 + (Z + 0.1) ** 2), Z + 0.1),
        # Sideways shifts do not change the distance of a plane.
        ("mount.shift_x", 0.02, np.sqrt((X - 0.02) ** 2 + Y**2 + Z**2), Z),
        # A turned beam meets the plane at Z / cos w; the distance of a mark stays.
        ("mount.turn_y", 0.02, DISTANCE, Z / np.cos(0.02)),
        # The plane turns about the target's origin, 0.2 m beside the beam: with its normal
        # (sin w, 0, cos w) the beam meets it at Z + 0.2 tan w.
        (
            "structure.turn_y",
            0.02,
            np.sqrt((0.2 + 0.4 * np.cos(0.02)) ** 2 + Y**2 + (Z - 0.4 * np.sin(0.02)) ** 2),
            Z + 0.2 * np.tan(0.02),
        ),
        ("range.scale", 1e-3, DISTANCE * 1.001, Z * 1.001),
        ("range.offset", 0.01, DISTANCE + 0.01, Z + 0.01),
    ],
)
def test_ranges_by_hand(name, value, to_mark, to_plane):
    sight, at = _bench_arrays(Bench())
    values = np.zeros(N_PORTS)
    values[PORT_INDEX[name]] = value
    np.testing.assert_allclose(bench_range(sight, at, values, 0.0), to_mark, rtol=1e-13)
    np.testing.assert_allclose(bench_range(sight, at, values, 1.0), to_plane, rtol=1e-13)


def test_a_late_clock_acts_on_ranges_too():
    """10 ms later a target that recedes at 0.5 m/s is 5 mm farther away."""
    sight, at = _bench_arrays(Bench(velocity=(0, 0, 0.5, 0, 0, 0)))
    values = np.zeros(N_PORTS)
    values[PORT_INDEX["clock.offset"]] = 0.01
    np.testing.assert_allclose(bench_range(sight, at, values, 1.0), Z + 0.005, rtol=1e-13)


@pytest.mark.parametrize("lens", COEFFICIENTS)
def test_a_disc_behind_a_distorting_lens_has_the_centroid_of_its_outline(lens):
    """The polygon of many points of the rim, imaged one by one, has its centroid there."""
    radius, angle = 0.06, 2.0 * np.pi * np.arange(720) / 720
    arms = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    image = jax.vmap(lambda point: pixel_of(lens, point)(jnp.zeros(N_PORTS)))(POINT + arms)
    centre = np.asarray(pixel_of(lens)(jnp.zeros(N_PORTS)))
    a = np.asarray(image) - centre
    b = np.roll(a, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    centroid = ((a + b) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())
    ports = jnp.zeros(N_PORTS).at[PORT_INDEX["target.disc"]].set(radius**2)
    off = np.asarray(pixel_of(lens)(ports)) - centre
    assert np.linalg.norm(off) > 0.05
    np.testing.assert_allclose(off, centroid, atol=2e-3 * np.linalg.norm(centroid))


@pytest.mark.parametrize("lens", COEFFICIENTS)
def test_derivatives_beside_a_disc_lack_its_square_alone(lens):
    """A mark of 2 cm before a camera at metres: 1e-4 of the other derivatives, none of its own."""
    steps = 1e-2 * LARGEST
    values = AT["all"].copy()
    values[DISC] = 0.01**2
    function = pixel_of(lens)
    derivative = np.asarray(jax.jacrev(function)(values))
    batch = jax.jit(jax.vmap(function))
    at = [np.asarray(batch(values + s * np.diag(steps))) for s in (1.0, -1.0, 2.0, -2.0)]
    slope = ((8.0 * (at[0] - at[1]) - (at[2] - at[3])) / (12.0 * steps[:, None])).T
    size = np.abs(slope).max(axis=0)
    off = np.abs(derivative - slope).max(axis=0) / np.maximum(size, 1e-12)
    assert off[DISC] < 1e-6
    assert off[size * LARGEST > 1e-6].max() < 1e-3


def test_every_port_has_a_hand_calculation():
    assert set(HAND) == set(NAMES)
