"""A cell with everything round it: buses, recording, emulated nodes, and the way out of all of them.

The composition root: the only place, besides studies and tests, that sees both sides of the bus. In real time the first
second of a run is judged as a link, by the figures of its own cycle.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Self

from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.observers import Observers
from canprobe.cell.master.options import DEFAULT_OPTIONS, RunOptions, Say
from canprobe.cell.planning.bridges import check_bridges
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.model import BridgeSettings, Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.buses import BusRecord, RealBuses, make_buses
from canprobe.cell.session.folder import STEPS, KeptFiles, StepLog, zeros_file
from canprobe.cell.session.joint_record import exchanged
from canprobe.cell.session.links import need_controllers
from canprobe.cell.session.recovery import VIRTUAL_WAIT_S, Recovery
from canprobe.cell.session.target import LOCKSTEP, VIRTUAL
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError, SafetyStop, UsageError
from canprobe.fieldbus.bus.clock import elapsed_ns
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.real.memory import garbage_collection_paused, reserve_memory
from canprobe.fieldbus.bus.real.processor import MASTER_PRIORITY, realtime
from canprobe.fieldbus.tools.link import AnswerFigures, Fitness, LinkFigures, LinkLimits, judge_link

if TYPE_CHECKING:
    from canprobe.cell.master.external_arm import ExternalArm

REHEARSED_S = 0.3
"""Length of the scene's phase in a rehearsal, s: an estimator answers several times in it."""
CLEARANCE_MM = 0.5
"""Longest way to the object, mm: its cycles are all alike."""
MAX_TOUCHES = 2


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
        buses: its buses, with the emulated nodes: `world`, `lockstep` and, at the end, `truth`.
        files: files of its folder, and those that could not be written.
        record: record of the buses, from the entry on; every time in the files of the run counts from its `origin_ns`.
        around: puts something round the cell's port, such as a meter; set before the session is entered.
    """

    def __init__(self, scene: Scene | Plan, options: RunOptions = DEFAULT_OPTIONS) -> None:
        self.steps = StepLog(options.say, options.out / STEPS if options.recover and options.out else None)
        self.options = options = replace(options, say=self.steps)
        self.plan = scene if isinstance(scene, Plan) else make_plan(resolve(scene))
        self.scene = self.plan.scene
        self.started_ns = 0
        self.wall_ns = 0
        self.files = KeptFiles(options.out, self._note)
        self.observers = Observers(options.observers) if options.observers else None
        self.around: Callable[[Port], Port] = lambda port: port
        self._stack = ExitStack()
        self.buses = make_buses(self.plan, options, self.files, self._stack)
        self._entered = self._left = False
        self._cell: Cell | None = None
        self._recovery: Recovery | None = None
        self._stopped_for: CanprobeError | None = None
        self._arm: ExternalArm | None = None

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

    def refuse_reentry(self) -> None:
        """Raise UsageError where the session was opened before."""
        if self._entered:
            raise UsageError("a session is opened once: open another cell with open_cell(scene)")

    def __enter__(self) -> Self:
        self.refuse_reentry()
        self._entered = True
        self.started_ns = elapsed_ns()
        for warning in self.plan.warnings:
            self.steps(f"warning: {warning}")
        self.record = BusRecord(self.plan, self.options.out, self.observers, self._stack)
        try:
            port = self.around(self.buses.open(self.record))
            self.steps.time_s = lambda: (port.clock.now_ns() - self.record.origin_ns) * 1e-9
            self._arm = self._external_arm(port)
            self._cell = self._make_cell(port)
            if isinstance(self.buses, RealBuses):
                self._get_ready(port, self._cell, self.buses)
            self._stack.enter_context(self.record.timed(port.clock))
            self._stack.enter_context(garbage_collection_paused(collect=not self.virtual))
            self._stack.callback(self._observe_frames, port)
            if self.options.recover:
                self._stack.callback(port.close)
                self._cell.__enter__()
                self._recovery = Recovery(
                    self.plan,
                    self._cell,
                    port,
                    make_cell=self._make_cell,
                    buses=self.buses,
                    say=self.steps,
                    longest_s=VIRTUAL_WAIT_S if self.virtual else math.inf,
                )
                self._stack.callback(self._recovery.close)
            else:
                self._stack.enter_context(self._cell)
            self._observe_frames(port)
            if not self.options.to_check and (other := exchanged(self.plan, self.cell.bring_up)) is not None:
                self.steps(f"warning: {other}")
                self._note(other)
        except BaseException as error:
            self._close()
            need_controllers(self.scene.bus.interface, self.buses.ports, error)
            raise
        return self

    def __exit__(self, *_: object) -> None:
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
        after, runner = progress, self.cell if self._recovery is None else self._recovery
        if not self.virtual:
            first_second = FirstSecond(self.cell, self.plan, self.steps)

            def after(measurement: Measurement) -> None:
                first_second(measurement)
                progress(measurement)

        try:
            runner.run(controller, after)
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
            self.cell.watch.start(self.cell.port.clock.now_ns())  # alarms from before have been looked at
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
            direct=self.buses.make_cycle,
            origin_ns=self.record.origin_ns,
            zeros=zeros_file(self.plan),
            before=before,
            arm=self._arm,
        )

    def _external_arm(self, port: Port) -> ExternalArm | None:
        """The arm that is not on the bus, stopped on every way out; None with drives, or without an arm."""
        arm, its = self.options.arm, self.plan.setup.arm
        if its is None or (external := its.external) is None:
            if arm is not None:
                raise UsageError('arm: expected a scene with arm.kind = "external", got one without')
            return None
        from canprobe.cell.master.external_arm import stopping

        if arm is None and external.emulated:
            from canprobe.cell.emulated.flange_arm import EmulatedArm

            arm = EmulatedArm(self.plan, self.buses.world.plant, port.clock)
        elif arm is None:
            if external.address is None:
                raise UsageError(
                    "arm.address: missing: expected where the program of the arm listens, or arm= in Python"
                )
            from canprobe.cell.session.arm_socket import SocketArm

            arm = self._stack.enter_context(contextlib.closing(SocketArm(external)))
        return self._stack.enter_context(stopping(arm))

    def _close(self) -> None:
        try:
            self._stack.close()
        finally:
            self._left = True
            self.wall_ns = elapsed_ns() - self.started_ns
            self.files.note_unwritten(self.record.failure())
            self.files.note_unwritten(self.steps.failure)

    def _note(self, fault: str) -> None:
        if self._cell is not None:
            self._cell.notes.add(fault)

    def _observe_frames(self, port: Port) -> None:
        """Give the observers the frames of bring-up, and those after the last cycle."""
        if self.observers is not None:
            self.observers.frames_alone(port.clock.now_ns())

    def _get_ready(self, port: Port, cell: Cell, buses: RealBuses) -> None:
        """Get ready for real time: start the emulated nodes, rehearse, reserve memory, ask for priority."""
        if self.plan.setup.emulates:
            cell.bring_up.listen()  # they would boot beside those of another master
        buses.start_nodes()
        self.steps("rehearse in lockstep")
        rehearse(self.plan)
        reserve_memory(self.plan.cycles if self.options.rows_kept is None else self.options.rows_kept)
        buses.await_nodes(port, cell.watch.push)
        if self.scene.cycle.realtime:
            self._stack.enter_context(realtime(MASTER_PRIORITY, self.steps))


def rehearse(plan: Plan) -> None:
    """Run the beginning of a plan in lockstep, with every node emulated, before a real bus; its errors are ignored.

    No real cycle makes a first call then. A first call is slow: libraries are paged in, tables filled, the interpreter
    specialises its code. On a slow processor first cycles took 3 to 10 ms each, and the drives stopped by themselves
    because SYNCs were missing.
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


def shortened(scene: Scene) -> Scene:
    """The scene on a lockstep bus without bit times, with all parts of its cycles in as few cycles as possible."""
    task = replace(
        scene.task,
        duration_s=min(scene.task.duration_s, REHEARSED_S),
        clearance_mm=min(scene.task.clearance_mm, CLEARANCE_MM),
        touches=min(scene.task.touches, MAX_TOUCHES),
    )
    devices = {name: getattr(scene, name) for name in ("arm", "sensor", "carrier")}
    return replace(
        scene,
        bus=replace(scene.bus, interface=LOCKSTEP, timed=False, bit_error_rate=0.0),
        task=task,
        joints={name: replace(joint, emulated=None) for name, joint in scene.joints.items()},
        **{name: replace(one, emulated=True) for name, one in devices.items() if one is not None},
    )


def link_limits(plan: Plan) -> LinkLimits:
    """Limits of a plan's cell for the link."""
    missed = plan.setup.arm.missed_syncs if plan.setup.arm is not None else 5
    return LinkLimits(missed, plan.setup.limits.late_share)


class FirstSecond:
    """Judges the first second of a run in real time by the figures of the cycle itself, and says where it is not fit.

    Args:
        cell: the cell, brought up.
        plan: its plan.
        say: called with the verdict, if it is not fit.
    """

    def __init__(self, cell: Cell, plan: Plan, say: Say) -> None:
        self._cell, self._plan, self._say = cell, plan, say
        patient = plan.setup.limits.late_share >= 1.0  # late cycles are expected, and stop nothing
        self._left: int | None = None if patient else round(1e9 / plan.sync.period_ns)
        self._begin = self._counts()

    def __call__(self, _: Measurement) -> None:
        """Count a cycle."""
        if self._left is None:
            return
        self._left -= 1
        if self._left > 0:
            return
        self._left = None
        cell, period_ns = self._cell, self._plan.sync.period_ns
        missed, late, full = (now - then for now, then in zip(self._counts(), self._begin, strict=True))
        lateness = sorted(list(cell.cycles.cycle.statistics.period_error_ns)[-round(1e9 / period_ns) :])
        answers: tuple[AnswerFigures, ...] = ()
        if cell.drives is not None:
            number = len(lateness) * len(cell.drives.axes)
            answers = (AnswerFigures(0, number, (), min(late, missed), max(0, missed - late), (1,) * missed),)
        wait_ns = self._plan.budget.looks_ns[-1]
        figures = LinkFigures(period_ns, lateness, wait_ns, answers, queue_full=full)
        verdict = judge_link(figures, link_limits(self._plan))
        if verdict.fitness is not Fitness.FIT:
            self._say(
                f"warning: in its first second the link was {verdict.fitness} for {verdict.rate_hz:g} Hz: {late}"
                f" answers late, {missed} missed, {100 * figures.late_share():.1f} % overruns; canprobe check"
                f" {self._plan.setup.name} says why"
            )

    def _counts(self) -> tuple[int, int, int]:
        drives = self._cell.drives
        missed, late = (drives.missed, drives.late) if drives is not None else (0, 0)
        return missed, late, self._cell.port.counters.transmit_full
