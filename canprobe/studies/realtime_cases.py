"""The cases of study `realtime`: one run each on a real SocketCAN interface, emulated nodes in their own process."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.bus.clock import MonotonicClock
from canprobe.bus.open import open_port
from canprobe.bus.priority import MASTER_PRIORITY, realtime
from canprobe.cell.build import make_task
from canprobe.cell.measurement import Command, Controller, Measurement
from canprobe.child import EmulatorChild
from canprobe.errors import CanprobeError
from canprobe.planning import make_plan
from canprobe.scene import Scene, TactileModeName
from canprobe.scene_loader import load_scene
from canprobe.scene_resolve import resolve
from canprobe.session import Session, resolve_scene
from canprobe.studies.cycle_times import CycleTimes, answer_latencies, processor_seconds, share_of, woken

CHANNEL = "vcan0"
PATIENCE = {"missed_syncs": 250, "late_cycles_max_percent": 100}
"""Of the cases' scenes: what cannot be held is measured, and ended neither by a drop-out nor by late cycles."""
WIRE_BITRATE = 50_000_000
"""Of the sweep's plans: a virtual bus has no bit rate, and what a real one allows is the plan's business."""


@dataclass(frozen=True, slots=True)
class Measured:
    """A case and what was measured; `ended` tells why it ended early."""

    case: str
    sensor: str
    rate_hz: float
    times: CycleTimes
    ended: str = ""


def measure_scan(seconds: float) -> Measured:
    """The scene `cylinder` with servo and estimator."""
    scene = _scene(seconds)
    return _measured("whole controller", scene, lambda session: make_task(session.plan))


def measure_plain(seconds: float, rate_hz: float = 400.0) -> Measured:
    """The cycle of `plain_canopen` with the same nodes."""
    from canprobe.studies.plain_canopen import run_plain

    scene = holding_scene("window", rate_hz)
    with served(CHANNEL, in_realtime=True), realtime(MASTER_PRIORITY, _unheard):
        times = run_plain(make_plan(resolve(scene)), CHANNEL, seconds)
    return Measured("plain canopen", "window", rate_hz, times)


def measure_bare(seconds: float, rate_hz: float = 400.0) -> Measured:
    """A loop that wakes at every deadline and does nothing: what the machine itself misses."""
    period_ns, lateness = round(1e9 / rate_hz), list[int]()
    with realtime(MASTER_PRIORITY, _unheard):
        deadlines = list(woken(MonotonicClock(), period_ns, round(seconds * rate_hz), lateness))
    times = CycleTimes.of_wakes(period_ns, lateness, (deadlines[-1] - deadlines[0]) * 1e-9)
    return Measured("bare clock", "none", rate_hz, times)


def measure_hold(mode: TactileModeName, rate_hz: float, seconds: float) -> Measured:
    """The joints held where they stand, at any rate."""
    scene = holding_scene(mode, rate_hz)
    with served(CHANNEL, in_realtime=True):
        return _measured("hold", scene, lambda _: Hold(int(seconds * rate_hz)))


def holding_scene(mode: TactileModeName, rate_hz: float) -> Scene:
    """Six drives and the sensor at half their rate, none of them started by the session."""
    scene = _scene()
    scene = replace(scene, bus=replace(scene.bus, bitrate=WIRE_BITRATE))  # no CAN has it, so no scene may ask for it
    real = with_real_nodes(replace(scene, cycle=replace(scene.cycle, rate_hz=rate_hz)))
    assert real.sensor is not None
    return replace(real, sensor=replace(real.sensor, mode=mode, rate_hz=rate_hz / 2))


def with_real_nodes(scene: Scene) -> Scene:
    """The scene with arm and sensor left to somebody else."""
    assert scene.arm is not None and scene.sensor is not None
    arm, sensor = replace(scene.arm, emulated=False), replace(scene.sensor, emulated=False)
    return replace(scene, arm=arm, sensor=sensor)


def _scene(seconds: float | None = None, channel: str = CHANNEL, *, in_realtime: bool = True) -> Scene:
    """The scene `cylinder`, patient; in real time with the processor and the memory, as far as they are to be had."""
    scene = resolve_scene(load_scene("cylinder"), interface="socketcan", channel=channel, duration_s=seconds)
    return replace(patient(scene), cycle=replace(scene.cycle, realtime=in_realtime))


def patient(scene: Scene) -> Scene:
    """The scene with drives that wait for their master, and a master that is never too late."""
    assert scene.arm is not None
    limits = replace(scene.limits, late_cycles_max_percent=PATIENCE["late_cycles_max_percent"])
    return replace(scene, arm=replace(scene.arm, missed_syncs=PATIENCE["missed_syncs"]), limits=limits)


def _unheard(_: str) -> None:
    """What is not permitted was said by the first case."""


class Hold:
    """Keep the joints where they were found, for some cycles."""

    def __init__(self, cycles: int) -> None:
        self._cycles = cycles
        self._q: Any = None

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        if self._q is None:
            self._q = measurement.q
        self._cycles -= 1
        return Command(q_target=self._q, done=self._cycles <= 0)


@contextmanager
def served(channel: str, child: EmulatorChild | None = None, *, in_realtime: bool = False) -> Iterator[None]:
    """The nodes of `cylinder` in their process; they take rates and mappings from the master, not from their scene."""
    scene = _scene(channel=channel, in_realtime=in_realtime)
    child = child or EmulatorChild(scene, None, channel)
    port = open_port("socketcan", channel, scene.bus.bitrate, MonotonicClock())
    try:
        child.start()
        child.await_boot_ups(port)
        yield
    finally:
        port.close()
        child.end()


def _measured(case: str, scene: Scene, make: Callable[[Session], Controller]) -> Measured:
    assert scene.sensor is not None
    ended = ""
    with tempfile.TemporaryDirectory() as folder:
        session = Session(scene, Path(folder))
        used_s = 0.0
        try:
            with session:
                used_s = processor_seconds()
                session.run(make(session))
        except CanprobeError as error:
            if not session.opened:
                raise
            ended = str(error)
        times = _times(session, Path(folder), used_s)
    return Measured(case, scene.sensor.mode, scene.cycle.rate_hz, times, ended)


def _times(session: Session, folder: Path, used_s: float) -> CycleTimes:
    cell, cycle = session.cell, session.cell.cycle
    assert cycle is not None and cell.drives is not None
    period_ns, seconds = session.plan.sync.period_ns, cycle.t_ns * 1e-9
    return CycleTimes(
        period_ns=period_ns,
        lateness_ns=np.array(cycle.statistics.period_error_ns, np.int64),
        response_ns=np.array(cycle.statistics.response_ns, np.int64),
        compute_ns=np.array(cycle.statistics.compute_ns, np.int64),
        latency_ns=answer_latencies(folder / "bus.log", cell.drives.feedback_ids, period_ns),
        overruns=cycle.statistics.overruns,
        missed=cell.drives.missed,
        seconds=seconds,
        processor_share=share_of(used_s, seconds),
    )
