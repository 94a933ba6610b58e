"""SIGTERM and SIGHUP as interrupts, so that all ways of being told to stop take the same safe way out; and when."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator

from canprobe.bus.interrupts import TERMINATIONS, raise_terminated


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
def interrupts_held() -> Iterator[None]:
    """An interrupt waits for the end of the block: what is begun in it is done whole. In the main thread only."""
    came: list[int] = []
    numbers = (signal.SIGINT, *TERMINATIONS)
    before = [signal.signal(number, lambda n, _: came.append(n)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
        if came:
            signal.raise_signal(came[0])
