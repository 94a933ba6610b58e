"""The cases of study `realtime`: one run each on a real SocketCAN interface, emulated nodes in their own process."""

from __future__ import annotations

import atexit
import functools
import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.hardware import TactileModeName
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.child_process import EmulatorChild
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.clock import MonotonicClock, wake_lateness
from canprobe.fieldbus.bus.real.opening import open_port
from canprobe.fieldbus.bus.real.processor import MASTER_PRIORITY, realtime
from canprobe.fieldbus.eds.packaged import eds_file
from canprobe.fieldbus.protocol.frames import SYNC_ID
from canprobe.lab.studies.result import CHANNEL, measuring_facts

RATE_HZ = 400.0
MISSED_SYNCS, LATE_PERCENT = 250, 100
"""Limits in the scenes of the cases: neither a drop-out nor late cycles end a run at a rate that cannot be held."""
ON_VCAN: Mapping[str, Any] = {"bus.interface": "socketcan", "bus.channel": CHANNEL}
"""Changes that bring a scene to the interface."""
WIRE_BITRATE = 50_000_000
"""Bit rate of the plans at any rate: a virtual bus has none."""


Times = NDArray[np.int64]


def _nothing() -> Times:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class CycleTimes:
    """Times of the cycles of one run; empty arrays where a time was not measured.

    Attributes:
        period_ns: requested period of SYNC.
        lateness_ns: time of each SYNC behind its deadline (n,), ns.
        seconds: time from the first SYNC to the last.
        response_ns: time from the last TPDO to the RPDOs in every fifth cycle (m,), ns.
        compute_ns: that time and the controller's work after the RPDOs (m,), ns.
        latency_ns: time from each SYNC to the last of the drives' TPDOs that answer it (k,), ns.
        missed: number of TPDOs that did not come in their cycle.
        processor_share: processor time of the master's process over `seconds`; None where it cannot be measured.
    """

    period_ns: int
    lateness_ns: Times
    seconds: float
    response_ns: Times = field(default_factory=_nothing)
    compute_ns: Times = field(default_factory=_nothing)
    latency_ns: Times = field(default_factory=_nothing)
    missed: int = 0
    processor_share: float | None = None

    @property
    def overruns(self) -> int:
        """Number of cycles woken more than half a period late."""
        return int(np.count_nonzero(self.lateness_ns > self.period_ns // 2))

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.lateness_ns)

    @property
    def rate_hz(self) -> float:
        """Held rate, cycles per second."""
        return (self.cycles - 1) / self.seconds if self.seconds > 0 else 0.0


def answer_latencies(path: Path, feedback_ids: frozenset[int], period_ns: int) -> Times:
    """Measure the time from each SYNC of a candump log to the last of the TPDOs that answer it within a period.

    Args:
        path: path of the log.
        feedback_ids: COB-IDs of the TPDOs.
        period_ns: period of SYNC.

    Returns:
        One number for each SYNC that all of them answered (k,), ns, in whole microseconds.
    """
    syncs: list[int] = []
    arrivals: dict[int, list[int]] = {can_id: [] for can_id in feedback_ids}
    for t_ns, _, can_id, _ in read_candump(path):
        if can_id == SYNC_ID:
            syncs.append(t_ns)
        elif can_id in arrivals:
            arrivals[can_id].append(t_ns)
    if not syncs or not arrivals:
        return _nothing()
    begins = np.array(sorted(syncs), np.int64)
    last = np.full(len(begins), -1, np.int64)
    complete = np.ones(len(begins), bool)
    for times in arrivals.values():
        stamps = np.array([*sorted(times), np.iinfo(np.int64).max], np.int64)
        delays = stamps[np.searchsorted(stamps, begins)] - begins
        complete &= delays < period_ns
        last = np.maximum(last, delays)
    return last[complete]


@dataclass(frozen=True, slots=True)
class Measured:
    """A case and its times; `ended` is the reason of an early end."""

    case: str
    sensor: str
    rate_hz: float
    times: CycleTimes
    ended: str = ""


def measure_scan(seconds: float) -> Measured:
    """The scene `cylinder` with servo and estimator."""
    scene = _scene(seconds)
    return _measured("whole controller", scene, lambda session: make_task(session.plan))


def measure_bare(seconds: float) -> Measured:
    """A loop that wakes at every deadline and does nothing: the machine's own lateness."""
    clock, period_ns = MonotonicClock(), round(1e9 / RATE_HZ)
    with realtime(MASTER_PRIORITY, lambda _: None):  # the first case has reported missing permissions
        first_ns = clock.now_ns() + period_ns
        lateness = wake_lateness(clock, period_ns, round(seconds * RATE_HZ))
        times = CycleTimes(period_ns, np.array(lateness, np.int64), (clock.now_ns() - first_ns) * 1e-9)
    return Measured("bare clock", "none", RATE_HZ, times)


def measure_hold(mode: TactileModeName, rate_hz: float, seconds: float) -> Measured:
    """The joints hold their position, at any rate."""
    scene = holding_scene(mode, rate_hz)
    with served():
        return _measured("hold", scene, lambda _: Hold(int(seconds * rate_hz)))


def holding_scene(mode: TactileModeName, rate_hz: float) -> Scene:
    """Six drives and the sensor at half their rate; the session starts none of them."""
    scene = on_any_bitrate(with_real_nodes(_scene()), WIRE_BITRATE)
    assert scene.sensor is not None
    sensor = replace(scene.sensor, mode=mode, rate_hz=rate_hz / 2)
    return replace(scene, cycle=replace(scene.cycle, rate_hz=rate_hz), sensor=sensor)


def with_real_nodes(scene: Scene) -> Scene:
    """The scene whose arm and array are served by another process."""
    return load_scene(scene, {"arm.emulated": False, "sensor.emulated": False})


def _scene(seconds: float | None = None) -> Scene:
    """The scene `cylinder`, patient; with real-time priority and locked memory where they are permitted."""
    on_bus = {**ON_VCAN, "cycle.realtime": True}
    return patient(load_scene("cylinder", on_bus if seconds is None else {**on_bus, "task.duration_s": seconds}))


def patient(scene: Scene, missed_syncs: int = MISSED_SYNCS) -> Scene:
    """The scene with drives that tolerate missed SYNCs, and a master that no late cycles stop."""
    return load_scene(scene, {"arm.missed_syncs": missed_syncs, "limits.late_cycles_max_percent": float(LATE_PERCENT)})


def vcan_facts(quick: bool, runs: int, missed_syncs: int = MISSED_SYNCS) -> dict[str, Any]:
    """Machine, versions and settings of a study on the interface, whose cells are `patient`."""
    limits = {"missed_syncs": missed_syncs, "late_cycles_max_percent": LATE_PERCENT}
    return measuring_facts(quick, runs) | {"interface": CHANNEL, **limits}


class Hold(Controller):
    """Hold the joints at their first position, for some cycles or for ever."""

    def __init__(self, cycles: float = math.inf) -> None:
        self._cycles = cycles
        self._q: Any = None

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        if self._q is None:
            self._q = measurement.q
        self._cycles -= 1
        return Command(q_target=self._q, done=self._cycles <= 0)


@contextmanager
def served(child: EmulatorChild | None = None) -> Iterator[None]:
    """The nodes of `cylinder` in a child process; they take rates and mappings from the master."""
    scene = _scene()
    child = child or EmulatorChild(make_plan(resolve(scene)), None, (CHANNEL,))
    port = open_port("socketcan", CHANNEL, scene.bus.bitrate, MonotonicClock())
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
        session = Session(scene, RunOptions(Path(folder)))
        used_s = 0.0
        try:
            with session:
                used_s = process_time()
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
        seconds=seconds,
        response_ns=np.array(cycle.statistics.response_ns, np.int64),
        compute_ns=np.array(cycle.statistics.compute_ns, np.int64),
        latency_ns=answer_latencies(folder / "bus.log", cell.drives.feedback_ids, period_ns),
        missed=cell.drives.missed,
        processor_share=processor_share(used_s, seconds),
    )


def processor_share(used_before_s: float, passed_s: float) -> float | None:
    """Processor share since `process_time` gave `used_before_s`; None in a guest, which counts whole ticks."""
    if os.environ.get("CANPROBE_VCAN") == "guest" or passed_s <= 0:
        return None
    return (process_time() - used_before_s) / passed_s


def on_any_bitrate(scene: Scene, bitrate: int) -> Scene:
    """The scene with a bit rate (bit/s) that no CAN has, and copies of its EDS files that list no bit rates."""
    arm, sensor = scene.arm, scene.sensor
    if arm is not None:
        arm = replace(arm, eds=_eds_for_any_bitrate(arm.eds))
    if sensor is not None:
        sensor = replace(sensor, eds=_eds_for_any_bitrate(sensor.eds))
    return replace(scene, bus=replace(scene.bus, bitrate=bitrate), arm=arm, sensor=sensor)


@functools.cache
def _eds_for_any_bitrate(eds: str) -> str:
    folder = Path(tempfile.mkdtemp(prefix="canprobe-eds-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / eds_file(eds).name
    copy.write_bytes(re.sub(rb"(?m)^(BaudRate_\w+)=1", rb"\1=0", eds_file(eds).read_bytes()))
    return str(copy)
