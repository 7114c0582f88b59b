"""Unknowns in levels: the same matrix, the same solution and the same trials as without."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import relay_recording
from pose_networks import network

import jaxvm.solve.levels as levels_of
from jaxvm.montecarlo import LevenbergMarquardt, network_study, networks, run
from jaxvm.network.scene import build
from jaxvm.recording.model import Prior
from jaxvm.scenes import parse_description, simulate_network
from jaxvm.solve.arrow import NormalCholesky
from jaxvm.solve.levels import Levels
from jaxvm.solve.problem import in_levels, normal_at, scene_problem
from jaxvm.solve.robust import HuberLoss

D = 3  # unknowns of a body


def scattered(pairs, bodies: int, seed: int):
    """Unknowns of bodies in any order, those of each pair, products of pairs, and their sum."""
    rng = np.random.default_rng(seed)
    n = D * bodies
    own = rng.permutation(n).reshape(bodies, D)
    # A body that is not there is held: its columns count nothing.
    columns = np.array(
        [np.concatenate([own[b] if b < bodies else np.full(D, n) for b in p]) for p in pairs]
    )
    rows = rng.normal(size=(len(pairs), 4 * D, 2 * D))
    products = np.swapaxes(rows, 1, 2) @ rows
    full = np.zeros((n + 1, n + 1))
    for at, product in zip(columns, products, strict=True):
        np.add.at(full, (at[:, None], at), product)
    return columns, products, full[:n, :n]


def ring(bodies: int, closed: bool):
    pairs = [(k, k + 1) for k in range(bodies - 1)] + [(0, bodies)]
    return [*pairs, (bodies - 1, 0)] if closed else pairs


@settings(max_examples=6, deadline=None)
@given(st.booleans(), st.integers(40, 60), st.integers(0, 9), st.booleans())
def test_levels_give_the_matrix_and_its_solutions(closed, bodies, seed, parted):
    pairs = ring(bodies, closed)
    if parted:
        # Two parts, and a body that nothing touches.
        pairs = [p for p in pairs if bodies // 2 not in p] + [(bodies // 2 + 1, bodies)]
    columns, products, full = scattered(pairs, bodies, seed)
    n = len(full)
    levels = Levels.of([columns[:7], columns[7:]], n)
    assert levels is not None
    assert levels.unknown.shape[1] <= (2 if closed else 1) * D
    matrix = levels.matrix(jnp.asarray(products.ravel()))
    np.testing.assert_allclose(matrix.as_matrix(), full, atol=1e-12)
    np.testing.assert_allclose(lx.diagonal(matrix), np.diag(full), atol=1e-12)
    v = np.random.default_rng(1).normal(size=(n, 2))
    raised = full + np.diag(np.where(np.diag(full) == 0.0, 1.0, 0.0))
    solution = jax.jit(lambda m, b: m.factorised().solve(b))(matrix, jnp.asarray(v))
    np.testing.assert_allclose(raised @ solution, v, atol=1e-8)
    damped = matrix + jnp.asarray(0.3) * lx.IdentityLinearOperator(matrix.in_structure())
    found = lx.linear_solve(damped, jnp.asarray(v[:, 0]), solver=NormalCholesky())
    np.testing.assert_allclose(full @ found.value + 0.3 * found.value, v[:, 0], atol=1e-9)


def test_an_indefinite_matrix_fails():
    columns, products, full = scattered(ring(40, False), 40, 0)
    levels = Levels.of([columns], len(full))
    assert levels is not None
    bad = levels.matrix(jnp.asarray(-products.ravel()))
    found = lx.linear_solve(bad, jnp.ones(len(full)), solver=NormalCholesky(), throw=False)
    assert found.result == lx.RESULTS.singular


def test_what_all_see_stays_dense():
    columns, _, full = scattered([(a, b) for a in range(8) for b in range(a)], 8, 0)
    assert Levels.of([columns], len(full)) is None


@pytest.fixture(scope="module")
def chain():
    """Twelve stations in a row, at their true state."""
    made = simulate_network(parse_description('layout = "chain"\nstations = 12\n'), noise=0.0)
    scene = build(made.recording)
    return scene.with_state(made.truth.state(scene))


def with_prior():
    """Stations joined by links, one pose known beforehand."""
    known = network()
    prior = Prior("stations.s3.pose", known.truth[3], np.full(6, 1e-3))
    return build(replace(known.recording, model=replace(known.recording.model, priors=(prior,))))


@pytest.mark.parametrize("kind", ["chain", "links and a prior", "loops"])
def test_the_normal_equations_are_those_of_the_arrow(chain, kind, monkeypatch):
    scenes = {
        "chain": lambda: chain,
        "links and a prior": with_prior,
        "loops": lambda: relay_recording().true_scene(),
    }
    monkeypatch.setattr(levels_of, "_GAIN", 0)
    problem = scene_problem(scenes[kind](), HuberLoss(1.0))
    x = jnp.asarray(np.random.default_rng(0).normal(size=problem.n)) * 1e-3
    in_order = in_levels(problem)
    assert in_order.levels is not None
    plain, found = normal_at(problem, x), normal_at(in_order, x)
    np.testing.assert_allclose(found.cost, plain.cost, rtol=1e-12)
    np.testing.assert_allclose(found.gradient, plain.gradient, rtol=1e-9, atol=1e-6)
    a, b = found.hessian.as_matrix(), plain.hessian.as_matrix()
    np.testing.assert_allclose(a, b, atol=1e-10 * float(jnp.abs(b).max()))


@pytest.mark.parametrize("estimator", [None, LevenbergMarquardt()])
def test_trials_are_those_of_the_arrow(chain, estimator, monkeypatch):
    def study():
        quantity = lambda state: {"last": state.world_from_station[-1]}  # noqa: E731
        return network_study(chain, quantity, estimator=estimator)

    found = run(study(), 0, 40, batch=20)
    monkeypatch.setattr(networks, "specialised", lambda problem: problem)
    plain = run(study(), 0, 40, batch=20)
    assert found.failed == plain.failed == 0
    np.testing.assert_allclose(found.errors, plain.errors, atol=1e-5 * plain.errors.std())
