"""jaxvm (JAX videometrics): measure with networks of cameras, find the physics a model left out.

Double precision is switched on when the package is imported: photogrammetric normal equations
need it. XLA's thread pool inside one CPU operation is switched off unless XLA_FLAGS speaks of it:
it brings nothing for the many small blocks here, and can lock up for ever on machines with few
cores.
"""

import os

_FLAG = "--xla_cpu_multi_thread_eigen"
if _FLAG not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_FLAG}=false".strip()

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

__version__ = "0.1.0"
