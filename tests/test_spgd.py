"""Stochastic parallel gradient descent against its theory; it and L-BFGS by Gauss-Newton."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from networks import nudged, scale_recording
from scipy.optimize import lsq_linear

from jaxvm.compiling import compile_seconds
from jaxvm.solve.adjust import adjust
from jaxvm.solve.lbfgs import minimise_lbfgs
from jaxvm.solve.spgd import SPGD, ConstantGain, SpallGain, TraceGain, minimise_spgd


def misfit(u, args):
    """Half the sum of squares of A u - b."""
    a, b = args
    return 0.5 * jnp.sum((a @ u - b) ** 2)


def descend(solver, u, args, fn=misfit):
    return optx.minimise(fn, solver, jnp.asarray(u), args, max_steps=None, throw=False)


def steps(found) -> int:
    return int(found.stats["evaluations"]) // 2


def random_system(n, seed=0):
    """A least-squares problem in n unknowns, scaled to a unit diagonal, and its least cost."""
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((3 * n, n)) + 0.5 * rng.standard_normal((3 * n, 1))
    a /= np.linalg.norm(a, axis=0)
    b = rng.standard_normal(3 * n)
    return a, b, 0.5 * np.linalg.lstsq(a, b)[1][0]


@pytest.mark.parametrize("share", [0.1, 1.0, 2.5])
def test_mean_change_of_a_step(share):
    """E[dJ] = -eta |g|^2 + eta^2/2 (tr H |g|^2 + 2 g'Hg - 2 sum H_ii g_i^2)."""
    n = 6
    a, b, _ = random_system(n)
    a *= np.linspace(0.5, 2.0, n)
    h, u = a.T @ a, np.linspace(-3.0, 4.0, n)
    g = h @ u - a.T @ b
    eta = share / np.trace(h)

    def change(key):
        solver = SPGD(key, ConstantGain(eta))
        shape = jax.ShapeDtypeStruct((), float)
        args, tags = (jnp.asarray(a), jnp.asarray(b)), frozenset()
        state = solver.init(misfit, jnp.asarray(u), args, {}, shape, None, tags)
        moved, _, _ = solver.step(
            lambda y, args: (misfit(y, args), None), jnp.asarray(u), args, {}, state, tags
        )
        return misfit(moved, args) - misfit(jnp.asarray(u), args)

    changes = np.asarray(jax.vmap(change)(jax.random.split(jax.random.key(0), 20_000)))
    bent = np.trace(h) * g @ g + 2 * g @ h @ g - 2 * np.sum(np.diag(h) * g**2)
    expected = -eta * g @ g + 0.5 * eta**2 * bent
    error = changes.std() / np.sqrt(len(changes))
    assert error < 0.03 * eta * g @ g
    assert abs(changes.mean() - expected) < 4 * error


def network(kind, n, seed):
    """Scalar unknowns at the nodes of a ring or a grid, measured differences, node 0 held.

    Returns:
        Scaled design matrix, measurements, start by dead reckoning along a depth-first tree.
    """
    if kind == "ring":
        edges = [(i, (i + 1) % n) for i in range(n)]
    else:
        side = round(n**0.5)
        place = np.arange(n).reshape(side, side)
        across = zip(place[:, :-1].ravel(), place[:, 1:].ravel(), strict=True)
        edges = [*across, *zip(place[:-1].ravel(), place[1:].ravel(), strict=True)]
    measured = np.random.default_rng(seed).standard_normal(len(edges))
    a = np.zeros((len(edges), n))
    for row, (i, j) in enumerate(edges):
        a[row, [i, j]] = -1.0, 1.0
    reckoned, todo = {0: 0.0}, [0]
    while todo:
        node = todo[-1]
        ways = [(k, *np.flatnonzero((a[k] != 0) & (np.arange(n) != node))) for k in
                np.flatnonzero(a[:, node])]  # fmt: skip
        ahead = [(k, other) for k, other in ways if other not in reckoned]
        if not ahead:
            todo.pop()
            continue
        k, other = ahead[0]
        reckoned[other] = reckoned[node] + a[k, other] * measured[k]
        todo.append(other)
    a = a[:, 1:]
    size = np.linalg.norm(a, axis=0)
    return a / size, measured, size * np.array([reckoned[i] for i in range(1, n)])


@pytest.mark.parametrize(
    "kind, n, published",
    [("ring", 9, 330), ("ring", 16, 1_900), ("ring", 36, 24_290), ("grid", 16, 850),
     ("grid", 36, 5_180)],
)  # fmt: skip
def test_steps_to_the_optimum_of_a_network(kind, n, published):
    """Numbers of MATHEMATICS 1.7: ring 3rd power of its size, grid 2.7th."""
    found = []
    for seed in range(5):
        a, b, start = network(kind, n, seed)
        least = misfit(np.linalg.lstsq(a, b)[0], (a, b))
        solver = SPGD(jax.random.key(seed), target_cost=1.01 * least, rtol=0.0)
        result = descend(solver, start, (jnp.asarray(a), jnp.asarray(b)))
        assert misfit(result.value, (a, b)) <= 1.01 * least
        found.append(steps(result))
    assert 0.5 < np.median(found) / published < 2.0


def test_first_part_of_the_way_is_short():
    """From a random start to 1 % of its cost takes about 6 steps for each node of a ring."""
    n, found = 64, []
    for seed in range(3):
        a, _, _ = network("ring", n, seed)
        start = 1e3 * np.random.default_rng(seed).standard_normal(n - 1)
        solver = SPGD(jax.random.key(seed), target_share=0.01)
        result = descend(solver, start, (jnp.asarray(a), jnp.zeros(n)))
        found.append(steps(result))
    assert 3 * n < np.median(found) < 12 * n


def test_on_the_misclosure_of_a_loop_alone_it_wanders():
    """Excess |xi - xi_LS|^2 / |xi_LS|^2 is eta/2 (n-1)(n-2), unless corrections cost something."""
    n, w = 8, 3.0
    eta = 1.0 / (20.0 * n)
    loop = jnp.ones((1, n)), jnp.array([w])
    held = jnp.concatenate([jnp.ones((1, n)), 0.3 * jnp.eye(n)]), jnp.array([w, *n * [0.0]])

    def excess(args, solver):
        a, b = args
        least = jnp.linalg.lstsq(a, b)[0]
        xi = descend(solver, jnp.zeros(n), args).value
        return jnp.sum((xi - least) ** 2) / jnp.sum(least**2)

    def alone(key):
        return excess(loop, SPGD(key, ConstantGain(eta), target_cost=1e-9, rtol=0.0))

    def with_fidelity(key):
        solver = SPGD(key, ConstantGain(eta), rtol=0.0, max_evaluations=40_000)
        return excess(held, solver)

    keys = jax.random.split(jax.random.key(1), 1024)
    found = np.asarray(jax.jit(jax.vmap(alone))(keys))
    error = found.std() / np.sqrt(len(found))
    expected = 0.5 * eta * (n - 1) * (n - 2)
    # The formula is the first order in eta.
    assert abs(found.mean() - expected) < 4 * error + 0.15 * expected
    assert np.asarray(jax.jit(jax.vmap(with_fidelity))(keys[:8])).max() < 1e-6


@pytest.mark.parametrize("wrong", [1e-6, 1e-2, 1.0, 1e2, 1e4])
def test_gain_mends_itself(wrong):
    """Whatever the first gain, the steps taken are within a factor of the ones of a right one."""
    n = 20
    a, b, least = random_system(n)
    args, start = (jnp.asarray(a), jnp.asarray(b)), 1e3 * np.ones(n)
    options = dict(target_cost=1.01 * least, rtol=0.0, max_evaluations=200_000)
    right = steps(descend(SPGD(jax.random.key(0), **options), start, args))
    solver = SPGD(jax.random.key(0), trace=wrong * n, **options)
    found = descend(solver, start, args)
    assert misfit(found.value, args) <= 1.01 * least
    assert steps(found) < 2 * right + 1000
    # The mean of s'Hs weighted by slope^2 is tr H and a little more.
    assert 0.5 < 1.0 / float(found.stats["gain"]) / n < 2.0
    if wrong == 1e-2:
        # Gain 100 / tr H by the rule of 1997 diverges, and the start remains the best point.
        lost = descend(SPGD(jax.random.key(0), ConstantGain(100.0 / n), **options), start, args)
        assert np.array_equal(lost.value, start)


def test_gain_adapts_where_the_cost_is_not_quadratic():
    """Far out a robust loss hardly bends: at the gain of the bottom it takes for ever."""
    n = 10
    a, b, _ = random_system(n)

    def robust(u, args):
        return jnp.sum(jnp.sqrt(1.0 + (args[0] @ u - args[1]) ** 2) - 1.0)

    args, start = (jnp.asarray(a), jnp.asarray(b)), 1e5 * np.ones(n)
    bottom = descend(SPGD(jax.random.key(1), rtol=1e-9), np.zeros(n), args, robust).stats["cost"]
    options = dict(target_cost=1.01 * bottom, rtol=0.0, max_evaluations=20_000)
    adapted = descend(SPGD(jax.random.key(0), **options), start, args, robust)
    fixed = SPGD(jax.random.key(0), ConstantGain(1.0 / n), **options)
    assert robust(adapted.value, args) <= 1.01 * bottom
    assert robust(descend(fixed, start, args, robust).value, args) > 2.0 * bottom


@pytest.mark.parametrize("gain, momentum", [(TraceGain(), 0.9), (SpallGain(), 0.0)])
def test_options_arrive_too(gain, momentum):
    n = 20
    a, b, least = random_system(n)
    args, start = (jnp.asarray(a), jnp.asarray(b)), np.full(n, 30.0)
    options = dict(target_cost=1.01 * least, rtol=0.0, max_evaluations=100_000)
    plain = steps(descend(SPGD(jax.random.key(0), **options), start, args))
    found = descend(SPGD(jax.random.key(0), gain, momentum, **options), start, args)
    assert misfit(found.value, args) <= 1.01 * least
    assert steps(found) < 5 * plain


def test_unknowns_of_any_structure():
    """PyTrees, and auxiliary values, which are those of the solution."""

    def fn(y, args):
        cost = jnp.sum((y["a"] - 1.0) ** 2) + (y["b"] + 2.0) ** 2
        return 0.5 * cost, y["b"]

    solver = SPGD(jax.random.key(0), target_cost=1e-8)
    start = {"a": jnp.zeros((2, 2)), "b": jnp.zeros(())}
    found = optx.minimise(fn, solver, start, has_aux=True, max_steps=None)
    assert np.abs(found.value["a"] - 1.0).max() < 2e-4
    assert float(found.aux) == float(found.value["b"]) == pytest.approx(-2.0, abs=2e-4)
    with pytest.raises(eqx.EquinoxRuntimeError, match="maximum number of steps"):
        optx.minimise(fn, SPGD(jax.random.key(0), max_evaluations=20), start, has_aux=True)


@cache
def small_scene(seed=0):
    """Two cameras and twelve free points, off the truth, by Gauss-Newton."""
    known = scale_recording(seed)
    return adjust(nudged(known, known.true_scene(), 1e-4))


def test_spgd_comes_to_the_solution_of_a_scene():
    known = small_scene()
    found = minimise_spgd(known.problem, jax.random.key(0), max_evaluations=40_000, rtol=1e-5)
    assert known.cost <= found.cost < 1.01 * known.cost
    assert found.cost == pytest.approx(float(known.problem.cost(found.x)), rel=1e-10)
    # The history tells how it went there.
    assert found.history[0] == pytest.approx(known.cost_before, rel=1e-4)
    assert found.history[-1] == found.cost
    assert (np.diff(found.evaluations_at) > 0).all()
    assert found.evaluations_at[-1] == found.evaluations <= 40_000
    assert 64 < len(found.history) < 512


def test_spgd_is_reproducible_and_its_program_serves_again():
    known, other = small_scene(), small_scene(1)
    options = dict(max_evaluations=300)
    first = minimise_spgd(known.problem, jax.random.key(3), **options)
    again = minimise_spgd(known.problem, jax.random.key(3), **options)
    assert np.array_equal(first.x, again.x) and np.array_equal(first.history, again.history)
    assert first.why == "stopped after 300 evaluations: not converged" and not first.converged
    assert first.evaluations == 300
    compiled = compile_seconds()
    differently = minimise_spgd(known.problem, jax.random.key(4), **options)
    minimise_spgd(other.problem, jax.random.key(3), max_evaluations=500, target_cost=1.0, rtol=0.0)
    assert compile_seconds() == compiled
    assert not np.array_equal(first.x, differently.x)


def test_spgd_stops_where_it_is_told():
    problem = small_scene().problem
    key = jax.random.key(0)
    cost = minimise_spgd(problem, key, target_cost=40.0)
    assert cost.cost <= 40.0 and cost.why == "reached: the cost is down to the target"
    share = minimise_spgd(problem, key, target_share=0.5)
    assert share.cost <= 0.5 * share.history[0] and "share" in share.why and share.converged
    slow = minimise_spgd(problem, key, rtol=0.05)
    assert "hardly falls" in slow.why and not slow.converged
    none = eqx.tree_at(lambda p: p.base, problem, problem.base * jnp.nan)
    assert minimise_spgd(none, key).why == "failed: the cost is no number"
    with pytest.raises(ValueError, match="never comes to rest"):
        minimise_spgd(problem, key, momentum=1.0)


def test_inactive_unknowns_stay():
    problem = small_scene().problem
    problem = eqx.tree_at(lambda p: p.active, problem, problem.active.at[:5].set(False))
    for found in (
        minimise_spgd(problem, jax.random.key(0), max_evaluations=300),
        minimise_lbfgs(problem, max_evaluations=20),
    ):
        assert (found.x[:5] == 0.0).all() and (found.x[5:] != 0.0).all()
        assert np.array_equal(problem.flat(found.x)[problem.column < 5],
                              problem.base[problem.column < 5])  # fmt: skip


def test_lbfgs_comes_to_the_solution_of_a_scene():
    known = small_scene()
    found = minimise_lbfgs(known.problem)
    assert found.converged, found.why
    assert found.cost == pytest.approx(known.cost, rel=1e-8)
    assert found.history[-1] == found.cost
    assert found.history[0] == pytest.approx(known.cost_before, rel=1e-12)
    assert (np.diff(found.history) <= 0).all() and (np.diff(found.evaluations_at) > 0).all()
    assert found.evaluations_at[-1] == found.evaluations
    target = minimise_lbfgs(known.problem, target_cost=1.01 * known.cost)
    assert target.cost <= 1.01 * known.cost and target.why.startswith("reached")
    assert target.evaluations < found.evaluations
    few = minimise_lbfgs(known.problem, max_evaluations=10)
    assert few.why == "stopped after 10 evaluations: not converged"


class Counted(eqx.Module):
    """A linear problem that counts how often its cost is evaluated."""

    a: jax.Array
    b: jax.Array
    calls: list = eqx.field(static=True)
    packets: tuple = (0,)

    @property
    def n(self):
        return self.a.shape[1]

    @property
    def active(self):
        return jnp.ones(self.n, bool)

    def cost(self, x):
        jax.debug.callback(lambda: self.calls.append(1))
        return misfit(x, (self.a, self.b))


class Calls(list):
    """A list that can be a static field."""

    def __hash__(self):
        return id(self)


@pytest.mark.parametrize("bounded", [False, True])
def test_lbfgs_counts_its_evaluations_and_keeps_its_bounds(bounded):
    a, b, _ = random_system(8)
    problem = Counted(jnp.asarray(a), jnp.asarray(10.0 * b), Calls())
    lower, upper = (np.full(8, -1.0), np.full(8, 2.0)) if bounded else (-np.inf, np.inf)
    found = minimise_lbfgs(problem, bounds=(lower, upper) if bounded else None)  # type: ignore
    jax.effects_barrier()
    assert len(problem.calls) == found.evaluations
    exact = lsq_linear(a, 10.0 * b, (lower, upper), tol=1e-14)
    assert bounded == (exact.active_mask != 0).any()
    assert np.abs(found.x - exact.x).max() < 1e-4
    assert found.cost == pytest.approx(exact.cost, rel=1e-8)
    assert (found.x >= lower).all() and (found.x <= upper).all()
    if bounded:
        with pytest.raises(ValueError, match="outside of the bounds"):
            minimise_lbfgs(problem, bounds=(np.full(8, 0.1), upper))  # type: ignore
