"""jaxvm (JAX videometrics): measure with networks of cameras, find the physics a model left out.

Double precision is switched on when the package is imported: photogrammetric normal equations
need it. The settings below are made unless the environment already has them:

- XLA runs and waits in one pool of as many threads as there are cores (NPROC); with two cores, two
  batched triangular solves that wait for each other's helpers lock up for ever. Eight are enough.
- OpenBLAS must not start threads for matrices of 30 rows: it made them 200 times slower. Also
  where NumPy was imported before.
- XLA's own threads inside one operation bring nothing for the many small blocks here.
- XLA's fusion emitters double the time of compiling and save a sixth of the time of running; a
  diagnosis of a recording of a new size is mostly compiling. From jaxlib 0.11.1 on there is no
  choice, and a process that asks for one ends at once.
- XLA drops optimization barriers before it fuses loops, and then computes a derivative again in
  every loop that needs it: barriers stay. XLA's compilers for accelerators end with an error where
  they do, and that of jaxlib 0.12 for processors ends the process: with it, and where an
  accelerator may be found (a plugin of JAX, unless JAX_PLATFORMS is cpu), they go.
- The C library gives blocks of some MB back to the system and takes the next ones anew, page
  by page, which costs more than what is computed in them: up to 64 MB they are kept, for all
  threads together.

Compiled programs stay in the user's cache folder, so that a second run starts at once
(`jaxvm.compiling`); JAX_COMPILATION_CACHE_DIR names another folder,
JAX_ENABLE_COMPILATION_CACHE=false keeps none. Executables are loaded from there: it is a folder for
its user alone.
"""

import ctypes
import os
import sys
from importlib.util import find_spec

import jaxlib.version

from jaxvm import interrupted

interrupted.heard_by_the_command()

_jaxlib = jaxlib.version.__version_info__
_on_processors = os.environ.get("JAX_PLATFORMS") == "cpu" or not (
    find_spec("jax_plugins") or find_spec("libtpu")
)
_flags = {"--xla_cpu_multi_thread_eigen": "false"}
if _jaxlib < (0, 11, 1):
    _flags["--xla_cpu_use_fusion_emitters"] = "false"
if _jaxlib < (0, 12) and _on_processors:
    _flags["--xla_disable_hlo_passes"] = "cse_barrier_expander"
for _flag, _value in _flags.items():
    if _flag not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_flag}={_value}".strip()
if "OPENBLAS_NUM_THREADS" not in os.environ:
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if "numpy" in sys.modules:  # it has read the environment already
        from threadpoolctl import ThreadpoolController

        ThreadpoolController().select(internal_api="openblas").limit(limits=1)
os.environ.setdefault("NPROC", str(max(8, os.cpu_count() or 1)))

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -2, -3, -8  # of <malloc.h>
if sys.platform == "linux" and not any("MALLOC" in name for name in os.environ):
    _mallopt = getattr(ctypes.CDLL(None), "mallopt", lambda *_: 0)
    _mallopt(_M_MMAP_THRESHOLD, 1 << 26)
    _mallopt(_M_TRIM_THRESHOLD, 1 << 28)
    _mallopt(_M_TOP_PAD, 1 << 25)
    _mallopt(_M_ARENA_MAX, 1)

import jax  # noqa: E402
from platformdirs import user_cache_path  # noqa: E402

jax.config.update("jax_enable_x64", True)
if jax.config.values["jax_compilation_cache_dir"] is None:
    _folder = user_cache_path("jaxvm") / f"compiled-{jax.__version__}"
    jax.config.update("jax_compilation_cache_dir", str(_folder))
if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
    # Small programs are kept, too: there are hundreds, and each takes a tenth of a second.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)

__version__ = "0.1.0"
