"""Waiting for what another process does, with a look now and then: who looks all the time takes its processor."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path

LOOK_S = 0.02


def wait_until(done: Callable[[], bool], alive: Callable[[], bool], told: Callable[[], object]) -> None:
    """Wait until `done`; an AssertionError with what was `told` if it is not `alive` before that."""
    while not done():
        assert alive(), told()
        time.sleep(LOOK_S)


def wait_for_size(path: Path, size: int, process: subprocess.Popen[str] | subprocess.Popen[bytes]) -> None:
    """Wait until the file that a process writes has `size` bytes."""
    wait_until(
        lambda: path.exists() and path.stat().st_size >= size,
        lambda: process.poll() is None,
        process.communicate,
    )
