"""For all tests.

Tests wait for the compiler more than for anything else: they ask it for programs that are made
quickly, not for the quickest ones. The demonstration, the notebooks and the benchmarks run what
users run; JAX_DISABLE_MOST_OPTIMIZATIONS=0 has the tests do so, too.
"""

import os

import pytest

os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # read when JAX is imported

from jaxvm.compiling import forget_compiled_if_many  # noqa: E402


@pytest.fixture(autouse=True, scope="module")
def few_memory_maps():
    """A worker runs many files, and Linux ends a process with too many compiled programs."""
    forget_compiled_if_many()
