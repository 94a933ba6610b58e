"""A cell with everything round it: buses, recording, emulated nodes, and the way out of all of them.

The composition root: the only place, besides studies and tests, that sees both sides of the bus.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property, partial
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from numpy.typing import NDArray

from canprobe.cell.emulated.truth_columns import TruthColumns
from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.cycle import Cycle
from canprobe.cell.master.observers import Observers
from canprobe.cell.master.options import DEFAULT_OPTIONS, RunOptions, quiet
from canprobe.cell.npz import read_npz, write_npz
from canprobe.cell.planning.bridges import check_bridges
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.rows import RowFiles
from canprobe.cell.scene.model import BridgeSettings, Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.bus_record import BusRecord
from canprobe.cell.session.buses import channel_routes, lockstep_bus, open_ports
from canprobe.cell.session.emulator_child import EmulatorChild
from canprobe.cell.session.first_second import FirstSecond
from canprobe.cell.session.folder import STEPS, prepare_folder, zeros_file
from canprobe.cell.session.joint_record import exchanged
from canprobe.cell.session.link_faults import expected_of
from canprobe.cell.session.links import check_links, need_controllers
from canprobe.cell.session.recovery import VIRTUAL_WAIT_S, Recovery
from canprobe.cell.session.rehearsal import shortened
from canprobe.cell.session.step_log import StepLog
from canprobe.cell.session.target import LOCKSTEP, VIRTUAL
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError, ResultsError, SafetyStop, UsageError
from canprobe.fieldbus.bus.candump import RecordingPort
from canprobe.fieldbus.bus.clock import Clock, MonotonicClock, VirtualClock, elapsed_ns
from canprobe.fieldbus.bus.files import writing
from canprobe.fieldbus.bus.joined import JoinedPort
from canprobe.fieldbus.bus.port import Port, Reports
from canprobe.fieldbus.bus.real.interrupts import interrupts_held
from canprobe.fieldbus.bus.real.memory import garbage_collection_paused, reserve_memory
from canprobe.fieldbus.bus.real.processor import MASTER_PRIORITY, realtime
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.emulated.world import World


def with_bridges(scene: Scene, names: Sequence[str]) -> Scene:
    """The scene with more bridges in use; an unknown bridge raises `UsageError`."""
    if not names:
        return scene
    names = (names,) if isinstance(names, str) else names
    check_bridges(names)
    known = scene.bridge or BridgeSettings()
    use: Any = tuple(dict.fromkeys((*known.use, *names)))
    return replace(scene, bridge=replace(known, use=use))


class Session:
    """One cell from bring-up to safe stop. A context manager; :meth:`run` may be called more than once inside.

    Args:
        scene: the scene to bring up, or its plan.
        options: options of the run; the session writes ``bus.log``, ``scene.toml`` and ``truth.npz``.

    Attributes:
        record: record of the buses, from the entry on; every time in the files of the run counts from its `origin_ns`.
        around: puts something round the cell's port, such as a meter; set before the session is entered.
        unwritten: files that could not be written, each with the reason; the cell's faults list them too.
    """

    def __init__(self, scene: Scene | Plan, options: RunOptions = DEFAULT_OPTIONS) -> None:
        self.steps = StepLog(options.say, options.out / STEPS if options.recover and options.out else None)
        self.options = options = replace(options, say=self.steps)
        self.plan = scene if isinstance(scene, Plan) else make_plan(resolve(scene))
        self.scene = self.plan.scene
        self.out = options.out
        self.started_ns = 0
        self.wall_ns = 0
        self.truth: dict[str, Floats] = {}
        self.lockstep: LockstepBus | None = None
        self._ports: dict[str, Port] = {}
        self.unwritten: list[str] = []
        self.observers = Observers(options.observers) if options.observers else None
        self._say = options.say
        self._stack = ExitStack()
        self._open_buses = self._stack.enter_context(ExitStack())  # left last, also those that were opened again
        self._entered = self._left = False
        self._cell: Cell | None = None
        self._direct: Callable[..., Cycle] | None = None
        self._recovery: Recovery | None = None
        self._child: EmulatorChild | None = None
        self._stopped_for: CanprobeError | None = None
        self.around: Callable[[Port], Port] = lambda port: port

    @cached_property
    def world(self) -> World:
        """The emulated nodes and their plant on a lockstep bus; their participants may be replaced until it opens."""
        from canprobe.cell.emulated.world import make_world

        nodes, folder = self.scene.emulated_node_ids, self.options.rows_folder
        return make_world(self.plan, nodes, truth=self.keeps_all, at_once=True, folder=folder)

    @property
    def cell(self) -> Cell:
        """The cell, while the session is open or afterwards."""
        if self._cell is None:
            raise UsageError("the cell is not open: use `with canprobe.open_cell(scene) as cell:`")
        return self._cell if self._recovery is None else self._recovery.cell

    @property
    def started(self) -> bool:
        """Whether the buses were opened and the cell was made: a report is possible, even of a failed bring-up."""
        return self._cell is not None

    @property
    def opened(self) -> bool:
        """Whether the nodes were brought up."""
        return self._cell is not None and self.cell.cycle is not None

    @property
    def virtual(self) -> bool:
        """Whether it runs in this process, in virtual time."""
        return self.scene.bus.interface in VIRTUAL

    @property
    def keeps_all(self) -> bool:
        """Whether each cycle keeps its row in the log, and each SYNC its row in the truth."""
        return self.options.rows_kept is None

    def refuse_reentry(self) -> None:
        """Raise UsageError where the session was opened before."""
        if self._entered:
            raise UsageError("a session is opened once: open another cell with open_cell(scene)")

    def __enter__(self) -> Self:
        self.refuse_reentry()
        self._entered = True
        self.started_ns = elapsed_ns()
        for warning in self.plan.warnings:
            self._say(f"warning: {warning}")
        self.record = self._stack.enter_context(BusRecord(self.plan, self.out, self.observers))
        try:
            port = self.around(self._open())
            self.steps.time_s = lambda: (port.clock.now_ns() - self.record.origin_ns) * 1e-9
            self._cell = self._make_cell(port)
            if not self.virtual:
                self._get_ready(port)
            self._stack.enter_context(self.record.timed(port.clock))
            self._stack.enter_context(garbage_collection_paused(collect=not self.virtual))
            self._stack.callback(self._observe_frames, port)
            if self.options.recover:
                self._stack.callback(port.close)
                self._cell.__enter__()
                self._recovery = self._make_recovery(port, self._cell)
                self._stack.callback(self._recovery.close)
            else:
                self._stack.enter_context(self._cell)
            self._observe_frames(port)
            if not self.options.to_check and (other := exchanged(self.plan, self.cell.bring_up)) is not None:
                self._say(f"warning: {other}")
                self._note(other)
        except BaseException as error:
            self._close()
            need_controllers(self.scene.bus.interface, self._ports, error)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    def run(
        self,
        controller: Controller | Callable[[Measurement], Command],
        progress: Callable[[Measurement], None] = lambda _: None,
    ) -> None:
        """Run a controller until it is done; see :meth:`canprobe.cell.master.cell.Cell.run`.

        After a stop by the supervision nothing moves again before `resume`, unless it was a loss that a cell which
        recovers may come back from.
        """
        if self._left:
            raise UsageError("the cell is closed: open another one with `with canprobe.open_cell(scene) as cell:`")
        if self._stopped_for is not None:
            raise UsageError(
                f"the cell was stopped for safety: {self._stopped_for}; nothing moves again by itself: look at the arm,"
                " then call resume() before the next run"
            )
        first_second = None if self.virtual else FirstSecond(self.cell, self.plan, self._say)

        def after_cycle(measurement: Measurement) -> None:
            if first_second is not None:
                first_second(measurement)
            progress(measurement)

        after = progress if first_second is None else after_cycle
        try:
            if self._recovery is not None:
                self._recovery.run(controller, after)
            else:
                self.cell.run(controller, after)
        except CanprobeError as error:
            passing = self._recovery is not None and self._recovery.lost
            if isinstance(error, SafetyStop) or (self.cell.stopped_by is not None and not passing):
                self._stopped_for = error
            raise

    def resume(self) -> None:
        """Allow the next run after a stop for safety, or ask for motion after a loss; see `cell.session.recovery`.

        Raises:
            UsageError: nothing was stopped, and the cell was not opened with ``recover``; or the cell is closed.
        """
        if self._stopped_for is not None and not self._left:
            self._stopped_for = None
            return
        if self._recovery is None or self._left:
            raise UsageError(
                "resume: nothing was stopped for safety, and the cell is closed, or was not opened with recover=True"
            )
        self._recovery.resume()

    def _make_cell(self, port: Port, before: Cell | None = None) -> Cell:
        return Cell(
            self.plan,
            port,
            self.options,
            observers=self.observers,
            log_failure=self.record.failure,
            direct=self._direct,
            origin_ns=self.record.origin_ns,
            zeros=zeros_file(self.plan),
            before=before,
        )

    def _make_recovery(self, port: Port, cell: Cell) -> Recovery:
        def alive() -> None:
            if self._child is not None:
                self._child.raise_ended()

        return Recovery(
            self.plan,
            cell,
            port,
            make_cell=self._make_cell,
            reopen=lambda: self._reopen(port),
            alive=alive,
            say=self._say,
            longest_s=VIRTUAL_WAIT_S if self.virtual else math.inf,
        )

    def _reopen(self, port: Port) -> Port:
        """Open the interfaces again; in virtual time there is nothing to open.

        Raises:
            InterfaceError: one is missing, down or bus-off.
        """
        if self.virtual:
            return port
        check_links(self.scene.bus.interface, expected_of(self.plan), quiet)
        return self._join(self._open_ports(port.clock))

    def _close(self) -> None:
        try:
            self._stack.close()
        finally:
            self._left = True
            self.wall_ns = elapsed_ns() - self.started_ns
            self.note_unwritten(self.record.failure())
            self.note_unwritten(self.steps.failure)

    def note_unwritten(self, failure: str | None) -> None:
        """Note that a file could not be written, and why; None notes nothing."""
        if failure is not None and self._cell is not None:
            self.unwritten.append(failure)
            self._note(failure)

    def keep(self, name: str, rows: RowFiles) -> dict[str, NDArray[Any]]:
        """Write the columns of rows into a file of the run's folder, and read them back: large ones are mapped.

        A failure is noted, and the files of the rows stay. The columns then are in memory, as without a folder.
        """
        columns = rows.columns()
        if self.out is None or not columns:
            return dict(columns)
        try:
            with interrupts_held():
                write_npz(self.out / name, columns)
        except ResultsError as error:
            self.note_unwritten(str(error))
            return dict(columns)
        rows.remove()
        return read_npz(self.out / name)

    def _note(self, fault: str) -> None:
        if self._cell is not None:
            self._cell.notes.add(fault)

    # the three kinds of bus

    def _open(self) -> Port:
        if self.scene.bus.direct:
            return self._open_direct()
        return self._open_lockstep() if self.scene.bus.interface == LOCKSTEP else self._open_real()

    def _join(self, ports: dict[str, Port]) -> Port:
        """One port for the cell, whatever the number of buses."""
        return ports.popitem()[1] if len(ports) == 1 else JoinedPort(ports, channel_routes(self.plan))

    def _observe_frames(self, port: Port) -> None:
        """Give the observers the frames of bring-up, and those after the last cycle."""
        if self.observers is not None:
            self.observers.frames_alone(port.clock.now_ns())

    def _need_emulated(self, what: str) -> None:
        if missing := set(self.plan.node_ids) - set(self.scene.emulated_node_ids):
            raise UsageError(f"{what} emulated nodes only: node {min(missing)} is marked emulated = false")

    def _open_direct(self) -> Port:
        """Counts and images in the place of frames: the port's bus has no node, only its clock is used."""
        from canprobe.cell.session.direct import DirectCycle

        self._need_emulated("without a bus there are")
        if self.out is not None:
            prepare_folder(self.plan, self.out)
            with writing(self.out / "bus.log"):
                (self.out / "bus.log").unlink(missing_ok=True)
        self._stack.callback(self._keep_truth)
        self._direct = partial(DirectCycle, world=self.world)
        clock = VirtualClock()
        nobody = LockstepBus(clock, self.plan.buses[0].channel)
        clock.detach(nobody)
        return nobody.port()

    def _open_lockstep(self) -> Port:
        self._need_emulated("a lockstep bus has")
        if self.plan.setup.array is not None and not self.plan.setup.array.emulated:
            raise UsageError("a lockstep bus has emulated devices only: sensor.emulated = false")
        clock = VirtualClock()
        buses = {bus.channel: lockstep_bus(self.scene, clock, bus.channel) for bus in self.plan.buses}
        for channel, bus in buses.items():
            bus.recorder = self.record.writer(channel)
            bus.error_recorder = self.record.error_writer(channel)
        self.lockstep = buses[self.plan.buses[0].channel]
        participants = self.world.participants
        self._stack.callback(self._keep_truth)
        bus_of = {node.node_id: buses[node.channel] for node in self.plan.nodes}
        array = self.plan.setup.array
        for participant in participants:
            bus = bus_of.get(getattr(participant, "node_id", 0), self.lockstep)
            if participant is self.world.raw_array and array is not None:
                bus = buses[array.channel]
            bus.attach(participant)
        return self._join({channel: bus.port() for channel, bus in buses.items()})

    def _keep_truth(self) -> None:
        if self.world.recorder is not None:
            self.truth = TruthColumns(self.keep("truth.npz", self.world.recorder))

    def _open_real(self) -> Port:
        bus = self.scene.bus
        if bus.interface == "virtual" and self.plan.setup.emulates:
            raise UsageError(
                "python-can's virtual bus ends at the process, and emulated nodes have one of their own; use --bus"
                " lockstep, or --bus socketcan --channel vcan0 by: canprobe vcan -- COMMAND"
            )
        check_links(bus.interface, expected_of(self.plan), self._say)
        clock = MonotonicClock()
        self.record.origin_ns = clock.now_ns()
        return self._join(self._open_ports(clock))

    def _open_ports(self, clock: Clock) -> dict[str, Port]:
        """Open the ports of all buses, in the place of those that were open; their counters go on."""
        before = self._ports
        for port in before.values():
            port.close()
        ports = open_ports(self.plan, clock, lambda channel: Reports(self.record.error_writer(channel), self._note))
        self._ports = self._open_buses.enter_context(ports)
        for name, port in before.items():
            self._ports[name].counters.add(port.counters)
        return {name: RecordingPort(port, self.record.writer(name)) for name, port in self._ports.items()}

    def _get_ready(self, port: Port) -> None:
        """Get ready for real time: start the emulated nodes, rehearse, reserve memory, ask for priority."""
        child = None
        if self.plan.setup.emulates:
            self.cell.bring_up.listen()  # they would boot beside those of another master
            self._say("start the emulated nodes")
            channels = list(self.plan.emulated_channels)
            child = EmulatorChild(self.plan, self.out, channels, truth=self.keeps_all, origin_ns=self.record.origin_ns)
            self._stack.callback(self._end_child, child)
            child.start()
            self._child = child
        self._say("rehearse in lockstep")
        rehearse(self.plan)
        reserve_memory(self.plan.cycles if self.keeps_all else self.options.rows_kept)
        if child is not None:
            child.await_boot_ups(port, self._say, self.cell.watch.push)
        if self.scene.cycle.realtime:
            self._stack.enter_context(realtime(MASTER_PRIORITY, self._say))

    def _end_child(self, child: EmulatorChild) -> None:
        self.truth = child.end()
        self.note_unwritten(child.unwritten)


def rehearse(plan: Plan) -> None:
    """Run the beginning of a plan with every node emulated; its errors are ignored.

    Args:
        plan: the plan that is about to run on a real bus.
    """
    with contextlib.suppress(CanprobeError):
        run_beginning(plan)


def run_beginning(plan: Plan) -> Session:
    """Bring the cell of a plan up in lockstep with every node emulated, and carry out the beginning of its task.

    Returns:
        The session, closed.

    Raises:
        CanprobeError: as in a run.
    """
    with Session(shortened(plan.scene)) as session:
        session.run(make_task(session.plan))
    return session
