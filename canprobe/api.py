"""The Python API: run a scene's task, or open its cell for controllers; and the commands that need no results."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from functools import cached_property
from pathlib import Path
from types import NoneType, TracebackType
from typing import TYPE_CHECKING, Any, Self

from canprobe.cell.master.array import patch_from
from canprobe.cell.master.controller import Command, Controller, Measurement, TactileSample, as_controller
from canprobe.cell.master.observers import Observation, Observer, Observers
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.summary import RunResult, log_columns, summarise, tactile_columns, write_columns, write_files
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Setup, Touch
from canprobe.cell.session.check_joints import check_joints
from canprobe.cell.session.children import Bridges
from canprobe.cell.session.emulation import emulate, emulate_eds
from canprobe.cell.session.home import home
from canprobe.cell.session.looking import commission, monitor, scan
from canprobe.cell.session.session import Say, Session, quiet, with_bridges
from canprobe.cell.session.target import VIRTUAL, Target
from canprobe.cell.session.terminal import Progress
from canprobe.cell.session.up import up
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.shape import ShapeRecord, ShapeTracker, on_run_clock
from canprobe.cell.tasks.task import TaskRecord, record_of
from canprobe.errors import CanprobeError, ResultsError, UsageError
from canprobe.fieldbus.bus.real.interrupts import interrupts_held, interrupts_repeated
from canprobe.mechanics.robot.chain import forward_jacobian
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    import numpy.typing as npt

    from canprobe.cell.results.contacts import Contacts
    from canprobe.mechanics.touch.consistency import Consistency
    from canprobe.mechanics.touch.patch.image import Patch
    from canprobe.mechanics.touch.surface_map import SurfaceMap

__all__ = [
    "Command",
    "Measurement",
    "Observation",
    "RunResult",
    "Target",
    "check_joints",
    "commission",
    "emulate",
    "emulate_eds",
    "home",
    "monitor",
    "open_cell",
    "run",
    "scan",
    "up",
]

AnyObserver = Observer | Callable[[Observation], None]


def run(
    scene: Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    bus: str | None = None,
    channel: str | Mapping[str, str] | None = None,
    bitrate: int | None = None,
    out: Path | str | None = None,
    seed: int | None = None,
    duration_s: float | None = None,
    progress: Progress | None = None,
    say: Say = quiet,
    files: bool = True,
    force: bool = False,
    observers: Sequence[AnyObserver] = (),
    bridge: Sequence[str] = (),
) -> RunResult:
    """Run a scene's task and write what was measured.

    Args:
        scene: a packaged name, the path of a TOML file, or what `canprobe.load_scene` returns.
        overrides: values in the place of the scene's, such as ``{"task.force_n": 3}``; see `canprobe.load_scene`.
        bus: ``lockstep``, ``direct`` (no bus), ``socketcan`` or another interface, in the place of the scene's.
        channel: in the place of the scene's; ``{"can0": "vcan0", "can1": "vcan1"}`` where it names several.
        bitrate: in the place of the scene's, bit/s.
        out: folder for the files; ``runs/<scene>-<time>`` by default.
        seed: of the emulation, in the place of the scene's.
        duration_s: of the task, in the place of the scene's, s.
        progress: called with (seconds done, seconds in all).
        say: called with each step of bring-up and stop.
        files: False writes nothing.
        force: let the files replace those of an earlier run in ``out``; without, a folder that is not empty is refused.
        observers: called after each cycle with its measurement, command and frames (`Observation`).
        bridge: names of bridges to other tools, besides those of the scene; see `canprobe.cell.planning.bridges`.

    Returns:
        The finished run.

    Raises:
        SceneError: the scene has mistakes; nothing was started.
        PlanError: the scene does not fit; nothing was started.
        UsageError: an argument is wrong, or ``out`` is not empty; nothing was started.
        BusError: an interface or a node failed. The drives are disabled and the files written, unless no bus opened.
        SafetyStop: the cell was stopped for safety. The drives are disabled and the files written.
        ResultsError: a file could not be written, for example on a full disk. The drives are disabled.
    """
    _refuse_wrong(overrides, out, observers, bridge)
    given = {"scene.seed": seed, "task.duration_s": duration_s, "bus.interface": bus, "bus.bitrate": bitrate}
    scene = load_scene(scene, _over(overrides, given))
    resolved = with_bridges(Target.over(scene, channel=channel).applied_to(scene), bridge)
    folder = results_folder(resolved, out) if files else None
    check_free(folder, force=force)
    plan = make_plan(resolve(resolved))
    task = make_task(plan)
    with OpenCell(plan, folder, say, observers, task=task) as cell:
        return cell.run(cell.open_to_requests(task), _report(progress, resolved.task.duration_s))


def _refuse_wrong(overrides: object, out: object, observers: object, bridge: object) -> None:
    """Raise a UsageError where an argument of `run` or `open_cell` is of another kind than it must be."""
    for name, value, kinds, expected in (
        ("overrides", overrides, (Mapping, NoneType), 'values by key such as {"task.force_n": 3}'),
        ("out", out, (str, os.PathLike, NoneType), "the path of a folder"),
        ("observers", observers, (list, tuple), "a list of observers"),
        ("bridge", bridge, (list, tuple, str), "a list of names of bridges"),
    ):
        if not isinstance(value, kinds):
            raise UsageError(f"{name}: expected {expected}, got {value!r}")


def _over(overrides: Mapping[str, Any] | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """Overrides, and over them what an argument gives."""
    return {**(overrides or {}), **{key: value for key, value in given.items() if value is not None}}


def results_folder(scene: Scene, out: Path | str | None = None) -> Path:
    """Where `run` puts the files: ``out``, or ``runs/<scene>-<time>`` to the millisecond."""
    return Path(out) if out is not None else timed_folder(scene.name)


def timed_folder(name: str) -> Path:
    """``runs/<name>-<time>`` to the millisecond."""
    return Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S-%f}"[:-3]


def plan(scene: Scene | str | Path, overrides: Mapping[str, Any] | None = None) -> Plan:
    """Everything that follows from a scene before anything is started; see `canprobe.cell.planning.make.make_plan`.

    Args:
        scene, overrides: as for `run`.

    Returns:
        The plan.

    Raises:
        UsageError: there is no such scene.
        SceneError: the scene has mistakes.
        PlanError: with every reason why it does not fit, its numbers and the ways out.
    """
    return make_plan(resolve(load_scene(scene, overrides)))


def check_free(folder: Path | None, *, force: bool) -> None:
    """Refuse a folder that holds anything: results never replace others unless that is wanted.

    Raises:
        UsageError: it is not empty, and ``force`` is False.
    """
    if folder is not None and not force and folder.is_dir() and any(folder.iterdir()):
        raise UsageError(
            f"{folder}: not empty: name another folder for the results, or let them replace those of an earlier run"
            " there with --force (force=True)"
        )


def _report(progress: Progress | None, total_s: float) -> Callable[[Measurement], None]:
    if progress is None:
        return lambda _: None
    return lambda measurement: progress(min(measurement.t_ns * 1e-9, total_s), total_s)


def _estimates(setup: Setup, tracker: ShapeTracker | None) -> dict[str, list[ShapeRecord]]:
    """The answers of the estimator in the loop, and of the others on the same contacts."""
    if tracker is None or setup.shape is None:
        return {}
    from canprobe.cell.tasks.from_plan import estimates_of

    return estimates_of(setup, tracker, (setup.shape.method, *setup.shape.also))


def _mapped(
    setup: Setup, tracker: ShapeTracker | None, start_s: float
) -> tuple[SurfaceMap | None, Consistency | None, dict[str, Any] | None]:
    """The surface map of a scan, the tests at its crossings (they take a second), and both for the summary."""
    if tracker is None or setup.shape is None:
        return None, None, None
    from canprobe.cell.results.map_score import map_of_scan

    return map_of_scan(tracker, setup.shape.method, start_s)


def _drawings(result: RunResult, out: Path, say: Say) -> dict[str, Callable[[], None]]:
    """What draws each picture of a run of at least one cycle; the page of its scene comes last, it takes longest."""

    def report() -> None:
        from canprobe.cell.results.figures import draw_run

        draw_run(result, out / "report.png")

    def surface() -> None:
        from canprobe.cell.results.surface_figure import draw_surface

        draw_surface(result, out / "surface.png")

    def page() -> None:
        from canprobe.cell.results.page import write_page_of

        try:
            write_page_of(out, result.plan.setup, say)
        except UsageError as error:  # a controller's column that is called like one of ours and is something else
            say(f"report.html is left out: {error}")

    outputs = result.plan.outputs if len(result.log["t_s"]) else ()
    known = {"report.png": report, "surface.png": surface, "report.html": page}
    return {name: draw for name, draw in known.items() if name in outputs}


def _draw(name: str, draw: Callable[[], None]) -> str | None:
    """Draw one picture; why that failed. Whatever a library of pictures raises, the run's results are written."""
    try:
        with interrupts_repeated():
            draw()
    except (CanprobeError, OSError) as error:
        return str(error)
    except Exception as error:
        return f"{name}: cannot be drawn: {type(error).__name__}: {error}"
    return None


class OpenCell(Session):
    """A cell for controllers: brought up where its block is entered, stopped where it is left, with its results then.

    One block is one run, however many controllers it runs one after the other: one log, one summary, one folder. The
    summary's contact and shape are those of the controller that ran last.

    Args:
        plan: of the scene.
        out: folder of the results; None writes nothing.
        say: called with each step.
        observers: called after each cycle.
        rows_kept: cycles whose row of the log is kept, and no truth; None for all.
        task: whose contact and shape stand in the summary, whatever is run.
    """

    def __init__(
        self,
        plan: Plan,
        out: Path | None,
        say: Say,
        observers: Sequence[AnyObserver] = (),
        rows_kept: int | None = None,
        *,
        task: Controller | None = None,
    ) -> None:
        super().__init__(plan, out, say, (), rows_kept)
        self._bridges = Bridges(plan, out, virtual=plan.scene.bus.interface in VIRTUAL, say=say)
        self._watchers = tuple(observers)
        self._task = task
        self._last: Controller | None = task
        self._result = RunResult.__new__(RunResult)

    def __enter__(self) -> Self:
        if self._entered:
            return super().__enter__()  # which refuses it
        self._bridges.__enter__()
        try:
            if watchers := (*self._watchers, *self._bridges.observers):
                self.observers = Observers(watchers)
            super().__enter__()
        except BaseException as error:
            self._finish(error)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        failure = error
        try:
            super().__exit__(kind, error, trace)
        except BaseException as late:
            failure = late
            raise
        finally:
            self._finish(failure)

    def patch(self, sample: TactileSample) -> Patch:
        """What the array says of the contact: force, N, and place on the pad, m, with what makes them doubtful.

        Args:
            sample: of a measurement, `measurement.tactile`.

        Raises:
            UsageError: the scene has no array.
        """
        if self._patch_from is None:
            raise UsageError(f"{self.plan.setup.name}: expected a scene with an array; got one without")
        return self._patch_from(sample)

    @cached_property
    def _patch_from(self) -> Callable[[TactileSample], Patch] | None:
        return patch_from(self.plan.setup)

    def probe(self, q: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Where joint positions put the probe, and how it moves with them.

        Args:
            q: (n,) joint positions, rad or m.

        Returns:
            (4, 4) pose of the probe's centre in the base frame, m, whose z axis is the pole; and (6, n) its Jacobian:
            velocity (rows 0-2) and angular velocity (3-5) in the base frame, per rate of each joint.

        Raises:
            UsageError: the scene has no arm.
        """
        setup = self.plan.setup
        if setup.arm is None:
            raise UsageError(f"{setup.name}: expected a scene with an arm; got one without")
        return forward_jacobian(setup.arm.model.chain, q, setup.probe.T_flange_probe)

    def run(  # type: ignore[override]
        self,
        controller: Controller | Callable[[Measurement], Command],
        progress: Callable[[Measurement], None] = lambda _: None,
    ) -> RunResult:
        """Run a controller until it is done.

        Args:
            controller: a `Controller`, or a function of the measurement that returns a `Command`.
            progress: called with the measurement of each cycle.

        Returns:
            The result of the whole block, the same from every call; it is complete when the block is left.

        Raises:
            UsageError: this is no controller, or its step returned no command.
            BusError: the interface or a node failed.
            SafetyStop: the cell was stopped for safety, or the controller gave a `stop_reason`.
        """
        runs = as_controller(controller)
        if self._task is None:
            self._last = runs
        super().run(runs, progress)
        return self._result

    def open_to_requests(self, task: Controller) -> Controller:
        """The task, which other tools may start, stop and set where the scene allows that."""
        return self._bridges.open_to_requests(task)

    def _finish(self, failure: BaseException | None) -> None:
        """What the run was, once the bus is closed; nothing where none was opened."""
        try:
            if self.started:
                self._conclude(failure)
        finally:
            self._bridges.end(None)

    def _conclude(self, failure: BaseException | None) -> None:
        log, tactile = log_columns(self.cell), tactile_columns(self.cell)
        try:
            self._score(log, tactile, failure)
        except BaseException:  # what was measured is kept all the same
            self._write(lambda out: write_columns(log, tactile, out))
            raise
        summary = self._result.summary
        if isinstance(failure, CanprobeError):
            failure.summary = summary
        self._write(lambda out: write_files(self._result, out))
        if self.out is not None:
            for name, draw in _drawings(self._result, self.out, self._say).items():
                self._say(f"draw {name}")
                if (why := _draw(name, draw)) is not None:
                    self._note_unwritten(why)
        summary["faults"] += [line for line in self.unwritten if line not in summary["faults"]]
        if self.unwritten and failure is None:
            unwritten = ResultsError("\n".join(self.unwritten))
            unwritten.summary = summary
            raise unwritten
        for line in self.unwritten:  # what stopped the run comes first
            if failure is not None and line != str(failure):
                failure.add_note(line)

    def _score(
        self, log: dict[str, Floats], tactile: dict[str, npt.NDArray[Any]], failure: BaseException | None
    ) -> None:
        """Make the run's result of what was measured, by the plan that it ran with."""
        record, start_s, setup = record_of(self._last), self.cell.start_ns * 1e-9, self.plan.setup
        if record.shape is not None and setup.shape is not None and setup.shape.also:
            self._say(f"estimate again with {', '.join(setup.shape.also)}")
        estimates = _estimates(setup, record.shape)
        surface_map, consistency, map_summary = _mapped(setup, record.shape, start_s)
        summary = summarise(
            self,
            record,
            estimates,
            None if failure is None else _reason(failure),
            map_summary=map_summary,
            bridges=self._bridges.status(),
        )
        summary["bridges"] = self._bridges.end(summary)
        RunResult.__init__(
            self._result,
            self.plan,
            summary,
            log,
            self.truth,
            {name: on_run_clock(records, start_s) for name, records in estimates.items()},
            record.taxels,
            tactile,
            surface_map,
            consistency,
            self.out,
            self._contacts(record, start_s),
        )

    def _write(self, write: Callable[[Path], None]) -> None:
        """Write files into the run's folder; what cannot be written is noted, and raised at the end."""
        if self.out is None:
            return
        try:
            with interrupts_held():
                write(self.out)
        except ResultsError as error:
            for line in str(error).splitlines():
                self._note_unwritten(line)

    def _contacts(self, record: TaskRecord, start_s: float) -> Contacts | None:
        task = self.plan.setup.task
        if record.shape is None or not isinstance(task, Touch):
            return None
        from canprobe.cell.results.contacts import contacts_of

        return contacts_of(record.shape.samples, task, start_s)


def _reason(failure: BaseException) -> str:
    """Why a run ended, in words."""
    if isinstance(failure, KeyboardInterrupt):
        return "interrupted"
    return str(failure) if isinstance(failure, CanprobeError) else f"{type(failure).__name__}: {failure}"


def open_cell(
    scene: Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    bus: str | None = None,
    channel: str | Mapping[str, str] | None = None,
    bitrate: int | None = None,
    out: Path | str | None = None,
    seed: int | None = None,
    say: Say = quiet,
    force: bool = False,
    observers: Sequence[AnyObserver] = (),
    bridge: Sequence[str] = (),
    rows_kept: int | None = None,
) -> OpenCell:
    """A cell for controllers of your own; leaving its block always disables the drives and closes the bus.

    Example::

        with canprobe.open_cell("free", out="runs/mine") as cell:
            result = cell.run(my_controller)
        print(result.text())

    The block is the run: its result is complete, and its files are written, when it is left, however it is left.

    Args:
        scene, overrides, bus, channel, bitrate, seed: as for `run`.
        out: folder for the same files as those of `run`; None writes nothing.
        say: called with each step.
        force, observers, bridge: as for `run`.
        rows_kept: cycles whose row of the log is kept; all by default, which grows by about 1 KiB a cycle. With a
            number the truth is not kept, and the scan is not scored.

    Returns:
        The cell; ``with`` brings it up.

    Raises:
        SceneError: the scene has mistakes; nothing was started.
        PlanError: the scene does not fit; nothing was started.
        UsageError: an argument is wrong, or ``out`` is not empty; nothing was started.
        BusError: when the block is entered: an interface or a node failed.
        SafetyStop: when the block is entered: the probe is pressed.
        ResultsError: when the block is left: a file could not be written.
    """
    _refuse_wrong(overrides, out, observers, bridge)
    given = {"scene.seed": seed, "bus.interface": bus, "bus.bitrate": bitrate}
    scene = load_scene(scene, _over(overrides, given))
    resolved = with_bridges(Target.over(scene, channel=channel).applied_to(scene), bridge)
    folder = Path(out) if out is not None else None
    check_free(folder, force=force)
    return OpenCell(make_plan(resolve(resolved)), folder, say, observers, rows_kept)
