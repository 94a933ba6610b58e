"""What commands print: JSON documents, tables, a progress bar; and interrupts that leave a terminal in order."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TextIO

from canprobe.bus.scheduling import TERMINATIONS, Terminated, raise_terminated

# What commands print: JSON documents, tables, a progress bar.

Progress = Callable[[float, float], None]


def print_json(document: object) -> None:
    """One JSON document on stdout; NaN is refused rather than written."""
    print(json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False))


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Rows in columns as wide as they need to be."""
    if not rows:
        return
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def say(line: str) -> None:
    """Report one step, on stderr."""
    print(line, file=sys.stderr, flush=True)


def say_on_terminal(line: str) -> None:
    """Report one step, if stderr is a terminal."""
    if sys.stderr.isatty():
        say(line)


def progress_bar(stream: TextIO | None = None, width: int = 40, unit: str = ".1f s") -> Progress | None:
    """A progress bar on a terminal, None elsewhere.

    Args:
        stream: stderr by default.
        width: of the bar, in characters.
        unit: form of a number, and the unit's name.

    Returns:
        A function of (done, total), both in the same unit, that redraws only when the picture changes.
    """
    out = sys.stderr if stream is None else stream
    if not out.isatty():
        return None
    form, name = unit.split()
    shown = -1

    def show(done: float, total: float) -> None:
        nonlocal shown
        share = min(max(done / total, 0.0), 1.0) if total > 0 else 1.0
        if (percent := int(100 * share)) == shown:
            return
        shown = percent
        bar = "█" * round(width * share)
        out.write(f"\r{bar.ljust(width, '░')} {percent:3d} %  {done:{form}} of {total:{form}} {name}")
        out.write("\n" if percent == 100 else "")
        out.flush()

    return show


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
