"""Reports of a command while it works: steps and a progress bar, with colours where a terminal shows them.

Colours and the width of the window are for terminals only; a bar is drawn in notebooks too.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import TextIO

Progress = Callable[[float, float], None]
"""Called with the part that is done and the whole, in one unit."""
COLOURS = {"bold": "1", "red": "31", "green": "32", "yellow": "33", "cyan": "36"}
MIN_COLUMNS = 16
"""Least width for breaking the cells of a table, and for a bar, characters."""
MARKED_WORDS = ("warning", "noted", "fault")


def columns(stream: TextIO) -> int | None:
    """Width of the terminal behind a stream; None for a pipe, where lines stay whole."""
    if not stream.isatty():
        return None
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


def painted(text: str, colour: str, stream: TextIO) -> str:
    """The text in a colour, where the stream is a terminal with colours and NO_COLOR is empty (no-color.org)."""
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\x1b[{COLOURS[colour]}m{text}\x1b[0m"


class StepReport:
    """Reports of a command while it works: its steps, and one bar.

    Args:
        verbosity: level of detail: -1 only warnings, 0 the steps of long commands, 1 every step.
        stream: stream to write to; stderr by default.

    Attributes:
        words: gives the words of each line that is written.
    """

    def __init__(self, verbosity: int = 0, stream: TextIO | None = None) -> None:
        self.verbosity = verbosity
        self.words: Callable[[str], str] = str
        self._stream = sys.stderr if stream is None else stream
        self._bar = ""

    def say(self, line: str) -> None:
        """Report one step; a warning is always written."""
        mark = next((mark for mark in MARKED_WORDS if line.startswith(f"{mark}:")), None)
        if mark is None and self.verbosity < 0:
            return
        self._write(line if mark is None else painted(mark, "yellow", self._stream) + line.removeprefix(mark))

    def detail(self, line: str) -> None:
        """Report one step of a command whose result is enough: on a terminal, and with `-v` everywhere.

        The address of a bridge, which ends with the run, and warnings are shown everywhere.
        """
        if self.verbosity > 0 or self._stream.isatty() or line.startswith(("bridge ", "warning:")):
            self.say(line)

    def complain(self, line: str) -> None:
        """Report the error that stops the command, below its bar."""
        self.end_bar()
        prog, colon, rest = line.partition(":")
        self._write(painted(prog + colon, "red", self._stream) + rest)

    def bar(self, unit: str = ".1f s") -> Progress | None:
        """A progress bar as wide as the terminal; None elsewhere, and where the command is quiet.

        Args:
            unit: format of the numbers, and name of their unit.

        Returns:
            A function of (done, total), both in the same unit, which redraws only when the picture changes.
        """
        if self.verbosity < 0 or (columns(self._stream) is None and "ipykernel" not in sys.modules):
            return None
        form, name = unit.split()
        shown = ""

        def show(done: float, total: float) -> None:
            nonlocal shown
            share = min(max(done / total, 0.0), 1.0) if total > 0 else 1.0
            text = f" {int(100 * share):3d} %  {done:{form}} of {total:{form}} {name}"
            room = min((columns(self._stream) or 80) - len(text) - 1, 60)
            drawn = ("█" * round(room * share)).ljust(room, "░") if room >= MIN_COLUMNS else ""
            if (now := f"{drawn} {int(100 * share)}") != shown:
                shown, self._bar = now, f"{painted(drawn, 'cyan', self._stream)}{text}"
                self._stream.write(f"\r{self._bar}\x1b[K")
                self._stream.flush()
            if share == 1.0:
                self.end_bar()

        return show

    def end_bar(self) -> None:
        """Leave the bar as it is; the next output begins on a new line."""
        if self._bar:
            self._bar = ""
            self._stream.write("\n")
            self._stream.flush()

    def _write(self, line: str) -> None:
        """A line above the bar, if there is one."""
        line = self.words(line)
        self._stream.write(f"\r\x1b[K{line}\n{self._bar}" if self._bar else f"{line}\n")
        self._stream.flush()
