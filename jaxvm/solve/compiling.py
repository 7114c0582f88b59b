"""How long XLA has been compiling in this process."""

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
