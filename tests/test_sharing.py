"""Observations on many devices and in several processes; adjustment without any callback."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from networks import stereo_recording
from pose_networks import network
from processes import EIGHT, answers, apart, together

from jaxvm.montecarlo import LevenbergMarquardt
from jaxvm.network.scene import build
from jaxvm.solve.adjust import adjust
from jaxvm.solve.problem import normal_at, scaled, scene_problem
from jaxvm.solve.sharing import SharedProblem


@pytest.fixture(scope="module")
def stereo():
    known = stereo_recording()
    return known.true_scene(known.recording)


def test_observations_on_eight_devices_give_the_numbers_of_one():
    said = answers(apart("adjust", XLA_FLAGS=EIGHT))
    assert len(said) == 2
    for devices, evaluations, off in said:
        assert devices == "8" and int(evaluations) > 2 and float(off) < 1e-9


def test_observations_in_two_processes_give_the_numbers_of_one():
    # What joins the processes may say something before.
    for devices, evaluations, off in together("adjust")[-2:]:
        assert devices == "2" and int(evaluations) > 2 and float(off) < 1e-9


def test_normal_equations_of_one_device_are_those_of_the_problem(stereo):
    problem = scene_problem(stereo)
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("observations",))
    x = jnp.asarray(np.random.default_rng(0).normal(0.0, 1e-4, problem.n))
    whole, shared = problem.normal(x), SharedProblem.of(problem, mesh).normal(x)
    assert shared.cost == pytest.approx(float(whole.cost), rel=1e-12)
    for a, b in zip(jax.tree.leaves(shared), jax.tree.leaves(whole), strict=True):
        assert np.allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(b).max(initial=0.0))


def test_a_mesh_with_other_axes_is_refused(stereo):
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("trials",))
    with pytest.raises(ValueError, match='one axis "observations"'):
        adjust(stereo, mesh=mesh)


OTHERS = "outfeed", "infeed", "debug_print"
"""Primitives that talk to the host, beside those that are called callbacks."""


def primitives(jaxpr) -> set[str]:
    """Names of all primitives of a program, those inside of loops and calls too."""
    names = set()
    for equation in jaxpr.eqns:
        names.add(equation.primitive.name)
        for value in jax.tree.leaves(
            equation.params, is_leaf=lambda p: isinstance(p, jax.extend.core.ClosedJaxpr)
        ):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                names |= primitives(inner)
    return names


@pytest.mark.parametrize("which", ["stereo", "links"])
def test_a_whole_adjustment_needs_no_callback(stereo, which):
    """One program from the start to the solution: nothing comes back to the host on the way."""
    scene = stereo if which == "stereo" else build(network().recording)
    problem = scene_problem(scene)
    problem, _ = scaled(problem, normal_at(problem, jnp.zeros(problem.n)))
    arrays, rest = eqx.partition(problem, eqx.is_array)

    def whole(arrays):
        return LevenbergMarquardt()(eqx.combine(arrays, rest), jax.random.key(0))

    found = primitives(jax.make_jaxpr(whole)(arrays).jaxpr)
    assert {"while", "cholesky"} <= found
    assert not [name for name in found if "callback" in name or name in OTHERS]
    with jax.transfer_guard("disallow"):
        program = jax.jit(whole).lower(arrays).compile()
        solution = program(arrays)
    assert "xla_ffi_python" not in program.as_text()
    assert "python_cpu_callback" not in program.as_text()
    known = adjust(scene)
    state = problem.state(solution.x)
    assert float(solution.cost) == pytest.approx(known.cost, rel=1e-9)
    assert np.allclose(state.flatten(), known.scene.state.flatten(), atol=1e-8)
