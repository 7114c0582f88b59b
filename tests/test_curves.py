"""Free-form curves and maps: partitions of unity, exact cubics, and a turn that has no name."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import HELD, IMAGE, predicted

from jaxvm.discover.curves import curve_constants, curved_drivers
from jaxvm.geometry.targets import grid_points
from jaxvm.network.scene import build
from jaxvm.physics.catalogue.maps import (
    fine_image_map,
    fine_plate_map,
    finest_image_map,
    image_map,
    plate_map,
)
from jaxvm.physics.drivers import (
    OBSERVATION_DRIVER_INDEX,
    OBSERVATION_DRIVERS,
    PLANES,
    patterns,
)
from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.physics.forms import BASIS_INDEX, FORMS, N_KNOTS, evaluate_basis
from jaxvm.recording import Camera, Model, Observations, Recording, Station, Target
from jaxvm.recording.model import grid_names
from jaxvm.solve.adjust import adjust

LOW, HIGH = -3.0, 7.0

all_bases = jax.jit(jax.vmap(evaluate_basis, in_axes=(0, None, None, None)))


def splines(x: np.ndarray) -> np.ndarray:
    """The bases of a free-form curve between LOW and HIGH, [knots, samples]."""
    numbers = jnp.array([BASIS_INDEX[name] for name in FORMS["curve"].bases])
    constants = jnp.array(curve_constants(LOW, HIGH))
    return np.asarray(all_bases(numbers, jnp.asarray(x), jnp.arange(len(x)), constants))


def test_splines_of_a_curve_sum_to_one_inside():
    rows = splines(np.linspace(LOW, HIGH, 301))
    assert rows.shape == (N_KNOTS["curve"], 301)
    assert (rows >= 0.0).all()
    np.testing.assert_allclose(rows.sum(axis=0), 1.0, rtol=1e-13)
    # Each of them is needed, and beyond the interval the sum falls.
    assert (rows.max(axis=1) > 0.1).all()
    assert (splines(np.array([LOW - 1.0, HIGH + 1.0])).sum(axis=0) < 0.99).all()


def test_a_curve_follows_any_cubic_exactly():
    x = np.linspace(LOW, HIGH, 200)
    rows = splines(x)
    for power in range(4):
        wanted = (x / 3.0) ** power
        weights = np.linalg.lstsq(rows.T, wanted, rcond=None)[0]
        assert np.abs(rows.T @ weights - wanted).max() < 1e-9
    fourth = (x / 3.0) ** 4
    weights = np.linalg.lstsq(rows.T, fourth, rcond=None)[0]
    assert np.abs(rows.T @ weights - fourth).max() > 1e-5


def sum_of_tiles(terms, x, y) -> np.ndarray:
    """Sum of the patterns of terms at places of their plane."""
    drivers = np.full((len(x), len(OBSERVATION_DRIVERS)), np.nan)
    first, second, _ = PLANES[terms[0].driver]
    drivers[:, OBSERVATION_DRIVER_INDEX[first]] = x
    drivers[:, OBSERVATION_DRIVER_INDEX[second]] = y
    own = (patterns([term], jnp.asarray(drivers))[:, 0] for term in terms)
    return np.sum([np.asarray(values) for values in own], axis=0)


def test_tiles_of_the_image_sum_to_one_inside():
    """The image reaches to (0.8, 0.6) half diagonals; the outermost tiles stand on its border."""
    along_u = [term for term in image_map() if term.port == "detect.u"]
    along_v = [term for term in image_map() if term.port == "detect.v"]
    rng = np.random.default_rng(0)
    inner = rng.uniform(-1.0, 1.0, (2, 50)) * [[0.4], [0.2]]
    whole = rng.uniform(-1.0, 1.0, (2, 200)) * [[0.8], [0.6]]
    for terms in (along_u, along_v):
        assert len(terms) == 20
        np.testing.assert_allclose(sum_of_tiles(terms, *inner), 1.0, rtol=1e-12)
        everywhere = sum_of_tiles(terms, *whole)
        # On an edge the tile beyond it, of height 1/6, is missing; at a corner two are.
        assert (everywhere > (5 / 6) ** 2 - 1e-12).all() and (everywhere < 1 + 1e-12).all()


def test_tiles_of_a_plate_sum_to_one_inside():
    rng = np.random.default_rng(1)
    terms = plate_map()
    assert {term.port for term in terms} == {"target.point_z"}
    np.testing.assert_allclose(
        sum_of_tiles(terms, *rng.uniform(-0.5, 0.5, (2, 50))), 1.0, rtol=1e-12
    )
    whole = sum_of_tiles(terms, *rng.uniform(-1.0, 1.0, (2, 200)))
    assert (whole > (5 / 6) ** 2 - 1e-12).all() and (whole < 1 + 1e-12).all()


@pytest.mark.parametrize("finer", [fine_image_map, finest_image_map, fine_plate_map])
def test_finer_maps_cover_all_of_their_plane(finer):
    reach = [[1.0], [1.0]] if finer is fine_plate_map else [[0.8], [0.6]]
    at = np.random.default_rng(2).uniform(-1.0, 1.0, (2, 200)) * reach
    for port in {term.port for term in finer()}:
        total = sum_of_tiles([term for term in finer() if term.port == port], *at)
        assert (total > (5 / 6) ** 2 - 1e-12).all() and (total < 1 + 1e-12).all()


def test_a_tile_is_nothing_where_its_plane_has_no_meaning():
    assert (sum_of_tiles(plate_map(), np.full(3, np.nan), np.zeros(3)) == 0.0).all()


N_EPOCHS = 40
MARKS = grid_points(4, 5, 0.2) - [0.4, 0.3, 0.0]


@pytest.fixture(scope="module")
def turning():
    """A camera that stands and turns as a chirp before a plate that stands.

    Nothing is free, so that what is left is the turn and the noise.
    """
    camera = Camera(
        "cam", "desk", IMAGE, "pinhole", np.full(2, 1000.0), np.array([639.5, 479.5]), None, HELD
    )
    place = np.array([0.1, -0.2, 0.05, 0.0, 0.0, 1.6])
    model = Model(
        "chirp",
        (camera,),
        (Station("desk", "static", HELD),),
        (Target("plate", grid_names(4, 5), MARKS, "static", place),),
    )
    time = 60.0 * np.arange(N_EPOCHS)
    epoch, point = np.divmod(np.arange(N_EPOCHS * len(MARKS)), len(MARKS))
    nothing = np.zeros(len(epoch), int)
    seen = Observations(
        epoch, nothing, nothing, point, np.zeros((len(epoch), 2)), np.full(len(epoch), 0.05)
    )
    recording = Recording(model, np.arange(N_EPOCHS), time, {}, seen)
    scene = build(recording)
    pixel = predicted(scene)
    share = time / time[-1]
    chirp = 1e-4 * np.sin(2.0 * np.pi * (0.6 * share + 1.6 * share**2)) * (0.5 + share)
    # A small turn about y moves marks by -f (1 + x^2) along u, and by -f x y along v.
    x, y = ((pixel - [639.5, 479.5]) / 1000.0).T
    pixel -= 1000.0 * chirp[epoch, None] * np.stack([1.0 + x**2, x * y], axis=1)
    pixel += 0.05 * np.random.default_rng(0).standard_normal(pixel.shape)
    scene = build(replace(recording, observations=replace(seen, pixel=pixel)))
    return scene, chirp, 2.0 * len(epoch)


def named(time: np.ndarray):
    """Courses of named forms, with constants all over their range."""
    steady = (time - time.mean()) / time[-1]
    yield from ([steady, steady**2], [np.tanh(np.gradient(steady))])
    for tau in np.geomspace(60.0, 3000.0, 20):
        yield [-np.expm1(-time / tau)]
        yield [np.log1p(time / tau)]
    for instant in time[1:-1]:
        yield [1.0 * (time >= instant)]
        yield [np.maximum(time - instant, 0.0)]
    for period in np.geomspace(300.0, 20_000.0, 60):
        yield [np.sin(2 * np.pi * time / period), np.cos(2 * np.pi * time / period)]


def test_a_free_form_curve_explains_a_turn_that_no_form_describes(turning):
    scene, chirp, n = turning
    ((name, constants),) = curved_drivers(scene)
    assert name == "time"
    time = scene.recording.time
    best = 0.0
    for bases in named(time):
        rows = np.stack(bases, axis=1)
        left = chirp - rows @ np.linalg.lstsq(rows, chirp, rcond=None)[0]
        best = max(best, 1.0 - float(left @ left / (chirp @ chirp)))
    assert best < 0.6
    effect = Effect(
        "turns", (Term("mount.turn_y"),), "time", "curve", constants, 0.0, Scope(camera=("cam",))
    )
    fitted = adjust(scene.with_effects((effect,)), check=False)
    assert fitted.converged, fitted.why
    before, after = 2.0 * fitted.cost_before, 2.0 * fitted.cost
    assert (before - after) / (before - n) > 0.9
    assert fitted.variance_factor == pytest.approx(1.0, abs=0.25)
    weights = np.asarray(fitted.scene.state.amplitude)[: N_KNOTS["curve"]]
    numbers = jnp.array([BASIS_INDEX[name] for name in FORMS["curve"].bases])
    rows = np.asarray(all_bases(numbers, jnp.asarray(time), time, jnp.array(constants)))
    assert np.corrcoef(weights @ rows, chirp)[0, 1] > 0.95


def test_few_epochs_carry_no_curve(turning):
    scene, _, _ = turning
    mask = np.arange(N_EPOCHS) < 2 * N_KNOTS["curve"] - 1
    assert curved_drivers(build(scene.recording.select_epochs(mask))) == []
