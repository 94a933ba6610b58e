"""When an interrupt is raised."""

from __future__ import annotations

import contextlib
import signal
import sys

import pytest

from canprobe.cli import main
from canprobe.cli.interrupts import termination_interrupts
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.real.interrupts import Terminated, interrupts_held, interrupts_repeated


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


class Picture:
    """As libraries that draw have it: what is raised in `__del__` Python drops, with a traceback on stderr."""

    def __del__(self):
        signal.raise_signal(self.number)


def draw(number):
    """Draw until somebody interrupts it, 20 s at most; the first interrupt is dropped."""
    picture = Picture()
    picture.number = number
    del picture
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 20_000_000_000
    while clock.now_ns() < deadline_ns:
        pass


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_ends_the_drawing_of_a_run_even_if_a_library_drops_it(
    number, status, monkeypatch, tmp_path, capfd
):
    monkeypatch.setattr("canprobe.cell.results.figures.draw_run", lambda *_: draw(number))
    out = tmp_path / "run"
    assert main(["run", "free", "--duration", "0.05", "--out", str(out)]) == status
    assert capfd.readouterr().err == f"canprobe: interrupted, the cell is stopped; results until then: {out}\n"
    assert (out / "summary.json").exists() and (out / "log.npz").exists()


def test_an_interrupt_is_raised_again_until_the_block_is_left(hangup_heard):
    """Whoever cleans up for long is cut short too; afterwards everything is as before."""
    before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)], sys.unraisablehook
    raised = []

    def work():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            try:
                draw(signal.SIGINT)
            except KeyboardInterrupt as interrupt:
                raised.append(type(interrupt))

    with pytest.raises(Terminated), termination_interrupts(), interrupts_repeated():
        work()
    assert raised == [Terminated]
    assert ([signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)], sys.unraisablehook) == before


def test_an_interrupt_that_was_dropped_at_the_very_end_is_raised_after_it():
    with pytest.raises(KeyboardInterrupt), interrupts_repeated(), contextlib.suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_without_one_nothing_happens_and_an_error_passes():
    with pytest.raises(ZeroDivisionError), interrupts_held():
        raise ZeroDivisionError
    with interrupts_held():
        pass
