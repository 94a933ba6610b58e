"""The Python API and what the command line calls: run, open_cell, up, emulate, scan."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from canprobe.bus.scheduling import interrupts_held, interrupts_repeated
from canprobe.cell.controller import Command, Controller, Measurement, as_controller
from canprobe.cell.cycle import Observation, Observer, Observers
from canprobe.errors import BusError, CanprobeError, ResultsError, UsageError
from canprobe.planning.make import make_plan
from canprobe.planning.model import Plan
from canprobe.results.summary import RunResult, log_columns, summarise, write_files
from canprobe.scene.model import Scene
from canprobe.scene.resolve import resolve
from canprobe.session.children import Bridges
from canprobe.session.emulation import emulate, emulate_eds
from canprobe.session.links import check_links, need_controllers
from canprobe.session.session import LOCKSTEP, Say, Session, hush_canopen, open_ports, quiet, resolve_scene
from canprobe.session.up import check_joints, news_teller, telling_notes
from canprobe.tasks.from_plan import make_task
from canprobe.tasks.shape import ShapeRecord, ShapeTracker, on_run_clock
from canprobe.tasks.task import record_of
from canprobe.tasks.untouched import HoldTask

if TYPE_CHECKING:
    from canprobe.bus.port import Port
    from canprobe.cell.commission import Commissioned
    from canprobe.cell.monitor import CellView
    from canprobe.touch.consistency import Consistency
    from canprobe.touch.surface_map import SurfaceMap


MONITOR_PERIOD_NS = 100_000_000
SILENCE_NS = 1_000_000_000
"""A bus on which nothing was heard for so long has its controller looked at."""

__all__ = [
    "Command",
    "Measurement",
    "Observation",
    "RunResult",
    "check_joints",
    "commission",
    "emulate",
    "emulate_eds",
    "monitor",
    "open_cell",
    "run",
    "scan",
    "up",
]

ROWS_OF_UP = 4000
"""Cycles that `up` remembers: it runs for days."""
Progress = Callable[[float, float], None]
AnyObserver = Observer | Callable[[Observation], None]


def run(
    scene: Scene,
    *,
    interface: str | None = None,
    channel: str | None = None,
    sensor_channel: str | None = None,
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
    """Carry out a scene's task and write what was measured.

    Args:
        scene: from `canprobe.load_scene`.
        interface, channel, bitrate: in the place of the scene's bus.
        sensor_channel: the sensor's bus, where it is another one.
        out: folder for the files; ``runs/<scene>-<time>`` by default.
        seed, duration_s: in the place of the scene's.
        progress: called with (seconds done, seconds in all).
        say: called with each step of bring-up and stop.
        files: False writes nothing.
        force: let the files replace those of an earlier run in ``out``; without, a folder that is not empty is refused.
        observers: called after each cycle with what it saw, said and had on the bus (`Observation`).
        bridge: names of bridges to other tools, besides those of the scene; see `canprobe.planning.bridges`.

    Raises:
        UsageError: the scene does not fit; nothing was started.
        BusError: an interface or a node failed. The drives are disabled and the files written, unless no bus opened.
        SafetyStop: the cell was stopped for safety. The drives are disabled and the files written.
        ResultsError: a file could not be written, for want of room say. The drives are disabled.
    """
    resolved = resolve_scene(
        scene,
        interface=interface,
        channel=channel,
        sensor_channel=sensor_channel,
        bitrate=bitrate,
        seed=seed,
        duration_s=duration_s,
        bridge=bridge,
    )
    folder = results_folder(resolved, out) if files else None
    check_free(folder, force=force)
    plan = make_plan(resolve(resolved))
    task = make_task(plan)
    with OpenCell(plan, folder, say, observers, task=task) as cell:
        return cell.run(cell.open_to_requests(task), _report(progress, resolved.task.duration_s))


def _requested(
    plan: Plan, task: Controller | None, make: Callable[[], Controller] | None, bridges: Bridges
) -> Controller:
    """The task, open to requests where other tools may make any; nothing of the kind is loaded where not."""
    if not bridges.requests:
        return task if task is not None else HoldTask()
    from canprobe.tasks.from_plan import RequestedTask

    return RequestedTask(task, make, bridges.requests, plan.sync.period_ns * 1e-9)


def results_folder(scene: Scene, out: Path | str | None = None) -> Path:
    """Where `run` puts the files: ``out``, or ``runs/<scene>-<time>`` to the millisecond."""
    return Path(out) if out is not None else Path("runs") / f"{scene.name}-{datetime.now():%Y%m%d-%H%M%S-%f}"[:-3]


def plan(scene: Scene) -> Plan:
    """Everything that follows from a scene before anything is started; see `canprobe.planning.make.make_plan`.

    Raises:
        UsageError: this is no scene.
        PlanError: with every reason why it does not fit, its numbers and the ways out.
    """
    return make_plan(resolve(scene))


def check_free(folder: Path | None, *, force: bool) -> None:
    """Refuse a folder that holds anything: results never replace others unless that is wanted.

    Raises:
        UsageError: it is not empty, and nobody said that this is well.
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


def _estimates(scene: Scene, tracker: ShapeTracker | None) -> dict[str, list[ShapeRecord]]:
    """What the estimator in the loop said, and the others on the same contacts."""
    if tracker is None or scene.shape is None:
        return {}
    from canprobe.tasks.from_plan import estimates_of

    return estimates_of(resolve(scene), tracker, (scene.shape.method, *scene.shape.also))


def _mapped(
    scene: Scene, tracker: ShapeTracker | None, start_s: float
) -> tuple[SurfaceMap | None, Consistency | None, dict[str, Any] | None]:
    """The surface map of a scan, the tests at its crossings, which take a second, and what the summary says of them."""
    if tracker is None or scene.shape is None:
        return None, None, None
    from canprobe.results.scores import map_of_scan

    return map_of_scan(tracker, scene.shape.method, start_s)


def _draw(result: RunResult, out: Path, say: Say) -> None:
    if not len(result.log["t_s"]):
        return
    if "report.html" in result.plan.outputs:
        page, recorded = (importlib.import_module(f"canprobe.bridge.view.{name}") for name in ("browser", "recorded"))
        try:
            shown = recorded.read_run(out)
        except UsageError as error:  # a controller's column that is called like one of ours and is something else
            say(f"report.html is left out: {error}")
        else:
            page.write_page(shown, out / "report.html")
    if "report.png" in result.plan.outputs:
        from canprobe.results.figures import draw_run
        from canprobe.results.surface_figure import draw_surface

        draw_run(result, out / "report.png")
        draw_surface(result, out / "surface.png")


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
        self._bridges = Bridges(plan, out, virtual=plan.scene.bus.interface == LOCKSTEP, say=say)
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

    def run(  # type: ignore[override]
        self,
        controller: Controller | Callable[[Measurement], Command],
        progress: Callable[[Measurement], None] = lambda _: None,
    ) -> RunResult:
        """Run a controller until it is done; see :meth:`canprobe.cell.cell.Cell.run`.

        Returns:
            The result of the whole block, the same from every call; it is complete when the block is left.
        """
        runs = as_controller(controller)
        if self._task is None:
            self._last = runs
        super().run(runs, progress)
        return self._result

    def open_to_requests(self, task: Controller) -> Controller:
        """The task, which other tools may start, stop and set where the scene allows that."""
        return _requested(self.plan, task, None, self._bridges)

    def _finish(self, failure: BaseException | None) -> None:
        """What the run was, once the bus is closed; nothing where none was opened."""
        try:
            if self.started:
                self._conclude(failure)
        finally:
            self._bridges.end(None)

    def _conclude(self, failure: BaseException | None) -> None:
        record, start_s = record_of(self._last), self.cell.start_ns * 1e-9
        estimates = _estimates(self.scene, record.shape)
        surface_map, consistency, map_summary = _mapped(self.scene, record.shape, start_s)
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
            log_columns(self.cell),
            self.truth,
            {name: on_run_clock(records, start_s) for name, records in estimates.items()},
            record.taxels,
            surface_map,
            consistency,
            self.out,
        )
        if isinstance(failure, CanprobeError):
            failure.summary = summary
        if self.out is not None:
            try:
                with interrupts_held():
                    write_files(self._result, self.out)
                with interrupts_repeated():
                    _draw(self._result, self.out, self._say)
            except (CanprobeError, OSError) as error:
                summary["faults"].append(str(error))
                self.unwritten.append(str(error))
        if self.unwritten and failure is None:
            unwritten = ResultsError("\n".join(self.unwritten))
            unwritten.summary = summary
            raise unwritten
        for told in self.unwritten:  # what stopped the run counts for more
            if failure is not None and told != str(failure):
                failure.add_note(told)


def _reason(failure: BaseException) -> str:
    """Why a run ended, in words."""
    if isinstance(failure, KeyboardInterrupt):
        return "interrupted"
    return str(failure) if isinstance(failure, CanprobeError) else f"{type(failure).__name__}: {failure}"


def open_cell(
    scene: Scene,
    *,
    interface: str | None = None,
    channel: str | None = None,
    sensor_channel: str | None = None,
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

        with canprobe.open_cell(canprobe.load_scene("free"), out="runs/mine") as cell:
            result = cell.run(my_controller)
        print(result.text())

    The block is the run: its result is complete, and its files are written, when it is left, however it is left.

    Args:
        scene: from `canprobe.load_scene`.
        interface, channel, sensor_channel, bitrate, seed: in the place of the scene's.
        out: folder for the same files as those of :func:`run`; None writes nothing.
        say: called with each step.
        force, observers, bridge: as for `run`.
        rows_kept: cycles whose row of the log is kept; all by default, which grows by about 1 KiB a cycle. With a
            number nothing is kept of the truth, and the scan is not scored.

    Raises:
        UsageError: the scene does not fit, or ``out`` is not empty; nothing was started.

    Entering the block raises:
        BusError: an interface or a node failed.
        SafetyStop: the probe is pressed on.

    Leaving it raises:
        ResultsError: a file could not be written.
    """
    resolved = resolve_scene(
        scene,
        interface=interface,
        channel=channel,
        sensor_channel=sensor_channel,
        bitrate=bitrate,
        seed=seed,
        bridge=bridge,
    )
    folder = Path(out) if out is not None else None
    check_free(folder, force=force)
    return OpenCell(make_plan(resolve(resolved)), folder, say, observers, rows_kept)


def up(
    scene: Scene,
    *,
    interface: str | None = None,
    channel: str | None = None,
    sensor_channel: str | None = None,
    bitrate: int | None = None,
    say: Say = quiet,
    bridge: Sequence[str] = (),
) -> None:
    """Bring the cell up, hold and supervise it until it is interrupted, then stop it safely.

    Raises:
        UsageError, BusError, SafetyStop: as `run`.
    """
    if (interface or scene.bus.interface) == LOCKSTEP:
        raise UsageError("up: a lockstep bus lives inside one run; name a real interface with --bus")
    resolved = resolve_scene(
        scene, interface=interface, channel=channel, sensor_channel=sensor_channel, bitrate=bitrate, bridge=bridge
    )
    plan = make_plan(resolve(resolved))
    with (
        Bridges(plan, None, virtual=False, say=say) as bridges,
        telling_notes(Session(plan, None, say, bridges.observers, ROWS_OF_UP), say) as session,
    ):
        say(f"the cell is up: nodes {', '.join(map(str, plan.node_ids))}; Ctrl-C stops it")
        session.run(_requested(plan, None, lambda: make_task(plan), bridges), news_teller(session, say))


def scan(
    interface: str, channel: str, bitrate: int, timeout_s: float = 0.2, *, say: Say = quiet
) -> list[dict[str, Any]]:
    """List the nodes that answer on a bus, with the identity that 1018h gives.

    Args:
        interface, channel, bitrate: of the bus.
        timeout_s: to wait for an answer.
        say: called with what is wrong with the interface's setting.

    Raises:
        InterfaceError: no such interface, or no node answers and the CAN controller's state is why.
    """
    from canprobe.cell.commission import scan_nodes

    with _bus_without_scene(interface, channel, bitrate, say) as port:
        nodes = scan_nodes(port, timeout_s)
    if not nodes:
        need_controllers(interface, {channel: port})
    return nodes


@contextlib.contextmanager
def _bus_without_scene(interface: str, channel: str, bitrate: int, say: Say) -> Iterator[Port]:
    """A port of a bus of which nothing more is known, whose setting is no reason to leave it alone."""
    from canprobe.bus.interfaces import open_port
    from canprobe.bus.port import MonotonicClock
    from canprobe.session.links import Expected

    hush_canopen()
    check_links(interface, {channel: Expected(bitrate, of_scene=False)}, say, must=False)
    port = open_port(interface, channel, bitrate, MonotonicClock())
    try:
        yield port
    except BusError as error:
        need_controllers(interface, {channel: port}, error)
        raise
    finally:
        port.close()


def commission(
    interface: str,
    channel: str,
    bitrate: int,
    *,
    scene: Scene | None = None,
    assign: Sequence[tuple[tuple[int | None, int | None, int | None, int | None], int]] = (),
    store: bool = True,
    say: Say = quiet,
) -> Commissioned:
    """Find the nodes that have no id and give them theirs by LSS (CiA 305).

    Args:
        interface, channel, bitrate: of the bus.
        scene: whose nodes get their ids; as far as its EDS files and serial numbers tell which is which.
        assign: or else ((vendor, product, revision, serial number), node id), None for a number that may be any.
        store: let the devices keep their ids when their power goes.
        say: called with what is wrong with the interface's setting.

    Raises:
        UsageError: the scene does not fit.
        BusError: see `canprobe.cell.commission.commission`.
        InterfaceError: no such interface, or no node answers and the CAN controller's state is why.
    """
    from canprobe.cell.commission import Wanted, commission, wanted_by

    wanted = [Wanted(node_id, "--assign", numbers) for numbers, node_id in assign]
    if scene is not None:
        wanted = wanted_by(make_plan(resolve(resolve_scene(scene, interface=interface))))
    with _bus_without_scene(interface, channel, bitrate, say) as port:
        done = commission(port, wanted, must=scene is None, store=store)
    if not done.nodes and not done.unconfigured:
        need_controllers(interface, {channel: port})
    return done


def monitor(
    scene: Scene,
    *,
    interface: str | None = None,
    channel: str | None = None,
    sensor_channel: str | None = None,
    bitrate: int | None = None,
    duration_s: float | None = None,
    say: Say = quiet,
) -> Iterator[CellView]:
    """Look at a running cell ten times a second, sending nothing.

    Args:
        scene: what is on the bus.
        interface, channel, sensor_channel, bitrate: in the place of the scene's.
        duration_s: how long; for ever by default.
        say: called with what is wrong with the interface's setting.

    Yields:
        What is known by then; the same object each time.

    Raises:
        UsageError: the scene does not fit, or its bus is a lockstep bus, which lives inside one run.
        InterfaceError: no such interface, or it was lost; or a bus is silent and its CAN controller's state is why.
    """
    from canprobe.bus.port import MonotonicClock
    from canprobe.cell.monitor import Monitor
    from canprobe.session.links import expected_of

    resolved = resolve_scene(
        scene, interface=interface, channel=channel, sensor_channel=sensor_channel, bitrate=bitrate
    )
    if resolved.bus.interface == LOCKSTEP:
        raise UsageError("monitor: a lockstep bus lives inside one run; name a real interface with --bus")
    plan, clock, interface = make_plan(resolve(resolved)), MonotonicClock(), resolved.bus.interface
    wanted = {name: replace(expected, frames_at_once=0) for name, expected in expected_of(plan).items()}
    check_links(interface, wanted, say, must=False)
    with open_ports(plan, clock) as ports:
        listener = Monitor(plan)
        start_ns = next_ns = clock.now_ns()
        duration_ns = None if duration_s is None else duration_s * 1e9
        patience_ns = SILENCE_NS if duration_ns is None else min(SILENCE_NS, duration_ns)
        heard_ns = dict.fromkeys(ports, start_ns)
        while duration_ns is None or next_ns < start_ns + duration_ns:
            next_ns += MONITOR_PERIOD_NS
            clock.sleep_until_ns(next_ns)
            for name, port in ports.items():
                if frames := port.drain():
                    listener.push(frames, name)
                    heard_ns[name] = next_ns
                elif next_ns - heard_ns[name] >= patience_ns:
                    need_controllers(interface, {name: port})
                    heard_ns[name] = next_ns  # the state is asked for once a second at most
            yield listener.view(clock.now_ns())
