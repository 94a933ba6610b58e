"""Run one command to its end: signals passed on to it, a time-out, and its exit status as a shell would see it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from types import FrameType
from typing import Protocol

TIMED_OUT = 124
_GRACE_S = 5.0
_POLL_S = 0.02
_PATIENCE = 3
_FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class Signals:
    """Signals that arrived and were not dealt with yet, oldest first."""

    def __init__(self) -> None:
        self._pending: list[int] = []

    def take(self) -> list[int]:
        """Return what arrived since the last call."""
        taken, self._pending = self._pending, []
        return taken

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self._pending.append(number)


@contextlib.contextmanager
def caught_signals() -> Iterator[Signals]:
    """Within the block, remember SIGINT, SIGTERM, SIGHUP and SIGQUIT instead of dying; ignored ones stay ignored."""
    signals = Signals()
    before = {number: signal.getsignal(number) for number in _FORWARDED}
    try:
        for number, handler in before.items():
            if handler != signal.SIG_IGN:
                signal.signal(number, signals._remember)
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class Job(Protocol):
    """A command that runs somewhere."""

    def poll(self) -> int | None:
        """Pass its output on; return its exit status once it has ended."""
        ...

    def send_signal(self, number: int) -> None:
        """Send a signal to the command and what it started in its group."""
        ...

    def kill(self) -> None:
        """End it at once, whatever it does."""
        ...


def supervise(job: Job, signals: Signals, timeout_s: float | None) -> tuple[int, bool]:
    """Run `job` to its end.

    Every signal is passed on; the third one kills. On the time-out the job gets SIGTERM and 5 s, then it is killed.

    Args:
        job: what runs already.
        signals: where signals of this process arrive.
        timeout_s: how long it may run, from now; `None` for ever.

    Returns:
        Its exit status, and whether it ran into the time-out (the status is then 124).
    """
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    timed_out = False
    received = 0
    while (status := job.poll()) is None:
        for number in signals.take():
            received += 1
            if received >= _PATIENCE:
                job.kill()
                return 128 + number, timed_out
            job.send_signal(number)
        if deadline is not None and time.monotonic() >= deadline:
            if timed_out:
                job.kill()
                break
            timed_out = True
            job.send_signal(signal.SIGTERM)
            deadline += _GRACE_S
        time.sleep(_POLL_S)
    return (TIMED_OUT if timed_out or status is None else status), timed_out


class LocalJob:
    """A command that runs on this machine in a session of its own, without standard input.

    It is started by a shell, which says so and ends with 127 or 126 if there is no such program.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._process = subprocess.Popen(
            ["/bin/sh", "-c", 'exec "$@"', "sh", *command],
            stdin=subprocess.DEVNULL,
            env=dict(environment),
            start_new_session=True,
        )

    def poll(self) -> int | None:
        """Return the exit status, 128 + n after signal n, once it has ended."""
        status = self._process.poll()
        return 128 - status if status is not None and status < 0 else status

    def send_signal(self, number: int) -> None:
        """Send a signal to its process group."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, number)

    def kill(self) -> None:
        """Kill its process group."""
        self.send_signal(signal.SIGKILL)
        self._process.wait()
