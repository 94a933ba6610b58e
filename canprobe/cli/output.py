"""What commands print: JSON documents and tables; and interrupts that leave a terminal in order."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
from collections.abc import Iterator, Sequence

from canprobe.bus.scheduling import TERMINATIONS, Terminated, raise_terminated

# What commands print: JSON documents, tables.


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
