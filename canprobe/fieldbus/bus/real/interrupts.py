"""Ctrl-C, SIGTERM and SIGHUP taken between two cycles, where the cell can still act, instead of anywhere in one."""

from __future__ import annotations

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType, TracebackType
from typing import Any

from canprobe.fieldbus.bus.system import system

INTERRUPTS = (signal.SIGINT, *system.TERMINATION_SIGNALS)
"""Signals that end a program from outside, of which Ctrl-C is one."""
REPEAT_PERIOD_S = 0.1
"""Time between two repetitions of an interrupt."""


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP came; it is raised where the program is, as Ctrl-C is."""


def raise_terminated(_number: int, _frame: FrameType | None) -> None:
    """Raise `Terminated`; the handler of SIGTERM and SIGHUP."""
    raise Terminated


@contextlib.contextmanager
def signal_handlers(handlers: Mapping[int, Callable[[int, FrameType | None], object]]) -> Iterator[None]:
    """Within the block signals have these handlers. In another thread than the main one nothing changes."""
    before: dict[int, Any] = {}
    try:
        with contextlib.suppress(ValueError):  # not the main thread
            for number, handler in handlers.items():
                before[number] = signal.signal(number, handler)
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold an interrupt until the end of the block, so that the block is done whole. It works in the main thread only.

    Ignored signals stay ignored: SIGHUP under `nohup`, and SIGINT in the background of a shell without job control.
    """
    came: list[int] = []
    heeded = [number for number in INTERRUPTS if signal.getsignal(number) is not signal.SIG_IGN]
    try:
        with signal_handlers(dict.fromkeys(heeded, lambda number, _: came.append(number))):
            yield
    finally:
        if came:
            signal.raise_signal(came[0])


@contextlib.contextmanager
def interrupts_repeated() -> Iterator[None]:
    """Raise an interrupt again every `REPEAT_PERIOD_S` until the block is left. It works in the main thread only.

    It is for libraries that draw. Python drops what is raised in the callback of a weak reference or in `__del__`, of
    which they have thousands: one Ctrl-C in twenty was lost there, with a traceback on stderr.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[signal.Signals] = []
    left = threading.Event()
    handlers = {number: handler for number in INTERRUPTS if callable(handler := signal.getsignal(number))}
    hook = sys.unraisablehook

    def raise_it(number: int, frame: FrameType | None) -> None:
        came.append(kind := signal.Signals(number))
        if not left.is_set():
            handlers[kind](number, frame)

    def repeat() -> None:
        while not left.wait(REPEAT_PERIOD_S):
            if came:
                _thread.interrupt_main(came[0])

    def unraisable(dropped: Any) -> None:
        if not issubclass(dropped.exc_type, KeyboardInterrupt):
            hook(dropped)

    repeater = threading.Thread(target=repeat, daemon=True)
    sys.unraisablehook = unraisable
    try:
        with signal_handlers(dict.fromkeys(handlers, raise_it)):
            try:
                repeater.start()
                yield
            finally:
                left.set()
                repeater.join()
    finally:
        sys.unraisablehook = hook
    if came:
        signal.raise_signal(came[0])


class Interrupts:
    """Holds the first interrupt within the block until it is taken; a second one is raised where the program is.

    The first one is raised at once, too, where ``stuck()`` is true, as nobody would take it. Ignored signals stay
    ignored (as under `nohup`), one that would end the process raises `Terminated`, and outside the main thread nothing
    changes.

    Args:
        stuck: function that returns whether the program is held up somewhere.
    """

    def __init__(self, stuck: Callable[[], bool] = lambda: False) -> None:
        self._stuck = stuck
        self._before: dict[int, Callable[[int, FrameType | None], object]] = {}
        self._came = False
        self._waiting: int | None = None

    def __enter__(self) -> Interrupts:
        for number in INTERRUPTS:
            handler = signal.getsignal(number)
            if handler is signal.SIG_DFL and number in system.TERMINATION_SIGNALS:
                handler = raise_terminated
            if callable(handler):
                self._before[number] = handler
        self._handlers = signal_handlers(dict.fromkeys(self._before, self._note))
        self._handlers.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._handlers.__exit__(kind, error, trace)
        if error is None:
            self.take()

    def _note(self, number: int, frame: FrameType | None) -> None:
        first, self._came, self._waiting = not self._came, True, None
        if first and not self._stuck():
            self._waiting = number
        else:
            self._before[number](number, frame)

    def take(self) -> None:
        """Give the held interrupt, if there is one, to its former handler, which raises it as a rule."""
        if self._waiting is not None:
            number, self._waiting = self._waiting, None
            self._before[number](number, None)
