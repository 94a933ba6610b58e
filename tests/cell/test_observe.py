"""Observers of a cell: what they see, and that they cannot harm it."""

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.api import Command
from canprobe.bus.candump import read_candump
from canprobe.cell.observe import MOST_FRAMES, Observers


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
    with canprobe.open_cell(free, out=tmp_path, observers=(watcher, cycles.append)) as cell:

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


def test_without_observers_nothing_is_kept_and_nothing_is_said(free, tmp_path):
    result = undrawn_run(free, out=tmp_path, duration_s=0.1)
    assert result.summary["cycle"]["observe_us"] is None and result.summary["bridges"] is None


def test_frames_without_a_cycle_do_not_pile_up():
    watcher = Watcher()
    observers = Observers((watcher,))
    write = observers.tap(lambda *_: None)
    for i in range(MOST_FRAMES + 10):
        write(0x181, b"", i)
    observers.frames_alone(7)
    observers.frames_alone(8)
    assert [len(o.frames) for o in watcher.seen] == [MOST_FRAMES]
