"""Steps of the solvers against dense linear algebra, and their end against scipy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from networks import board_recording, free_points_recording, nudged
from scipy.optimize import least_squares

from jaxvm.solve.adjust import adjust
from jaxvm.solve.arrow import Arrow, NormalCholesky, factorise
from jaxvm.solve.optimise import Relaxing, gauss_newton, levenberg_marquardt, minimise
from jaxvm.solve.problem import Normal, normal_at, scaled, scene_problem

NETWORKS = {"epochs": board_recording, "points": free_points_recording}
"""What the local groups are."""


@eqx.filter_jit
def dense(x, problem):
    """Residuals as one vector, and their automatic derivative."""

    def whole(y):
        return jnp.concatenate([jnp.ravel(b) for b in jax.tree.leaves(problem.residual(y))])

    return whole(x), jax.jacfwd(whole)(x)


@pytest.fixture(scope="module", params=NETWORKS)
def network(request):
    """Which groups, scene off the truth, scaled problem there, its normal equations, r and J."""
    known = NETWORKS[request.param]()
    scene = nudged(known, known.true_scene(), 1e-3)
    problem = scene_problem(scene)
    problem, normal = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    r, j = map(np.asarray, dense(jnp.zeros(problem.n), problem))
    return request.param, scene, problem, normal, r, j


def test_groups_are_what_they_should_be(network):
    kind, scene, problem, *_ = network
    names = scene.unknowns.names()
    s, groups, d = problem.sizes
    assert (groups, d) == ((8, 6) if kind == "epochs" else (12, 3))
    word = "target board at epoch" if kind == "epochs" else "point p"
    assert all(name.startswith(word) for name in names[s:])
    assert not any(name.startswith(word) for name in names[:s])


def test_normal_equations_are_those_of_the_dense_jacobian(network):
    _, _, _, normal, r, j = network
    hessian = np.asarray(normal.hessian.as_matrix())
    assert np.allclose(np.diag(hessian), 1.0, rtol=1e-12)
    assert np.abs(hessian - j.T @ j).max() < 1e-11
    assert np.abs(normal.gradient - j.T @ r).max() < 1e-11 * np.abs(j.T @ r).max()
    assert float(normal.cost) == pytest.approx(0.5 * r @ r, rel=1e-13)


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_step_is_the_least_squares_step(network, damping):
    _, _, _, normal, r, j = network
    n = j.shape[1]
    tall = np.concatenate([j, np.sqrt(damping) * np.eye(n)])
    expected = np.linalg.lstsq(tall, np.concatenate([-r, np.zeros(n)]))[0]
    step = factorise(normal.hessian.add_diagonal(jnp.full(n, damping))).solve(-normal.gradient)
    # A backward stable solution has an error of this size and not a smaller one.
    bound = max(1e-10, 10 * np.finfo(float).eps * np.linalg.cond(tall) ** 2)
    assert np.linalg.norm(step - expected) < bound * np.linalg.norm(expected)
    # In the metric of the problem, which is what the cost feels, no conditioning excuses it.
    apart = np.linalg.norm(tall @ (np.asarray(step) - expected))
    assert apart < 1e-10 * np.linalg.norm(tall @ expected)


def random_arrow(s=4, groups=5, d=3, seed=0) -> tuple[Arrow, np.ndarray]:
    """A positive definite arrow matrix and the same one dense."""
    rng = np.random.default_rng(seed)
    rows = []
    for group in range(groups):
        own = np.zeros((2 * d + s, s + groups * d))
        own[:, :s] = rng.standard_normal((len(own), s))
        own[:, s + group * d : s + (group + 1) * d] = rng.standard_normal((len(own), d))
        rows.append(own)
    j = np.concatenate(rows)
    full = j.T @ j
    local = [slice(s + g * d, s + (g + 1) * d) for g in range(groups)]
    arrow = Arrow(
        jnp.asarray(full[:s, :s]),
        jnp.asarray(np.stack([full[own, :s] for own in local])),
        jnp.asarray(np.stack([full[own, own] for own in local])),
    )
    return arrow, full


SIZES = [(4, 5, 3), (3, 0, 0), (0, 4, 2)]


@pytest.mark.parametrize("size", SIZES)
def test_operator_is_its_dense_matrix(size):
    arrow, full = random_arrow(*size) if size[1] else dense_only(size[0])
    v = np.random.default_rng(1).standard_normal(len(full))
    assert np.allclose(arrow.as_matrix(), full, rtol=1e-13, atol=1e-13)
    assert np.allclose(arrow.mv(jnp.asarray(v)), full @ v, rtol=1e-12)
    assert np.allclose(arrow.diagonal(), np.diag(full), rtol=1e-14)
    assert np.allclose(lx.diagonal(arrow), np.diag(full), rtol=1e-14)
    extra = arrow.add_diagonal(jnp.asarray(v)).as_matrix()
    assert np.allclose(extra, full + np.diag(v), rtol=1e-13, atol=1e-13)
    assert np.allclose(Arrow.join(*arrow.split(jnp.asarray(v))), v)
    assert arrow.transpose().as_matrix().shape == full.shape
    assert arrow.in_size() == arrow.out_size() == len(full)


def dense_only(s: int) -> tuple[Arrow, np.ndarray]:
    """An arrow without local groups."""
    j = np.random.default_rng(2).standard_normal((2 * s, s))
    full = j.T @ j
    return Arrow(jnp.asarray(full), jnp.zeros((0, 0, s)), jnp.zeros((0, 0, 0))), full


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("damping", [None, 0.3])
def test_solver_solves(size, damping):
    arrow, full = random_arrow(*size) if size[1] else dense_only(size[0])
    n = len(full)
    v = np.random.default_rng(1).standard_normal(n)
    operator = arrow
    if damping is not None:
        shift = jnp.asarray(damping) * lx.IdentityLinearOperator(arrow.in_structure())
        operator, full = arrow + shift, full + damping * np.eye(n)
    solution = lx.linear_solve(operator, jnp.asarray(v), solver=NormalCholesky())
    assert np.allclose(solution.value, np.linalg.solve(full, v), rtol=1e-10)
    block = np.random.default_rng(3).standard_normal((n, 2))
    if damping is None:
        columns = factorise(arrow).solve(jnp.asarray(block))
        assert np.allclose(columns, np.linalg.solve(full, block), rtol=1e-10)


def test_solver_says_that_it_failed():
    arrow, full = random_arrow()
    bad = eqx.tree_at(lambda a: a.shared, arrow, arrow.shared - 1e3 * jnp.eye(4))
    solution = lx.linear_solve(bad, jnp.ones(len(full)), solver=NormalCholesky(), throw=False)
    assert solution.result == lx.RESULTS.singular
    with pytest.raises(TypeError, match="normal matrices"):
        other = lx.MatrixLinearOperator(jnp.eye(3))
        lx.linear_solve(other, jnp.ones(3), solver=NormalCholesky())


def test_untouched_unknowns_stay():
    arrow, full = random_arrow()
    silent = eqx.tree_at(
        lambda a: (a.coupling, a.local),
        arrow,
        (arrow.coupling.at[2, 1].set(0.0), arrow.local.at[2, 1].set(0.0).at[2, :, 1].set(0.0)),
    )
    at = 4 + 2 * 3 + 1
    v = jnp.ones(len(full)).at[at].set(0.0)
    keep = np.arange(len(full)) != at
    step = factorise(silent).solve(v)
    assert step[at] == 0.0
    matrix = np.asarray(silent.as_matrix())[np.ix_(keep, keep)]
    assert np.allclose(step[keep], np.linalg.solve(matrix, np.ones(keep.sum())), rtol=1e-10)


@pytest.fixture(scope="module")
def reference(network):
    """Cost and place of the minimum by scipy on the dense problem."""
    _, _, problem, *_ = network
    found = least_squares(
        lambda x: np.asarray(dense(jnp.asarray(x), problem)[0]),
        np.zeros(problem.n),
        lambda x: np.asarray(dense(jnp.asarray(x), problem)[1]),
        method="lm",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    return found


@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt"])
def test_both_methods_end_where_scipy_ends(network, reference, method):
    _, scene, _, _, r, _ = network
    result = adjust(scene, method=method)
    assert result.converged, result.why
    assert result.cost_before == pytest.approx(0.5 * r @ r, rel=1e-12)
    assert result.cost_before > 10 * result.cost
    assert result.cost == pytest.approx(reference.cost, rel=1e-8)
    # x counts standard deviations at most: where they end is the same to a thousandth of one.
    j = dense(jnp.asarray(reference.x), result.problem)[1]
    apart = np.linalg.norm(np.asarray(j) @ (np.asarray(result.x) - reference.x))
    assert apart < 1e-3


def test_rejections_in_a_row_damp_faster_and_faster():
    search = Relaxing(damping=1e-6)
    operator = lx.MatrixLinearOperator(jnp.eye(1))
    at = optx.FunctionInfo.EvalGradHessian(jnp.array(1.0), jnp.array([1.0]), operator)
    y, trial = jnp.zeros(1), jnp.array([-1.0])

    def stepped(state, value):
        other = optx.FunctionInfo.EvalGradHessian(jnp.array(value), jnp.array([0.0]), operator)
        size, accepted, _, state = search.step(jnp.array(False), y, trial, at, other, state)
        return float(size), bool(accepted), state

    state, sizes = search.init(y, None), []
    for _ in range(5):
        size, accepted, state = stepped(state, 2.0)
        assert not accepted
        sizes.append(size)
    assert np.allclose(np.log10(sizes), [5, 3, 0, -3, -6])
    size, accepted, state = stepped(state, 0.5)
    assert accepted and np.isclose(np.log10(size), -5)
    # After a step that was taken patience is what it was.
    assert np.isclose(np.log10(stepped(state, 2.0)[0]), -6)


class Ridge:
    """Half of (x0 + x1 - 1)^2: a valley, whose matrix rounding has made indefinite."""

    def normal(self, x) -> Normal:
        off = x[0] + x[1] - 1.0
        matrix = jnp.array([[1.0, 1.0], [1.0, 1.0 - 1e-6]])
        arrow = Arrow(matrix, jnp.zeros((0, 0, 2)), jnp.zeros((0, 0, 0)))
        return Normal(0.5 * off**2, off * jnp.ones(2), arrow)


def test_a_matrix_without_factors_is_no_convergence():
    ridge, start = Ridge(), jnp.zeros(2)
    # No damping helps Gauss-Newton: it says so and does not move.
    x, last = minimise(ridge, ridge.normal(start), gauss_newton())
    assert last.done and last.result != optx.RESULTS.successful
    assert int(last.evaluations) < 5 and np.all(x == 0.0)
    # Damped steps begin where damping does not help yet, and end in the valley.
    x, last = minimise(ridge, ridge.normal(start), levenberg_marquardt(damping=1e-11))
    assert last.done and last.result == optx.RESULTS.successful
    assert float(x.sum()) == pytest.approx(1.0, abs=1e-4)


def test_at_a_solution_one_evaluation_does(network):
    _, scene, *_ = network
    found = adjust(scene)
    again = adjust(found.scene)
    assert again.converged and again.evaluations == 1
    # Its unknowns are in standard deviations at most.
    assert np.abs(np.asarray(again.x)).max() < 1e-3
    assert again.cost == pytest.approx(found.cost, rel=1e-9)
