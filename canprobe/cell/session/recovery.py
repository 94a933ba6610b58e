"""A cell that comes back: after a node or the bus was lost it waits for them, is brought up again, and holds.

1. The cell stops safely, as without this. Its log, notes, counters and clock are kept, and where its joints stood.
2. Wait until the interface works, no other master is at work, and every node is there, by a heartbeat or an answer to
   an SDO request. A node that reported an error of its device has to boot: somebody has switched it off and on.
3. A new `Cell` on the same log: the whole bring-up with identity, configuration and zeros. A drive without an absolute
   encoder that may have been without power has to be homed, and ends the recovery.
4. The drives are enabled where they stand, but for a joint that reports another place than before.
5. The arm is held until motion is asked for. A controller goes on only if it says that it can
   (`Controller.resumable`); another one has ended with its error at the loss, as without this.

Losses are the conditions of `PASSING`, and a lost interface. What a person must look at ends the cell as ever.
"""

from __future__ import annotations

from collections.abc import Callable

from canprobe.cell.master.bringup import HEARTBEAT_CONSUMER
from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Command, Controller, Measurement, as_controller
from canprobe.cell.master.homing import TOLERANCE_RAD, UnhomedError
from canprobe.cell.master.node_bringup import read_entry
from canprobe.cell.master.notes import nodes_text
from canprobe.cell.master.options import Say
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration
from canprobe.cell.session.buses import SessionBuses
from canprobe.cell.tasks.paused import LastPlace, PausedController
from canprobe.errors import BusError, CanprobeError, InterfaceError, NodeError
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.presence import answering_nodes
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import Dialogue, hold_dialogues

PASSING = frozenset(
    {
        *("heartbeat", "nmt_state", "drive_fault", "emcy", "drive_silent", "sensor_stale"),
        *("foreign_master", "error_passive_long", "bus_off"),
    }
)
"""Keys of the conditions behind which may be a node that was switched off, or a bus that was cut."""
ANSWER_S = 0.1
"""Longest time to the answer of a node that is there."""
MASTER_QUIET_S = 2.0
"""Time for which another master has to be silent: somebody works at the nodes, and may go on."""
REOPEN_S = 0.5
"""Time between two attempts to open an interface."""
BRING_UP_ATTEMPTS = 5
"""Number of times that a cell may fail to come back, one after the other."""
STEADY_NS = 1_000_000_000
"""Time after which a cell has come back: a loss before that counts as a failure."""
VIRTUAL_WAIT_S = 60.0
"""Longest wait in virtual time, s, where nobody can come and switch a node on."""


class Recovery:
    """Runs controllers on a cell that comes back.

    Args:
        plan: plan of the cell.
        cell: the cell, brought up.
        port: its port.
        make_cell: makes the next cell on a port, after a stopped one.
        buses: its buses, which are opened again after a loss.
        say: called with each step.
        longest_s: longest wait for the nodes, s.

    Attributes:
        cell: the present cell, or the last one that was brought up.
    """

    def __init__(
        self,
        plan: Plan,
        cell: Cell,
        port: Port,
        *,
        make_cell: Callable[[Port, Cell], Cell],
        buses: SessionBuses,
        say: Say,
        longest_s: float,
    ) -> None:
        self.cell = cell
        self._plan, self._port, self._say = plan, port, say
        self._make_cell, self._buses = make_cell, buses
        self._longest_s = longest_s
        self._lost: CanprobeError | None = None
        self._lost_ns = self._back_ns = self._tries = 0
        self._place: LastPlace | None = None
        self._must_boot: set[int] = set()
        self._doubted: set[int] = set()
        self._released: set[int] = set()
        self._asked = self._running = False

    @property
    def lost(self) -> bool:
        """Whether the cell has ended by a loss that it may come back from."""
        return self._lost is not None

    def run(
        self, controller: Controller | Callable[[Measurement], Command], progress: Callable[[Measurement], None]
    ) -> None:
        """Run a controller until it is done; see `canprobe.cell.master.cell.Cell.run`.

        Raises:
            CanprobeError: as there: the loss that ended a controller that cannot go on, and what ends a recovery.
        """
        runs = as_controller(controller)
        self._running = True
        try:
            self._tries = 0  # it is asked for anew
            if self._lost is None and (error := self._attempt(lambda: self.cell.start(runs))) is not None:
                self._lose(error)
            if self._lost is not None:
                self._come_back(PausedController(runs, self._place, None))
            while (error := self._attempt(lambda: self.cell.advance(None, progress))) is not None:
                self._lose(error)
                if not runs.resumable:
                    raise error
                self._come_back(
                    PausedController(runs, self._place, lambda: self._asked, self._note_resumed),
                    " and holds; motion goes on when it is asked for (resume)",
                )
        finally:
            self._running = False

    def resume(self) -> None:
        """Ask for motion after a loss: a controller that is held goes on.

        Where none is held, a lost cell is brought up again, for the next controller.

        Raises:
            CanprobeError: what ends a recovery.
        """
        if self._running or self._lost is None:
            self._asked = True
        else:
            self._tries = 0
            self._come_back(None)

    def close(self) -> None:
        """Stop safely and close the bus."""
        self.cell.close()
        self._port.close()

    def _attempt(self, work: Callable[[], object]) -> CanprobeError | None:
        """Do some work of the cell; the loss that ended it, None where it was done."""
        try:
            work()
        except CanprobeError as error:
            if not may_pass(error, self.cell):
                raise
            return error
        return None

    def _lose(self, error: CanprobeError) -> None:
        """Stop the cell safely, and keep what it knows."""
        cell = self.cell
        self._lost, self._lost_ns = error, self._port.clock.now_ns()
        if self._lost_ns - self._back_ns > STEADY_NS:
            self._tries = 0
        self._say(f"lost: {error}")
        cell.notes.add_error(error, "the cell stopped, to come back", self._run_s(cell))
        cell.stop()
        if isinstance(error, InterfaceError):
            self._reopened()
        self._must_boot = cell.watch.alarmed - cell.bring_up.booted_again()
        self._doubted, self._released = cell.bring_up.booted_again(), set(cell.bring_up.released)
        arm = self._plan.setup.arm
        if cell.drives is not None and cell.drives.heard_all and arm is not None:
            q, ways = cell.drives.last_place(HEARTBEAT_CONSUMED_MS * 1_000_000)
            self._place = LastPlace(arm.model.joints, q, TOLERANCE_RAD * arm.model.radian + ways)

    def _run_s(self, cell: Cell) -> float:
        """Time on the run's clock, s."""
        return cell.cycles.run_s(cell.supervisor.seen.measurement)

    def _note_resumed(self) -> None:
        self._say("motion goes on")
        self.cell.notes.add("motion was asked for, and went on", t_s=self._run_s(self.cell))

    def _come_back(self, task: Controller | None, then: str = "") -> None:
        """Wait, bring the cell up, and enable it for a task; a failure before that is waited out, a few times.

        What was asked for meanwhile does not count. The report of the return ends with `then`.
        """
        assert self._lost is not None
        while True:
            self._tries += 1
            if self._tries > BRING_UP_ATTEMPTS:
                raise self._lost
            self._wait()
            cell = self._make_cell(self._port, self.cell)
            cell.doubted = frozenset(self._doubted)
            try:
                cell.__enter__()
                self.cell = cell
                if task is not None:
                    cell.start(task)
            except CanprobeError as error:
                cell.stop()
                self._doubted |= cell.bring_up.booted_again()
                self._released |= cell.bring_up.released
                passes = isinstance(error, BusError) and not isinstance(error, UnhomedError)
                if not passes or self._tries == BRING_UP_ATTEMPTS:
                    raise
                self._say(f"not back yet: {error}")
                if isinstance(error, InterfaceError):
                    self._reopened()
            else:
                self._lost, self._back_ns, self._asked = None, self._port.clock.now_ns(), False
                self._say(f"the cell is back after {(self._back_ns - self._lost_ns) * 1e-9:.1f} s{then}")
                self.cell.notes.add("the cell came back", t_s=self._run_s(self.cell))
                return

    def _wait(self) -> None:
        """Wait until the interface works, no other master is at work, and every node is there.

        Raises:
            CanprobeError: the loss, where it has lasted too long.
        """
        assert self._lost is not None
        clock, seen = self._port.clock, _Wait(self._plan, self.cell.watch.foreign is not None)
        end_ns, said = clock.now_ns() + self._longest_s * 1e9, ""
        while True:
            self._buses.raise_ended()
            try:
                why = seen.look(self._port, self._must_boot)
                if why is None:
                    self._doubted |= seen.without_power(self._port, self._released)
                    return
            except InterfaceError as error:
                clock.sleep_until_ns(clock.now_ns() + round(REOPEN_S * 1e9))
                why = self._reopened() or str(error)
            if why != said:
                self._say(f"wait: {why}")
                said = why
            if clock.now_ns() > end_ns:
                raise self._lost

    def _reopened(self) -> str | None:
        """Open the interfaces again; why that failed, None where it did not."""
        try:
            self._port = self._buses.reopen(self._port)
        except InterfaceError as error:
            return str(error)
        return None


class _Wait:
    """What was seen of the nodes while the cell waits for them.

    Args:
        plan: plan of the cell.
        foreign: whether another master was at work.
    """

    def __init__(self, plan: Plan, foreign: bool) -> None:
        self._plan, self._settings = plan, plan.setup.bring_up
        self._watch = NodeWatch(plan.node_ids)
        self._absent: set[int] = set()
        self._listen_s = MASTER_QUIET_S if foreign else max(self._settings.listen_s, ANSWER_S)

    def look(self, port: Port, must_boot: set[int]) -> str | None:
        """Listen, then ask the nodes that were not heard; why the cell has to wait on, None where it need not."""
        watch = self._watch
        watch.foreign = None
        watch.states.clear()
        network = PumpedNetwork(port, other=watch.push)
        network.pump_until(lambda: watch.foreign is not None, self._listen_s)
        if watch.another_master is not None:
            self._listen_s = MASTER_QUIET_S
            return watch.another_master
        silent = set(watch.node_ids) - set(watch.states)
        missing = silent - set(answering_nodes(network, silent, ANSWER_S))
        self._absent |= missing
        if missing:
            return f"{nodes_text(missing)} not there"
        if bad := {node_id for node_id in must_boot if not watch.boot_ups[node_id]}:
            return f"{nodes_text(bad)} reported an error of the device: see to it, then switch it off and on"
        return None

    def without_power(self, port: Port, released: set[int]) -> set[int]:
        """Nodes that may have been without power: they booted, or they do not show that they did not.

        A node that was released, and then was heard all the time, has kept its power. One that was out of reach at the
        stop still holds the heartbeat consumer that bring-up has written, unless it has booted since.
        """
        lost = {node_id for node_id, number in self._watch.boot_ups.items() if number} | (self._absent & released)
        network, asked = PumpedNetwork(port, other=self._watch.push), dict[int, Dialogue]()
        for setup in self._plan.nodes:
            if setup.homing and setup.node_id not in lost | released:
                asked[setup.node_id] = self._compare(setup, lost)
        hold_dialogues(network, asked, timeout_s=self._settings.sdo_s, retries=self._settings.retries)
        return lost

    def _compare(self, setup: NodeConfiguration, lost: set[int]) -> Dialogue:
        written = {w.value for w in setup.writes if w.index == HEARTBEAT_CONSUMER}
        try:
            kept = (yield from read_entry(setup, HEARTBEAT_CONSUMER, 1)) in written
        except NodeError:
            kept = False
        if not kept or self._settings.store:  # a stored value outlives the power
            lost.add(setup.node_id)


def may_pass(error: CanprobeError, cell: Cell) -> bool:
    """Whether behind the error of a cell may be a node that was switched off, or a bus that was cut.

    A drive that left its state without a reason on the bus does not count: somebody took its power (STO), or it has a
    fault.
    """
    if isinstance(error, InterfaceError):
        return True
    if cell.stopped_by is None:  # a request without an answer, while the drives are enabled
        silent = cell.watch.silent(cell.supervisor.seen.sync_ns)
        return isinstance(error, NodeError) and (silent is not None or bool(cell.bring_up.booted_again()))
    if cell.stopped_by.key not in PASSING:
        return False
    if cell.stopped_by.key != "drive_fault" or not isinstance(error, NodeError):
        return True
    event, seen = cell.watch.last_alarm.get(error.node_id), cell.supervisor.seen
    held_up = seen.gap_ns > seen.limits.missed_cycles * seen.limits.period_ns
    return event is not None or held_up
