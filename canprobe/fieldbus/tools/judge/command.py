"""The master under judgement as a process: started, awaited, and ended with more and more force."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.files import writing
from canprobe.fieldbus.bus.system import system

_FORCES = ((0.0, signal.SIGINT), (5.0, signal.SIGTERM), (7.0, system.KILL))
"""Signals that end a command, and after how many seconds each is sent."""


class MasterCommand:
    """A command that runs beside the served nodes, in a session of its own.

    Args:
        words: the command.
        output: file for its output and errors.

    Raises:
        UsageError: there is no such command.
        ResultsError: the file cannot be written.
    """

    def __init__(self, words: Sequence[str], output: Path) -> None:
        self.words = list(words)
        self.output = output
        with writing(output):
            self._file: IO[bytes] = output.open("wb")
        try:
            self._process = subprocess.Popen(
                self.words, stdin=subprocess.DEVNULL, stdout=self._file, stderr=self._file, **system.OWN_SESSION
            )
        except OSError as error:
            self._file.close()
            raise UsageError(f"{self.words[0]}: cannot be started: {error.strerror}") from error
        self._ending_s: float | None = None
        self._sent = 0

    @property
    def status(self) -> int | None:
        """Exit status, negative after a signal; None while it runs."""
        return self._process.poll()

    def last_lines(self) -> list[str]:
        """Last lines of its output."""
        return self.output.read_text(encoding="utf-8", errors="replace").splitlines()[-20:]

    def press_on(self) -> bool:
        """End it: send the signals whose time has come since the first call. Whether it has ended."""
        if self.status is not None:
            return True
        now_s = time.monotonic()
        self._ending_s = now_s if self._ending_s is None else self._ending_s
        while self._sent < len(_FORCES) and now_s - self._ending_s >= _FORCES[self._sent][0]:
            system.end_session(self._process, _FORCES[self._sent][1])
            self._sent += 1
        return False

    def close(self) -> None:
        """End it and wait for its end, end what it left running, and close the file."""
        try:
            while not self.press_on():
                time.sleep(0.02)
        finally:  # a second Ctrl-C leaves nothing behind, too
            system.end_session(self._process, system.KILL)
            self._file.close()
