"""Ctrl-C before the command line hears it: packages are imported for a second or two.

It imports nothing but the standard library, and is the first that the package imports.
"""

import os
import signal
import sys
from pathlib import Path

INTERRUPTED = 130
"""Exit status of a command that was interrupted."""

LAST_WORDS = "interrupted; nothing was left half-written"


def heard_by_the_command() -> None:
    """In the process of the command `jaxvm` end at once, in one line, until `jaxvm.cli` listens.

    Elsewhere the package is a guest and leaves signals alone.
    """
    if Path(sys.argv[0]).stem == "jaxvm":
        signal.signal(signal.SIGINT, _leave)


def _leave(*_: object) -> None:
    """An import could swallow an exception, and has nothing to tidy up."""
    os.write(2, f"{LAST_WORDS}\n".encode())
    os._exit(INTERRUPTED)
