"""For all tests."""

import pytest

from jaxvm.compiling import forget_compiled_if_many


@pytest.fixture(autouse=True, scope="module")
def few_memory_maps():
    """A worker runs many files, and Linux ends a process with too many compiled programs."""
    forget_compiled_if_many()
