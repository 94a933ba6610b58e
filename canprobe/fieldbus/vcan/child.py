"""Run one command to its end: signals passed on to it, a time-out, and its exit status as a shell would see it."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol

from canprobe.fieldbus.bus.real.interrupts import handled_signals, heeded_signals

TIMED_OUT_STATUS = 124
_GRACE_S = 5.0
POLL_PERIOD_S = 0.02
_MAX_SIGNALS = 3
_FORWARDED_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


@contextlib.contextmanager
def caught_signals(*, keyboard: bool = True) -> Iterator[list[int]]:
    """Yield a list to which SIGINT, SIGTERM, SIGHUP and SIGQUIT are appended within the block; ignored ones stay so.

    Args:
        keyboard: False drops SIGINT and SIGQUIT, which the terminal sends to a shell in this group as well.
    """
    signals: list[int] = []
    dropped = () if keyboard else (signal.SIGINT, signal.SIGQUIT)

    def take(number: int, _: object) -> None:
        if number not in dropped:
            signals.append(number)

    with handled_signals(dict.fromkeys(heeded_signals(*_FORWARDED_SIGNALS), take)):
        yield signals


class Job(Protocol):
    """A command that runs."""

    def poll(self) -> int | None:
        """Pass the output on; return the exit status once the command has ended."""

    def send_signal(self, number: int) -> None:
        """Send a signal to the command and what it started in its group."""

    def kill(self) -> None:
        """End the command at once, whatever it does."""


def supervise(job: Job, signals: list[int], timeout_s: float | None) -> tuple[int, bool]:
    """Run `job` to its end.

    Every signal is passed on; the third one kills. On the time-out the job gets SIGTERM and 5 s, then it is killed.

    Args:
        job: command that runs already.
        signals: list in which signals of this process arrive; those that were passed on are taken out.
        timeout_s: time that it may run, from now; `None`: without a limit.

    Returns:
        The exit status, and whether the time-out came, with status 124.
    """
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    timed_out = False
    received = 0
    while (status := job.poll()) is None:
        while signals:
            number = signals.pop(0)
            received += 1
            if received >= _MAX_SIGNALS:
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
        time.sleep(POLL_PERIOD_S)
    return (TIMED_OUT_STATUS if timed_out or status is None else status), timed_out


class LocalJob:
    """A command that runs on this machine in a session of its own, without standard input.

    It is started by a shell, which says so and ends with 127 or 126 if there is no such program.

    Args:
        command: program and arguments.
        environment: the command's whole environment.
        shell: whether it is a shell for the user, with standard input and terminal of this process.
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], shell: bool = False) -> None:
        self._send = os.kill if shell else os.killpg
        self._process = subprocess.Popen(
            ["/bin/sh", "-c", 'exec "$@"', "sh", *command],
            stdin=None if shell else subprocess.DEVNULL,
            env=dict(environment),
            start_new_session=not shell,
        )

    def poll(self) -> int | None:
        """Return the exit status, 128 + n after signal n, once it has ended."""
        status = self._process.poll()
        return 128 - status if status is not None and status < 0 else status

    def send_signal(self, number: int) -> None:
        """Send a signal to its process group, or to the shell."""
        with contextlib.suppress(ProcessLookupError):
            self._send(self._process.pid, number)

    def kill(self) -> None:
        """Kill its process group, or the shell."""
        self.send_signal(signal.SIGKILL)
        self._process.wait()
