"""What the package sets for XLA before JAX is there, in processes of their own."""

import os
import subprocess
import sys
from importlib.util import find_spec

import jaxlib.version
import pytest
from processes import free_port


def flags(**env) -> str:
    """XLA_FLAGS after the import, in a fresh environment."""
    unset = ("XLA_FLAGS", "JAX_PLATFORMS")
    known = {name: value for name, value in os.environ.items() if name not in unset}
    said = subprocess.run(
        [sys.executable, "-c", "import jaxvm, os; print(os.environ['XLA_FLAGS'])"],
        env=known | env,
        check=True,
        capture_output=True,
        text=True,
    )
    return said.stdout


KEPT = jaxlib.version.__version_info__ < (0, 12)
"""Whether XLA's compiler for processors takes barriers that stay."""


@pytest.mark.skipif(find_spec("jax_plugins") is not None, reason="JAX has a plugin here")
@pytest.mark.parametrize("plugin", ["jax_plugins", "libtpu"])
def test_barriers_stay_on_processors_alone(tmp_path, plugin):
    """The compilers for accelerators end with an error at a barrier that is still there."""
    (tmp_path / plugin).mkdir()
    path = {"PYTHONPATH": str(tmp_path)}
    assert ("cse_barrier_expander" in flags()) == KEPT
    assert "cse_barrier_expander" not in flags(**path)
    assert ("cse_barrier_expander" in flags(**path, JAX_PLATFORMS="cpu")) == KEPT


@pytest.mark.parametrize("first", ["jaxvm", "numpy, scipy.linalg"])
def test_openblas_has_one_thread_whatever_is_imported_first(first):
    """They wait in loops and take the cores from XLA: adjustment took three times as long."""
    assert openblas_threads(first) == {1}


@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="OpenBLAS has one thread on one core")
def test_the_users_number_of_threads_stays():
    assert openblas_threads("numpy, scipy.linalg", OPENBLAS_NUM_THREADS="2") == {2}


def openblas_threads(first: str, **env) -> set[int]:
    """Numbers of threads of all that OpenBLAS is loaded in, after the imports."""
    code = (
        f"import {first}\n"
        "import jaxvm, scipy.linalg, threadpoolctl\n"
        "libraries = threadpoolctl.threadpool_info()\n"
        "print(*(one['num_threads'] for one in libraries if one['internal_api'] == 'openblas'))"
    )
    known = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    said = subprocess.run(
        [sys.executable, "-c", code], env=known | env, check=True, capture_output=True, text=True
    )
    return set(map(int, said.stdout.split()))


def test_what_the_user_sets_stays():
    own = "--xla_cpu_multi_thread_eigen=true --xla_disable_hlo_passes=none"
    found = flags(XLA_FLAGS=own)
    assert found.startswith(own) and "cse_barrier_expander" not in found
    assert found.count("--xla_cpu_multi_thread_eigen") == 1


@pytest.mark.parametrize("module", ["drift", "scores", "networks", "poses"])
def test_studies_are_imported_before_jax_begins(module):
    """In a cluster `jax.distributed.initialize` comes after the imports and before all else."""
    code = (
        f"import jaxvm.montecarlo.{module}, jax\n"
        f"jax.distributed.initialize('127.0.0.1:{free_port()}', 1, 0)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert said.returncode == 0, said.stderr
