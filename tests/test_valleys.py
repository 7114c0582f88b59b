"""Curved, narrow valleys: steps that follow the curve reach the end, straight ones creep."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import board_recording, predicted, stereo_recording

from jaxvm.physics.effects import Effect, Scope, Term
from jaxvm.solve import optimise
from jaxvm.solve.adjust import adjust
from jaxvm.solve.problem import scene_problem
from jaxvm.solve.robust import HuberLoss


@pytest.mark.parametrize("loss", [None, HuberLoss(1.0)])
def test_the_bend_is_the_second_derivative_along_the_step(loss):
    problem = scene_problem(stereo_recording(with_ranges=True).true_scene(), loss)
    rng = np.random.default_rng(2)
    x = jnp.zeros(problem.n)
    # A step of some standard deviations of single unknowns, so that the residuals bend visibly.
    step = jnp.asarray(
        rng.standard_normal(problem.n) * 3.0 / np.sqrt(problem.normal(x).hessian.diagonal())
    )

    def stacked(y):
        blocks = jax.tree.leaves(problem.residual(y))
        return [jnp.ravel(block) for block in blocks]

    def along(t):
        return stacked(x + t * step)

    slope = jax.jacfwd(along)
    second = jax.jacfwd(slope)(0.0)
    weights = [
        jnp.repeat(problem.loss.weight(jnp.sum(block**2, axis=1)), block.shape[1])
        for block in jax.tree.leaves(problem.residual(x))
    ]
    if loss is not None:
        assert min(float(w.min()) for w in weights) < 0.9
    _, pull = jax.vjp(stacked, x)
    (expected,) = pull([w * own for w, own in zip(weights, second, strict=True)])
    got = problem.bend(problem.linearised(x), x, step)
    size = float(jnp.abs(expected).max())
    assert size > 1e-3
    np.testing.assert_allclose(got, expected, rtol=0, atol=2e-3 * size)


@pytest.fixture(scope="module")
def tilted():
    """A board before a camera with a tilted sensor, and the effect at zero in its model.

    Centre and decentring are free: they go a hundred pixels with the tilt, on a curved way.
    """
    known = board_recording(n_epochs=30)
    terms, camera = (Term("lens.tilt_y"),), Scope(camera=("cam",))
    effect = Effect("the sensor is tilted", terms, "constant", "constant", (), 0.0, camera, (0.15,))
    obs, rng = known.recording.observations, np.random.default_rng(4)
    pixel = predicted(known.true_scene().with_effects((effect,), (8, 4)))
    pixel += obs.sigma[:, None] * rng.standard_normal(pixel.shape)
    recording = replace(known.recording, observations=replace(obs, pixel=pixel))
    plain = adjust(known.true_scene(recording), check=False)
    return plain.scene.with_effects((replace(effect, amplitudes=(0.0,)),), (8, 4))


def test_a_valley_is_followed_to_its_end(tilted, monkeypatch):
    found = adjust(tilted, damping=1e-6, rtol=1e-9, max_steps=30, check=False)
    assert not found.failed and "converged:" in found.why
    # Full steps of Gauss-Newton, which go over a hump of three hundred times the cost, end there.
    newton = adjust(tilted, "gauss-newton", rtol=1e-12, check=False)
    assert found.cost == pytest.approx(newton.cost, rel=1e-7)
    (effect,) = found.scene.fitted_effects()
    assert effect.amplitudes[0] == pytest.approx(0.15, abs=0.03)
    monkeypatch.setattr(optimise, "_CURVED", 10**9)
    creeping = adjust(tilted, damping=1e-6, rtol=1e-9, max_steps=30, check=False)
    assert creeping.cost > found.cost + 5.0


def test_a_correction_that_is_too_long_is_not_taken(tilted):
    problem = scene_problem(tilted)
    solver = optimise.levenberg_marquardt(damping=jnp.asarray(1e-6))
    info = optimise._as_info(problem.normal(jnp.zeros(problem.n)))
    y, state = optimise._begin(solver, info)
    y, state = optimise._advance(solver, y, state, info)
    bend = problem.bend(problem.linearised(y), y, state.trial - y)
    straight = state.trial
    gentle = optimise._bent(solver, y, state, 1e-6 * bend).trial
    wild = optimise._bent(solver, y, state, 1e9 * bend).trial
    assert not np.array_equal(gentle, straight)
    np.testing.assert_array_equal(wild, straight)
    assert eqx.tree_equal(state.info, optimise._bent(solver, y, state, bend).info)
