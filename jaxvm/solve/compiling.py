"""Compilation: how long XLA has been at it in this process, and forgetting its programs."""

from pathlib import Path

import jax
import jax.monitoring

_total = 0.0


def _listen(event: str, duration_secs: float, **_) -> None:
    global _total
    if event.endswith("compile_duration"):
        _total += duration_secs


jax.monitoring.register_event_duration_secs_listener(_listen)


def compile_seconds() -> float:
    """Seconds spent compiling since the package was imported."""
    return _total


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
