"""The cell: bring-up, cycles under supervision, and a stop that disables the drives on every way out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cell.master.array import ArrayReceiver, RawReceiver, make_tactile
from canprobe.cell.master.bringup import BringUp, FoundNodes, NodeAccess
from canprobe.cell.master.carrier import make_carrier
from canprobe.cell.master.controller import Command, Controller, Measurement, as_controller, check_command
from canprobe.cell.master.cycle import Cycle
from canprobe.cell.master.held_arm import HeldArm
from canprobe.cell.master.homing import Homing
from canprobe.cell.master.observers import Observers
from canprobe.cell.master.options import DEFAULT_OPTIONS, RunOptions
from canprobe.cell.master.readings import Readings
from canprobe.cell.master.supervised_cycle import SupervisedCycle
from canprobe.cell.master.supervision import Condition, CycleState, Finding, Reaction, limits_of
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import Plan
from canprobe.errors import BusError, CanprobeError, SafetyStop, UsageError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.port import Port, nothing
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.real.interrupts import Interrupts
from canprobe.fieldbus.protocol.cia402 import DriveState

if TYPE_CHECKING:
    from canprobe.cell.master.arm_power import ArmPower
    from canprobe.cell.master.drives import DriveGroup
    from canprobe.cell.master.external_arm import ExternalArm

TARE_S = 0.3
"""Time in which an array takes the images of a tare, s."""
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
        arm: the arm that is not on the bus; None with drives, or without an arm.

    Attributes:
        drives, tactile: drives of the arm, and receiver of the array; None in a scene without one.
        carrier: receiver of the carrier's position; None where the object stands still.
        log: one row for each cycle.
        tactile_log: one row for each tactile frame, on the same clock.
        notes: faults that did not stop the cell.
        watch: states and errors that the nodes report.
        supervisor: the checks, from bring-up on.
        cycles: the supervised cycle, which has `log`, `tactile_log` and `notes`.
        cycle: the cycle on the bus; None before bring-up is done.
        homing: homing of the drives without an absolute encoder; None where there are none.
        readings: voltages and temperatures of the drives, for who serves them.
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
        arm: ExternalArm | None = None,
    ) -> None:
        setup = plan.setup
        self.port = port
        self.drives: DriveGroup | None = None
        if arm is not None:
            from canprobe.cell.master.external_arm import FlangeGroup

            self.drives = FlangeGroup(plan, arm)
        elif setup.arm is not None:
            from canprobe.cell.master.drives import make_drives

            self.drives = make_drives(plan)
        self.tactile: ArrayReceiver | None = make_tactile(plan) if before is None else before.tactile
        self.carrier = make_carrier(plan)
        self.watch = NodeWatch(plan.node_ids)
        seen = CycleState(limits_of(plan), self.watch, self.drives, self.tactile, port.counters, carrier=self.carrier)
        self.cycles: SupervisedCycle = SupervisedCycle(
            plan, port, seen, options, observers, log_failure, origin_ns, before.cycles if before else None
        )
        self.supervisor = self.cycles.supervisor
        self.log, self.tactile_log, self.notes = self.cycles.log, self.cycles.tactile_log, self.cycles.notes
        self.cycle: Cycle | None = None
        self._plan, self._options, self._say = plan, options, self.cycles.say
        self._network = PumpedNetwork(port, other=self._other)
        self.readings = Readings(self._network, plan)
        self._make_cycle = direct or Cycle
        setups = plan.nodes if direct is None else ()  # without setups, bring-up only takes its time
        settings, check = setup.bring_up, options.to_check
        if check:  # nothing is commanded or stored, such as a tare
            setups = tuple(replace(one, writes=tuple(w for w in one.writes if w.read_back)) for one in setups)
            settings = replace(settings, store=False)
        access = NodeAccess(self._network, self.watch, setups, settings, self._say)
        self.bring_up = BringUp(access, listened=before is not None, resets=not check)
        self.found = FoundNodes(access) if check else None
        self.stopped_by: Condition | None = None
        self.doubted: frozenset[int] = frozenset()
        self._stopped = self._running = False
        self._before = before
        self._power: ArmPower | None = None
        self._lift_off: Callable[[BaseException], None] = nothing
        if self.drives is not None:
            from canprobe.cell.master.arm_power import ArmPower
            from canprobe.cell.master.lift_off import lift_off

            self._power = ArmPower(plan, self.drives, self.cycles, self.bring_up)
            self._lift_off = partial(lift_off, plan, self.cycles)
        homed = any(one.homing for one in setups)
        self.homing = Homing(plan, access, self._supervise_homing, zeros) if homed else None
        self._held = HeldArm()
        self._retreats_for: CanprobeError | None = None
        if before is not None:  # the counters go on
            if self.drives is not None and before.drives is not None:
                for name in ("late", "missed", "malformed", "implausible"):
                    setattr(self.drives, name, getattr(before.drives, name))
            self.watch.communication = before.watch.communication
            self.supervisor.counts, self.supervisor.first = before.supervisor.counts, before.supervisor.first
            seen.overruns = before.supervisor.seen.overruns

    def _other(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take a frame that arrived during bring-up and has no subscriber."""
        if self.tactile is not None and can_id in self.tactile.cob_ids:
            self.tactile.push(can_id, data, t_ns)
        else:
            self.watch.push(can_id, data, t_ns)

    def __enter__(self) -> Cell:
        try:
            if self.found is not None:
                self.bring_up.listen()
                self.found.look()
            self.bring_up.run()
            if isinstance(self.tactile, RawReceiver):
                self.tactile.start(self._network, self._plan.setup.bring_up.boot_up_s, self._say)
            self.cycle = self._make_cycle(
                self.port,
                self._plan,
                drives=self.drives,
                tactile=self.tactile,
                carrier=self.carrier,
                watch=self.watch,
                other=self._network.feed,
                on_arrival=not isinstance(self.port.clock, VirtualClock),
                kept=self._options.rows_kept,
                before=None if self._before is None else self._before.cycle,
            )
            if self._before is not None and self.tactile is not None:
                self.tactile.newest_cycle = self.cycle.number  # its age counts from the first SYNC of this cell
            self._before = None
            self.cycles.start(self.cycle)
            self.watch.start(self.port.clock.now_ns())
            if self.homing is not None:
                self.homing.look()
                self.homing.doubt(self.doubted)
                if not self._options.to_home:
                    self.homing.refuse_unhomed()
        except BaseException as error:
            self.stop()
            if not self._options.recover:
                self.close()
            self.cycles.name_another_master(error)
            raise
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        self.close()
        if error is not None:
            self.cycles.name_another_master(error)

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
        with self._running_one():
            self.cycles.attend(runs)
            self.stopped_by, self._retreats_for, self._held = None, None, HeldArm()
            if self._power is not None:
                self._power.enable(self._supervise_enabling)

    def advance(self, cycles: int | None, progress: Callable[[Measurement], None] = lambda _: None) -> bool:
        """The second half of `run`, in pieces: nothing happens between two calls, and virtual time stands still.

        On a real bus the drives stop by themselves where the next call does not come within a cycle.

        Args:
            cycles: most cycles to run; None: until the controller is done.
            progress: called after each cycle.

        Returns:
            Whether the controller is done.
        """

        def stuck() -> bool:
            return self.port.clock.now_ns() - self.cycles.cycle.sync_ns > STUCK_NS

        with self._running_one(), Interrupts(stuck) as interrupts:
            for _ in repeat(None) if cycles is None else range(cycles):
                if self._run_cycle(interrupts, progress):
                    return True
        return False

    def _run_cycle(self, interrupts: Interrupts, progress: Callable[[Measurement], None]) -> bool:
        """Run one cycle of the controller; True where the controller is done."""
        cycles, controller = self.cycles, self.cycles.controller
        measurement = cycles.begin()  # SYNC, collect
        held = self._supervise(measurement)
        with self._lifting_off_on_error():
            try:
                interrupts.take()
            except KeyboardInterrupt as interrupt:  # a controller that brakes by itself raises it when it has
                if not controller.brake(interrupt):
                    raise
            command = self._held.freeze(measurement) if held else controller.step(measurement)
            check_command(command, arm=self.drives is not None)
        command, finding = self.supervisor.guard_target(command if held else self._held.thaw(command, measurement))
        # a hold sends where the arm is: beyond a limit that is left out, and the hold does not become a stop
        if finding is not None and not held:
            self._react(finding)
        cycles.cycle.end(command)  # RPDOs
        with self._lifting_off_on_error():
            controller.update()
        cycles.cycle.count_work()
        cycles.record(measurement, command)
        progress(measurement)
        if command.stop_reason is not None:
            found = self._retreats_for
            # the error as it was found: its type has node and exit status, and a task gives back the words alone
            raise found if found and str(found) == command.stop_reason else SafetyStop(command.stop_reason)
        return bool(command.done)

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
                    # in the cycle, which sends the heartbeat: nodes miss their master after 250 ms without it
                    self.idle(self._plan.sync.period_ns * 1e-9)
                    writes.serve()
        self.idle(TARE_S)

    def idle(self, seconds: float) -> Measurement:
        """Cycle with disabled drives and without a controller; nothing is supervised, and no row is kept.

        Returns:
            The measurement of the last cycle.

        Raises:
            BusError: another master has come.
        """
        if self.drives is not None:
            self.drives.targets.goal = DriveState.SWITCH_ON_DISABLED
        for _ in range(max(1, round(seconds * 1e9 / self._plan.sync.period_ns))):
            self.cycles.recorded = self.cycles.begin()
            self.cycles.cycle.end(None)
            self.cycles.cycle.count_work()
            if self.watch.another_master is not None:
                raise BusError(self.watch.another_master)
        return self.cycles.recorded

    @contextmanager
    def _running_one(self) -> Iterator[None]:
        """Refuse a controller that runs another one in its step; name another master where an error ends this one."""
        if self._running:
            raise UsageError("the cell runs a controller already, which must not run another one in its step")
        self._running = True
        try:
            yield
        except BaseException as error:
            self.cycles.name_another_master(error)
            raise
        finally:
            self._running = False

    @contextmanager
    def _lifting_off_on_error(self) -> Iterator[None]:
        """Work of the controller: where it raises, the probe is lifted off before the run ends."""
        try:
            yield
        except BaseException as error:
            self._lift_off(error)
            raise

    # supervision

    def _supervise_enabling(self) -> None:
        finding = self.supervisor.finding(enabling=True)
        if finding is not None and finding.condition.reaction is not Reaction.HOLD:
            self.stopped_by = finding.condition
            raise finding.error

    def _supervise_homing(self) -> None:
        """Raise what ends the cell while a joint is homed: there is no SYNC meanwhile."""
        self.cycles.note_alarms()
        seen = self.supervisor.seen
        seen.sync_ns, seen.controller_state = self.port.clock.now_ns(), self.port.state
        self._supervise_enabling()

    def _supervise(self, measurement: Measurement) -> bool:
        """Check the conditions of the table; True: hold in this cycle."""
        finding = self.supervisor.finding()
        if finding is None and not self.cycles.controller.retreats_itself:
            finding = self.supervisor.guard_contact(measurement)
        if finding is None:
            return False
        if finding.condition.reaction is not Reaction.HOLD:
            self._react(finding)
            return False
        if not self._held.holds:
            self.notes.add_error(finding.error, "hold", self.cycles.run_s(measurement))
        return True

    def _react(self, finding: Finding) -> None:
        controller = self.cycles.controller
        self.stopped_by, reaction = finding.condition, finding.condition.reaction
        if finding.condition.blind and controller.array_blind is None:
            controller.array_blind = str(finding.error)
        if reaction is Reaction.RETREAT and controller.retreats_itself:
            self._retreats_for = self._retreats_for or finding.error
            controller.retreat(str(finding.error))
            return
        if reaction in (Reaction.RETREAT, Reaction.LIFT):
            self._lift_off(finding.error)
        raise finding.error

    # the way out

    def disable(self) -> None:
        """Stop the drives, then disable them; the nodes stay up.

        Raises:
            CanprobeError: the bus fails.
        """
        if self._power is not None and self.cycle is not None:
            self._power.disable()

    def close(self) -> None:
        """Stop safely and close the bus. Never raises; failures are faults."""
        self.stop()
        self.notes.attempt(self.port.close)
        self.cycles.note_silent_taxels()
        for line in self.supervisor.notes():
            self.notes.add(line)

    def stop(self) -> None:
        """Stop safely, once: quick stop, disable, pre-operational. Never raises; failures are faults."""
        if self._stopped:
            return
        self._stopped = True
        self.notes.attempt(self.cycles.record_last)
        self.notes.attempt(self.disable)
        self.cycles.note_pressing()
        if isinstance(self.tactile, RawReceiver):
            self.notes.attempt(partial(self.tactile.stop, self.port))
        if self.homing is not None:
            self.notes.attempt(self.homing.keep)
        self.notes.attempt(self.bring_up.release)
        if self.found is not None and self.bring_up.took_over:
            self.notes.attempt(self.found.restore)
