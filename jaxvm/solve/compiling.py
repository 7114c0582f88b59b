"""Compilation: how long XLA has been at it in this process, and programs that stay on disk."""

import os
from pathlib import Path

import jax
import jax.monitoring
from platformdirs import user_cache_path

_total = 0.0


def _listen(event: str, duration_secs: float, **_) -> None:
    global _total
    if event.endswith("compile_duration"):
        _total += duration_secs


jax.monitoring.register_event_duration_secs_listener(_listen)


def compile_seconds() -> float:
    """Seconds spent compiling since the package was imported."""
    return _total


def keep_compiled() -> None:
    """Keep compiled programs on disk (the user's cache folder): a second run starts at once.

    An environment variable JAX_COMPILATION_CACHE_DIR names another folder.
    """
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = user_cache_path("jaxvm") / f"compiled-{jax.__version__}"
        jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


_MAPS, _MOST_MAPS = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")


def forget_compiled_if_many() -> bool:
    """Forget compiled programs before the process runs out of memory maps; whether it did.

    Linux allows a process some 65,000 maps, every compiled program takes dozens, and beyond the
    limit XLA ends the process ("LLVM compilation error: Cannot allocate memory"). Whoever works
    through many recordings of many sizes calls this between them; what is on disk stays there.
    """
    if not (_MAPS.exists() and _MOST_MAPS.exists()):
        return False
    many = _MAPS.read_bytes().count(b"\n") > 0.5 * int(_MOST_MAPS.read_text())
    if many:
        jax.clear_caches()
    return many
