"""Time-outs of tests that stretch where the machine is busy: they end what hangs, and judge no speed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import pytest_timeout

GUEST_FOLDER = "CANPROBE_TEST_VCAN_FOLDER"
"""Names the folder that a session in a guest shares with the one outside, which knows the load of the machine."""
_LOAD = "load"
_SETTINGS = pytest.StashKey[Any]()


def crowding() -> float:
    """Programs that want a processor now, for each there is; at least 1."""
    if folder := os.environ.get(GUEST_FOLDER):
        try:
            return float(Path(folder, _LOAD).read_text(encoding="ascii"))
        except (OSError, ValueError):
            return 1.0
    return max(1.0, os.getloadavg()[0] / len(os.sched_getaffinity(0)))


def tell_guest(folder: Path) -> None:
    """Write the crowding down for a session in a guest: its own load says nothing of the machine."""
    new = folder / f"{_LOAD}.new"
    new.write_text(f"{crowding():.2f}", encoding="ascii")
    new.replace(folder / _LOAD)


def patience_s(quiet_s: float) -> float:
    """How long to wait for what takes less than `quiet_s` on a quiet machine."""
    return 2 * quiet_s * crowding()


def _waited_s() -> float:
    """How long this thread wanted a processor and others had it; workers of a test run go last."""
    try:
        return int(Path("/proc/thread-self/schedstat").read_text(encoding="ascii").split()[1]) / 1e9
    except (OSError, IndexError, ValueError):  # a guest's kernel does not count it
        return 0.0


def set_timer(item: pytest.Item, settings: Any) -> bool:
    """Set the timer of pytest-timeout, which looks again where the machine was busy instead of ending the test."""
    start_s = time.monotonic() - _waited_s()

    def look(number: int, frame: FrameType | None) -> None:
        __tracebackhide__ = True
        left_s = settings.timeout * crowding() - (time.monotonic() - _waited_s() - start_s)
        if left_s > 0:
            signal.setitimer(signal.ITIMER_REAL, max(left_s, 0.1))
        else:
            pytest_timeout.timeout_sigalrm(item, settings)

    def cancel() -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)

    item.cancel_timeout = cancel  # type: ignore[attr-defined]
    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, settings.timeout)
    item.stash[_SETTINGS] = settings
    return True


def set_timer_again(item: pytest.Item) -> None:
    """Set the timer for another attempt: a failure has cancelled it."""
    if (settings := item.stash.get(_SETTINGS, None)) is not None:
        set_timer(item, settings)
