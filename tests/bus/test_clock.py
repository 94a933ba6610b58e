"""Both clocks; the monotonic one by its own readings only, never by how long something took."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from canprobe.bus.port import MonotonicClock, VirtualClock


def test_virtual_time_stands_still_and_jumps() -> None:
    clock = VirtualClock()
    assert (clock.now_ns(), clock.now_ns()) == (0, 0)
    clock.sleep_until_ns(2_500_000)
    clock.sleep_until_ns(1)
    assert clock.now_ns() == 2_500_000
    assert VirtualClock(7).now_ns() == 7


@pytest.mark.parametrize("native", [True, False])
def test_monotonic_sleep_never_ends_early(native: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not native:  # a C library without clock_nanosleep
        monkeypatch.setattr("canprobe.bus.port.ctypes.CDLL", lambda _: object())
    clock = MonotonicClock()
    for ahead_ns in (-5, 0, 1, 300_000):
        target_ns = time.monotonic_ns() + ahead_ns
        clock.sleep_until_ns(target_ns)
        assert clock.now_ns() >= target_ns - (0 if native else 1_000)
    clock.sleep_until_ns(-1)
    assert clock.now_ns() <= time.monotonic_ns()


@contextmanager
def alarm(action: object, seconds: float) -> Iterator[None]:
    before = signal.signal(signal.SIGALRM, action)  # type: ignore[arg-type]
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_a_signal_that_raises_ends_the_sleep_and_another_does_not() -> None:
    clock = MonotonicClock()
    rung: list[int] = []
    with alarm(lambda number, _: rung.append(number), 0.001):
        target_ns = clock.now_ns() + 20_000_000
        clock.sleep_until_ns(target_ns)
        assert rung == [signal.SIGALRM]
        assert clock.now_ns() >= target_ns

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    with alarm(interrupt, 0.001), pytest.raises(KeyboardInterrupt):
        clock.sleep_until_ns(clock.now_ns() + 3600 * 10**9)


def test_a_time_that_is_past_asks_nothing_of_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    class Library:
        def clock_nanosleep(self, *request: object) -> int:
            return asked.append(request) or 0  # type: ignore[func-returns-value]

    monkeypatch.setattr("canprobe.bus.port.ctypes.CDLL", lambda _: Library())
    clock = MonotonicClock()
    clock.sleep_until_ns(clock.now_ns())
    assert not asked
    clock.sleep_until_ns(clock.now_ns() + 10_000_000)
    assert len(asked) == 1
