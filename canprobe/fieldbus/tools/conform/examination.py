"""An examination: every point in its turn, what it wrote put back after it, its verdict in the report.

    hear the bus → read the device → snapshot → look whether it reaches operational
    → for each point: 6041h, run, put back, 6041h, EMCY → put all of it back

It goes on after a point that fails. It ends where the power stage is on without permission, where the device no longer
answers, and where the bus is gone; whatever ends it, an exception and Ctrl-C too, what was written is put back first.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from canprobe.errors import CanprobeError, NodeError
from canprobe.fieldbus.bus.clock import wake_lateness
from canprobe.fieldbus.bus.port import ControllerState, Port, nothing, stamps_text
from canprobe.fieldbus.bus.real.interrupts import interrupts_held
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.protocol.cia402 import CONTROLWORD, POWERED_STATES, describe_state, known_state
from canprobe.fieldbus.protocol.emcy import SYNC_LOST_CODE, describe
from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState
from canprobe.fieldbus.protocol.pdo import RPDOS
from canprobe.fieldbus.tools.conform import outcome
from canprobe.fieldbus.tools.conform.device import ExaminedDevice
from canprobe.fieldbus.tools.conform.frame_link import BenchTimes
from canprobe.fieldbus.tools.conform.frame_text import frame_text
from canprobe.fieldbus.tools.conform.journal import Journal, restorable
from canprobe.fieldbus.tools.conform.pdo_bench import PdoBench
from canprobe.fieldbus.tools.conform.permits import Permits, WriteList, is_object
from canprobe.fieldbus.tools.conform.point import Point
from canprobe.fieldbus.tools.conform.registry import LEFT_OUT, POINTS
from canprobe.fieldbus.tools.conform.sdo_client import READ_TYPE, SdoRefused
from canprobe.fieldbus.tools.conform.surroundings import hear
from canprobe.fieldbus.tools.reports import Report, ReportRow, Verdict

_BACK_ON_BUS_S = 5.0
_STATE_READS = 10
STAMP_NS = 10_000_000
"""Largest delay of a stamp for points on times, a half of what they allow the machine."""
_WAY_OUT = "type: canprobe conform --restore {path} --node {node_id}"


@dataclass(frozen=True, slots=True)
class ExaminationSettings:
    """Settings of an examination.

    Attributes:
        written: what the user permits to be written.
        motion: whether the power stage of a drive may be switched on.
        snapshot: file of the snapshot; None: it is kept in memory.
        keep_snapshot: whether that file stays when all is put back.
        listen_s: time in which the bus is heard first, s.
        times: how long the bench waits.
        bitrate: bit rate of the bus, bit/s, for the background load.
        fd: whether the bus carries CAN FD frames.
        ask: function that asks a person to do something by hand, and returns whether it was done; None: nobody is
            there.
    """

    written: WriteList = field(default_factory=WriteList)
    motion: bool = False
    snapshot: Path | None = None
    keep_snapshot: bool = False
    listen_s: float = 1.0
    times: BenchTimes = field(default_factory=BenchTimes)
    bitrate: int = 1_000_000
    fd: bool = False
    ask: Callable[[str], bool] | None = None


class Examination:
    """An examination of one device.

    Args:
        port: connection to the bus; it is not closed.
        node_id: id of the device.
        description: statements of its EDS; None without one.
        settings: settings.

    Attributes:
        report: the report so far.
        bench: the bench; it is there once the bus was heard.
        journal: the snapshot; it is there once the device was read.
    """

    bench: PdoBench
    journal: Journal

    def __init__(
        self,
        port: Port,
        node_id: int,
        description: Description | None = None,
        settings: ExaminationSettings | None = None,
    ) -> None:
        self.settings = settings or ExaminationSettings()
        self.report = Report("conform", f"node {node_id} on {port.channel}")
        self._port, self._node_id, self._description = port, node_id, description
        self._boots = 0
        self._late_ns = 0  # of a stamp
        self._ended = ""

    def run(
        self, points: Sequence[Point] = POINTS, on_row: Callable[[ReportRow, int, int], object] = nothing
    ) -> Report:
        """Examine the device.

        Args:
            points: the points.
            on_row: function that is called with each row, its number, and the number of all.

        Raises:
            NodeError: the device does not answer.
            BenchFailure: something else ended the examination, and what was written could not be put back.
        """
        self._meet()
        try:
            self._begin()
            for number, point in enumerate(points, start=1):
                row = self._examine(point)
                self.report.rows.append(row)
                on_row(row, number, len(points))
        except BaseException:
            with interrupts_held():
                self._leave()
            raise
        with interrupts_held():
            try:
                self._leave()
            except outcome.BenchFailure as error:
                self.report.rows.append(ReportRow("bench", "put back", Verdict.ERROR, detail=str(error)))
        self.report.left_out += LEFT_OUT if set(points) >= set(POINTS) else ()
        self.report.distributions.update(self.bench.distributions)
        return self.report

    def _meet(self) -> None:
        """Hear the bus, read the device, and make the snapshot."""
        settings = self.settings
        surroundings = hear(self._port, self._node_id, settings.listen_s)
        if surroundings.master.endswith(f" {self._node_id}"):
            raise NodeError(
                self._node_id, "another master talks to it over SDO; two clients on one channel disturb each other"
            )
        written = settings.written.with_motion() if settings.motion else settings.written
        permits = Permits(self._node_id, surroundings, written)
        device = ExaminedDevice(self._node_id, self._description)
        self.bench = bench = PdoBench(self._port, device, permits, settings.times)
        bench.bitrate, bench.fd, bench.by_hand = settings.bitrate, settings.fd, self._by_hand
        try:
            bench.first_answer = bench.ask(READ_TYPE)
        except CanprobeError as error:
            raise NodeError(self._node_id, f"it cannot be examined: {error}") from error
        device.read_all(bench, written)
        permitted = [p for p in device.values if written.permits(p) and not is_object(p[0], CONTROLWORD)]
        values, temporary = restorable(device.values, permitted), not settings.keep_snapshot
        self.journal = Journal(values, settings.snapshot, device.identity, temporary=temporary)
        permits.values, bench.noted = device.values, self.journal.note
        permits.rpdo_ids = set(device.valid_pdos(RPDOS))
        if (emcy_id := device.number(0x1014)) and not emcy_id >> 31:
            bench.emcy_id = emcy_id & 0x7FF
        self._boots = bench.boots
        facts = device.facts()
        self.report.title = f"{facts.get('device name', 'device')}, node {self._node_id} on {self._port.channel}"
        history = [f"{device.number(0x1003, n):08X}h" for n in range(1, device.number(0x1003) + 1)]
        self.report.facts.update(facts)
        self.report.facts["error history (1003h) before"] = ", ".join(history) or "empty"
        if not self._port.stamps_arrival:
            self._late_ns = wake_lateness(self._port.clock, 2_000_000, 100)[-1]
        self.report.facts["frames are stamped"] = stamps_text(self._port, self._late_ns)
        self.report.facts["bus"] = f"{self._port.channel}, beside the device: {surroundings.text()}"
        if surroundings.lacks("nmt") and device.has(0x1017):
            self.report.facts["warning"] = "another master may watch the heartbeat of the device, which points change"

    def _begin(self) -> None:
        """Bring the device to pre-operational, unless its power stage is on: an axis may hang on it."""
        try:
            self._check_power()
        except outcome.BenchFailure as error:
            self._ended = f"not examined: {error}"
            return
        self._put_back()
        if not self.bench.permits.surroundings.lacks("nmt"):
            with contextlib.suppress(CanprobeError):  # a device that fails here fails the points that are about it
                self._look_for_standing_errors()
            with contextlib.suppress(CanprobeError):
                self._put_back()

    def _look_for_standing_errors(self) -> None:
        """Find the errors that the device has already, and whether they keep it out of operational.

        An error that stays would otherwise fail every point that needs operational, and each for another reason.
        """
        bench = self.bench
        state: int | None = None
        with contextlib.suppress(outcome.Deviation, outcome.PointNotApplicable):
            bench.watch_state()
            bench.nmt(NmtCommand.START)
            bench.pass_time(bench.times.silence_s)
            for _ in range(_STATE_READS):  # on a slow bus a heartbeat from before may have waited in a queue
                if (state := bench.state()) == NmtState.OPERATIONAL:
                    break
        found = {emcy.code for emcy in bench.errors()}
        ended = len(bench.emergencies) > len(bench.errors())
        bench.emergencies.clear()
        register = bench.number(0x1001)
        if register and (newest := bench.device.number(0x1003, 1) & 0xFFFF):
            found.add(newest)
        errors = ", ".join(f"EMCY {code:04X}h ({describe(code)})" for code in sorted(found))
        if register and not ended:  # it stays; one that comes and goes is none that stands
            bench.standing = found
            self.report.facts["error before the first point"] = errors or f"1001h is {register:02X}h"
        if state in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED):
            cause = errors or f"1001h is {register:02X}h, and no EMCY came"
            bench.kept_out = f"NMT start leads to state {state:02X}h; {cause}"
            self.report.facts["warning"] = bench.kept_out

    def _examine(self, point: Point) -> ReportRow:
        """One point: run it, put back what it wrote, look for what it left behind."""
        if self._ended:
            return _row(point, Verdict.ERROR, self._ended)
        if why := self._lacks(point):
            return _row(point, Verdict.NOT_APPLICABLE, why)
        bench, began_ns = self.bench, self.bench.now_ns
        verdict, detail = self._run(point)
        sent = tuple(frame_text(*frame, self._node_id) for frame in bench.sent)
        came = tuple(frame_text(*frame, self._node_id) for frame in bench.came)
        written: list[str] = []
        if not self._ended:
            try:
                with interrupts_held():
                    written = self._put_back()
                self._check_power()
                unasked = bench.unasked()
                if unasked and verdict in (Verdict.PASS, Verdict.NOT_APPLICABLE):
                    code = unasked[0].code
                    verdict, detail = Verdict.FAIL, f"EMCY {code:04X}h ({describe(code)}) that nobody asked for"
            except CanprobeError as error:
                fails = verdict is Verdict.FAIL and not self._ended
                verdict, detail = (verdict, f"{detail}; then {error}") if fails else (Verdict.ERROR, str(error))
        if verdict is Verdict.PASS:
            detail = "; ".join(bench.notes)
        seconds = (bench.now_ns - began_ns) * 1e-9
        return _row(point, verdict, detail, sent=sent, came=came, written=tuple(written), seconds=seconds)

    def _run(self, point: Point) -> tuple[Verdict, str]:
        """Run a point; its verdict, and why."""
        self.bench.notes.clear()
        try:
            self._prepare()
            point.run(self.bench)
        except outcome.PointNotApplicable as error:
            if isinstance(error, outcome.NotPermitted):
                self.report.left_out.append((f"{point.group} {point.title}", str(error)))
            return Verdict.NOT_APPLICABLE, str(error)
        except (outcome.Deviation, SdoRefused) as error:
            return Verdict.FAIL, str(error)
        except CanprobeError as error:
            return Verdict.ERROR, str(error)
        return Verdict.PASS, ""

    def _by_hand(self, step: str) -> bool:
        """Let a person do something, and let the report list it."""
        done = self.settings.ask is not None and self.settings.ask(step)
        self.report.manual.append(f"{step}: {'done' if done else 'not done, as nobody confirmed it'}")
        return done

    def _lacks(self, point: Point) -> str:
        """Why a point does not apply; empty where it does."""
        if "eds" in point.needs and self._description is None:
            return "no EDS was given; --eds FILE names it"
        if "drive" in point.needs and not self.bench.device.is_drive:
            return "the device is no CiA 402 drive"
        if "stamps" in point.needs and self._late_ns > STAMP_NS:
            return f"its stamps may be {STAMP_NS * 1e-6:.0f} ms late, and are up to {self._late_ns * 1e-6:.1f} ms here"
        if "motion" in point.needs and not self.settings.motion:
            return "it switches the power stage on; --motion permits it"
        for need in ("nmt", "sync", "alone"):
            if need in point.needs and (why := self.bench.permits.surroundings.lacks(need)):
                self.report.left_out.append((f"{point.group} {point.title}", why))
                return why
        return ""

    def _prepare(self) -> None:
        """See that the device answers and that its power stage is off."""
        bench = self.bench
        self._await_bus()
        # a device that watches SYNC and gets none may say so between any two points
        bench.asked = {SYNC_LOST_CODE} if bench.device.number(0x1006) else set()
        bench.forget()
        bench.emergencies.clear()
        try:
            bench.ask(READ_TYPE)
        except CanprobeError as error:
            raise outcome.BenchFailure(f"the device does not answer before the point begins: {error}") from error
        self._check_power()
        bench.forget()

    def _await_bus(self) -> None:
        """Wait while the controller of this machine is bus off, as long as may help."""
        until_ns = self.bench.now_ns + round(_BACK_ON_BUS_S * 1e9)
        while self._port.state is ControllerState.BUS_OFF and self.bench.now_ns < until_ns:
            self._port.wait(self.bench.now_ns + 100_000_000)
            self._port.drain()

    def _check_power(self) -> None:
        """Check that the power stage of each axis is off.

        Raises:
            BenchFailure: it cannot be read.
            PowerStageOn: one is on; the examination has ended.
        """
        for index in self.bench.device.statuswords:
            try:
                word = self.bench.number(index)
            except outcome.Deviation as error:
                raise outcome.BenchFailure(f"{index:04X}h cannot be read: {error}") from error
            if known_state(word) in POWERED_STATES:
                why = f"the power stage is on: the drive is {describe_state(word)} ({index:04X}h)"
                self._ended = f"not examined: {why}"
                raise outcome.PowerStageOn(why)

    def _put_back(self) -> list[str]:
        """Put back what the point wrote, and all of it where the device booted; it is pre-operational afterwards."""
        bench = self.bench
        self._await_bus()
        bench.load = None
        bench.permits.harmless.clear()
        commanded = not bench.permits.surroundings.lacks("nmt")
        if commanded:
            bench.settle(NmtState.PRE_OPERATIONAL)
        try:
            written = self.journal.restore(bench, all_of_it=bench.boots != self._boots)
        except outcome.BenchFailure as error:
            if not commanded:
                raise
            try:  # a device may have values at power on that it does not take back
                bench.reset()
            except outcome.Deviation:
                raise error from None
            written = self.journal.restore(bench, all_of_it=True)
        if commanded and bench.asked and bench.number(0x1001) & ~bench.device.number(0x1001):
            bench.reset()  # an error that was provoked and stays would fail the points that follow
            written += self.journal.restore(bench, all_of_it=True)
        self._boots = bench.boots
        return written

    def _leave(self) -> None:
        """Put back everything, and bring the device into the state that it had; nothing is sent to an axis with power.

        Raises:
            BenchFailure: something was not restored; the message says what to type.
        """
        bench, surroundings = self.bench, self.bench.permits.surroundings
        if self._ended and not self.journal.touched:
            return
        bench.kept_out = ""
        try:
            self._check_power()
            self._put_back()
            self.journal.close()
            if surroundings.states.get(self._node_id) == NmtState.OPERATIONAL and not surroundings.lacks("nmt"):
                bench.settle(NmtState.OPERATIONAL)
        except CanprobeError as error:
            path = self.journal.path
            way = "" if path is None else "; " + _WAY_OUT.format(path=path, node_id=self._node_id)
            raise outcome.BenchFailure(f"node {self._node_id}: not everything was put back: {error}{way}") from error


def _row(point: Point, verdict: Verdict, detail: str, **more: Any) -> ReportRow:
    failed = verdict is Verdict.FAIL
    more |= {"clause": point.clause, "expected": point.expected}
    more |= {"hint": point.hint, "severity": "wrong"} if failed else {}
    return ReportRow(point.group, point.title, verdict, detail=detail, **more)


def restore_snapshot(port: Port, node_id: int, path: Path, times: BenchTimes | None = None) -> list[str]:
    """Put back what a snapshot holds, as after an examination that was cut off.

    Raises:
        UsageError: the file is no snapshot.
        NodeError: the device does not answer, is another one, or its power stage is on.
        BenchFailure: something was not restored.
    """
    journal = Journal.load(path)
    examination = Examination(port, node_id, settings=ExaminationSettings(times=times or BenchTimes()))
    examination._meet()
    bench, identity = examination.bench, examination.bench.device.identity
    if identity != journal.identity:
        raise NodeError(node_id, f"it is {identity} (1018h), the snapshot is of {journal.identity}")
    try:
        examination._check_power()
    except outcome.PowerStageOn as error:
        raise NodeError(node_id, str(error)) from error
    bench.permits.values = journal.values
    bench.permits.written = WriteList(places=frozenset(journal.values))
    if not bench.permits.surroundings.lacks("nmt"):
        bench.settle(NmtState.PRE_OPERATIONAL)
    return journal.restore(bench, all_of_it=True)
