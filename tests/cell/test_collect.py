"""When a cycle goes on: at its looks, or once the last TPDO has come."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from canprobe.cell.cycle import Cycle, CycleSettings
from canprobe.protocol.frames import SYNC_ID

TPDOS = (0x181, 0x182)
LOOKS = (625, 1145, 1500)
"""µs."""


class Port:
    """A bus on which frames come at given times (µs) after each SYNC, and a clock that jumps."""

    stamps_arrival = True

    def __init__(self, arrivals):
        self._arrivals, self._coming = arrivals, []
        self.clock, self._now = self, 0
        self.drains = 0

    def now_ns(self):
        return self._now

    def sleep_until_ns(self, t_ns):
        self._now = max(self._now, t_ns)

    def send_batch(self, frames, t_ns=None):
        if frames[0][0] == SYNC_ID:
            self._coming = sorted((self._now + us * 1000, can_id) for can_id, us in self._arrivals)

    def wait(self, until_ns):
        if self._coming:
            until_ns = min(until_ns, self._coming[0][0])
        self.sleep_until_ns(until_ns)

    def drain(self):
        self.drains += 1
        there = [(can_id, b"", t) for t, can_id in self._coming if t <= self._now]
        self._coming = self._coming[len(there) :]
        return there


class Drives:
    feedback_ids = frozenset(TPDOS)
    heard_all, torque_permille, statuswords, enabled = False, (), (), False

    def begin(self, *_):
        self._missing = set(TPDOS)

    def push(self, can_id, _data, _t_ns):
        self._missing.discard(can_id)

    @property
    def complete(self):
        return not self._missing

    def end_collect(self):
        pass

    def ages(self):
        return ()


def goes_on_at(arrivals, *, on_arrival=True, drives=True):
    """µs after the SYNC at which a cycle has its measurement, and how often it has looked."""
    port = Port(arrivals)
    settings = CycleSettings(2_500_000, 0, 10**12, 127, tuple(look * 1000 for look in LOOKS), on_arrival)
    watch = SimpleNamespace(push=lambda *_: True)
    cycle = Cycle(port, settings, drives=Drives() if drives else None, tactile=None, watch=watch, other=lambda _: None)
    for _ in range(3):
        port.drains = 0
        cycle.begin()
        cycle.skip()
    port.drains = 0
    cycle.begin()
    return (port.now_ns() - cycle.sync_ns) / 1000, port.drains


@pytest.mark.parametrize(
    ("last_us", "begins_us", "looks"),
    [
        (0, 0, 1),  # nodes on the same processor that go first
        (300, 625, 2),
        (900, 900, 3),  # no waiting for the next look
        (1144, 1144, 3),
        (1600, 1500, 3),  # late
    ],
)
def test_on_a_running_clock_a_cycle_goes_on_once_the_last_tpdo_is_in(last_us, begins_us, looks):
    assert goes_on_at([(TPDOS[0], 0), (TPDOS[1], last_us)]) == (begins_us, looks)


def test_chatter_wakes_a_cycle_but_keeps_it_no_longer():
    chatter = [(0x7FF, us) for us in range(0, 2500, 10)]
    assert goes_on_at([(TPDOS[0], 100), *chatter])[0] == LOOKS[-1]


@pytest.mark.parametrize(("last_us", "begins_us"), [(0, 625), (300, 625), (900, 1145), (1600, 1500)])
def test_in_lockstep_it_goes_on_at_a_look(last_us, begins_us):
    assert goes_on_at([(TPDOS[0], 0), (TPDOS[1], last_us)], on_arrival=False)[0] == begins_us


def test_without_drives_there_is_nothing_to_go_on_with_before_the_first_look():
    assert goes_on_at([], drives=False)[0] == LOOKS[0]
