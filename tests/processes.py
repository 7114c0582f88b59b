"""Starting `apart.py`, and what it says."""

import os
import socket
import subprocess
import sys
from pathlib import Path

EIGHT = "--xla_force_host_platform_device_count=8"
"""Eight devices on one processor."""


def apart(*arguments, **environment) -> subprocess.Popen:
    """Work in a process of its own."""
    return subprocess.Popen(
        [sys.executable, str(Path(__file__).parent / "apart.py"), *map(str, arguments)],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        text=True,
    )


def together(*arguments) -> list[list[str]]:
    """Work of two processes on loopback, and what the first one says, line by line."""
    port = free_port()
    both = [apart(*arguments, port, rank, 2) for rank in (0, 1)]
    return [answers(own) for own in both][0]


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def answer(process: subprocess.Popen) -> list[str]:
    """What it said last."""
    return answers(process)[-1]


def answers(process: subprocess.Popen) -> list[list[str]]:
    """What it said, line by line."""
    said = process.communicate()[0]
    assert process.returncode == 0
    return [line.split() for line in said.splitlines()]
