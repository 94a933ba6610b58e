"""The steps of a session as lines of a file, for runs that come back from losses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from canprobe.cell.master.options import Say


class StepLog:
    """Reports each step to the user, and appends it to a file with its time on the run's clock.

    Args:
        say: called with each step.
        path: path of the file; None writes none.

    Attributes:
        time_s: function that gives the time on the run's clock, s; None before the bus is open. What is said before
            then is written as soon as it is.
        failure: why a line could not be written; None while all could.
    """

    def __init__(self, say: Say, path: Path | None) -> None:
        self._say, self._path = say, path
        self.time_s: Callable[[], float] | None = None
        self.failure: str | None = None
        self._waiting: list[str] = []

    def __call__(self, text: str) -> None:
        """Report a step."""
        if self._path is not None and self.failure is None:
            self._waiting.append(f"{self.time_s() if self.time_s is not None else 0.0:12.4f}  {text}\n")
            if self.time_s is not None:
                self._write(self._path)
        self._say(text)

    def _write(self, path: Path) -> None:
        try:
            with path.open("a", encoding="utf-8") as file:
                file.writelines(self._waiting)
        except OSError as error:
            self.failure = f"{path}: cannot be written: {error.strerror}"
        self._waiting.clear()
