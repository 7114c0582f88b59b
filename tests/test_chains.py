"""Pose-relay chains, relay stations and double chains against closed forms and Monte Carlo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from jaxvm.geometry import pose_from_vector, vector_from_pose
from jaxvm.pose.chains import (
    Link,
    along,
    compose,
    drawn,
    growth,
    mark_covariance,
    simulate,
    straight_growth,
)
from jaxvm.pose.double_chain import DoubleChain, far_covariance, far_errors, far_growth
from jaxvm.pose.relay import adjust_relay, all_pairs, pair_variance, precision_gain

TRIALS = 2000
STRAIGHT = dict(length=10.0, sigma_turn=20e-6, sigma_shift=0.2e-3)


def isotropic(sigma_turn, sigma_shift):
    """Covariance with the same standard deviation about and along every axis."""
    return np.diag([sigma_turn**2] * 3 + [sigma_shift**2] * 3)


def equal_links(n, shift, covariance):
    """The same link n times, without a turn."""
    pose = np.tile([0.0, 0.0, 0.0, *shift], (n, 1))
    return Link(jnp.asarray(pose), jnp.broadcast_to(jnp.asarray(covariance), (n, 6, 6)))


def straight(n):
    """The chain of the closed form."""
    return equal_links(
        n, (10.0, 0.0, 0.0), isotropic(STRAIGHT["sigma_turn"], STRAIGHT["sigma_shift"])
    )


def crooked(n, seed=0, sigma=1e-5):
    """Links of any direction with full covariances that couple turns and shifts."""
    rng = np.random.default_rng(seed)
    pose = np.hstack([rng.normal(0, 1, (n, 3)), rng.normal(0, 3, (n, 3))])
    root = sigma * rng.normal(size=(n, 6, 6)) * np.repeat([1.0, 10.0], 3)[:, None]
    return Link(jnp.asarray(pose), jnp.asarray(root @ root.transpose(0, 2, 1)))


def inside(squares, degrees, count):
    """Whether a mean of normalised squares lies within the central 99.8 % of its distribution."""
    low, high = chi2.ppf([0.001, 0.999], degrees * count) / count
    return low < np.mean(squares) < high


def normalised(errors, covariance):
    """e^T C^-1 e of many errors."""
    return np.einsum("ti,ti->t", errors, np.linalg.solve(covariance, errors.T).T)


@pytest.mark.parametrize("n, micro, milli", [(10, 63.2, 3.44), (20, 89.4, 9.98)])
def test_a_straight_chain_grows_as_in_closed_form(n, micro, milli):
    turn, lateral, axial = straight_growth(n, **STRAIGHT)
    assert round(float(turn) * 1e6, 1) == micro
    assert round(float(lateral) * 1e3, 2) == milli
    got = growth(straight(n))
    np.testing.assert_allclose(got.turn[-1], turn, rtol=1e-12)
    np.testing.assert_allclose(got.lateral[-1], lateral, rtol=1e-12)
    np.testing.assert_allclose(got.axial[-1], axial, rtol=1e-12)
    # Station by station: the closed form of every shorter chain.
    for k in (1, n // 2):
        np.testing.assert_allclose(
            [got.turn[k - 1, 0], got.lateral[k - 1], got.axial[k - 1]],
            straight_growth(k, **STRAIGHT),
            rtol=1e-12,
        )


def test_composition_is_that_of_matrices_and_its_covariance_the_finite_differences():
    """The end as a product of 4x4 matrices; its twist by the twist of every link, numerically."""
    links = crooked(4)

    def matrix(vector):
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = Rotation.from_rotvec(vector[:3]).as_matrix(), vector[3:]
        return out

    def end(twists):
        out = np.eye(4)
        for vector, (x, y, z, *rho) in zip(np.array(links.pose), twists, strict=True):
            small = np.array([[0, -z, y, rho[0]], [z, 0, -x, rho[1]], [-y, x, 0, rho[2]], [0] * 4])
            out = out @ matrix(vector) @ expm(small)
        return out

    nominal, h = end(np.zeros((4, 6))), 1e-6
    slope = np.zeros((6, 4, 6))
    for i, j in np.ndindex(4, 6):
        twists = np.zeros((4, 6))
        twists[i, j] = h
        moved = (np.linalg.inv(nominal) @ (end(twists) - end(-twists))) / (2 * h)
        slope[:, i, j] = [moved[2, 1], moved[0, 2], moved[1, 0], *moved[:3, 3]]
    got = compose(links)
    np.testing.assert_allclose(matrix(np.array(got.pose)), nominal, atol=1e-12)
    expected = np.einsum("aij,ijk,bik->ab", slope, links.covariance, slope)
    np.testing.assert_allclose(got.covariance, expected, rtol=1e-7, atol=1e-8 * expected.max())


def test_there_and_back_is_the_same_link():
    link = jax.tree.map(lambda x: x[0], crooked(1))
    twice = link.back().back()
    np.testing.assert_allclose(twice.pose, link.pose, atol=1e-13)
    np.testing.assert_allclose(twice.covariance, link.covariance, rtol=1e-9, atol=1e-20)
    # The way back of a chain is the chain of the ways back.
    chain = crooked(5, seed=1)
    backwards = jax.tree.map(lambda x: x[::-1], jax.vmap(Link.back)(chain))
    np.testing.assert_allclose(compose(backwards).pose, compose(chain).back().pose, atol=1e-12)
    np.testing.assert_allclose(
        compose(backwards).covariance, compose(chain).back().covariance, rtol=1e-9, atol=1e-18
    )


def test_drawn_chains_scatter_as_predicted():
    """Closed form within the error bars, and the whole covariance of the end by chi-square."""
    links = straight(10)
    trials = simulate(links, jax.random.key(1), TRIALS)
    predicted = growth(links)
    for name in ("turn", "shift", "axial", "lateral"):
        off = (getattr(trials.measured, name) - getattr(predicted, name)) / getattr(
            trials.bars, name
        )
        assert np.abs(off).max() < 4.5, name
    # The bars themselves: of a Gaussian component sd / sqrt(2 trials).
    expected = predicted.turn / np.sqrt(2 * TRIALS)
    np.testing.assert_allclose(trials.bars.turn, expected, rtol=0.15)
    links = crooked(10, seed=2)
    errors = np.asarray(simulate(links, jax.random.key(2), TRIALS).error)
    covariance = np.asarray(jax.vmap(Link.in_first_axes)(along(links)))
    for k in range(10):
        assert inside(normalised(errors[:, k], covariance[k]), 6, TRIALS)


def test_chains_are_vmapped():
    """Three chains at once are those one by one."""
    chains = [crooked(5, seed) for seed in range(3)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *chains)
    together = jax.vmap(growth)(stacked)
    for i, chain in enumerate(chains):
        np.testing.assert_allclose(together.lateral[i], growth(chain).lateral, rtol=1e-12)


def test_a_mark_seen_from_the_front_is_bad_in_depth_and_tilt():
    sight = np.array([1.0, 2.0, 2.0]) / 3
    covariance = mark_covariance(jnp.asarray(sight), 1e-5, 4e-4, 4e-5, 3e-3)
    across = np.cross(sight, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    none = np.zeros(3)
    for vector, sigma in (
        (np.append(sight, none), 4e-5),
        (np.append(across, none), 3e-3),
        (np.append(none, sight), 4e-4),
        (np.append(none, across), 1e-5),
    ):
        np.testing.assert_allclose(np.sqrt(vector @ covariance @ vector), sigma, rtol=1e-12)


# Relay stations


def station(m, seed=0, shift=0.0, covariance=None):
    """True poses of all pairs of m cameras of any orientation."""
    rng = np.random.default_rng(seed)
    own = np.hstack([rng.normal(0, 1, (m, 3)), rng.normal(0, max(shift, 1e-300), (m, 3))])
    poses = [pose_from_vector(jnp.asarray(v)) for v in own]
    pairs = all_pairs(m)
    true = jnp.stack([vector_from_pose(poses[a].inverse() @ poses[b]) for a, b in pairs])
    covariance = isotropic(1e-4, 1e-4) if covariance is None else covariance
    return pairs, Link(true, jnp.broadcast_to(jnp.asarray(covariance), (len(pairs), 6, 6)))


@pytest.mark.parametrize("m", [3, 4, 6, 8])
def test_a_station_gains_the_root_of_half_its_cameras(m):
    pairs, links = station(m)
    relay = adjust_relay(pairs, links)
    adjusted = relay.links(pairs)
    expected = np.tile(pair_variance(m) * np.asarray(links.covariance[0]), (len(pairs), 1, 1))
    np.testing.assert_allclose(adjusted.covariance, expected, atol=1e-12 * 1e-8)
    np.testing.assert_allclose(precision_gain(pairs, links, relay), np.sqrt(m / 2), rtol=1e-12)


def test_calibrations_of_a_station_fulfil_every_loop_and_scatter_as_predicted():
    """A thousand calibrations of four cameras with coupled errors: corrections, poses, squares."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(6, 6)) * np.repeat([1e-4, 3e-4], 3)[:, None]
    pairs, links = station(4, shift=0.5, covariance=root @ root.T)
    keys = jax.random.split(jax.random.key(3), TRIALS)
    measured = jax.vmap(lambda key: drawn(links, key))(keys)
    relay = jax.jit(jax.vmap(lambda links: adjust_relay(pairs, links)))(measured)
    assert int(relay.steps.max()) < 10 and float(relay.last.max()) < 1e-5

    assert inside(np.asarray(relay.squares), 6 * (6 - 4 + 1), TRIALS)
    exact = adjust_relay(pairs, links)

    def twists(relay):
        """log(adjusted^-1 . true) of the other cameras: to first order -(turn, R^T shift)."""
        own = jax.vmap(pose_from_vector)(relay.first_from_body)
        true = jax.vmap(pose_from_vector)(exact.first_from_body)
        turn = jnp.einsum("nij,nik->njk", own.rotation, true.rotation)
        skew = 0.5 * (turn - turn.transpose(0, 2, 1))
        rotation = jnp.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
        shift = jnp.einsum("nij,ni->nj", own.rotation, true.shift - own.shift)
        return jnp.concatenate([rotation, shift], axis=1)[1:].ravel()

    errors = np.asarray(jax.vmap(twists)(relay))
    joint = np.asarray(exact.covariance).reshape(24, 24)[6:, 6:]
    assert inside(normalised(errors, joint), 18, TRIALS)
    # Around a loop the adjusted poses multiply to the identity.
    one = jax.tree.map(lambda x: x[0], relay)
    loop = [pose_from_vector(one.between(a, b).pose) for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))]
    product = loop[0] @ loop[1] @ loop[2] @ loop[3]
    np.testing.assert_allclose(product.rotation, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(product.shift, np.zeros(3), atol=1e-14)


def test_links_may_differ_by_many_orders_of_magnitude():
    """A ladder whose rungs are 1e6 times better than its rails: two bodies of a rung are one."""
    n, sigma, better = 8, 1e-3, 1e-6
    rails = [(k + r, k + r + 2) for k in range(0, 2 * n - 2, 2) for r in (0, 1)]
    rungs = [(k, k + 1) for k in range(0, 2 * n, 2)]
    pairs = np.array(rails + rungs)
    size = np.where(np.arange(len(pairs)) < len(rails), sigma, sigma * better)
    pose = np.zeros((len(pairs), 6))
    links = Link(jnp.asarray(pose), jnp.asarray(size[:, None, None] ** 2 * np.eye(6)))
    relay = adjust_relay(pairs, links)
    spread = np.asarray(relay.between(0, 2 * n - 2).covariance)
    # Without levers: n - 1 pairs of rails side by side, sigma^2 / 2 each.
    np.testing.assert_allclose(spread, 0.5 * (n - 1) * sigma**2 * np.eye(6), rtol=1e-5, atol=1e-12)
    assert float(relay.last) < 1e-6


def test_what_no_link_joins_is_named():
    pairs, links = station(3)
    with pytest.raises(ValueError, match="no link joins right, rear to front"):
        adjust_relay(pairs[2:], jax.tree.map(lambda x: x[2:], links), ("front", "right", "rear"))
    with pytest.raises(ValueError, match="link 1 joins right with itself"):
        adjust_relay(np.array([[0, 1], [1, 1]]), links, ("front", "right"))


# Double chains

RUNG = isotropic(10e-6, 5e-6)


def double(k, length, out, home=None, rung=None, apart=0.3):
    """Straight chains out and home, side by side; covariances of one link of each."""
    return DoubleChain(
        equal_links(k, (length, 0.0, 0.0), out),
        equal_links(k, (-length, 0.0, 0.0), out if home is None else home),
        equal_links(k + 1, (0.0, apart, 0.0), rung),
    )


def plates():
    """Tilted plates of 0.5 m at 10 m, f = 5000 px, 0.05 px (MATHEMATICS 1.6)."""
    return mark_covariance(jnp.array([1.0, 0.0, 0.0]), 1e-5, 0.63e-3, 63e-6, 0.17e-3)


def test_without_levers_double_chains_are_resistors():
    """Ladder with rungs of a quarter: k, k/2 + 1/8, parallel resistors, k/2 + 0.11."""
    k, unit = 10, 1e-12
    chain = double(k, 0.0, unit * np.eye(6), rung=unit / 4 * np.eye(6), apart=0.0)
    got = far_covariance(chain)
    parallel = k * (k + 0.5) / (2 * k + 0.5)
    laplacian = np.zeros((2 * k + 2, 2 * k + 2))
    for (a, b), conductance in zip(chain.pairs(), [1.0] * (2 * k) + [4.0] * (k + 1), strict=True):
        e = np.zeros(2 * k + 2)
        e[a], e[b] = 1.0, -1.0
        laplacian += conductance * np.outer(e, e)
    inverse = np.linalg.pinv(laplacian)
    ladder = inverse[0, 0] + inverse[k, k] - 2 * inverse[0, k]
    for name, variance in (
        ("single", k),
        ("naive", k / 2 + 0.125),
        ("classic", parallel),
        ("weighted", parallel),
        ("adjusted", ladder),
    ):
        expected = variance * unit * np.eye(6)
        np.testing.assert_allclose(getattr(got, name), expected, atol=1e-9 * unit * k)
    # Anti-symmetric currents see half ladders: Z^2 + Z = r/2 with r = 1/4.
    assert ladder == pytest.approx(k / 2 + (np.sqrt(1.5) - 1) / 2, abs=1e-4)


def test_the_gain_of_the_adjustment_comes_from_errors_at_opposite_ends():
    """Same plates, same precision: home links that err at their other end make all the gain."""
    opposite = double(10, 10.0, plates(), rung=RUNG)
    got = far_growth(opposite)
    # The mean with full covariances has little over that with equal weights,
    assert 1.0 < got.naive.lateral / got.weighted.lateral < 1.05
    # the adjustment an order of magnitude: tilts of plates are replaced by reciprocal pointing,
    assert got.weighted.lateral / got.adjusted.lateral > 12
    # so that the turn grows with the rungs, which carry it from body to body.
    pointing = np.hypot(10e-6, np.sqrt(2) * 1e-5 / 10.0)
    assert got.adjusted.turn[2] == pytest.approx(np.sqrt(10) * pointing, rel=0.05)
    # Depth and roll have no lever and no gain.
    assert got.weighted.axial / got.adjusted.axial == pytest.approx(1.0, abs=0.01)
    assert got.weighted.turn[0] / got.adjusted.turn[0] == pytest.approx(1.0, abs=0.01)

    # Where both err at the far station nothing is left of the gain.
    same = DoubleChain(opposite.out, jax.vmap(Link.back)(opposite.out), opposite.rungs)
    alike = far_growth(same)
    assert alike.weighted.lateral / alike.adjusted.lateral < 1.02

    # Nor without lever arms, whatever the anisotropy.
    short = double(10, 0.0, plates(), rung=RUNG, apart=0.0)
    covariance = far_covariance(short)
    fallen = np.sqrt(np.diagonal(covariance.weighted) / np.diagonal(covariance.adjusted))
    assert fallen.max() < 1.01


def test_means_of_unlike_chains_need_their_weights():
    """Home links three times worse: equal weights spoil the better chain."""
    iso = isotropic(20e-6, 0.2e-3)
    chain = double(10, 10.0, iso, 9 * iso, isotropic(10e-6, 0.1e-3))
    got = far_growth(chain)
    assert got.naive.lateral > 1.7 * got.single.lateral
    order = [getattr(got, name).lateral for name in ("adjusted", "weighted", "classic", "single")]
    assert order == sorted(order)


def test_no_estimate_beats_the_weighted_mean_but_the_adjustment():
    """Covariances are ordered in every direction: adjusted <= weighted <= any mean (crooked)."""
    chain = crooked_double()
    got = far_covariance(chain)
    for better, worse in (
        ("adjusted", "weighted"),
        ("weighted", "classic"),
        ("weighted", "naive"),
        ("weighted", "single"),
    ):
        scale = 1 / np.sqrt(np.diagonal(getattr(got, worse)))
        rest = (getattr(got, worse) - getattr(got, better)) * scale[:, None] * scale
        assert np.linalg.eigvalsh(rest).min() > -1e-9


def crooked_double():
    """A chain around corners whose far body both ways lead to exactly."""
    out, rungs = crooked(5, seed=5), crooked(6, seed=6, sigma=3e-6)
    spread = crooked(5, seed=7).covariance

    def home(out, near, far):
        """(i+1)_from_i of the chain home: over the rung, back along the link, over the rung."""
        return near.back().then(out).then(far).back().pose

    pose = jax.vmap(home)(
        out, jax.tree.map(lambda x: x[:-1], rungs), jax.tree.map(lambda x: x[1:], rungs)
    )
    return DoubleChain(out, Link(pose, spread), rungs)


@pytest.mark.parametrize("chain", [crooked_double, lambda: double(5, 10.0, plates(), None, RUNG)])
def test_drawn_double_chains_scatter_as_predicted(chain):
    """Every estimate, made of drawn links without linearising, has its predicted covariance."""
    chain = chain()
    errors = far_errors(chain, jax.random.key(8), 1000, chain)
    predicted = far_covariance(chain)
    for name, own in zip(errors._fields, errors, strict=True):
        squares = normalised(np.asarray(own), np.asarray(getattr(predicted, name)))
        assert inside(squares, 6, 1000), name


def test_an_adjustment_that_believes_wrong_covariances_loses_its_gain():
    """Weights of isotropic errors for planar marks: the adjustment is far from its best."""
    chain = double(5, 10.0, plates(), None, RUNG)
    wrong = isotropic(63e-6, 0.63e-3)
    believed = double(5, 10.0, wrong, None, RUNG)
    right = far_growth(chain).adjusted.lateral
    errors = far_errors(chain, jax.random.key(9), 1000, believed)
    lateral = np.sqrt(np.mean(np.asarray(errors.adjusted)[:, 4:] ** 2))
    assert lateral > 3 * right
