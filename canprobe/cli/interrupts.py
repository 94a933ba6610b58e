"""SIGTERM and SIGHUP as interrupts, so that each of them ends a command in the same safe way."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator

from canprobe.fieldbus.bus.real.interrupts import TERMINATION_SIGNALS, Terminated, raise_terminated


@contextlib.contextmanager
def termination_interrupts() -> Iterator[None]:
    """Within the block SIGTERM and SIGHUP raise `Terminated`; outside a main thread nothing changes."""
    before = {number: signal.getsignal(number) for number in TERMINATION_SIGNALS}
    try:
        for number, handler in before.items():
            if handler != signal.SIG_IGN:  # as nohup has it
                signal.signal(number, raise_terminated)
    except ValueError:  # not the main thread, which alone receives signals
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


@contextlib.contextmanager
def first_ctrl_c(asked: Callable[[], None]) -> Iterator[None]:
    """Within the block the first Ctrl-C calls `asked`; the second one interrupts as usual."""
    before = signal.getsignal(signal.SIGINT)

    def ask(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        asked()

    try:
        signal.signal(signal.SIGINT, ask)
    except ValueError:  # not the main thread, which alone receives signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
