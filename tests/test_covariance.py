"""Covariances against the dense inverse and against a thousand repetitions of the noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import adjusted, at_values, board_recording, free_points_recording
from scipy.stats import chi2

from jaxvm.physics.effects import Effect, Term
from jaxvm.solve.adjust import adjust
from jaxvm.solve.arrow import factorise
from jaxvm.solve.covariance import covariance, standard_deviations, wald_drops

REPEATS = 1000


def derived(state):
    """A distance, a baseline, a focal length and how far its camera stands: what one reports."""
    between = state.point[9] - state.point[14]
    base = state.world_from_station[0, 3:] - state.world_from_station[2, 3:]
    return jnp.stack(
        [
            jnp.sqrt(between @ between),
            jnp.sqrt(base @ base),
            state.focal[1, 0],
            jnp.sqrt(state.world_from_station[1, 3:] @ state.world_from_station[1, 3:]),
        ]
    )


@pytest.fixture(scope="module")
def exact():
    """The network of free points without noise, adjusted."""
    known = free_points_recording(noise=0.0)
    return known, adjust(known.true_scene())


@eqx.filter_jit
def repeated(problem, noise):
    """States and derived quantities of adjustments with different noise on the pixels (px)."""

    def where(p):
        return p.network.pixels[0].circumstances.pixel

    def once(error):
        noisy = eqx.tree_at(where, problem, where(problem) + error)
        x = jnp.zeros(problem.n)
        normal = noisy.normal(x)
        x = x - factorise(normal.hessian).solve(normal.gradient)
        # The second step corrects for curvature; the matrix has hardly changed.
        x = x - factorise(normal.hessian).solve(noisy.normal(x).gradient)
        state = noisy.state(x)
        return state.flatten(), derived(state)

    return jax.lax.map(once, noise, batch_size=100)


@pytest.fixture(scope="module")
def sample(exact):
    """A thousand results."""
    _, result = exact
    problem = result.problem
    factor = problem.network.pixels[0]
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((REPEATS, *factor.sigma.shape)) * np.asarray(factor.sigma)
    return tuple(map(np.asarray, repeated(problem, jnp.asarray(noise))))


def test_noise_free_network_ends_at_the_truth(exact):
    known, result = exact
    assert result.cost < 1e-12
    points = known.truth["point"]
    assert np.allclose(result.scene.state.point[: len(points)], points, atol=1e-10)


def test_standard_deviations_are_those_of_repetitions(exact, sample):
    known, result = exact
    sd = np.asarray(standard_deviations(result).flatten())
    truth = np.asarray(known.true_scene().state.flatten())
    free = sd > 0
    assert free.sum() == np.sum(result.scene.unknowns.column < result.scene.unknowns.n)
    spread = sample[0][:, free].std(axis=0, ddof=1)
    assert np.abs(spread / sd[free] - 1.0).max() < 4.5 / np.sqrt(2 * REPEATS)
    bias = (sample[0].mean(axis=0) - truth)[free] / sd[free]
    assert np.abs(bias).max() < 4.5 / np.sqrt(REPEATS)
    assert np.array_equal(sample[0][:, ~free], np.tile(truth[~free], (REPEATS, 1)))


def test_derived_quantities_have_the_covariance_of_repetitions(exact, sample):
    _, result = exact
    c = np.asarray(covariance(result, derived))
    s = np.cov(sample[1].T)
    half = np.linalg.inv(np.linalg.cholesky(c))
    spectrum = np.linalg.eigvalsh(half @ s @ half.T)
    # Edges of the Marchenko-Pastur law for four quantities, with some air.
    edge = np.sqrt(len(c) / REPEATS)
    assert (1 - edge) ** 2 - 0.08 < spectrum.min() and spectrum.max() < (1 + edge) ** 2 + 0.08
    # Correlated quantities: a diagonal matrix would not do.
    correlation = c / np.sqrt(np.outer(np.diag(c), np.diag(c)))
    assert np.abs(correlation - np.eye(4)).max() > 0.2


def test_many_points_together(exact, sample):
    """Squared Mahalanobis distances of five points are chi-square with 15 degrees of freedom."""
    known, result = exact
    layout = result.problem.network.layout
    slots = layout.slots("point", np.arange(8, 13)).ravel()
    c = np.asarray(covariance(result, lambda state: state.point[8:13]))
    error = sample[0][:, slots] - known.truth["point"][8:13].ravel()
    distance = np.einsum("ni,ij,nj->n", error, np.linalg.inv(c), error)
    assert abs(distance.mean() - 15.0) < 4.5 * np.sqrt(2 * 15.0 / REPEATS)
    inside = np.mean(distance < chi2.ppf(0.95, 15))
    assert abs(inside - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / REPEATS)


def test_scale_multiplies(exact):
    _, result = exact
    plain, scaled = (np.asarray(covariance(result, derived, scale=s)) for s in (1.0, 4.0))
    assert np.allclose(scaled, 4.0 * plain, rtol=1e-14)
    one, two = (standard_deviations(result, scale=s).flatten() for s in (1.0, 4.0))
    assert np.allclose(two, 2.0 * np.asarray(one), rtol=1e-14)


@pytest.mark.parametrize("name", ["board", "points"])
def test_marginals_are_the_diagonal_of_the_dense_inverse(name):
    _, result = adjusted(name)
    problem = result.problem
    normal = eqx.filter_jit(type(problem).normal)(problem, result.x)
    hessian = np.asarray(normal.hessian.as_matrix())
    inverse = np.append(np.diag(np.linalg.inv(hessian)), 0.0)
    expected = np.asarray(problem.factor) * np.sqrt(inverse[np.asarray(problem.column)])
    got = np.asarray(standard_deviations(result).flatten())
    assert np.allclose(got, expected, rtol=1e-6)


def test_wald_drop_is_the_rise_of_a_refit():
    """Amplitudes of three effects that the data do contain, and one that they don't."""
    known = board_recording(free=frozenset({"focal", "centre"}))
    ports = ("lens.k1", "lens.p1", "lens.p2", "sensor.skew")
    effects = tuple(Effect(port, (Term(port),)) for port in ports)
    held = known.truth["distortion"].copy()
    held[0, :4] -= [4e-3, 0.0, 1e-3, -1e-3]
    scene = at_values(known.true_scene().with_effects(effects), {"distortion": held})
    result = adjust(scene)
    groups = [np.array(g) for g in ([0], [1], [2], [3], [1, 2], [0, 1, 2, 3])]
    drops = wald_drops(result, groups)
    columns = scene.unknowns.column[scene.network.layout.all("amplitude")]
    for group, drop in zip(groups, drops, strict=True):
        active = ~np.isin(np.arange(scene.unknowns.n), columns[group])
        refit = adjust(scene, active=active)
        assert (np.asarray(refit.scene.state.amplitude)[group] == 0.0).all()
        rise = 2.0 * (refit.cost - result.cost)
        assert drop == pytest.approx(rise, rel=0.05)
    assert min(drops[:3]) > 10 > drops[3]
    assert drops[5] > drops[4] > max(drops[1:3])
