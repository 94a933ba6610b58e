"""Real-time scheduling: asked for, told where it is refused, and given back."""

import os
import subprocess
import sys

import pytest

from canprobe.fieldbus.bus.real.memory import MAX_RESERVE_BYTES, MIN_RESERVE_BYTES, reserve_memory
from canprobe.fieldbus.bus.real.processor import realtime

SCRIPT = """
import os, sys
from canprobe.fieldbus.bus.real.processor import realtime
def locked():
    return int(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmLck")))
def state():
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, len(os.sched_getaffinity(0)), locked() > 0
said = []
before = state()
with realtime(7, said.append):
    within = state()
try:
    with realtime(7, said.append):
        raise ZeroDivisionError
except ZeroDivisionError:
    after_error = state()
print(before == state(), before == after_error, within, said)
"""


def run(*prefix):
    """In a small process of its own: this one has a gigabyte to lock, and other tests beside it."""
    done = subprocess.run([*prefix, sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def permitted():
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *before)
    except OSError:
        return False
    return True


@pytest.mark.skipif(not permitted(), reason="SCHED_FIFO is not permitted here")
def test_everything_is_had_and_given_back():
    """After an error within, too."""
    assert run() == f"True True ({os.SCHED_FIFO}, 7, 1, True) []"


def test_what_is_refused_is_told_with_the_way_to_it(monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr("canprobe.fieldbus.bus.posix.c_library", refuse)
    before, said = os.sched_getaffinity(0), []
    with realtime(40, said.append):
        pass
    assert said[0] == (
        "real time: no SCHED_FIFO priority 40: Operation not permitted; run as root, or allow it: ulimit -r 50"
    )
    assert [line.split(":")[1] for line in said[-1:]] == [" no locked memory"]
    assert os.sched_getaffinity(0) == before


# Memory taken before it is needed.


def held(cycles):
    """Bytes for small objects that are taken, from what holds them."""
    kept = reserve_memory(cycles)
    assert all(len(block) == 480 for block in kept)
    return len(kept) * (256 << 10)


@pytest.mark.parametrize(
    "cycles, size", [(0, MIN_RESERVE_BYTES), (1024, MIN_RESERVE_BYTES + (4 << 20)), (10**9, MAX_RESERVE_BYTES)]
)
def test_as_much_as_the_cycles_will_keep(cycles, size):
    assert held(cycles) == pytest.approx(size / 2, rel=0.05)
