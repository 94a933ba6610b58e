"""The cell: bring-up, cycles under supervision, and a stop that disables the drives on every way out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from canprobe.cell.master.array import ArrayReceiver, RawReceiver, make_patch_reader, make_tactile
from canprobe.cell.master.as_found import FoundNodes
from canprobe.cell.master.bringup import BringUp
from canprobe.cell.master.controller import (
    Command,
    Controller,
    Measurement,
    SampleReader,
    TactileSample,
    as_controller,
    check_command,
)
from canprobe.cell.master.cycle import Cycle
from canprobe.cell.master.drives import make_drives
from canprobe.cell.master.held_arm import HeldArm
from canprobe.cell.master.homing import Homing
from canprobe.cell.master.joint_columns import joint_columns
from canprobe.cell.master.lift_off import LiftOff
from canprobe.cell.master.log import RunLog
from canprobe.cell.master.notes import Notes
from canprobe.cell.master.observers import Observers
from canprobe.cell.master.options import DEFAULT_OPTIONS, RunOptions
from canprobe.cell.master.push_witness import PushWitness
from canprobe.cell.master.raw_array_start import RawArrayStart
from canprobe.cell.master.supervision import Condition, Finding, Reaction, Seen, limits_of
from canprobe.cell.master.supervisor import JointGuard, Supervisor
from canprobe.cell.master.tactile_log import TactileLog
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.configuration import make_setups
from canprobe.cell.planning.model import Plan
from canprobe.errors import BusError, CanprobeError, NodeError, SafetyStop, UsageError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.port import Port, PortCounters, TimedFrame
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.real.interrupts import Interrupts
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, DriveState
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE
from canprobe.mechanics.touch import Patch

Result = TypeVar("Result")

WARM_UP_S = 0.1
"""Time of cycles before the drives are enabled, s, until both sides run at their usual speed."""
REST_TIMEOUT_S = 2.0
TARE_S = 0.3
"""Time in which an array takes the images of a tare, s."""
SILENT_TAXELS = (
    ": interpolated; have the array repaired, or state the taxels as `dead` in [taxels] of its calibration file"
)
OWN_COLUMNS = frozenset({"t_s", "q_rad", "q_m", "statusword", "torque_permille", "q_target_rad", "q_target_m"})
"""Columns of the cell in the log; a controller's `Command.columns` have other names."""
STUCK_NS = 1_000_000_000
"""Time in a cycle after which an interrupt does not wait for its end."""


class Cell:
    """One cell on one bus. A context manager: entering brings the nodes up, leaving stops them safely.

    Args:
        plan: plan of the scene.
        port: port of the bus; it is closed on leaving.
        options: options of the run.
        observers: called after each cycle.
        log_failure: returns why frames are no longer written into the log, None while they are.
        direct: makes a cycle without a bus, with the arguments of `Cycle`, and starts its nodes; None: the nodes are
            brought up and reached over the port.
        origin_ns: time on the port's clock from which the run counts, as ``bus.log`` does.
        zeros: file that records the zeros of real drives that are homed.
        before: stopped cell of the same run, whose log, notes, counters and time this one continues.

    Attributes:
        drives, tactile: drives of the arm, and receiver of the array; None in a scene without one.
        log: one row for each cycle.
        tactile_log: one row for each tactile frame, on the same clock.
        notes: faults that did not stop the cell.
        watch: states and errors that the nodes report.
        supervisor: the checks, from bring-up on.
        cycle: None before bring-up is done.
        homing: homing of the drives without an absolute encoder; None where there are none.
        bring_up: the steps of bring-up.
        found: the nodes as a check found them; None of another cell.
        stopped_by: condition that stopped the cell; None where something else did.
        doubted: nodes that may have been without power, so that a drive has to be homed; set before entering.
    """

    def __init__(
        self,
        plan: Plan,
        port: Port,
        options: RunOptions = DEFAULT_OPTIONS,
        *,
        observers: Observers | None = None,
        log_failure: Callable[[], str | None] = lambda: None,
        direct: Callable[..., Cycle] | None = None,
        origin_ns: int = 0,
        zeros: Path | None = None,
        before: Cell | None = None,
    ) -> None:
        setup = plan.setup
        rows = options.rows_folder
        self.log: RunLog = RunLog(options.rows_kept, rows) if before is None else before.log
        self.tactile_log: TactileLog = TactileLog(options.rows_kept, rows) if before is None else before.tactile_log
        self.drives = make_drives(plan)
        self.tactile: ArrayReceiver | None = make_tactile(plan) if before is None else before.tactile
        self.notes: Notes = Notes() if before is None else before.notes
        self.watch = NodeWatch(plan.node_ids)
        self.cycle: Cycle | None = None
        guard = JointGuard(plan) if setup.arm is not None else None
        seen = Seen(limits_of(plan), self.watch, self.drives, self.tactile, port.counters)
        self._reader: SampleReader | None = make_patch_reader(setup)
        touches = guard is not None and self._reader is not None
        push = PushWitness(guard.model, guard.T_flange_tip, setup.limits.force_max) if guard and touches else None
        self.supervisor = Supervisor(seen, guard, self._patch if touches else None, push)
        slides = setup.arm.model.chain.prismatic if setup.arm is not None else ()
        self._slides = np.array(slides, dtype=bool) if any(slides) else None
        self._plan = plan
        self._port = port
        self._options = options
        self._observers = observers
        self._log_failure = log_failure
        self._origin_ns = origin_ns
        self._network = PumpedNetwork(port, other=self._other)
        self._make_cycle = direct or Cycle
        setups = make_setups(plan) if direct is None else ()  # without setups, bring-up only takes its time
        settings, check = setup.bring_up, options.to_check
        if check:  # nothing is commanded or stored, such as a tare
            setups = tuple(replace(one, writes=tuple(w for w in one.writes if w.read_back)) for one in setups)
            settings = replace(settings, store=False)
        self.bring_up = BringUp(
            self._network, self.watch, setups, settings, self._say, listened=before is not None, resets=not check
        )
        self.found = FoundNodes(self._network, self.watch, setups, settings) if check else None
        self.stopped_by: Condition | None = None
        self.doubted: frozenset[int] = frozenset()
        self._stopped = False
        self._recorded = seen.measurement
        self._before = before
        self._raw_array = (
            RawArrayStart(self.tactile, self._network, setup.bring_up.boot_up_s, self._say)
            if isinstance(self.tactile, RawReceiver)
            else None
        )
        homed = any(one.homing for one in setups)
        besides: dict[str, Any] = {"supervise": self._supervise_homing, "record": zeros, "say": self._say}
        self.homing = Homing(plan, setups, self._network, self.watch, **besides) if homed else None
        self._holding = False
        self._held = HeldArm()
        self._running = False
        self._retreats_for: CanprobeError | None = None
        self._controller = Controller()
        self._remarks_noted = 0
        for node_id in self.watch.node_ids:
            for base in (HEARTBEAT_BASE, EMCY_BASE):
                self._network.subscribe(base + node_id, self.watch.push)
        if before is not None:
            self._count_on(before)

    def _count_on(self, before: Cell) -> None:
        """Continue the counters of the cell before."""
        if self.drives is not None and before.drives is not None:
            for name in ("late", "missed", "malformed", "implausible"):
                setattr(self.drives, name, getattr(before.drives, name))
        self.watch.communication = before.watch.communication
        seen, earlier = self.supervisor, before.supervisor
        seen.counts, seen.first, seen.seen.overruns = earlier.counts, earlier.first, earlier.seen.overruns

    @property
    def start_ns(self) -> int:
        """Deadline of the first cycle on the run's clock; 0 where there was no cycle."""
        return self.cycle.t_first_ns - self._origin_ns if self.cycle is not None else 0

    @property
    def faults(self) -> list[str]:
        """The faults, one line for each kind."""
        return self.notes.lines()

    @property
    def counters(self) -> PortCounters:
        """Counters of the cell's port."""
        return self._port.counters

    def _say(self, text: str) -> None:
        """Report a step to the user; a failure of the report must not stop the drives."""
        try:
            self._options.say(text)
        except Exception as error:
            self.notes.add(f"steps could not be reported: {type(error).__name__}")

    def _other(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take a frame that arrived during bring-up and has no subscriber."""
        if self.tactile is not None and can_id in self.tactile.cob_ids:
            self.tactile.push(can_id, data, t_ns)
        else:
            self.watch.push(can_id, data, t_ns)

    def listen(self) -> None:
        """Listen for another master, before anything is started for this cell; nothing is sent.

        Raises:
            BusError: when there is one.
        """
        self.bring_up.listen()

    def hear(self, frames: Iterable[TimedFrame]) -> None:
        """Take frames that arrived before bring-up, while another reader waited on the port."""
        for frame in frames:
            self.watch.push(*frame)

    def __enter__(self) -> Cell:
        try:
            if self.found is not None:
                self.bring_up.listen()
                self.found.look()
            self.bring_up.run()
            if self._raw_array is not None:
                self._raw_array.start()
            self.cycle = self._make_cycle(
                self._port,
                self._plan,
                drives=self.drives,
                tactile=self.tactile,
                watch=self.watch,
                other=self._network.feed,
                on_arrival=not isinstance(self._port.clock, VirtualClock),
                kept=self._options.rows_kept,
                **({} if self._before is None else {"before": self._before.cycle}),
            )
            if self._before is not None and self.tactile is not None:
                self.tactile.newest_cycle = self.cycle.number  # its age counts from the first SYNC of this cell
            self._before = None
            self.log.start_s = self.start_ns * 1e-9
            self.watch.start(self._port.clock.now_ns())
            if self.homing is not None:
                self.homing.look()
                self.homing.doubt(self.doubted)
                if not self._options.to_home:
                    self.homing.refuse_unhomed()
        except BaseException as error:
            self.stop()
            if not self._options.recover:
                self.close()
            self._name_another_master(error)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
        if error is not None:
            self._name_another_master(error)

    def run(
        self,
        controller: Controller | Callable[[Measurement], Command],
        progress: Callable[[Measurement], None] = lambda _: None,
    ) -> None:
        """Enable the drives, then run ``controller`` until it says done.

        Args:
            controller: a `Controller`, or a function of the measurement that returns a command.
            progress: called after each cycle.

        Raises:
            UsageError: when it is no controller, it returned no `Command`, or another one is running.
            SafetyStop: when the controller or the supervision stopped the cell.
            ResultsError: when frames can no longer be written into the log.
            NodeError: when a node was lost or failed.
            InterfaceError: when the bus was lost.
        """
        self.start(controller)
        self.advance(None, progress)

    def start(self, controller: Controller | Callable[[Measurement], Command]) -> None:
        """The first half of `run`: enable the drives for a controller, which `advance` then runs."""
        runs = as_controller(controller)
        with self._one_at_a_time(), self._naming_another_master():
            self._controller, self._retreats_for, self._remarks_noted = runs, None, 0
            self.stopped_by, self._held = None, HeldArm()
            if runs.reader is not None:
                self._note_silent_taxels()
                self._reader = runs.reader
            self._enable()

    def advance(self, cycles: int | None, progress: Callable[[Measurement], None] = lambda _: None) -> bool:
        """The second half of `run`, in pieces: nothing happens between two calls, and virtual time stands still.

        On a real bus the drives stop by themselves where the next call does not come within a cycle.

        Args:
            cycles: most cycles to run; None: until the controller is done.
            progress: called after each cycle.

        Returns:
            Whether the controller is done.
        """
        with self._one_at_a_time(), self._naming_another_master(), Interrupts(self._stuck) as interrupts:
            for _ in repeat(None) if cycles is None else range(cycles):
                if self._run_cycle(interrupts, progress):
                    return True
        return False

    def tare(self) -> None:
        """Take what the array shows for zero.

        Raises:
            UsageError: it cannot be tared.
            SdoError, BusError: it does not answer, or another master has come.
        """
        if isinstance(self.tactile, RawReceiver):
            self.tactile.tare()
        elif (array := self._plan.setup.array) is None:
            raise UsageError("tare: expected a cell with an array; got one without")
        else:
            with self.bring_up.tares(array.node_id) as writes:
                while writes.waiting:
                    self.idle(self._one_cycle_s)
                    writes.serve()
        self.idle(TARE_S)

    def idle(self, seconds: float) -> Measurement:
        """Cycle with disabled drives and without a controller; nothing is supervised, and no row is kept.

        Returns:
            The measurement of the last cycle.

        Raises:
            BusError: another master has come.
        """
        assert self.cycle is not None
        if self.drives is not None:
            self.drives.goal = DriveState.SWITCH_ON_DISABLED
        for _ in range(max(1, round(seconds * 1e9 / self._plan.sync.period_ns))):
            self._recorded = self._begin_cycle()
            self._look(self._recorded)
            self.cycle.end(None)
            self.cycle.count_work()
            if self.watch.another_master is not None:
                raise BusError(self.watch.another_master)
        return self._recorded

    def _begin_cycle(self) -> Measurement:
        """Begin a cycle. One that an error has left before its commands and its row gets both first."""
        assert self.cycle is not None
        self._record_last()
        if self.cycle.begun:  # the next SYNC keeps the period
            self.cycle.end(None)
        return self.cycle.begin()

    @contextmanager
    def _one_at_a_time(self) -> Iterator[None]:
        """Refuse a controller that runs another controller in its step."""
        if self._running:
            raise UsageError("the cell runs a controller already, which must not run another one in its step")
        self._running = True
        try:
            yield
        finally:
            self._running = False

    @contextmanager
    def _naming_another_master(self) -> Iterator[None]:
        """Add another master that was heard to any error that ends the cell: it may be the cause."""
        try:
            yield
        except BaseException as error:
            self._name_another_master(error)
            raise

    def _name_another_master(self, error: BaseException) -> None:
        words = self.watch.another_master
        if words is None or str(self.watch.foreign) in str(error):
            return
        if isinstance(error, CanprobeError):
            error.args = (f"{error}; {words}",)
        elif words not in self.faults:
            self.notes.add(words)

    def _run_cycle(self, interrupts: Interrupts, progress: Callable[[Measurement], None]) -> bool:
        """Run one cycle of the controller; True where the controller is done."""
        assert self.cycle is not None
        measurement = self._begin_cycle()
        held = self._supervise(measurement)
        step = self._held.freeze if held else self._controller.step
        command = self._or_lift_off(self._ask, step, measurement, interrupts)
        command, finding = self.supervisor.guard_target(command if held else self._held.thaw(command, measurement))
        if finding is not None and not held:
            self._react(finding)
        self.cycle.end(command)
        self._or_lift_off(self._controller.update)
        self.cycle.count_work()
        self._record(measurement, command)
        progress(measurement)
        if command.stop_reason is not None:
            found = self._retreats_for
            raise found if found and str(found) == command.stop_reason else SafetyStop(command.stop_reason)
        return bool(command.done)

    def _ask(self, step: Callable[[Measurement], Command], measurement: Measurement, interrupts: Interrupts) -> Command:
        """Ask the controller for its command, and check it.

        Raises:
            KeyboardInterrupt: when an interrupt came.
            UsageError: when the controller returns something else.
        """
        try:
            interrupts.take()
        except KeyboardInterrupt:
            if not self._controller.brake():
                raise
        command = step(measurement)
        if not isinstance(command, Command):
            raise UsageError(f"controller: expected its step to return a Command, got {command!r}")
        check_command(command, arm=self.drives is not None)
        if not OWN_COLUMNS.isdisjoint(command.columns):
            taken = ", ".join(sorted(OWN_COLUMNS.intersection(command.columns)))
            raise UsageError(f"controller: expected other columns than the cell's, got {taken}")
        return command

    def _or_lift_off(self, work: Callable[..., Result], *arguments: object) -> Result:
        """Do the controller's work; where it raises, the probe is lifted off before the run ends."""
        try:
            return work(*arguments)
        except BaseException as error:
            self._lift_off(error)
            raise

    def _stuck(self) -> bool:
        """Whether the controller, or a function after it, has not returned for `STUCK_NS`."""
        assert self.cycle is not None
        return self._port.clock.now_ns() - self.cycle.sync_ns > STUCK_NS

    # enabling and supervision

    def _enable(self) -> None:
        if self.drives is None:
            return
        self._say("enable the drives")
        self.drives.forget_targets()  # of a controller before this one: the arm may stand elsewhere
        self.drives.goal = DriveState.SWITCH_ON_DISABLED
        times = self._plan.setup.bring_up
        with self.bring_up.confirm_modes(times.enable_s) as modes:
            self._cycle_until((), WARM_UP_S, check=modes.serve)
            while modes.waiting:
                self._cycle_until((), self._one_cycle_s, check=modes.serve)
        self._await_rest()
        if (reason := self._controller.inspect(self.drives.joints())) is not None:
            raise SafetyStop(reason)
        self.drives.goal = DriveState.OPERATION_ENABLED
        if not self._cycle_until((DriveState.OPERATION_ENABLED,), times.enable_s, check=self._supervise_enabling):
            i, instead = self.drives.first_not_in(DriveState.OPERATION_ENABLED)
            node_id = self.drives.axes[i].node_id
            raise NodeError(
                node_id,
                f"(joint {i + 1}) is {instead} {times.enable_s:g} s after the command to enable operation"
                " (bring_up.enable_s)" + self.watch.last_words(node_id),
            )

    def _await_rest(self) -> None:
        """Wait until every drive is known to be at rest: its first target is its reported position."""
        assert self.drives is not None
        for _ in range(int(REST_TIMEOUT_S * 1e9 / self._plan.sync.period_ns)):
            if all(self.drives.rests):
                return
            self._cycle_until((), self._one_cycle_s)
        i = self.drives.rests.index(False)
        node_id, last_ns = self.drives.axes[i].node_id, self._plan.traffic.budget.looks_ns[-1]
        if (came_ns := self.drives.lateness_ns[i]) > last_ns:
            why = (
                f"its TPDO comes {came_ns * 1e-6:.2f} ms behind the SYNC, and the cell waits for it until"
                f" {last_ns * 1e-6:.2f} ms: lower cycle.rate_hz"
            )
        else:
            why = f"reports no position that stays for {REST_TIMEOUT_S:g} s: moving, or a wrong TPDO"
        raise NodeError(node_id, why + self.watch.last_words(node_id))

    @property
    def _one_cycle_s(self) -> float:
        """A time in which `_cycle_until` makes one cycle."""
        return 1.5e-9 * self._plan.sync.period_ns

    def _cycle_until(
        self,
        states: tuple[DriveState, ...],
        timeout_s: float,
        check: Callable[[], None] = lambda: None,
    ) -> bool:
        """Cycle with held targets until every drive is in one of the states; False after the time-out."""
        assert self.cycle is not None and self.drives is not None
        for _ in range(int(timeout_s * 1e9 / self._plan.sync.period_ns)):
            measurement = self._begin_cycle()
            self._look(measurement)
            check()
            reached = bool(states) and measurement.q is not None and not self._drives_beside(states)
            self.cycle.end(None)
            self._record(measurement, None)
            if reached:
                return True
        return False

    def _drives_beside(self, states: tuple[DriveState, ...]) -> list[int]:
        """Nodes of the drives in none of the states.

        A drive that has booted since it was configured is off, and its last statusword is of before.
        """
        assert self.drives is not None
        off = self.bring_up.booted_again() if DriveState.SWITCH_ON_DISABLED in states else set[int]()
        drives = zip(self.drives.axes, self.drives.states, strict=True)
        return [axis.node_id for axis, state in drives if state not in states and axis.node_id not in off]

    def _look(self, measurement: Measurement) -> None:
        assert self.cycle is not None
        self._note_alarms()
        seen = self.supervisor.seen
        seen.restarts = self._controller.restarts
        seen.compares_motion = self._controller.compares_motion
        for remark in self._controller.remarks[self._remarks_noted :]:
            self._remarks_noted += 1
            self.notes.add(remark, t_s=(self.start_ns + measurement.t_ns) * 1e-9)
            self._say(remark)
        if self._reader is not None and measurement.tactile is not None:
            self._reader.read(measurement.tactile)
            seen.silent_taxels = self._reader.found
        self.supervisor.step(
            measurement,
            sync_ns=self.cycle.sync_ns,
            overruns=self.cycle.statistics.overruns,
            counters=self._port.counters,
            controller_state=self._port.state,
            log_failure=self._log_failure() or self.log.failure,
        )
        self._controller.array_alive = self.supervisor.array_alive

    def _supervise_enabling(self) -> None:
        finding = self.supervisor.finding(enabling=True)
        if finding is not None and finding.condition.reaction is not Reaction.HOLD:
            self.stopped_by = finding.condition
            raise finding.error

    def _supervise_homing(self) -> None:
        self._note_alarms()
        seen = self.supervisor.seen
        seen.sync_ns, seen.controller_state = self._port.clock.now_ns(), self._port.state
        self._supervise_enabling()

    def _supervise(self, measurement: Measurement) -> bool:
        """Check the conditions of the table; True: hold in this cycle."""
        self._look(measurement)
        finding = self.supervisor.finding()
        if finding is None and not self._controller.lets_go:
            finding = self.supervisor.guard_contact(measurement)
        if finding is None or finding.condition.reaction is not Reaction.HOLD:
            self._holding = False
            if finding is not None:
                self._react(finding)
        elif not self._holding:
            self._holding = True
            self.notes.add_error(finding.error, "hold", (self.start_ns + measurement.t_ns) * 1e-9)
        return self._holding

    def _react(self, finding: Finding) -> None:
        self.stopped_by, reaction = finding.condition, finding.condition.reaction
        if finding.condition.blind and self._controller.array_blind is None:
            self._controller.array_blind = str(finding.error)
        if reaction is Reaction.RETREAT and self._controller.lets_go:
            self._retreats_for = self._retreats_for or finding.error
            self._controller.retreat(str(finding.error))
            return
        if reaction in (Reaction.RETREAT, Reaction.LIFT):
            self._lift_off(finding.error)
        raise finding.error

    def _lift_off(self, error: BaseException) -> None:
        """Lift the probe off its object, as far as the drives obey, before the cell is stopped for ``error``."""
        supervisor = self.supervisor
        if self.drives is None or self.tactile is None or not supervisor.pressing() or supervisor.must_stop():
            return
        lift = LiftOff(self._plan, self.drives, self.watch, error, self._controller.trail)
        t_s = (self.start_ns + supervisor.seen.measurement.t_ns) * 1e-9
        if not lift.possible:
            self.notes.add("no lift-off: a drive may be moving, or none obeys", t_s=t_s)
            return
        self._say("lift off with the drives that obey")
        self.notes.add("lift off", t_s=t_s)
        lift.begin()
        assert self.cycle is not None
        try:
            if not self.cycle.begun:  # the controller's update failed: the commands of this cycle are out
                self._look(self._begin_cycle())
            while (command := lift.command(supervisor)) is not None:
                self.cycle.end(command)
                self._record(supervisor.seen.measurement, command)
                self._look(self._begin_cycle())
        except CanprobeError as failure:
            self.notes.add(f"while lifting off: {failure}")

    def _note_alarms(self) -> None:
        for event in self.watch.news():
            self.notes.add(event.what, node_id=event.node_id, t_s=(event.t_ns - self._origin_ns) * 1e-9)

    def _record(self, measurement: Measurement, command: Command | None) -> None:
        assert self.cycle is not None
        self._recorded = measurement
        t_s = measurement.t_ns * 1e-9 + self.log.start_s
        row: dict[str, object] = {"t_s": t_s, "sync_late_us": self.cycle.late_ns * 1e-3}
        if self.drives is not None:
            if measurement.q is not None:
                row.update(joint_columns("q", measurement.q, self._slides))
            row["q_age"] = measurement.q_age
            row["statusword"] = measurement.statuswords
            if measurement.torque_permille:
                row["torque_permille"] = measurement.torque_permille
        if command is not None:
            if command.q_target is not None:
                row.update(joint_columns("q_target", command.q_target, self._slides))
            row.update(command.columns)
        if self.tactile is not None:
            row["tactile_age"] = measurement.tactile_age
            if measurement.tactile is not None:
                self.tactile_log.add(t_s, self.log.start_s, measurement.tactile)
        self.log.add(row)
        if self._observers is not None:
            self._observers.cycle(self.start_ns, measurement, command)

    # the way out

    def close(self) -> None:
        """Stop safely and close the bus. Never raises; failures are faults."""
        self.stop()
        self._try(self._port.close)
        self._note_silent_taxels()
        for line in self.supervisor.notes():
            self.notes.add(line)

    def stop(self) -> None:
        """Stop safely, once: quick stop, disable, pre-operational. Never raises; failures are faults."""
        if self._stopped:
            return
        self._stopped = True
        self._try(self._record_last)
        self._try(self._stop_drives)
        self._note_pressing()
        if self._raw_array is not None:
            self._try(self._raw_array.stop)
        if self.homing is not None:
            self._try(self.homing.keep)
        self._try(self.bring_up.release)
        if self.found is not None and self.bring_up.took_over:
            self._try(self.found.restore)

    def _note_pressing(self) -> None:
        """Note whether the probe is left pressing, as far as that is known."""
        free = "free it; a run does not begin while the array measures a force"
        if self._controller.array_blind is not None:
            self.notes.add(
                f"the probe may be left pressing, with an unknown force: the array is not believed, as"
                f" {self._controller.array_blind}; look, and {free}"
            )
        elif force := self.supervisor.pressing():
            least = "at least " if self.supervisor.shows_a_part else ""
            self.notes.add(f"the probe is left pressing with {least}{force:.1f} N: {free}")

    def _record_last(self) -> None:
        """Record the last cycle, where an error left it before its row."""
        if self.cycle is not None and (seen := self.supervisor.seen.measurement) is not self._recorded:
            self._record(seen, None)

    def _patch(self, sample: TactileSample) -> Patch:
        assert self._reader is not None
        return self._reader.read(sample)

    def _note_silent_taxels(self) -> None:
        if self._reader is not None and (words := self._reader.faults):
            self.notes.add(words + SILENT_TAXELS)

    def _try(self, action: Callable[[], None]) -> None:
        """Run one step of the way out to its end: an interrupt repeats it once, a failure is noted."""
        for _ in range(2):
            try:
                action()
            except KeyboardInterrupt:
                continue
            except CanprobeError as error:
                self.notes.add(f"while stopping: {error}")
            return

    def _stop_drives(self) -> None:
        if self.drives is None or self.cycle is None or not self.drives.heard_all:
            return
        self._say("stop and disable the drives")
        off = tuple(state for state in DriveState if state not in POWERED_STATES)
        self.drives.goal = DriveState.QUICK_STOP_ACTIVE
        self._stop_until(off)  # with 605Ah = 2 a drive at rest leaves quick stop by itself
        self.drives.goal = DriveState.SWITCH_ON_DISABLED
        disabled = (DriveState.SWITCH_ON_DISABLED, DriveState.FAULT, DriveState.NOT_READY_TO_SWITCH_ON)
        if not self._stop_until(disabled):
            stuck = self._drives_beside(disabled)
            self.notes.add(f"while stopping: node {stuck[0] if stuck else '?'} did not confirm that it is disabled")

    def _stop_until(self, states: tuple[DriveState, ...]) -> bool:
        """Like `_cycle_until`, for a bus that may come and go: a failed cycle is tried again."""
        assert self.cycle is not None
        end_ns = self._port.clock.now_ns() + int(self._plan.setup.bring_up.stop_s * 1e9)
        failure: CanprobeError | None = None
        while (left_ns := end_ns - self._port.clock.now_ns()) > 0:
            try:
                return self._cycle_until(states, left_ns * 1e-9)
            except CanprobeError as error:
                failure = error
                self.cycle.skip()
        if failure is not None:
            self.notes.add(f"while stopping: {failure}")
        return False
