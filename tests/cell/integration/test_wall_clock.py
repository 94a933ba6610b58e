"""The wall clock is set in each phase of a run, through the port that has its stamps from the kernel.

The cell runs in virtual time, and each frame passes through a `SocketCanPort`, whose socket is a stand-in that stamps
frames by a wall clock. The run is then the same, to the last bit, as one whose wall clock nobody sets.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.npz import read_npz
from canprobe.cell.tasks.task import Phase
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort, StampClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.protocol.frames import NMT_ID, SYNC_ID

SHORT = {"task.duration_s": 0.1, "task.clearance_mm": 0.1, "cycle.rate_hz": 200.0}
HOUR_NS = 3_600_000_000_000
WALL_NS = 1_700_000_000_000_000_000


class WallClock:
    """A wall clock that is set at times of the monotonic one; `steps` are pairs of a time and a step, ns."""

    def __init__(self, steps):
        self._steps = steps

    def at(self, t_ns):
        return t_ns + WALL_NS + sum(step for since_ns, step in self._steps if since_ns <= t_ns)


class Kernel:
    """The socket of a lockstep port: frames come and go by it, stamped by the wall clock."""

    def __init__(self, port, wall, sent):
        self._port, self._wall, self._sent = port, wall, sent

    def send(self, frames):
        self._sent += [(self._port.clock.now_ns(), can_id) for can_id, _ in frames]
        self._port.send_batch(frames)
        return len(frames)

    def receive(self, wait=False):
        return [(can_id, data, self._wall.at(t_ns), 0) for can_id, data, t_ns in self._port.drain()]


@pytest.fixture
def run_with(monkeypatch, tmp_path) -> Callable:
    """Runs a press by ports with this wall clock: its log, its summary, and what the master sent (time, identifier)."""
    make_port = LockstepBus.port
    with ExitStack() as stack:

        def run(name, steps=()):
            wall, sent = WallClock(steps), []

            def stamped(bus):
                inner = make_port(bus)
                for attribute, stand_in in {
                    "check_interface": lambda *_: None,
                    "_open": lambda *_, **__: stack.enter_context(socket.socket()),
                    "FrameSocket": lambda *_: Kernel(inner, wall, sent),
                    "StampClock": lambda monotonic_ns: StampClock(lambda: wall.at(monotonic_ns()), monotonic_ns),
                }.items():
                    monkeypatch.setattr(f"canprobe.fieldbus.bus.real.socketcan.{attribute}", stand_in)
                port = SocketCanPort(bus.channel, bus.clock)
                monkeypatch.setattr(port, "wait", inner.wait)
                monkeypatch.setattr(port, "_await_empty", lambda: True)
                return port

            monkeypatch.setattr(LockstepBus, "port", stamped)
            result = undrawn_run(canprobe.load_scene("press", SHORT), out=tmp_path / name)
            return read_npz(tmp_path / name / "log.npz"), result.summary, sent

        yield run


def test_a_wall_clock_that_is_set_in_each_phase_changes_nothing(run_with):
    log, summary, sent = run_with("reference")
    assert summary["completed"] and summary["cycle"]["clock_steps"] == 0
    syncs = [t_ns for t_ns, can_id in sent if can_id == SYNC_ID]
    first = sent[0][0]
    times = {"listen": first // 2, "bring-up": (first + syncs[0]) // 2}
    for phase in Phase:
        if (during := np.flatnonzero(log["phase"] == phase)).size:
            times[phase.name] = round(1e9 * log["t_s"][during[len(during) // 2]]) + 300_000
    times["stop"] = (next(t_ns for t_ns, can_id in sent if t_ns > syncs[-1] and can_id == NMT_ID) + syncs[-1]) // 2
    assert {"listen", "bring-up", "APPROACH", "stop"} < times.keys() and len(times) >= 7, times
    steps = [(t_ns, (-1) ** number * HOUR_NS) for number, t_ns in enumerate(sorted(times.values()))]  # alternately
    stepped, found, _ = run_with("set", steps)
    assert found["completed"] and found["cycle"]["clock_steps"] == len(times)
    assert found["cycle"]["missed_pdos"] == 0
    assert stepped.keys() == log.keys()
    for column, values in log.items():
        np.testing.assert_array_equal(stepped[column], values, err_msg=column)
