"""jaxvm (JAX videometrics): measure with networks of cameras, find the physics a model left out.

Double precision is switched on when the package is imported: photogrammetric normal equations
need it. Four settings below are made unless the environment already has them:

- XLA runs and waits in one pool of as many threads as there are cores (NPROC); with two cores, two
  batched triangular solves that wait for each other's helpers lock up for ever. Eight are enough.
- OpenBLAS must not start threads for matrices of 30 rows: it made them 200 times slower.
- XLA's own threads inside one operation bring nothing for the many small blocks here.
- XLA's fusion emitters double the time of compiling and save a sixth of the time of running; a
  diagnosis of a recording of a new size is mostly compiling.
"""

import os

for _flag in ("--xla_cpu_multi_thread_eigen", "--xla_cpu_use_fusion_emitters"):
    if _flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_flag}=false".strip()
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NPROC", str(max(8, os.cpu_count() or 1)))

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)

__version__ = "0.1.0"
