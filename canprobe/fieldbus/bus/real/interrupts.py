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

REPEAT_PERIOD_S = 0.1
"""Time between two repetitions of an interrupt."""


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP came; it is raised where the program is, as Ctrl-C is."""


def raise_terminated(_number: int, _frame: FrameType | None) -> None:
    """Raise `Terminated`; the handler of SIGTERM and SIGHUP."""
    raise Terminated


@contextlib.contextmanager
def handled_signals(handlers: Mapping[int, Callable[[int, FrameType | None], object]]) -> Iterator[None]:
    """Within the block signals have these handlers. Outside the main thread, which receives none, nothing changes."""
    before = {number: signal.getsignal(number) for number in handlers}
    in_main_thread = threading.current_thread() is threading.main_thread()
    try:
        if in_main_thread:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        yield
    finally:
        if in_main_thread:
            for number, former in before.items():
                signal.signal(number, former)


def heeded_signals(*numbers: int) -> list[int]:
    """Those of some signals that are not ignored: SIGHUP is under `nohup`, SIGINT in the background of some shells."""
    return [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]


@contextlib.contextmanager
def interrupts_held() -> Iterator[None]:
    """Hold an interrupt until the end of the block, so that the block is done whole. It works in the main thread only.

    Ignored signals stay ignored.
    """
    came: list[int] = []
    heeded = heeded_signals(signal.SIGINT, *system.TERMINATION_SIGNALS)
    try:
        with handled_signals(dict.fromkeys(heeded, lambda number, _: came.append(number))):
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
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, *system.TERMINATION_SIGNALS)}
    handlers = {number: handler for number, handler in before.items() if callable(handler)}
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
    with handled_signals(dict.fromkeys(handlers, raise_it)):
        try:
            sys.unraisablehook = unraisable
            repeater.start()
            yield
        finally:
            left.set()
            repeater.join()
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
        for number in (signal.SIGINT, *system.TERMINATION_SIGNALS):
            before = signal.getsignal(number)
            handler = raise_terminated if before is signal.SIG_DFL and number in system.TERMINATION_SIGNALS else before
            if callable(handler):
                self._before[number] = handler
        self._handled = handled_signals(dict.fromkeys(self._before, self._note))
        self._handled.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._handled.__exit__(kind, error, trace)
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
