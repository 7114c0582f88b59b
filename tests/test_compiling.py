"""Programs that stay on disk: called at once by the next process, with the same result."""

import json
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.compilation_cache import compilation_cache

from jaxvm import compiling
from jaxvm.compiling import program

_traced: list[str] = []


class Line(eqx.Module):
    """A static and an array field, as most arguments here have."""

    slope: jax.Array
    name: str = eqx.field(static=True)


@program
def weighted(line: Line, x, power, shapes: tuple[int, ...] = ()):
    _traced.append(line.name)
    return {"line": Line(line.slope * x**power, line.name), "none": None, "shapes": shapes}


@program
def solved(matrix, right):
    _traced.append("solved")
    return jnp.linalg.solve(matrix, right), jnp.linalg.cholesky(matrix @ matrix.T)


@program
def through(function, x):
    _traced.append("through")
    return function(x)


def doubled(x):
    return 2.0 * x


@pytest.fixture(autouse=True)
def _kept(tmp_path, monkeypatch):
    """Programs of a test stay in a folder of its own; types of this file count as known."""
    _traced.clear()
    monkeypatch.setattr(compiling, "_OURS", compiling._OURS | {__name__})
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    _forget()
    yield
    jax.config.update("jax_compilation_cache_dir", before)
    compilation_cache.reset_cache()
    _forget()


def _forget():
    """As in a new process."""
    compiling._folder.cache_clear()
    for one in (weighted, solved, through):
        one.forget()
    jax.clear_caches()


def test_a_second_process_traces_nothing():
    line, x = Line(jnp.asarray(3.0), "a"), np.arange(4.0)
    first = weighted(line, x, 2)
    _forget()
    second = weighted(line, x, 2)
    assert _traced == ["a"]
    assert second["line"].name == "a" and second["none"] is None and second["shapes"] == ()
    np.testing.assert_array_equal(first["line"].slope, 3.0 * x**2)
    np.testing.assert_array_equal(second["line"].slope, 3.0 * x**2)


def test_what_is_static_makes_another_program():
    line, x = Line(jnp.asarray(3.0), "a"), np.arange(1.0, 5.0)
    results = [weighted(line, x, power)["line"].slope for power in (1, 1.0, True, 2)]
    assert len(_traced) == 4
    assert weighted(Line(line.slope, "b"), x, 1)["line"].name == "b"
    assert weighted(line, x, 1, shapes=(2, 3))["shapes"] == (2, 3)
    np.testing.assert_array_equal(results[3], 3.0 * x**2)
    _forget()
    assert weighted(line, x, 2)["line"].slope[1] == 12.0
    # Other lengths and other kinds of numbers, too; a number of Python's takes the kind of others.
    single, exact = x.astype(np.float32), Line(jnp.full((), 3.0, jnp.float64), "a")
    assert weighted(line, x[:2], 2)["line"].slope.shape == (2,)
    assert weighted(line, single, 2)["line"].slope.dtype == jnp.float32
    assert weighted(exact, single, 2)["line"].slope.dtype == jnp.float64
    assert len(_traced) == 9


def test_other_sources_ask_for_the_same_executable(tmp_path, monkeypatch):
    """What changes elsewhere in the package costs tracing, and no compiling."""
    matrix = np.diag([1.0, 2.0, 3.0])
    solved(matrix, np.ones(3))
    kept = set((tmp_path / "programs").iterdir())
    _forget()
    monkeypatch.setattr(compiling, "_context", lambda: "other sources")
    before = compiling.compile_seconds()
    solution, _ = solved(matrix, np.ones(3))
    assert compiling.compile_seconds() == before
    np.testing.assert_allclose(solution, [1.0, 0.5, 1.0 / 3.0])
    assert _traced == ["solved", "solved"]
    assert len(set((tmp_path / "programs").iterdir()) - kept) == 1


def test_another_setting_of_jax_is_another_program(tmp_path):
    """Whatever is set in the middle of a process: what was made before is not taken for it."""
    before = jax.config.values["jax_disable_most_optimizations"]
    solved(np.eye(3), np.ones(3))
    kept = set((tmp_path / "programs").iterdir())
    _forget()
    jax.config.update("jax_disable_most_optimizations", not before)
    try:
        solved(np.eye(3), np.ones(3))
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
    assert len(set((tmp_path / "programs").iterdir()) - kept) == 2
    assert _traced == ["solved", "solved"]


@pytest.mark.parametrize("damage", [b"", b"not a program", None])
def test_a_damaged_file_is_made_again(tmp_path, damage):
    x = np.ones(3)
    solved(np.eye(3), x)
    for file in (tmp_path / "programs").iterdir():
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    _forget()
    np.testing.assert_array_equal(solved(np.eye(3), x)[0], x)
    _forget()
    np.testing.assert_array_equal(solved(np.eye(3), x)[0], x)
    assert _traced == ["solved"] * 2


def tripled(x):
    return 3.0 * x


def test_what_a_user_wrote_is_traced_anew(monkeypatch):
    """Its name says nothing about what it does tomorrow."""
    monkeypatch.setattr(compiling, "_OURS", compiling._OURS - {__name__})
    x = np.arange(3.0)
    assert through(doubled, x)[2] == 4.0
    _forget()
    monkeypatch.setattr(tripled, "__qualname__", "doubled")
    monkeypatch.setitem(globals(), "doubled", tripled)
    assert through(doubled, x)[2] == 6.0


def test_functions_of_modules_are_told_apart_and_local_ones_not_kept():
    x = np.arange(3.0)
    assert through(doubled, x)[2] == 4.0
    for factor in (3.0, 4.0):

        def scaled(x, factor=factor):
            return factor * x

        assert through(scaled, x)[2] == 2.0 * factor
    _forget()
    assert through(doubled, x)[2] == 4.0
    assert _traced == ["through"] * 3


def test_under_transformations_it_is_part_of_the_whole():
    matrices = np.stack([np.eye(2), 2.0 * np.eye(2)])
    found, _ = jax.vmap(solved, (0, None))(matrices, np.ones(2))
    np.testing.assert_array_equal(found, [[1.0, 1.0], [0.5, 0.5]])
    slope = jax.grad(lambda x: weighted(Line(x, "a"), jnp.ones(3), 1)["line"].slope.sum())(2.0)
    assert slope == 3.0


def test_what_jax_cannot_write_is_left_to_its_own_cache(tmp_path, monkeypatch):
    def refused(_):
        raise NotImplementedError

    monkeypatch.setattr(compiling.serialize_executable, "serialize", refused)
    x = np.ones(3)
    np.testing.assert_array_equal(solved(np.eye(3), x)[0], x)
    np.testing.assert_array_equal(solved(np.eye(3), x)[0], x)
    assert not list((tmp_path / "programs").iterdir())
    assert any(file.name.startswith("jit_solved") for file in tmp_path.iterdir())


def test_nothing_is_kept_where_the_user_wants_none(tmp_path):
    jax.config.update("jax_enable_compilation_cache", False)
    try:
        _forget()
        solved(np.eye(3), np.ones(3))
    finally:
        jax.config.update("jax_enable_compilation_cache", True)
    assert not list(tmp_path.iterdir())


_PROCESS = """
import json, numpy as np
from test_compiling import solved, _traced
matrix = np.array([[4.0, 1.0], [1.0, 3.0]])
print(json.dumps([np.asarray(part).tolist() for part in solved(matrix, matrix[0])] + [_traced]))
"""


def test_a_new_process_calls_lapack_at_once(tmp_path):
    """An executable that calls LAPACK where no program that does so was ever lowered."""
    folder = os.path.dirname(__file__)
    env = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path), "PYTHONPATH": folder}
    env.pop("XLA_FLAGS", None)
    command = [sys.executable, "-c", _PROCESS]
    runs = [
        subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        for _ in range(2)
    ]
    assert [run.returncode for run in runs] == [0, 0], runs[1].stderr
    first, second = (json.loads(run.stdout) for run in runs)
    assert first[:2] == second[:2]
    np.testing.assert_allclose(second[0], [1.0, 0.0], atol=1e-15)
    assert (first[2], second[2]) == (["solved"], [])
