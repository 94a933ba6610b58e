"""SIGTERM and SIGHUP as interrupts, so that each of them ends a command in the same safe way."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator

from canprobe.fieldbus.bus.real.interrupts import Terminated, handled_signals, heeded_signals, raise_terminated
from canprobe.fieldbus.bus.system import system


def termination_interrupts() -> contextlib.AbstractContextManager[None]:
    """Within the block SIGTERM and SIGHUP raise `Terminated`, but for one that is ignored, as under nohup."""
    return handled_signals(dict.fromkeys(heeded_signals(*system.TERMINATION_SIGNALS), raise_terminated))


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

    return handled_signals({signal.SIGINT: ask})
