"""Deadlines of a node: order, re-arming, cancelling, missed periods."""

from __future__ import annotations

from types import SimpleNamespace

from hypothesis import given
from hypothesis import strategies as st

from canprobe.fieldbus.node.timers import Timers


def test_rearmed_later_and_earlier():
    fired: list[int] = []
    timers = Timers(SimpleNamespace())
    timer = timers.new(fired.append)
    timer.arm(50)
    timer.arm(80)
    assert timers.next_ns == 80
    timer.arm(30)
    assert timers.next_ns == 30
    timers.run(100)
    assert fired == [30]


def test_cancelled_is_silent():
    timers = Timers(SimpleNamespace())
    timer = timers.new(lambda _: 1 / 0)
    timer.arm(5)
    timer.cancel()
    timers.run(10)
    assert timers.next_ns is None


def test_missed_periods_are_skipped_and_the_phase_kept():
    fired: list[int] = []
    timers = Timers(SimpleNamespace())

    def again(due: int) -> None:
        fired.append(due)
        timer.arm_next(due, 100)

    timer = timers.new(again)
    timer.arm(100)
    timers.run(100)
    timers.run(1234)
    assert (fired, timers.next_ns) == ([100, 200], 1300)


def test_nothing_is_kept_of_deadlines_that_come_and_go():
    """A far deadline, then a near one that fires, again and again: as when 1017h is written long, short, long."""
    fired: list[int] = []
    timers = Timers(SimpleNamespace())
    timer = timers.new(fired.append)
    for t_ns in range(10_000):
        timer.arm(t_ns + 10**9)
        forgotten = timers.new(fired.append)
        forgotten.arm(t_ns + 10**9)
        forgotten.cancel()
        timer.arm(t_ns + 1)
        timers.run(t_ns + 1)
    assert fired == list(range(1, 10_001))
    assert not timers.armed


@given(st.lists(st.tuples(st.integers(0, 3), st.one_of(st.none(), st.integers(0, 40))), max_size=30))
def test_next_is_the_minimum_of_what_is_armed(orders):
    timers = Timers(SimpleNamespace())
    made = [timers.new(lambda _: None) for _ in range(4)]
    for which, due in orders:
        if due is None:
            made[which].cancel()
        else:
            made[which].arm(due)
        armed = [timer.due_ns for timer in made if timer.due_ns is not None]
        assert timers.next_ns == min(armed, default=None)
