"""The Python API and what the command line calls: run, open_cell, up, emulate, scan."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canprobe.bridging import Bridges
from canprobe.bus.interrupts import interrupts_held
from canprobe.cell.build import make_task
from canprobe.cell.measurement import Command, Controller, Measurement
from canprobe.cell.observe import Observation, Observer
from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.emulation import emulate, emulate_eds
from canprobe.errors import CanprobeError, ResultsError, UsageError
from canprobe.joint_report import check_joints
from canprobe.link_report import check_links
from canprobe.note_report import news_teller, telling_notes
from canprobe.planning import Plan, make_plan
from canprobe.results import RunResult, log_columns, summarise, write_files
from canprobe.scene import Scene
from canprobe.scene_resolve import resolve
from canprobe.session import LOCKSTEP, Say, Session, hush_canopen, quiet, resolve_scene
from canprobe.session_bus import open_ports

if TYPE_CHECKING:
    from canprobe.cell.commission import Commissioned
    from canprobe.cell.monitor import CellView
    from canprobe.touch.consistency import Consistency
    from canprobe.touch.surface_map import SurfaceMap

MONITOR_PERIOD_NS = 100_000_000

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
        observers: called after each cycle with what it saw, said and had on the bus (`Observation`).
        bridge: names of bridges to other tools, besides those of the scene; see `canprobe.planning.bridges`.

    Raises:
        UsageError: the scene does not fit; nothing was started.
        BusError: an interface or a node failed. The drives are disabled and the files written, unless no bus opened.
        SafetyStop: the cell was stopped for safety. The drives are disabled and the files written.
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
    plan = make_plan(resolve(resolved))
    controller = make_task(plan)
    failure: BaseException | None = None
    with Bridges(plan, folder, virtual=resolved.bus.interface == LOCKSTEP, say=say) as bridges:
        session = Session(plan, folder, say, (*observers, *bridges.observers))
        try:
            with session:
                session.run(_requested(plan, controller, None, bridges), _report(progress, resolved.task.duration_s))
        except (CanprobeError, KeyboardInterrupt) as error:
            failure = error
            if not session.started:
                raise
        result = _finish(session, controller, failure, bridges)
    if failure is not None:
        if isinstance(failure, CanprobeError):
            failure.summary = result.summary
        raise failure
    return result


def _requested(
    plan: Plan, task: Controller | None, make: Callable[[], Controller] | None, bridges: Bridges
) -> Controller:
    """The task, open to requests where other tools may make any; nothing of the kind is loaded where not."""
    if not bridges.requests:
        return task if task is not None else _Hold()
    from canprobe.cell.tasks.requested import RequestedTask

    return RequestedTask(task, make, bridges.requests, plan.sync.period_ns * 1e-9)


class _Hold:
    """Stay where the drives are."""

    def step(self, _: Measurement) -> Command:
        """Nothing to do."""
        return Command()


def results_folder(scene: Scene, out: Path | str | None = None) -> Path:
    """Where `run` puts the files: ``out``, or ``runs/<scene>-<time>`` to the millisecond."""
    return Path(out) if out is not None else Path("runs") / f"{scene.name}-{datetime.now():%Y%m%d-%H%M%S-%f}"[:-3]


def plan(scene: Scene) -> Plan:
    """Everything that follows from a scene before anything is started; see `canprobe.planning.make_plan`.

    Raises:
        UsageError: this is no scene.
        PlanError: with every reason why it does not fit, its numbers and the ways out.
    """
    return make_plan(resolve(scene))


def _report(progress: Progress | None, total_s: float) -> Callable[[Measurement], None]:
    if progress is None:
        return lambda _: None
    return lambda measurement: progress(min(measurement.t_ns * 1e-9, total_s), total_s)


def _finish(session: Session, controller: object, failure: BaseException | None, bridges: Bridges) -> RunResult:
    estimates = _estimates(session.scene, controller)
    reason = None if failure is None else (str(failure) or "interrupted")
    surface_map, consistency, map_summary = _mapped(session.scene, controller)
    summary = summarise(session, controller, estimates, reason, map_summary=map_summary, bridges=bridges.status())
    summary["bridges"] = bridges.end(summary)
    result = RunResult(
        session.plan,
        summary,
        log_columns(session.cell),
        session.truth,
        estimates,
        getattr(controller, "taxels", None),
        surface_map,
        consistency,
        session.out,
    )
    if session.out is not None:
        try:
            with interrupts_held():
                write_files(result, session.out)
            _draw(result, session.out)
        except OSError as error:  # a full disk: what stopped the run counts for more, and the cell is safe
            told = f"{session.out}: not all results could be written: {error.strerror or error}"
            summary["faults"].append(told)
            if failure is None:
                raise ResultsError(told) from error
            failure.add_note(told)
    return result


def _estimates(scene: Scene, controller: object) -> dict[str, list[ShapeRecord]]:
    """What the estimator in the loop said, and the others on the same contacts."""
    tracker = getattr(controller, "shape", None)
    if tracker is None or scene.shape is None:
        return {}
    from canprobe.cell.tasks.build import estimates_of

    return estimates_of(resolve(scene), tracker, (scene.shape.method, *scene.shape.also))


def _mapped(scene: Scene, controller: object) -> tuple[SurfaceMap | None, Consistency | None, dict[str, Any] | None]:
    """The surface map of a scan, the tests at its crossings, which take a second, and what the summary says of them."""
    tracker = getattr(controller, "shape", None)
    if tracker is None or scene.shape is None:
        return None, None, None
    from canprobe.cell.mapping import map_of_scan, summarise_map
    from canprobe.touch.consistency import check_consistency

    surface_map = map_of_scan(tracker, scene.shape.method)
    consistency = check_consistency(surface_map)
    return surface_map, consistency, summarise_map(surface_map, consistency)


def _draw(result: RunResult, out: Path) -> None:
    for name in ("report.html", "report.png", "surface.png"):
        (out / name).unlink(missing_ok=True)  # of an earlier run
    if not len(result.log["t_s"]):
        return
    if "report.html" in result.plan.outputs:
        page, recorded = (importlib.import_module(f"canprobe.bridge.view.{name}") for name in ("page", "recorded"))
        page.write_page(recorded.read_run(out), out / "report.html")
    if "report.png" in result.plan.outputs:
        from canprobe.studies.run_figure import draw_run
        from canprobe.studies.surface_figure import draw_surface

        draw_run(result, out / "report.png")
        draw_surface(result, out / "surface.png")


@contextlib.contextmanager
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
    observers: Sequence[AnyObserver] = (),
    bridge: Sequence[str] = (),
    rows_kept: int | None = None,
) -> Iterator[Session]:
    """Bring a cell up for a controller of your own; leaving always disables the drives and closes the bus.

    Example::

        with canprobe.open_cell(canprobe.load_scene("free")) as cell:
            cell.run(my_controller)

    Args:
        scene: from `canprobe.load_scene`.
        interface, channel, sensor_channel, bitrate, seed: in the place of the scene's.
        out: folder for ``bus.log``, ``scene.toml`` and ``truth.npz``; None writes nothing.
        say: called with each step.
        observers, bridge: as for `run`.
        rows_kept: cycles whose row of the log is kept; all by default, which grows by about 1 KiB a cycle.

    Raises:
        UsageError: the scene does not fit; nothing was started.
        BusError: an interface or a node failed.
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
    plan = make_plan(resolve(resolved))
    with (
        Bridges(plan, folder, virtual=resolved.bus.interface == LOCKSTEP, say=say) as bridges,
        Session(plan, folder, say, (*observers, *bridges.observers), rows_kept) as session,
    ):
        yield session


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
    check_links(plan, say)
    with (
        Bridges(plan, None, virtual=False, say=say) as bridges,
        telling_notes(Session(plan, None, say, bridges.observers, ROWS_OF_UP), say) as session,
    ):
        say(f"the cell is up: nodes {', '.join(map(str, plan.node_ids))}; Ctrl-C stops it")
        session.run(_requested(plan, None, lambda: make_task(plan), bridges), news_teller(session, say))


def scan(interface: str, channel: str, bitrate: int, timeout_s: float = 0.2) -> list[dict[str, Any]]:
    """List the nodes that answer on a bus, with the identity that 1018h gives.

    Raises:
        InterfaceError: no such interface.
    """
    from canprobe.bus.clock import MonotonicClock
    from canprobe.bus.open import open_port
    from canprobe.cell.scan import scan_nodes

    hush_canopen()
    port = open_port(interface, channel, bitrate, MonotonicClock())
    try:
        return scan_nodes(port, timeout_s)
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
) -> Commissioned:
    """Find the nodes that have no id and give them theirs by LSS (CiA 305).

    Args:
        interface, channel, bitrate: of the bus.
        scene: whose nodes get their ids; as far as its EDS files and serial numbers tell which is which.
        assign: or else ((vendor, product, revision, serial number), node id), None for a number that may be any.
        store: let the devices keep their ids when their power goes.

    Raises:
        UsageError: the scene does not fit.
        BusError: see `canprobe.cell.commission.commission`.
        InterfaceError: no such interface.
    """
    from canprobe.bus.clock import MonotonicClock
    from canprobe.bus.open import open_port
    from canprobe.cell.commission import commission, wanted_by
    from canprobe.cell.lss_choice import Wanted

    hush_canopen()
    wanted = [Wanted(node_id, "--assign", numbers) for numbers, node_id in assign]
    if scene is not None:
        wanted = wanted_by(make_plan(resolve(resolve_scene(scene, interface=interface))))
    port = open_port(interface, channel, bitrate, MonotonicClock())
    try:
        return commission(port, wanted, must=scene is None, store=store)
    finally:
        port.close()


def monitor(
    scene: Scene,
    *,
    interface: str | None = None,
    channel: str | None = None,
    sensor_channel: str | None = None,
    bitrate: int | None = None,
    duration_s: float | None = None,
) -> Iterator[CellView]:
    """Look at a running cell ten times a second, sending nothing.

    Args:
        scene: what is on the bus.
        interface, channel, sensor_channel, bitrate: in the place of the scene's.
        duration_s: how long; for ever by default.

    Yields:
        What is known by then; the same object each time.

    Raises:
        UsageError: the scene does not fit, or its bus is a lockstep bus, which lives inside one run.
        InterfaceError: no such interface, or it was lost.
    """
    from canprobe.bus.clock import MonotonicClock
    from canprobe.cell.monitor import Monitor

    resolved = resolve_scene(
        scene, interface=interface, channel=channel, sensor_channel=sensor_channel, bitrate=bitrate
    )
    if resolved.bus.interface == LOCKSTEP:
        raise UsageError("monitor: a lockstep bus lives inside one run; name a real interface with --bus")
    plan, clock = make_plan(resolve(resolved)), MonotonicClock()
    with open_ports(plan, clock) as ports:
        listener = Monitor(plan)
        start_ns = next_ns = clock.now_ns()
        while duration_s is None or next_ns < start_ns + duration_s * 1e9:
            next_ns += MONITOR_PERIOD_NS
            clock.sleep_until_ns(next_ns)
            for name, port in ports.items():
                listener.push(port.drain(), name)
            yield listener.view(clock.now_ns())
