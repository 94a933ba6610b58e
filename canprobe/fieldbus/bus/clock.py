"""Clocks: virtual time that jumps, and the monotonic clock of the machine, behind one interface.

All times are integer nanoseconds. The cycle asks only for `now_ns` and `sleep_until_ns`; with a `VirtualClock` a
sleep is a jump that runs everything due on the way, so a simulated second lasts as long as its computation.
"""

from __future__ import annotations

import time
from typing import Protocol

from canprobe.fieldbus.bus.system import system


class Clock(Protocol):
    """A source of time and the only way to wait for it."""

    def now_ns(self) -> int:
        """Return the present time in ns; it never decreases."""

    def sleep_until_ns(self, t_ns: int) -> None:
        """Return when the clock shows `t_ns` or later; at once if it does already."""


class Driver(Protocol):
    """Something that lives in virtual time, such as a `LockstepBus`."""

    def next_deadline_ns(self) -> int | None:
        """Return the time at which it next has something to do; `None` if it only waits for others."""

    def settle(self) -> None:
        """Do everything due at the present instant; afterwards its next deadline lies in the future."""

    def run_until_ns(self, until_ns: int) -> None:
        """Do everything due up to and including `until_ns`, and move the clock to each instant on the way."""


class VirtualClock:
    """A clock that stands still until somebody waits, then jumps from one deadline to the next.

    Several drivers (buses) may share one clock: they are settled at each instant in the order of their attachment.

    Args:
        start_ns: time at which the clock starts.
    """

    __slots__ = ("_drivers", "_now_ns")

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._drivers: list[Driver] = []

    def now_ns(self) -> int:
        """Return the present virtual time in ns."""
        return self._now_ns

    def attach(self, driver: Driver) -> None:
        """Let `driver` be run whenever time passes one of its deadlines."""
        self._drivers.append(driver)

    def detach(self, driver: Driver) -> None:
        """Stop running `driver`."""
        self._drivers.remove(driver)

    def step(self, until_ns: int) -> bool:
        """Go to the next instant at which something is due and do it, or to `until_ns` if nothing is due by then.

        Returns:
            True if something was done (call again), False if `until_ns` is reached and nothing is due any more.
        """
        target = until_ns + 1
        for driver in self._drivers:
            due = driver.next_deadline_ns()
            if due is not None and due < target:
                target = due
        if target > until_ns:
            self._now_ns = max(self._now_ns, until_ns)
            return False
        self._now_ns = max(self._now_ns, target)
        for driver in self._drivers:
            driver.settle()
        return True

    def move_ns(self, t_ns: int) -> None:
        """Move the clock to `t_ns`, unless that is past; a running driver calls it."""
        self._now_ns = t_ns if t_ns > self._now_ns else self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Run every driver up to and including `t_ns`; the first one runs alone until the next one is due."""
        if len(self._drivers) == 1:
            self._drivers[0].run_until_ns(t_ns)
            self.move_ns(t_ns)
            return
        while True:
            first, alone_ns, earliest = None, t_ns + 1, t_ns + 1
            for driver in self._drivers:
                due = driver.next_deadline_ns()
                if due is None or due >= alone_ns:
                    continue
                if due < earliest:
                    first, alone_ns, earliest = driver, earliest, due
                else:
                    alone_ns = due
            if first is None:
                self.move_ns(t_ns)
                return
            if alone_ns > earliest:
                first.run_until_ns(alone_ns - 1)
            else:
                self.step(t_ns)


class MonotonicClock:
    """CLOCK_MONOTONIC. Whoever sleeps names an absolute deadline, so that periods do not drift."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in ns."""
        return system.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until CLOCK_MONOTONIC shows `t_ns`; a signal handler that raises ends the sleep.

        A time that is past costs one reading of the clock; the system call would cost five in a virtual machine.
        """
        # On Linux `time.sleep` is clock_nanosleep until an absolute time, so that a signal makes it no longer.
        if (left_ns := t_ns - system.monotonic_ns()) > 0:
            time.sleep(left_ns * 1e-9)


class Pace:
    """Lets virtual time pass no faster than real time; time that computing took is not made up for."""

    def __init__(self) -> None:
        self._clock, self._ahead_ns = MonotonicClock(), -(1 << 62)

    def keep(self, t_ns: int) -> None:
        """Wait where `t_ns` of virtual time would come too early; the first call waits for nothing."""
        self._ahead_ns = max(self._ahead_ns, self._clock.now_ns() - t_ns)
        self._clock.sleep_until_ns(t_ns + self._ahead_ns)


def epoch_now_ns() -> int:
    """Time of day in ns since the Unix epoch, for data that leave this machine; no decision uses it."""
    return time.time_ns()


def elapsed_ns() -> int:
    """Running count of real nanoseconds, to measure costs; no decision uses it.

    It is real time on a virtual clock too, so that the cost of a cycle is measured in lockstep as well.
    """
    return time.perf_counter_ns()


def wake_lateness(clock: Clock, period_ns: int, cycles: int) -> list[int]:
    """Lateness of a loop that does nothing but wake at its deadlines, ascending, ns: the machine's own."""
    deadline_ns, lateness = clock.now_ns() + period_ns, list[int]()
    for _ in range(cycles):
        clock.sleep_until_ns(deadline_ns)
        late_ns = clock.now_ns() - deadline_ns
        lateness.append(late_ns)
        deadline_ns += (late_ns // period_ns + 1) * period_ns
    return sorted(lateness)
