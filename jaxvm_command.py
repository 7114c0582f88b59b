"""The command `jaxvm`: an interruption is heard from the first moment on.

Outside the package: whatever imports a part of the package imports JAX first, which takes a second.
"""

import os
import signal
import sys

INTERRUPTED = 130
LAST_WORDS = "interrupted; nothing was left half-written"


def main() -> int:
    """Run the command line; returns its exit status."""
    signal.signal(signal.SIGINT, _leave)
    from jaxvm.cli import main

    return main()


def _leave(*_: object) -> None:
    """End at once: an import could swallow an exception, and has nothing to tidy up."""
    os.write(2, f"{LAST_WORDS}\n".encode())
    os._exit(INTERRUPTED)


if __name__ == "__main__":
    sys.exit(main())
