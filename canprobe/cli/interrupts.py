"""SIGTERM and SIGHUP as interrupts, so that each of them ends a command in the same safe way."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator, Mapping

from canprobe.fieldbus.bus.real.interrupts import Terminated, raise_terminated
from canprobe.fieldbus.bus.system import system


@contextlib.contextmanager
def _handlers(handlers: Mapping[int, Callable[..., None]]) -> Iterator[None]:
    """Within the block signals have these handlers; outside a main thread nothing changes."""
    before = {number: signal.getsignal(number) for number in handlers}
    try:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    except ValueError:  # not the main thread, which alone receives signals
        yield
        return
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


def termination_interrupts() -> contextlib.AbstractContextManager[None]:
    """Within the block SIGTERM and SIGHUP raise `Terminated`, but for one that is ignored, as under nohup."""
    heeded = [number for number in system.TERMINATION_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    return _handlers(dict.fromkeys(heeded, raise_terminated))


@contextlib.contextmanager
def left_by_ctrl_c() -> Iterator[None]:
    """Ctrl-C is the normal way to leave the block; SIGTERM and SIGHUP go on to the caller, for status 143."""
    try:
        yield
    except Terminated:
        raise
    except KeyboardInterrupt:
        pass


def first_ctrl_c(asked: Callable[[], None]) -> contextlib.AbstractContextManager[None]:
    """Within the block the first Ctrl-C calls `asked`; the second one interrupts as usual."""
    before = signal.getsignal(signal.SIGINT)

    def ask(*_: object) -> None:
        signal.signal(signal.SIGINT, before)
        asked()

    return _handlers({signal.SIGINT: ask})
