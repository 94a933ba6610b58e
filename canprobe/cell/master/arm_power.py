"""The drives of an arm are enabled where they stand, and stopped and disabled on every way out, in the cycle."""

from __future__ import annotations

from collections.abc import Callable

from canprobe.cell.master.bringup import BringUp
from canprobe.cell.master.drives import DriveGroup
from canprobe.cell.master.supervised_cycle import SupervisedCycle
from canprobe.cell.planning.model import Plan
from canprobe.errors import BusError, CanprobeError, SafetyStop
from canprobe.fieldbus.protocol.cia402 import DISABLED_STATES, UNPOWERED_STATES, DriveState

WARM_UP_S = 0.1
"""Time of cycles before the drives are enabled, s, until both sides run at their usual speed."""
REST_TIMEOUT_S = 2.0


class ArmPower:
    """Enables and disables the drives of an arm.

    Args:
        plan: plan of the cell.
        drives: the drives.
        cycles: cycle of the cell.
        bring_up: its bring-up, which has configured them.
    """

    def __init__(self, plan: Plan, drives: DriveGroup, cycles: SupervisedCycle, bring_up: BringUp) -> None:
        self._drives, self._cycles, self._bring_up = drives, cycles, bring_up
        self._watch, self._times = cycles.supervisor.seen.watch, plan.setup.bring_up
        self._period_ns, self._last_look_ns = plan.sync.period_ns, plan.budget.looks_ns[-1]

    def enable(self, check: Callable[[], None]) -> None:
        """Enable the drives, each with its position as its target.

        Args:
            check: raises the error of a condition that ends the cell; called in each cycle of enabling.

        Raises:
            NodeError: a drive is in another mode, not at rest, or does not become enabled in time.
            SafetyStop: the controller does not let them be enabled here.
        """
        drives, cycles = self._drives, self._cycles
        cycles.say("enable the drives")
        drives.targets.forget()  # of a controller before this one: the arm may stand elsewhere
        drives.targets.goal = DriveState.SWITCH_ON_DISABLED
        enable_s, one_cycle_s = self._times.enable_s, 1.5e-9 * self._period_ns
        with self._bring_up.confirm_modes(enable_s) as modes:
            self._cycle_until(frozenset(), WARM_UP_S, modes.serve)
            while modes.waiting:
                self._cycle_until(frozenset(), one_cycle_s, modes.serve)
        for _ in range(int(REST_TIMEOUT_S * 1e9 / self._period_ns)):
            if all(drives.rests):
                break
            self._cycle_until(frozenset(), one_cycle_s)
        else:
            raise self._restless()
        if (reason := cycles.controller.inspect(drives.joints())) is not None:
            raise SafetyStop(reason)
        drives.targets.goal = DriveState.OPERATION_ENABLED
        if not self._cycle_until(frozenset({DriveState.OPERATION_ENABLED}), enable_s, check):
            i, instead = drives.first_not_in(DriveState.OPERATION_ENABLED)
            node_id = drives.axes[i].node_id
            raise drives.axes[i].error(
                f"(joint {i + 1}) is {instead} {enable_s:g} s after the command to enable operation"
                " (bring_up.enable_s)" + self._watch.last_words(node_id),
            )

    def _restless(self) -> BusError:
        """The error of a drive that is not known to be at rest: its first target is its reported position."""
        i = self._drives.rests.index(False)
        node_id = self._drives.axes[i].node_id
        if (came_ns := self._drives.lateness_ns[i]) > self._last_look_ns:
            why = (
                f"its TPDO comes {came_ns * 1e-6:.2f} ms behind the SYNC, and the cell waits for it until"
                f" {self._last_look_ns * 1e-6:.2f} ms: lower cycle.rate_hz"
            )
        else:
            why = f"reports no position that stays for {REST_TIMEOUT_S:g} s: moving, or a wrong TPDO"
        return self._drives.axes[i].error(why + self._watch.last_words(node_id))

    def disable(self) -> None:
        """Stop the drives, then disable them, as far as the bus lets it."""
        if not self._drives.heard_all:
            return
        self._cycles.say("stop and disable the drives")
        self._drives.targets.goal = DriveState.QUICK_STOP_ACTIVE
        self._stop_until(UNPOWERED_STATES)  # with 605Ah = 2 a drive at rest leaves quick stop by itself
        self._drives.targets.goal = DriveState.SWITCH_ON_DISABLED
        if not self._stop_until(DISABLED_STATES):
            stuck = self._others_than(DISABLED_STATES)
            which = f"node {stuck[0]}" if any(stuck) else "the arm"
            self._cycles.notes.add(f"while stopping: {which} did not confirm that it is disabled")

    def _stop_until(self, states: frozenset[DriveState]) -> bool:
        """Like `_cycle_until`, for a bus that may come and go: a failed cycle is tried again."""
        cycles, clock = self._cycles, self._cycles.port.clock
        end_ns = clock.now_ns() + int(self._times.stop_s * 1e9)
        failure: CanprobeError | None = None
        while (left_ns := end_ns - clock.now_ns()) > 0:
            try:
                return self._cycle_until(states, left_ns * 1e-9)
            except CanprobeError as error:
                failure = error
                cycles.cycle.skip()
        if failure is not None:
            cycles.notes.add(f"while stopping: {failure}")
        return False

    def _cycle_until(
        self, states: frozenset[DriveState], timeout_s: float, check: Callable[[], None] = lambda: None
    ) -> bool:
        """Cycle with held targets until every drive is in one of the states; False after the time-out."""
        cycles = self._cycles
        for _ in range(int(timeout_s * 1e9 / self._period_ns)):
            measurement = cycles.begin()
            check()
            reached = bool(states) and measurement.q is not None and not self._others_than(states)
            cycles.cycle.end(None)
            cycles.record(measurement, None)
            if reached:
                return True
        return False

    def _others_than(self, states: frozenset[DriveState]) -> list[int]:
        """Nodes of the drives in none of the states.

        A drive that has booted since it was configured is off, and its last statusword is of before.
        """
        off = self._bring_up.booted_again() if DriveState.SWITCH_ON_DISABLED in states else set[int]()
        drives = zip(self._drives.axes, self._drives.states, strict=True)
        return [axis.node_id for axis, state in drives if state not in states and axis.node_id not in off]
