"""An interrupt waits for the end of a cycle, unless nobody will come to take it."""

from __future__ import annotations

import signal
import threading

import pytest

from canprobe.fieldbus.bus.real.interrupts import Interrupts, Terminated

BOTH = [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated), (signal.SIGHUP, Terminated)]


@pytest.fixture(autouse=True)
def handlers_are_put_back(hangup_heard):
    before = [signal.getsignal(number) for number, _ in BOTH]
    yield
    assert [signal.getsignal(number) for number, _ in BOTH] == before


@pytest.mark.parametrize(("number", "kind"), BOTH)
def test_it_is_raised_when_it_is_taken(number, kind):
    with Interrupts() as interrupts:
        interrupts.take()
        signal.raise_signal(number)
        with pytest.raises(kind) as raised:
            interrupts.take()
        interrupts.take()
    assert raised.type is kind


@pytest.mark.parametrize(("number", "kind"), BOTH)
def test_the_second_is_raised_at_once_and_takes_the_first_with_it(number, kind):
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(kind):
            signal.raise_signal(number)
        interrupts.take()


def test_one_that_nobody_took_is_raised_at_the_end_of_the_block():
    with pytest.raises(KeyboardInterrupt), Interrupts():
        signal.raise_signal(signal.SIGINT)


def test_an_error_goes_before_it():
    with pytest.raises(ZeroDivisionError), Interrupts():
        signal.raise_signal(signal.SIGINT)
        raise ZeroDivisionError


def test_nothing_waits_for_a_program_that_is_stuck():
    with Interrupts(stuck=lambda: True), pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_what_is_ignored_stays_ignored(number):
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with Interrupts() as interrupts:
            signal.raise_signal(number)
            interrupts.take()
    finally:
        signal.signal(number, before)


def test_a_thread_without_signals_runs_on():
    done = []

    def work():
        with Interrupts() as interrupts:
            interrupts.take()
            done.append(True)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [True]
