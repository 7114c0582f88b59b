"""Functions of one row over whole tables, number by number, against `jax.vmap`."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from networks import free_points_recording

from jaxvm.geometry.lenses import LENS_NAMES, lens_family
from jaxvm.geometry.poses import pose_from_vector, vector_from_pose
from jaxvm.geometry.rotations import rotate, so3_exp, so3_log
from jaxvm.network.componentwise import componentwise, joined
from jaxvm.network.residual import linearise, present, residual, rows
from jaxvm.network.tiles import Tiles
from jaxvm.solve.problem import scene_problem

TILES, WIDTH = 3, 5


def relative(a, b):
    return vector_from_pose(pose_from_vector(a).inverse() @ pose_from_vector(b))


def seen(a, b):
    family = lens_family("opencv5")
    return family.distort(0.01 * b[:5], jnp.array([0.0, 0.0, 9.0]) + a[:3])


def several(a, b):
    return {
        "sorted": jnp.sort(a),
        "loop": jax.lax.fori_loop(0, 3, lambda _, x: x * a, b),
        "placed": jnp.zeros(8).at[jnp.array([2, 5, 0, 1, 3, 7])].set(b),
        "where": jnp.where(b > 0, a, 2.0),
        "known": jnp.array([1.0, 0.0, 3.0]) @ jnp.eye(3),
        "none": jnp.zeros((2, 0)),
        "padded": jax.lax.pad(a[:4].reshape(2, 2), b[0], [(1, 0, 0), (-1, 2, 1)]),
        "split": jnp.split(b, [2, 3]),
        "numbers": functools.reduce(lambda x, y: x**2 + y, jnp.unstack(b)),
        "columns": jnp.unstack(jnp.outer(a, b), axis=1)[1],
        "whole": jnp.linalg.norm(a) ** 3 + jnp.round(b[0]),
        "turned": jnp.flip(jnp.outer(a, b)[1:5:2], 1).T,
    }


@pytest.mark.parametrize(
    "function",
    [
        relative,
        seen,
        several,
        lambda a, b: jax.jacrev(relative, argnums=(0, 1))(a, b),
        lambda a, b: jax.jacfwd(relative, argnums=1)(a, b),
        lambda a, b: jax.jacrev(seen, argnums=(0, 1))(a, b),
        lambda a, b: jax.hessian(lambda a: rotate(a[:3], b[:3]) @ a[3:])(a),
        lambda a, b: so3_log(so3_exp(a[:3]) @ so3_exp(b[3:])),
        lambda a, b: jnp.linalg.cholesky(jnp.outer(a, a) + jnp.eye(6)) @ b,
    ],
)
def test_every_number_is_that_of_vmap(function):
    rng = np.random.default_rng(0)
    # The first is the same for a whole tile.
    a = jnp.asarray(rng.normal(size=(TILES, 1, 6)))
    b = jnp.asarray(rng.normal(size=(TILES, WIDTH, 6)))
    expected = jax.vmap(jax.vmap(function, (None, 0)))(a[:, 0], b)
    found = jax.jit(lambda a, b: taken_together(componentwise(function, a, b, axes=2), 0))(a, b)
    for own, of_vmap in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(own, of_vmap, rtol=1e-12, atol=1e-13)


def taken_together(numbers, axis):
    return jax.tree.map(lambda own: joined(own, (TILES, WIDTH), axis), numbers)


def test_rows_stand_where_they_are_asked_for():
    rng = np.random.default_rng(1)
    b = jnp.asarray(rng.normal(size=(TILES, WIDTH, 6)))
    numbers = componentwise(lambda b: jnp.reshape(b, (3, 2)), b, axes=2)
    whole = np.reshape(b, (TILES, WIDTH, 3, 2))
    for axis in range(3):
        found = joined(numbers, (TILES, WIDTH), axis)
        np.testing.assert_array_equal(np.moveaxis(found, (axis, axis + 1), (0, 1)), whole)


def test_what_is_known_to_be_zero_is_left_out():
    """The derivative of two independent parts: half of it is no array at all."""

    def function(x):
        return jax.jacrev(lambda x: jnp.stack([x[0] ** 2, jnp.sin(x[1])]))(x)

    found = componentwise(function, jnp.ones((4, 2)), axes=1)
    assert found[0, 1] == found[1, 0] == 0.0
    assert isinstance(found[0, 1], np.generic) and found[0, 0].shape == (4,)


@given(st.lists(st.integers(1, 70), min_size=1, max_size=40))
def test_tiles_hold_every_row_once_and_only_like_rows(lengths):
    run = np.repeat(np.arange(len(lengths)), lengths)
    shared = np.stack([run, run % 3], axis=1)
    tiles = Tiles.of(shared)
    if tiles is None:
        assert sum(-(-n // 4) * 4 for n in lengths) > 1.5 * len(run)
        return
    own, place = np.asarray(tiles.rows), np.asarray(tiles.place)
    np.testing.assert_array_equal(own.ravel()[place], np.arange(len(run)))
    assert (run[own] == run[own[:, :1]]).all()


def test_single_rows_are_no_tiles():
    assert Tiles.of(np.arange(50)[:, None]) is None


@pytest.fixture(scope="module")
def problem():
    scene = free_points_recording().true_scene()
    assert all(factor.tiles is not None for factor in scene.network.pixels)
    return scene_problem(scene)


def test_a_table_in_tiles_is_the_table(problem):
    """Derivatives by everything that is free, as one program with and without tiles."""
    network, at = problem.network, present(problem.network, problem.base, slopes=True)
    for factor, packets in zip(network.pixels, problem.packets, strict=False):

        @eqx.filter_jit
        def both(own, at, live=packets.live):
            return rows(own, network, at), linearise(own, network, at, live)

        tiled, plain = both(factor, at), both(factor.untiled(), at)
        for a, b in zip(jax.tree.leaves(tiled), jax.tree.leaves(plain), strict=True):
            scale = np.abs(b).max(initial=1.0)
            np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-13 * scale)


def test_trials_in_tiles_are_the_trials(problem):
    x = 1e-3 * jax.random.normal(jax.random.key(0), (4, problem.n))

    def residuals(x):
        return residual(problem.state(x), problem.network).pixels

    found = jax.jit(jax.vmap(residuals))(x)
    for own, at in enumerate(x):
        for many, one in zip(found, residuals(at), strict=True):
            np.testing.assert_allclose(many[own], one, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", LENS_NAMES)
def test_every_lens(name):
    family = lens_family(name)
    rng = np.random.default_rng(2)
    coefficients = jnp.asarray(1e-2 * rng.normal(size=(TILES, 1, family.n_coefficients)))
    marks = jnp.asarray(rng.normal(size=(TILES, WIDTH, 3))) + jnp.array([0.0, 0.0, 6.0])
    function = jax.jacrev(family.distort, argnums=(0, 1))
    expected = jax.vmap(jax.vmap(function, (None, 0)))(coefficients[:, 0], marks)
    found = taken_together(componentwise(function, coefficients, marks, axes=2), 0)
    for own, of_vmap in zip(found, expected, strict=True):
        np.testing.assert_allclose(own, of_vmap, rtol=1e-11, atol=1e-14)
