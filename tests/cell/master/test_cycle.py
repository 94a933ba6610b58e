"""When a cycle goes on: at its looks, or once the last TPDO has come."""

from types import SimpleNamespace

import numpy as np
import pytest
from undrawn import undrawn, undrawn_run

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.master.cycle import SYNCS_REMEMBERED, Cycle, Intake
from canprobe.cell.master.observers import MAX_FRAMES, Observers
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.frames import SYNC_ID

TPDOS = (0x181, 0x182)
PERIOD_NS = 2_500_000
LOOKS = (625, 1145, 1500)
"""µs."""


class Port:
    """A bus on which frames come at given times (µs) after each SYNC, and a clock that jumps."""

    stamps_arrival = True

    def __init__(self, arrivals=()):
        self._arrivals, self._coming = arrivals, []
        self.clock, self._now = self, 0
        self.drains, self.sent = 0, []

    def now_ns(self):
        return self._now

    def sleep_until_ns(self, t_ns):
        self._now = max(self._now, t_ns)

    def send_batch(self, frames, t_ns=None):
        self.sent += [(self._now, *frame) for frame in frames]
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


def a_cycle(port, *, on_arrival=True, drives=True, **more):
    """A cycle of 2.5 ms that looks at `LOOKS`."""
    budget = SimpleNamespace(looks_ns=tuple(look * 1000 for look in LOOKS))
    plan = SimpleNamespace(sync=SimpleNamespace(period_ns=PERIOD_NS, overflow=0), budget=budget)
    return Cycle(
        port,
        plan,
        drives=Drives() if drives else None,
        on_arrival=on_arrival,
        **{"tactile": None, "watch": SimpleNamespace(push=lambda *_: True), "other": lambda _: None, **more},
    )


def goes_on_at(arrivals, *, on_arrival=True, drives=True):
    """µs after the SYNC at which a cycle has its measurement, and how often it has looked."""
    port = Port(arrivals)
    cycle = a_cycle(port, on_arrival=on_arrival, drives=drives)
    for _ in range(3):
        port.drains = 0
        cycle.begin()
        cycle.skip()
    port.drains = 0
    cycle.begin()
    return (port.now_ns() - cycle.sync_ns) / 1000, port.drains


@pytest.mark.parametrize(
    ("last_us", "begins_us", "looks", "in_lockstep_us"),
    [
        (0, 0, 1, 625),  # nodes on the same processor that go first
        (300, 625, 2, 625),
        (900, 900, 3, 1145),  # no waiting for the next look, which lockstep has
        (1144, 1144, 3, 1145),
        (1600, 1500, 3, 1500),  # late
    ],
)
def test_a_cycle_goes_on_once_the_last_tpdo_is_in_and_in_lockstep_at_a_look(last_us, begins_us, looks, in_lockstep_us):
    arrivals = [(TPDOS[0], 0), (TPDOS[1], last_us)]
    assert goes_on_at(arrivals) == (begins_us, looks)
    assert goes_on_at(arrivals, on_arrival=False)[0] == in_lockstep_us


def test_chatter_wakes_a_cycle_but_keeps_it_no_longer():
    chatter = [(0x7FF, us) for us in range(0, 2500, 10)]
    assert goes_on_at([(TPDOS[0], 100), *chatter])[0] == LOOKS[-1]


def test_without_drives_there_is_nothing_to_go_on_with_before_the_first_look():
    assert goes_on_at([], drives=False)[0] == LOOKS[0]


@pytest.mark.parametrize(
    ("late_periods", "overruns", "left_out"), [(0.5, 0, 0), (0.501, 1, 0), (0.9, 1, 0), (1.2, 1, 1), (3.7, 1, 3)]
)
def test_a_sync_more_than_half_a_period_late_is_an_overrun(late_periods, overruns, left_out):
    """The next deadline is on the grid of the first one: whole periods are left out, not caught up."""
    port = Port()
    cycle = a_cycle(port, drives=False)
    cycle.begin()
    cycle.end(None)
    port.sleep_until_ns(cycle.t_first_ns + round((1 + late_periods) * PERIOD_NS))
    cycle.begin()
    assert cycle.statistics.overruns == overruns
    assert cycle.t_ns == (1 + left_out) * PERIOD_NS
    cycle.end(None)
    cycle.begin()
    assert cycle.statistics.overruns == overruns and cycle.t_ns == (2 + left_out) * PERIOD_NS


def test_an_array_that_was_never_heard_is_as_old_as_the_run():
    silent = SimpleNamespace(cob_ids=(), newest_cycle=None, take=lambda *_: None)
    intake = Intake(None, silent, SYNCS_REMEMBERED)
    for number in range(21):
        intake.begin(number, number * PERIOD_NS, number * PERIOD_NS)
    assert intake.measure(0).tactile_age == 20


def cycled(cycle, number, *, work=False):
    for _ in range(number):
        cycle.begin()
        cycle.end(None)
        if work:
            cycle.count_work()


def test_the_heartbeat_goes_every_100_ms_behind_the_commands():
    port = Port()
    cycle = a_cycle(port, drives=False)
    cycled(cycle, 82)
    beats = [(t_ns - cycle.t_first_ns) // PERIOD_NS for t_ns, can_id, data in port.sent if can_id == 0x77F]
    assert beats == [0, 40, 80]
    assert {data for _, can_id, data in port.sent if can_id == 0x77F} == {b"\x05"}
    assert sum(can_id == SYNC_ID for _, can_id, _ in port.sent) == 82
    assert {can_id for _, can_id, _ in port.sent} == {SYNC_ID, 0x77F}


def test_every_fifth_cycle_is_timed_and_the_last_ones_are_kept():
    cycle = a_cycle(Port(), drives=False)
    cycled(cycle, 11, work=True)
    statistics = cycle.statistics
    assert (len(statistics.period_error_ns), len(statistics.response_ns), len(statistics.compute_ns)) == (11, 3, 3)
    assert all(
        0 < response <= work for response, work in zip(statistics.response_ns, statistics.compute_ns, strict=True)
    )
    kept = a_cycle(Port(), drives=False, kept=2)
    cycled(kept, 11, work=True)
    kept = kept.statistics
    assert (len(kept.period_error_ns), len(kept.response_ns), len(kept.compute_ns)) == (2, 2, 2)


def test_frames_go_where_they_belong_and_what_came_before_a_sync_does_first():
    taken, left = [], []
    port = Port([(0x583, 100), (0x703, 200), (TPDOS[0], 300), (TPDOS[1], 300)])
    watch = SimpleNamespace(push=lambda can_id, *_: can_id == 0x703 and not taken.append(can_id))
    cycle = a_cycle(port, watch=watch, other=left.append)
    cycle.begin()
    assert taken == [0x703] and [can_id for frames in left for can_id, _, _ in frames] == [0x583]
    cycle.skip()
    port.stamps_arrival, port.drains, at = False, 0, []
    drain = port.drain
    port.drain = lambda: at.append(len(port.sent)) or drain()
    cycle.begin()
    assert at[0] == 1 and at[1:] == [2] * (len(at) - 1), "one look before the second SYNC"


# Observers of a cell: what they see, and that they cannot harm it.


class Watcher:
    def __init__(self):
        self.seen = []

    def observe(self, observation):
        self.seen.append(observation)


@pytest.fixture
def free():
    return canprobe.load_scene("free")


def test_an_observer_sees_every_cycle_every_frame_and_every_command(free, tmp_path):
    watcher, cycles = Watcher(), []
    with canprobe.open_cell(undrawn(free), out=tmp_path, observers=(watcher, cycles.append)) as cell:

        def step(measurement):
            return Command(columns={"mine_m": 0.5}, done=measurement.cycle > 60)

        cell.run(step)
    log = cell.cell.log.arrays()
    measured = [o for o in watcher.seen if o.measurement is not None]
    assert cycles == watcher.seen
    assert [o.measurement.t_ns for o in measured] == np.round(log["t_s"] * 1e9).tolist()
    assert {o.t_ns - o.measurement.t_ns for o in measured} == {measured[0].t_ns}  # one clock
    commanded = [o.command.columns["mine_m"] for o in measured if o.command is not None]
    assert len(commanded) == np.isfinite(log["mine_m"]).sum() > 10
    frames = [(can_id, data, t // 1000 * 1000) for o in watcher.seen for can_id, data, t in o.frames]
    assert frames == [(i, d, t) for t, _, i, d in read_candump(tmp_path / "bus.log")]
    assert watcher.seen[0].measurement is None and len(watcher.seen[0].frames) > 100  # bring-up
    (sync,) = [t for can_id, _, t in measured[20].frames if can_id == 0x080]
    assert measured[20].t_ns < sync < measured[20].t_ns + 100_000  # stamped at its end: 1 byte at 1 Mbit/s


def test_an_observer_that_fails_is_left_out_and_the_run_goes_on(free, tmp_path):
    watcher = Watcher()

    def fragile(observation):
        if observation.measurement is not None and observation.measurement.cycle == 5:
            raise ValueError("no disk")

    result = undrawn_run(free, out=tmp_path, duration_s=0.1, observers=(fragile, watcher))
    assert result.summary["completed"]
    assert [fault for fault in result.summary["faults"] if "fragile" in fault and "no disk" in fault]
    assert len(result.summary["faults"]) == 1
    assert len([o for o in watcher.seen if o.measurement]) == result.summary["cycle"]["cycles"]
    assert result.summary["cycle"]["observe_us"]["max"] > 0


def test_frames_without_a_cycle_do_not_pile_up():
    watcher = Watcher()
    observers = Observers((watcher,))
    write = observers.tap(lambda *_: None)
    for i in range(MAX_FRAMES + 10):
        write(0x181, b"", i)
    observers.frames_alone(7)
    observers.frames_alone(8)
    assert [len(o.frames) for o in watcher.seen] == [MAX_FRAMES]
