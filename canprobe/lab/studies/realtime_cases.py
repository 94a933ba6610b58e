"""The cases of study `realtime`: one run each on a real SocketCAN interface, emulated nodes in their own process."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time
from typing import Any

import canopen
import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.planning.configuration import NodeSetup, make_setups
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene, TactileModeName
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.emulator_child import EmulatorChild
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.clock import Clock, MonotonicClock
from canprobe.fieldbus.bus.real.opening import open_port
from canprobe.fieldbus.bus.real.processor import MASTER_PRIORITY, realtime
from canprobe.fieldbus.protocol.frames import SYNC_ID
from canprobe.fieldbus.protocol.sync import SyncCounter
from canprobe.lab.studies.harness import CHANNEL
from canprobe.lab.studies.no_bus import on_any_bitrate

Times = NDArray[np.int64]


def _nothing() -> Times:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class CycleTimes:
    """Times of the cycles of one run; empty arrays where a time was not measured.

    Attributes:
        period_ns: of SYNC, as asked.
        lateness_ns: of each SYNC behind its deadline (n,), ns.
        seconds: from the first SYNC to the last.
        response_ns: from the last TPDO to the RPDOs, of every fifth cycle (m,), ns.
        compute_ns: the same with the controller's work after the RPDOs (m,), ns.
        latency_ns: from each SYNC to the last of the drives' TPDOs that answer it (k,), ns.
        missed: TPDOs that a cycle did without.
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
        """Cycles woken more than half a period late."""
        return int(np.count_nonzero(self.lateness_ns > self.period_ns // 2))

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.lateness_ns)

    @property
    def rate_hz(self) -> float:
        """Cycles per second that were held."""
        return (self.cycles - 1) / self.seconds if self.seconds > 0 else 0.0


def woken(clock: Clock, period_ns: int, cycles: int, lateness: list[int]) -> Iterator[int]:
    """Wake at so many deadlines, a period apart, and append the lateness of each (ns); missed ones are skipped.

    Yields:
        The deadline, ns, or the last one that has passed by then.
    """
    deadline_ns = clock.now_ns() + period_ns
    for _ in range(cycles):
        clock.sleep_until_ns(deadline_ns)
        lateness.append(clock.now_ns() - deadline_ns)
        deadline_ns += lateness[-1] // period_ns * period_ns
        yield deadline_ns
        deadline_ns += period_ns


def answer_latencies(path: Path, feedback_ids: frozenset[int], period_ns: int) -> Times:
    """From each SYNC of a candump log to the last of the TPDOs that answer it within a period.

    Args:
        path: of the log.
        feedback_ids: COB-IDs of the TPDOs.
        period_ns: of SYNC.

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


def processor_share(used_before_s: float, passed_s: float) -> float | None:
    """Processor share since `process_time` gave `used_before_s`; None in a guest, which counts whole ticks."""
    if os.environ.get("CANPROBE_VCAN") == "guest" or passed_s <= 0:
        return None
    return (process_time() - used_before_s) / passed_s


# The cases, one run each.

RATE_HZ = 400.0
MISSED_SYNCS, LATE_PERCENT = 250, 100
PATIENCE = {"missed_syncs": MISSED_SYNCS, "late_cycles_max_percent": LATE_PERCENT}
"""Of the cases' scenes: neither a drop-out nor late cycles end a run at a rate that cannot be held."""
WIRE_BITRATE = 50_000_000
"""Of the plans at any rate: a virtual bus has no bit rate."""


@dataclass(frozen=True, slots=True)
class Measured:
    """A case and its times; `ended`: why it ended early."""

    case: str
    sensor: str
    rate_hz: float
    times: CycleTimes
    ended: str = ""


def measure_scan(seconds: float) -> Measured:
    """The scene `cylinder` with servo and estimator."""
    scene = _scene(seconds)
    return _measured("whole controller", scene, lambda session: make_task(session.plan))


def measure_plain(seconds: float) -> Measured:
    """The cycle of `run_plain` with the same nodes."""
    plan = make_plan(resolve(holding_scene("window", RATE_HZ)))
    with served(), realtime(MASTER_PRIORITY, _unheard):
        return Measured("plain canopen", "window", RATE_HZ, run_plain(plan, seconds))


def measure_bare(seconds: float) -> Measured:
    """A loop that wakes at every deadline and does nothing: the machine's own lateness."""
    period_ns, lateness = round(1e9 / RATE_HZ), list[int]()
    with realtime(MASTER_PRIORITY, _unheard):
        deadlines = list(woken(MonotonicClock(), period_ns, round(seconds * RATE_HZ), lateness))
    times = CycleTimes(period_ns, np.array(lateness, np.int64), (deadlines[-1] - deadlines[0]) * 1e-9)
    return Measured("bare clock", "none", RATE_HZ, times)


def measure_hold(mode: TactileModeName, rate_hz: float, seconds: float) -> Measured:
    """The joints hold their position, at any rate."""
    scene = holding_scene(mode, rate_hz)
    with served():
        return _measured("hold", scene, lambda _: Hold(int(seconds * rate_hz)))


def holding_scene(mode: TactileModeName, rate_hz: float) -> Scene:
    """Six drives and the sensor at half their rate; the session starts none of them."""
    scene = on_any_bitrate(_scene(), WIRE_BITRATE)
    real = with_real_nodes(replace(scene, cycle=replace(scene.cycle, rate_hz=rate_hz)))
    assert real.sensor is not None
    return replace(real, sensor=replace(real.sensor, mode=mode, rate_hz=rate_hz / 2))


def with_real_nodes(scene: Scene) -> Scene:
    """The scene with arm and sensor in another process."""
    assert scene.arm is not None and scene.sensor is not None
    arm, sensor = replace(scene.arm, emulated=False), replace(scene.sensor, emulated=False)
    return replace(scene, arm=arm, sensor=sensor)


def _scene(seconds: float | None = None) -> Scene:
    """The scene `cylinder`, patient; with real-time priority and locked memory where they are permitted."""
    on_bus = {"bus.interface": "socketcan", "bus.channel": CHANNEL, "cycle.realtime": True}
    return patient(load_scene("cylinder", on_bus if seconds is None else {**on_bus, "task.duration_s": seconds}))


def patient(scene: Scene, missed_syncs: int = MISSED_SYNCS) -> Scene:
    """The scene with drives that tolerate missed SYNCs, and a master that no late cycles stop."""
    assert scene.arm is not None
    limits = replace(scene.limits, late_cycles_max_percent=LATE_PERCENT)
    return replace(scene, arm=replace(scene.arm, missed_syncs=missed_syncs), limits=limits)


def _unheard(_: str) -> None:
    """Drop what is not permitted: the first case has reported it."""


class Hold(Controller):
    """Hold the joints at their first position for some cycles."""

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
        session = Session(scene, Path(folder))
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


# The same cycle written with plain canopen-python: its Network, its threads, its PDO objects. A reference only.
#
# SYNC, wait for six TPDOs, read statusword, position and torque, write the targets, transmit six RPDOs; read the
# sensor's PDOs. Nothing is computed: the targets are the first positions.

_ENABLING = (6, 7, 15)
_CYCLES_A_STEP = 20
_WAIT_SHARE = 0.6
"""Longest wait for TPDOs over the period, as in canprobe's cycle."""


def run_plain(plan: Plan, seconds: float) -> CycleTimes:
    """Bring the nodes of a plan with drives 1–6 up, run the cycle for some time, stop them."""
    network = canopen.Network()
    network.connect(interface="socketcan", channel=CHANNEL)
    try:
        nodes = [_configured(network, setup) for setup in make_setups(plan)]
        with _operational(network):
            cycle = _PlainCycle(network, plan, nodes)
            for word in _ENABLING:
                cycle.run(word, _CYCLES_A_STEP)
            return cycle.times(seconds)
    finally:
        network.disconnect()


def _configured(network: canopen.Network, setup: NodeSetup) -> Any:
    node: Any = network.add_node(setup.node_id, setup.dictionary)
    for write in setup.writes:
        variable = setup.dictionary.get_variable(write.index, write.subindex)
        assert variable is not None
        node.sdo.download(write.index, write.subindex, variable.encode_raw(write.value))
    node.tpdo.read()
    node.rpdo.read()
    return node


@contextmanager
def _operational(network: canopen.Network) -> Iterator[None]:
    network.nmt.send_command(1)
    try:
        yield
    finally:
        network.nmt.send_command(0x80)


class _PlainCycle:
    def __init__(self, network: canopen.Network, plan: Plan, nodes: Sequence[Any]) -> None:
        drive_ids = {node.node_id for node in plan.nodes if node.kind == "drive"}
        self._network, self._plan = network, plan
        self._drives = [node for node in nodes if node.id in drive_ids]
        self._maps = [m for node in nodes if node.id not in drive_ids for m in node.tpdo.values() if m.enabled]
        self._sync = SyncCounter(plan.sync.overflow)
        self._held: dict[int, int] = {}
        self.missed = 0
        self._clock = MonotonicClock()

    def run(self, word: int, cycles: int) -> list[int]:
        """Run some cycles; returns the lateness of each SYNC, ns."""
        period_ns = self._plan.sync.period_ns
        lateness: list[int] = []
        for deadline_ns in woken(self._clock, period_ns, cycles, lateness):
            self._once(word, deadline_ns + int(_WAIT_SHARE * period_ns))
        return lateness

    def _once(self, word: int, until_ns: int) -> None:
        maps = [drive.tpdo[1] for drive in self._drives]
        for tpdo in maps:
            tpdo.is_received = False
        self._network.sync.transmit(self._sync.next())
        for tpdo in maps:
            with tpdo.receive_condition:
                while not tpdo.is_received and (left_ns := until_ns - self._clock.now_ns()) > 0:
                    tpdo.receive_condition.wait(left_ns * 1e-9)
            self.missed += not tpdo.is_received
        for drive, tpdo in zip(self._drives, maps, strict=True):
            _, position, *_ = [variable.raw for variable in tpdo]
            self._held.setdefault(drive.id, position)
            controlword, target = list(drive.rpdo[1])
            controlword.raw = word
            target.raw = self._held[drive.id]
            drive.rpdo[1].transmit()
        for tpdo in self._maps:
            for variable in tpdo:
                _ = variable.raw

    def times(self, seconds: float) -> CycleTimes:
        """Run the cycle for some time."""
        period_ns, clock = self._plan.sync.period_ns, self._clock
        self.missed = 0
        begin_ns, used_s = clock.now_ns(), process_time()
        lateness: list[int] = []
        while (left_ns := seconds * 1e9 - (clock.now_ns() - begin_ns)) > 0:
            lateness += self.run(_ENABLING[-1], min(200, int(left_ns / period_ns) + 1))
        passed_s = (clock.now_ns() - begin_ns) * 1e-9
        late, share = np.array(lateness, np.int64), processor_share(used_s, passed_s)
        return CycleTimes(period_ns, late, passed_s, missed=self.missed, processor_share=share)
