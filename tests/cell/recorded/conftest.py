"""Recorded runs to replay: in lockstep, on a bus with delays under a sleepy cell, and by another controller."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from undrawn import undrawn_run
from wrapped import Wrapped

import canprobe
from canprobe.cell.emulated.world import make_world
from canprobe.cell.master.cell import Cell
from canprobe.cell.npz import write_npz
from canprobe.cell.scene.load import dump_scene
from canprobe.cell.tasks.from_plan import make_task
from canprobe.fieldbus.bus.candump import CandumpWriter, RecordingPort
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus


def short_scan(**keys):
    """The cylinder with a scan of a second or so, and the online estimator alone."""
    quick = {"task.duration_s": 1.1, "task.clearance_mm": 0.8, "shape.also": ()}
    return canprobe.load_scene("cylinder", quick | keys)


class SleepyClock:
    """A clock that wakes its sleeper up late; the bus itself keeps its own time."""

    def __init__(self, clock, rng):
        self._clock, self._rng = clock, rng

    def now_ns(self):
        return self._clock.now_ns()

    def sleep_until_ns(self, t_ns):
        self._clock.sleep_until_ns(max(t_ns, self._clock.now_ns()) + int(self._rng.gamma(2.0, 40e3)))


class DelayedPort:
    """A port whose frames come later than they were sent, now and then much later, and never overtake each other."""

    stamps_arrival = True

    def __init__(self, port, rng):
        self._port, self._rng, self._under_way, self._last = port, rng, [], 0
        self.clock = SleepyClock(port.clock, rng)
        self.channel, self.counters, self.state = port.channel, port.counters, port.state

    def send_batch(self, frames, t_ns=None):
        self._port.send_batch(frames)
        self._fetch()

    def drain(self):
        self._fetch()
        now = self.clock.now_ns()
        arrived = [frame for frame in self._under_way if frame[2] <= now]
        self._under_way = [frame for frame in self._under_way if frame[2] > now]
        return arrived

    def wait(self, until_ns):
        self._port.clock.sleep_until_ns(min(until_ns, self.clock.now_ns() + 200_000))

    def close(self):
        self._port.close()

    def _fetch(self):
        for can_id, data, t_ns in self._port.drain():
            slow = self._rng.random() < 0.01
            self._last = max(self._last, t_ns + int(self._rng.uniform(1e4, 1.8e6 if slow else 1e5)))
            self._under_way.append((can_id, data, self._last))


class Stalling(Wrapped):
    """The scene's task, which now and then takes most of a period, or more than two."""

    def __init__(self, plan, clock):
        super().__init__(make_task(plan))
        self._clock = clock

    def step(self, measurement):
        command = self.task.step(measurement)
        stall = {0: 2.2e6, 101: 3.9e6, 202: 9e6}.get(measurement.cycle % 303, 0)
        self._clock.sleep_until_ns(self._clock.now_ns() + int(stall))
        return command


@pytest.fixture(scope="session")
def lockstep_run(tmp_path_factory):
    """A run in lockstep, with all its files."""
    return undrawn_run(short_scan(), out=tmp_path_factory.mktemp("recorded") / "lockstep")


@pytest.fixture(scope="session")
def replayed_log(lockstep_run):
    """The replay of its log alone."""
    return canprobe.replay(lockstep_run.out / "bus.log", scene=lockstep_run.plan.scene)


@pytest.fixture(scope="session")
def motion_run(tmp_path_factory):
    """The same without the contact patch, whose share in an answer is taken or left: a small change may decide it."""
    return undrawn_run(short_scan(**{"shape.patch": False}), out=tmp_path_factory.mktemp("recorded") / "motion")


@pytest.fixture(scope="session")
def delayed_run(tmp_path_factory):
    """Folder and task of a run on a bus with delays under a cell with overruns: recorded as on a real interface."""
    out = tmp_path_factory.mktemp("recorded") / "delayed"
    out.mkdir()
    rng = np.random.default_rng(5)
    scene = short_scan()
    plan = canprobe.plan(scene)
    bus = LockstepBus(VirtualClock(), "can0")
    for participant in make_world(plan, scene.emulated_node_ids).participants:
        bus.attach(participant)
    with CandumpWriter(out / "bus.log", "can0") as writer:
        port = RecordingPort(DelayedPort(bus.port(), rng), writer.write)
        controller = Stalling(plan, bus.clock)
        cell = Cell(plan, port)
        with cell:
            cell.run(controller)
    recorded = replace(scene, bus=replace(scene.bus, interface="socketcan"))
    (out / "scene.toml").write_text(dump_scene(recorded))
    write_npz(out / "log.npz", cell.log.columns())
    write_npz(out / "tactile.npz", cell.tactile_log.columns())
    return out, controller.task, cell


@pytest.fixture
def copy_of(tmp_path):
    """Copy a run's folder with its log's lines changed, and without what its master measured: only the bus is left."""

    def copy(folder: Path, change):
        target = tmp_path / f"{folder.name}-changed"
        target.mkdir()
        for path in folder.iterdir():
            if path.name not in ("bus.log", "log.npz", "tactile.npz"):
                (target / path.name).write_bytes(path.read_bytes())
        lines = (folder / "bus.log").read_text().splitlines()
        (target / "bus.log").write_text("".join(f"{line}\n" for line in change(lines)))
        return target

    return copy
