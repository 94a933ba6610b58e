"""When an interrupt is raised."""

from __future__ import annotations

import signal

import pytest

from canprobe.bus.interrupts import Terminated, interrupts_held
from canprobe.cli.interrupts import termination_interrupts


@pytest.mark.usefixtures("hangup_heard")
@pytest.mark.parametrize(
    ("number", "kind"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated), (signal.SIGHUP, Terminated)]
)
def test_an_interrupt_waits_for_the_end_of_the_block(number, kind):
    done = []
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(kind) as raised, termination_interrupts():
        with interrupts_held():
            signal.raise_signal(number)
            done.append("whole")
        done.append("not reached")
    assert done == ["whole"] and raised.type is kind
    assert [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_is_ignored_stays_ignored_and_hides_no_other(number):
    """SIGHUP under `nohup`, SIGINT in the background of a shell without job control."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with pytest.raises(Terminated), termination_interrupts(), interrupts_held():
            assert signal.getsignal(number) is signal.SIG_IGN
            signal.raise_signal(number)
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(number, before)


def test_without_one_nothing_happens_and_an_error_passes():
    with pytest.raises(ZeroDivisionError), interrupts_held():
        raise ZeroDivisionError
    with interrupts_held():
        pass
