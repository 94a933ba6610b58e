"""A run, or a recorded bus, estimated again: measurements in, shape and summary out; or observations for bridges."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.master.controller import Command
from canprobe.cell.master.observers import Observation
from canprobe.cell.master.options import Say
from canprobe.cell.npz import write_npz
from canprobe.cell.planning.bridges import BRIDGES, check_bridges
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.recorded.recording import LogCycles, RunFolder, read_run, replay_contacts, replay_task
from canprobe.cell.results.run_files import TACTILE, TRUTH, is_recorded, needed, read_scene, read_truth
from canprobe.cell.results.scores import estimate_columns, summarise_shape
from canprobe.cell.results.summary import without_nan
from canprobe.cell.results.text import curvature_text, shape_lines
from canprobe.cell.scene.load import SAVED_AS, load_scene
from canprobe.cell.scene.model import BridgeSettings, OutputSettings, Scene
from canprobe.cell.scene.plugins import find_plugin
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Setup
from canprobe.cell.session.children import Bridges
from canprobe.cell.tasks.from_plan import estimates_of
from canprobe.cell.tasks.shape import ShapeRecord, ShapeTracker, on_run_clock
from canprobe.errors import ProtocolError, UsageError
from canprobe.fieldbus.bus.clock import Pace
from canprobe.fieldbus.bus.clock_steps import RecordedBus
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.protocol.frames import is_sync
from canprobe.mechanics.touch.estimate.fit import METHODS, unknown_method
from canprobe.mechanics.touch.map.surface_map import SurfaceMap
from canprobe.mechanics.types import Floats

SCHEMA = 2
_SCORED = ("kappa_per_m", "direction1", "direction2", "contact_normal", "contact_point_m")
"""Columns of the truth that estimates are scored against."""


@dataclass(frozen=True, slots=True)
class RecordedContacts:
    """The contacts of a record, for estimates and the summary.

    Attributes:
        tracker: the contacts, and the answers of the scene's estimator.
        driven_by: ``task``: the scene's task made its scan, and was stepped again; ``other``: every contact was used.
        start_s: time of the first cycle, s, on the record's clock.
        times_s: time of each cycle (n,), s, since the first.
        counts: counts by name.
        channel: channel of the log; None for the folder of a run.
        bus: reader of the log; None for the folder of a run.
    """

    tracker: ShapeTracker
    driven_by: str
    start_s: float
    times_s: Floats
    counts: dict[str, int]
    channel: str | None
    bus: RecordedBus | None = None


def _from_run(plan: Plan, run: RunFolder) -> RecordedContacts:
    """The contacts that the master of a run measured."""
    task = replay_task(plan, run)
    if task is not None and task.shape is not None and task.shape.samples:
        tracker, unplaced, driven_by = task.shape, task.record().unplaced, "task"
    else:
        tracker, unplaced = replay_contacts(plan, run.measurements())
        driven_by = "other"
    counts = {"cycles": len(run.times_ns), "unplaced_contacts": unplaced}
    return RecordedContacts(tracker, driven_by, run.start_s, run.times_s, counts, None)


def _from_log(plan: Plan, path: Path) -> RecordedContacts:
    """The contacts in a recorded bus."""
    cycles = LogCycles(plan, path)
    recording = cycles.recording
    try:
        tracker, unplaced = replay_contacts(plan, cycles)
    except ProtocolError as error:
        raise UsageError(f"{path}: on {recording.channel}: {error}") from error
    assert cycles.drives is not None and cycles.tactile is not None
    counts = {
        "cycles": len(cycles.sync_times_s),
        "lost_syncs": cycles.lost_syncs,
        "missed_pdos": cycles.drives.missed,
        "malformed_pdos": recording.malformed,
        "torn_frames": cycles.tactile.torn,
        "lost_frames": cycles.tactile.lost,
        "stale_frames": cycles.tactile.stale,
        "unplaced_contacts": unplaced,
        "error_frames": recording.error_frames,
        "other_frames": recording.other,
        "frames_lost_by_candump": sum(recording.bus.lost.values()),
    }
    times_s = np.array(cycles.sync_times_s)
    return RecordedContacts(tracker, "other", cycles.start_ns * 1e-9, times_s, counts, recording.channel, recording.bus)


def _truth(file: Path, setup: Setup) -> Mapping[str, Floats]:
    """The plant's truth, one row per SYNC; empty without the file, or where nothing happened."""
    columns = read_truth(file, setup) if is_recorded(file) else {}
    if not columns or not len(next(iter(columns.values()))):
        return {}
    needed(columns, _SCORED, file)
    return columns


def _last(records: Sequence[ShapeRecord], start_s: float) -> dict[str, Any]:
    """Number of answers of an estimator, and the last one."""
    if not records:
        return {"count": 0, "t_s": None, "kappa_per_m": None, "observed": None}
    record = records[-1]
    return {
        "count": len(records),
        "t_s": start_s + record.t_s,
        "kappa_per_m": np.asarray(record.estimate.kappa).tolist(),
        "observed": [bool(o) for o in record.estimate.observed],
    }


def _online(log: Mapping[str, Floats], records: Sequence[ShapeRecord]) -> dict[str, Any] | None:
    """Difference of the replayed curvature of the estimator in the loop and the logged one, number by number."""
    if (logged := log.get("K_per_m")) is None:
        return None
    online = _changes(logged[np.isfinite(logged).all(axis=(1, 2))])
    replayed = _changes(np.array([r.estimate.K for r in records if np.isfinite(r.estimate.K).all()]).reshape(-1, 2, 2))
    same = len(online) == len(replayed) > 0
    return {
        "estimates": len(online),
        "replayed": len(replayed),
        "K_max_difference_per_m": float(np.abs(online - replayed).max()) if same else None,
    }


def _changes(K: Floats) -> Floats:
    """The rows (m, 2, 2) of (n, 2, 2) that differ from the row before."""
    new = np.ones(len(K), bool)
    new[1:] = (K[1:] != K[:-1]).any(axis=(1, 2))
    return K[new]


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """One replayed log.

    Attributes:
        plan: plan of the scene.
        summary: ``schema, scene, log, channel``; ``driven_by`` (``task``: the scene's task made the scan and was
            stepped again; ``other``: every contact was used); ``cycle`` (number of cycles, counts of what is missing);
            ``contacts``; ``estimates`` (the last of each estimator); ``shape`` as in ``summary.json``; ``online`` (the
            difference to the run's log, None without one).
        estimates: the answers of each estimator, by name; all times are on the log's clock, as in the summary.
        tracker: the contacts, and the answers of the scene's estimator, with times since the first SYNC.
    """

    plan: Plan
    summary: dict[str, Any]
    estimates: dict[str, list[ShapeRecord]]
    tracker: ShapeTracker

    @property
    def surface_map(self) -> SurfaceMap | None:
        """One surface of all contacts, with its uncertainty."""
        return self.tracker.surface_map

    def text(self) -> str:
        """The summary as text."""
        summary, shape, online = self.summary, self.summary["shape"], self.summary["online"]
        how = (
            "the scene's task drove: its scan is replayed"
            if summary["driven_by"] == "task"
            else "whoever drove: every contact is fed to the estimators"
        )
        counts = ", ".join(
            f"{count} {name.replace('_', ' ').replace('pdos', 'PDOs').replace('syncs', 'SYNCs')}"
            for name, count in summary["cycle"].items()
            if count or name == "cycles"
        )
        where = summary["log"] if summary["channel"] is None else f"{summary['log']}, {summary['channel']}"
        lines = [
            f"{where}: scene {summary['scene']}",
            f"  replay     {how}",
            f"  record     {counts}; {summary['contacts']} contacts",
            *(f"  log        {note}" for note in summary["notes"]),
        ]
        if shape["kappa_true_per_m"] is not None:
            lines += shape_lines(shape)
        else:
            for name, last in summary["estimates"].items():
                found = curvature_text(last["kappa_per_m"])
                lines.append(f"  curvature  {name}: {found}, the last of {last['count']} estimates")
        if online is not None:
            difference = online["K_max_difference_per_m"]
            lines.append(
                f"  online     {online['replayed']} of {online['estimates']} estimates"
                + (f", largest difference {difference:.3g} 1/m" if difference is not None else "")
            )
        return "\n".join(lines)

    def save(self, path: Path | str) -> None:
        """Write the estimates as columns, ``<method>_<column>``, into a compressed npz file, exactly that file."""
        columns: dict[str, Floats] = {}
        for method, records in self.estimates.items():
            columns |= {f"{method}_{name}": values for name, values in estimate_columns(records).items()}
        write_npz(Path(path), columns)


def replay(
    log: Path | str, *, scene: Scene | str | Path | None = None, method: str | Sequence[str] | None = None
) -> ReplayResult:
    """Estimate the shape again from the folder of a run, or from a recorded bus.

    The folder of a run has the measurements of its master, and gives the online result again. From a candump log of the
    same nodes with any master, every contact is used. The summary states which of the two was done.

    Args:
        log: folder of a run, or a candump file.
        scene: scene of the nodes and estimators; by default the ``scene.toml`` beside the log.
        method: the estimators, one or several; by default the scene's.

    Returns:
        The estimates, and a summary.

    Raises:
        UsageError: when there is no log, scene, SYNC or contact, a method is unknown, a line is not in candump format,
            or a node sent no TPDO.
    """
    path, folder = find_log(Path(log))
    described = replace(scene_of(path, folder, scene), outputs=OutputSettings())  # the map, too, if the run had none
    plan = make_plan(resolve(described))
    methods = _methods(plan.scene, method)
    run = read_run(folder, plan.setup) if folder is not None else None
    contacts = _from_run(plan, run) if run is not None else _from_log(plan, path)
    source = path if folder is None or run is None else folder
    if not contacts.tracker.samples:
        raise UsageError(f"{source}: nothing was touched in it: no contact to estimate from")
    tracker, setup = contacts.tracker, plan.setup
    estimates = estimates_of(setup, tracker.records, tracker.settled(setup.probe.radius), methods)
    truth = _truth(folder / TRUTH, setup) if folder is not None else {}
    summary = {
        "schema": SCHEMA,
        "scene": plan.scene.name,
        "log": str(source),
        "channel": contacts.channel,
        "notes": [] if contacts.bus is None else contacts.bus.notes(),
        "driven_by": contacts.driven_by,
        "cycle": contacts.counts,
        "contacts": len(tracker.samples),
        "estimates": {name: _last(records, contacts.start_s) for name, records in estimates.items()},
        "shape": summarise_shape(setup, tracker, estimates, truth, contacts.times_s),
        "online": _online(run.log, tracker.records) if run is not None and contacts.driven_by == "task" else None,
    }
    on_clock = {name: on_run_clock(records, contacts.start_s) for name, records in estimates.items()}
    return ReplayResult(plan, without_nan(summary), on_clock, tracker)


def find_log(log: Path) -> tuple[Path, Path | None]:
    """The candump file, and the run's folder if `log` is one; UsageError where either is missing."""
    if not log.exists():
        raise UsageError(f"{log}: no such folder or file; expected the folder of a run, or a candump file")
    if not log.is_dir():
        return log, None
    path = log / "bus.log"
    if not path.exists() and not is_recorded(log / TACTILE):
        raise UsageError(
            f"{log}: no bus.log in this folder; expected a candump file, or the folder of a run with an array, or one"
            " on a bus with outputs.bus_log = true"
        )
    return path, log


def scene_of(path: Path, folder: Path | None, scene: Scene | str | Path | None) -> Scene:
    """The given scene, or the one beside the log; UsageError without either."""
    if scene is not None:
        return load_scene(scene)
    if folder is None:
        raise UsageError(f"{path}: a log alone does not describe its nodes: name the scene (--scene)")
    if not (folder / SAVED_AS).exists():
        raise UsageError(f"{folder}: no {SAVED_AS} in this folder: name the scene (--scene)")
    return read_scene(folder)


def _methods(scene: Scene, method: str | Sequence[str] | None) -> tuple[str, ...]:
    if scene.shape is None or scene.task.kind != "scan":
        raise UsageError(f"scene {scene.name}: task {scene.task.kind} estimates no shape; there is nothing to replay")
    if method is None:
        return (scene.shape.method, *scene.shape.also)
    names = (method,) if isinstance(method, str) else tuple(method)
    for name in names:
        if name not in METHODS and find_plugin("estimator", name) is None:
            raise unknown_method(name)
    return names or (scene.shape.method,)


TASK_COLUMNS = ("phase", "depth_at_1n_mm")
"""Columns of the task that the bridges use."""


@dataclass(frozen=True, slots=True)
class RecordedBridges:
    """The result of a log that was fed to bridges.

    Attributes:
        result: result of its estimators; None where the scene has none.
        bridges: the entry of each bridge in `summary.json`.
    """

    result: ReplayResult | None
    bridges: dict[str, dict[str, Any]]


def replay_into(
    log: Path | str,
    bridge: Sequence[str],
    *,
    scene: Scene | str | Path | None = None,
    method: str | Sequence[str] | None = None,
    say: Say = lambda _: None,
) -> RecordedBridges:
    """Feed a recorded bus to bridges, as if the cell were running; in real time where one shows it live.

    Args:
        log: folder of a run, or a candump file.
        bridge: names of the bridges.
        scene: scene of the nodes; by default the ``scene.toml`` beside the log.
        method: estimators, as for :func:`canprobe.replay`.
        say: called with the address or file of each bridge.

    Raises:
        UsageError: as in :func:`canprobe.replay`, or when a bridge is not available.
    """
    path, folder = find_log(Path(log))
    check_bridges(bridge)
    named = scene_of(path, folder, scene)  # its own bridges fed the run: they are replaced
    settings = replace(named.bridge or BridgeSettings(), use=tuple(dict.fromkeys(bridge)))  # type: ignore[arg-type]
    resolved = replace(named, bridge=settings)
    plan = make_plan(resolve(resolved))
    estimated = method is not None or (resolved.shape is not None and resolved.task.kind == "scan")
    result = replay(log, scene=resolved, method=method) if estimated else None
    observations = _observations(plan, path, folder, result)
    with Bridges(plan, path.parent, virtual=True, say=say) as bridges:
        live = any(BRIDGES[name].live for name in bridge)
        pace = Pace()
        for observation in observations:
            if live:
                pace.keep(observation.t_ns)
            for one in bridges.observers:
                one.observe(observation)
        return RecordedBridges(result, bridges.end(None) or {})


def _observations(plan: Plan, path: Path, folder: Path | None, result: ReplayResult | None) -> Iterator[Observation]:
    """The observations of a recorded log; `folder` is that of a run, None for another log.

    Those of a run have the measurements of its master, with the frames from each SYNC to the next.
    """
    # the answers of the scene's estimator, by the cycle's time since the first, ns
    estimates = {} if result is None else {round(r.reported_s * 1e9): r.estimate for r in result.tracker.records}
    run = read_run(folder, plan.setup) if folder is not None else None
    columns: dict[str, Floats] = {}
    if run is None:
        cycles = LogCycles(plan, path)
        start_ns, measurements, channel = cycles.start_ns, iter(cycles), cycles.recording.channel
    else:
        start_ns, measurements, channel = round(run.start_s * 1e9), run.measurements(), plan.buses[0].channel
        columns = {name: run.log[name] for name in TASK_COLUMNS if name in run.log}
    groups = frames_by_sync(path, channel, plan) if path.is_file() else iter(())
    if before := next(groups, []):
        yield Observation(before[-1][2], None, None, before)
    if run is not None:
        groups = _until(groups, [*(start_ns + run.times_ns[1:]).tolist(), math.inf])
    for k, (m, frames) in enumerate(zip(measurements, groups, strict=True)):
        known = {name: float(column[k]) for name, column in columns.items() if np.isfinite(column[k])}
        estimate = estimates.get(m.t_ns)
        command = Command(columns=dict(known), estimate=estimate) if known or estimate is not None else None
        yield Observation(start_ns + m.t_ns, m, command, frames)


def _until(groups: Iterator[list[TimedFrame]], ends_ns: Iterable[float]) -> Iterator[list[TimedFrame]]:
    """The frames of groups that begin before each of some instants."""
    waiting = next(groups, [])
    for end_ns in ends_ns:
        frames: list[TimedFrame] = []
        while waiting and waiting[0][2] < end_ns:
            frames += waiting
            waiting = next(groups, [])
        yield frames


def frames_by_sync(path: Path, first: str, plan: Plan) -> Iterator[list[TimedFrame]]:
    """All frames of the cell's buses: those before the first SYNC, then from each SYNC on the first bus to the next."""
    others = {bus.channel for bus in plan.buses[1:]}
    frames: list[TimedFrame] = []
    for t_ns, channel, can_id, data in RecordedBus(path):
        if channel != first and channel not in others:
            continue
        if is_sync(can_id, data) and channel not in others:
            yield frames
            frames = []
        frames.append((can_id, data, t_ns))
    yield frames
