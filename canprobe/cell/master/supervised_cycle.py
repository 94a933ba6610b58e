"""A cycle with all that the cell does in every one of them: SYNC → measurement → what the checks see; a row in the log.

It is the same whether a controller runs, the drives are enabled or stopped, or the probe is lifted off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.cycle import Cycle
from canprobe.cell.master.log import RunLog, TactileLog
from canprobe.cell.master.notes import Notes
from canprobe.cell.master.observers import Observers
from canprobe.cell.master.options import RunOptions, Say
from canprobe.cell.master.supervision import CycleState
from canprobe.cell.master.supervisor import JointGuard, Supervisor
from canprobe.cell.planning.model import Plan
from canprobe.cell.rows import BLOCK_ROWS, TACTILE_PHASE, joint_columns
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.port import Port

if TYPE_CHECKING:
    from canprobe.cell.master.patch_reader import PatchReader

SILENT_TAXELS = (
    ": interpolated; have the array repaired, or state the taxels as `dead` in [taxels] of its calibration file"
)


class SupervisedCycle:
    """The cycle of a cell, supervised and recorded.

    Args:
        plan, port, options, observers, log_failure, origin_ns: as for `canprobe.cell.master.cell.Cell`.
        seen: the cell as the checks see it.
        before: that of a stopped cell of the same run, whose log and notes this one continues.

    Attributes:
        cycle: the cycle on the bus; None before bring-up is done.
        controller: controller that runs now or ran last.
        reader: reader of the tactile samples: the controller's, or the cell's own; None without an array.
        supervisor: the checks.
        recorded: measurement whose row was written last.
        start_ns: deadline of the first cycle on the run's clock; 0 where there was no cycle.
        log, tactile_log, notes: a row for each cycle and for each tactile frame; faults that did not stop the cell.
    """

    def __init__(  # noqa: PLR0917
        self,
        plan: Plan,
        port: Port,
        seen: CycleState,
        options: RunOptions,
        observers: Observers | None,
        log_failure: Callable[[], str | None],
        origin_ns: int,
        before: SupervisedCycle | None,
    ) -> None:
        rows = options.rows_folder
        self.log: RunLog = RunLog(options.rows_kept, rows) if before is None else before.log
        self.tactile_log: TactileLog = TactileLog(options.rows_kept, rows) if before is None else before.tactile_log
        self.notes: Notes = Notes() if before is None else before.notes
        self.say: Say = self.notes.saying(options.say)
        self.cycle: Cycle  # once started
        self.controller = Controller()
        self.reader: PatchReader | None = make_patch_reader(plan.setup)
        self.start_ns = 0
        self.port = port
        self.recorded = seen.measurement
        guard = JointGuard(plan) if plan.setup.arm is not None else None
        push = None
        if guard is not None and self.reader is not None:
            from canprobe.cell.master.push_witness import PushWitness

            push = PushWitness(guard.model, guard.T_flange_tip, plan.setup.limits.force_max)
        self.supervisor = Supervisor(seen, guard, push)
        self._observers, self._log_failure, self._origin_ns = observers, log_failure, origin_ns
        slides = plan.setup.arm.model.chain.prismatic if plan.setup.arm is not None else ()
        self._slides = np.array(slides, dtype=bool) if any(slides) else None
        self._carrier_column = plan.setup.carrier.column if plan.setup.carrier is not None else ""
        self._remarks_noted = 0

    def start(self, cycle: Cycle) -> None:
        """Take the cycle on the bus, once the nodes are up."""
        self.cycle = cycle
        self.start_ns = cycle.t_first_ns - self._origin_ns
        self.log.start_s = self.start_ns * 1e-9

    def attend(self, controller: Controller) -> None:
        """Report on this controller from now on."""
        self.controller, self._remarks_noted = controller, 0
        if controller.reader is not None:
            self.note_silent_taxels()
            self.reader = controller.reader

    def begin(self) -> Measurement:
        """SYNC, TPDOs, measurement, for supervision and controller to see; what is new is noted.

        A cycle that an error has left before its commands and its row gets both first.
        """
        self.record_last()
        if self.cycle.begun:  # the next SYNC keeps the period
            self.cycle.end(None)
        measurement = self.cycle.begin()
        self.note_alarms()
        supervisor, controller = self.supervisor, self.controller
        seen = supervisor.seen
        seen.restarts, seen.compares_motion = controller.restarts, controller.compares_motion
        seen.counters, seen.controller_state = self.port.counters, self.port.state
        seen.log_failure = self._log_failure() or self.log.failure
        for remark in controller.remarks[self._remarks_noted :]:
            self._remarks_noted += 1
            self.notes.add(remark, t_s=self.run_s(measurement))
            self.say(remark)
        if self.reader is not None and measurement.tactile is not None:
            patch = self.reader.read(measurement.tactile)
            seen.patch = patch if seen.drives is not None else None
            seen.silent_taxels = self.reader.found
        supervisor.step(measurement, self.cycle.sync_ns, self.cycle.statistics.overruns)
        controller.array_alive = supervisor.array_alive
        return measurement

    def record(self, measurement: Measurement, command: Command | None) -> None:
        """Write the row of a cycle, and show it to the observers."""
        self.recorded = measurement
        seen = self.supervisor.seen
        t_s = measurement.t_ns * 1e-9 + self.log.start_s
        row: dict[str, object] = {"t_s": t_s, "sync_late_us": self.cycle.late_ns * 1e-3}
        if seen.drives is not None:
            if measurement.q is not None:
                row.update(joint_columns("q", measurement.q, self._slides))
            row["q_age"] = measurement.q_age
            if measurement.statuswords:
                row["statusword"] = measurement.statuswords
            if measurement.torque_permille:
                row["torque_permille"] = measurement.torque_permille
        if measurement.carrier is not None:
            row[self._carrier_column] = measurement.carrier
        if command is not None:
            if command.q_target is not None:
                row.update(joint_columns("q_target", command.q_target, self._slides))
            row.update(command.columns)
        if seen.tactile is not None:
            row["tactile_age"] = measurement.tactile_age
            if measurement.tactile is not None:
                self.tactile_log.add(t_s, self.log.start_s, measurement.tactile)
        self.log.add(row)
        if len(self.log) % BLOCK_ROWS == TACTILE_PHASE:
            self.tactile_log.flush()
        if self._observers is not None:
            self._observers.cycle(self.start_ns, measurement, command)

    def record_last(self) -> None:
        """Record the last cycle, where an error left it before its row."""
        last = self.supervisor.seen.measurement
        if last is not self.recorded:
            self.record(last, None)

    def run_s(self, measurement: Measurement) -> float:
        """Time of a measurement on the run's clock, s."""
        return (self.start_ns + measurement.t_ns) * 1e-9

    def name_another_master(self, error: BaseException) -> None:
        """Add another master that was heard to an error that ends the cell: it may be the cause."""
        watch = self.supervisor.seen.watch
        words = watch.another_master
        if words is None or str(watch.foreign) in str(error):
            return
        if isinstance(error, CanprobeError):
            # in place: another error would lose type and attributes, by which callers know node and exit status
            error.args = (f"{error}; {words}",)
        elif words not in self.notes.lines():
            self.notes.add(words)

    def note_alarms(self) -> None:
        """Note the alarms of the nodes since the last time."""
        for event in self.supervisor.seen.watch.news():
            self.notes.add(event.what, node_id=event.node_id, t_s=(event.t_ns - self._origin_ns) * 1e-9)

    def note_silent_taxels(self) -> None:
        """Note the taxels that the present reader has found not to measure."""
        if self.reader is not None and (words := self.reader.faults):
            self.notes.add(words + SILENT_TAXELS)

    def note_pressing(self) -> None:
        """Note whether the probe is left pressing, as far as that is known."""
        free = "free it; a run does not begin while the array measures a force"
        if (blind := self.controller.array_blind) is not None:
            self.notes.add(
                f"the probe may be left pressing, with an unknown force: the array is not believed, as"
                f" {blind}; look, and {free}"
            )
        elif force := self.supervisor.pressing():
            least = "at least " if self.supervisor.seen.shows_a_part else ""
            self.notes.add(f"the probe is left pressing with {least}{force:.1f} N: {free}")
