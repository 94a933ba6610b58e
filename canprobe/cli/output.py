"""What commands print: JSON documents, tables, steps and a progress bar; and interrupts that leave a terminal in order.

Results go to stdout, all else to stderr. Colours and the width of the window are for terminals only.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import signal
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from typing import TextIO

from canprobe.bus.scheduling import TERMINATIONS, Terminated, raise_terminated

Progress = Callable[[float, float], None]

# What a terminal can show.

COLOURS = {"bold": "1", "red": "31", "green": "32", "yellow": "33", "cyan": "36"}
_NARROW = 16
"""Columns below which no cell of a table is broken, and no bar is drawn."""
_MARKS = ("warning", "noted", "fault")


def columns(stream: TextIO) -> int | None:
    """Width of the terminal behind a stream; None where there is none."""
    if not stream.isatty():
        return None
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


def painted(text: str, colour: str, stream: TextIO) -> str:
    """The text in a colour, where the stream is a terminal that has them and NO_COLOR is empty (no-color.org)."""
    if not stream.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\x1b[{COLOURS[colour]}m{text}\x1b[0m"


# Results, on stdout.


def print_json(document: object) -> None:
    """One JSON document on stdout; NaN is refused rather than written."""
    print(json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False))


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Rows in columns as wide as they need to be; on a terminal that is too narrow the widest are broken."""
    if not rows:
        return
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if (window := columns(sys.stdout)) is not None:
        while sum(widths) + 2 * (len(widths) - 1) > window and max(widths) > _NARROW:
            widths[widths.index(max(widths))] -= 1
    for row in rows:
        broken = [
            [cell] if len(cell) <= width else textwrap.wrap(cell, width)
            for cell, width in zip(row, widths, strict=True)
        ]
        for number, line in enumerate(itertools.zip_longest(*broken, fillvalue="")):
            cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
            cells[0] = painted(cells[0], "bold", sys.stdout) if number == 0 else cells[0]
            print("  ".join(cells).rstrip())


def print_summary(text: str) -> None:
    """A summary: a headline, and lines that begin with what they are about; coloured on a terminal."""
    head, *lines = text.splitlines()
    print(painted(head, "green" if head.endswith(": done") else "red", sys.stdout))
    for line in lines:
        match = re.match(r"( +)(\S+)(.*)", line)
        colour = "yellow" if match and match[2] in _MARKS else "cyan"
        print(f"{match[1]}{painted(match[2], colour, sys.stdout)}{match[3]}" if match else line)


# Steps and progress, on stderr.


def say(line: str) -> None:
    """Report one line, on stderr."""
    print(line, file=sys.stderr, flush=True)


class Report:
    """What a command reports while it works: its steps, and one bar.

    Args:
        verbosity: -1 only warnings, 0 the steps of commands that work long, 1 every step.
        stream: stderr by default.
    """

    def __init__(self, verbosity: int = 0, stream: TextIO | None = None) -> None:
        self.verbosity = verbosity
        self._stream = sys.stderr if stream is None else stream
        self._bar = ""

    def say(self, line: str) -> None:
        """Report one step; a warning comes through however quiet the command is."""
        mark = next((mark for mark in _MARKS if line.startswith(f"{mark}:")), None)
        if mark is None and self.verbosity < 0:
            return
        self._write(line if mark is None else painted(mark, "yellow", self._stream) + line.removeprefix(mark))

    def detail(self, line: str) -> None:
        """Report one step of a command whose result says it all: a terminal shows it, and `-v` does everywhere."""
        if self.verbosity > 0 or self._stream.isatty():
            self.say(line)

    def complain(self, line: str) -> None:
        """Report what stops the command, below its bar."""
        self.end_bar()
        prog, colon, rest = line.partition(":")
        self._write(painted(prog + colon, "red", self._stream) + rest)

    def bar(self, unit: str = ".1f s") -> Progress | None:
        """A progress bar as wide as the terminal; None elsewhere, and where the command is quiet.

        Args:
            unit: form of a number, and the unit's name.

        Returns:
            A function of (done, total), both in the same unit, that redraws only when the picture changes.
        """
        if columns(self._stream) is None or self.verbosity < 0:
            return None
        form, name = unit.split()
        shown = ""

        def show(done: float, total: float) -> None:
            nonlocal shown
            share = min(max(done / total, 0.0), 1.0) if total > 0 else 1.0
            text = f" {int(100 * share):3d} %  {done:{form}} of {total:{form}} {name}"
            room = min((columns(self._stream) or 80) - len(text) - 1, 60)
            drawn = ("█" * round(room * share)).ljust(room, "░") if room >= _NARROW else ""
            if (now := f"{drawn} {int(100 * share)}") != shown:
                shown, self._bar = now, f"{painted(drawn, 'cyan', self._stream)}{text}"
                self._stream.write(f"\r{self._bar}\x1b[K")
                self._stream.flush()
            if share == 1.0:
                self.end_bar()

        return show

    def end_bar(self) -> None:
        """Leave the bar as it is; what follows begins on a new line."""
        if self._bar:
            self._bar = ""
            self._stream.write("\n")
            self._stream.flush()

    def _write(self, line: str) -> None:
        """A line above the bar, if there is one."""
        self._stream.write(f"\r\x1b[K{line}\n{self._bar}" if self._bar else f"{line}\n")
        self._stream.flush()


# SIGTERM and SIGHUP as interrupts: whatever stops a command, it leaves by the same safe way.


@contextlib.contextmanager
def termination_interrupts() -> Iterator[None]:
    """Within the block SIGTERM and SIGHUP raise `Terminated`; outside a main thread nothing changes."""
    before = {number: signal.getsignal(number) for number in TERMINATIONS}
    try:
        for number, handler in before.items():
            if handler != signal.SIG_IGN:  # as nohup has it
                signal.signal(number, raise_terminated)
    except ValueError:  # not the main thread: signals are not ours to receive
        yield
        return
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def left_by_ctrl_c() -> Iterator[None]:
    """Ctrl-C is the normal way to leave the block; SIGTERM and SIGHUP go on to the caller, for status 143."""
    try:
        yield
    except Terminated:
        raise
    except KeyboardInterrupt:
        pass
