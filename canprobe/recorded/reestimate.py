"""A recorded run, estimated again from its log alone: candump in, shape and summary out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.disk import read_npz, write_npz
from canprobe.errors import ProtocolError, UsageError
from canprobe.planning.make import make_plan
from canprobe.planning.model import Plan
from canprobe.recorded.cycles import LogCycles, TaskReplay, replay_contacts, replay_task
from canprobe.recorded.recording import Recording, read_recording
from canprobe.results.scores import estimate_columns, map_of_scan
from canprobe.results.summary import curvature_text, finite_or_none, shape_lines, summarise_shape
from canprobe.scene.load import load_scene
from canprobe.scene.model import Scene
from canprobe.scene.resolve import resolve
from canprobe.session.target import LOCKSTEP
from canprobe.tasks.from_plan import estimates_of
from canprobe.tasks.shape import ShapeRecord, ShapeTracker, on_run_clock
from canprobe.touch.estimate.fit import METHODS, unknown_method

Array = NDArray[np.float64]
SCHEMA = 1
_SCORED = ("kappa", "direction1", "direction2", "contact_normal", "contact_point")
"""Columns of the truth that estimates are scored against."""


def summarise_replay(
    plan: Plan,
    recording: Recording,
    cycles: LogCycles,
    task: TaskReplay,
    *,
    tracker: ShapeTracker,
    unplaced: int,
    estimates: dict[str, list[ShapeRecord]],
    folder: Path | None,
) -> dict[str, Any]:
    """The summary of a `ReplayResult`; what does not apply is None.

    Args:
        plan: of the scene.
        recording: the log.
        cycles: of the log, iterated to the end.
        task: the comparison with the scene's task.
        tracker: the contacts.
        unplaced: number of contacts without the joints of their instant.
        estimates: by name.
        folder: of the run, for ``truth.npz`` and ``log.npz``; None for a log alone.
    """
    truth = _truth(folder / "truth.npz") if folder is not None else {}
    start_s = cycles.start_ns * 1e-9
    map_summary = None if plan.scene.shape is None else map_of_scan(tracker, plan.scene.shape.method)[2]
    return {
        "schema": SCHEMA,
        "scene": plan.scene.name,
        "log": str(recording.path),
        "channel": recording.channel,
        "driven_by": "task" if task.drove else "other",
        "targets": {
            "compared": task.compared,
            "differing": task.differing,
            "worst_counts": task.worst_counts,
            "lifted_s": None if task.lifted_s is None else start_s + task.lifted_s,
            "parted_s": None if task.parted_s is None else start_s + task.parted_s,
        },
        "cycle": _cycle(cycles, recording, unplaced),
        "contacts": len(tracker.samples),
        "estimates": {name: _last(records, start_s) for name, records in estimates.items()},
        "shape": summarise_shape(
            plan.scene, tracker, estimates, truth, np.array(cycles.sync_times_s), map_summary=map_summary
        ),
        "online": _online(folder, tracker.records) if folder is not None and task.drove else None,
    }


def _truth(path: Path) -> dict[str, Array]:
    """The plant's truth, one row per SYNC; empty without the file."""
    columns = read_npz(path) if path.is_file() else {}
    for name in _SCORED if columns else ():
        column = columns.get(name, np.zeros(0))
        if column.dtype.kind != "f" or column.ndim != 2:
            raise UsageError(
                f"{path}: {name}: expected a row of numbers for each SYNC, got {column.dtype} of shape {column.shape}"
            )
    return columns


def _cycle(cycles: LogCycles, recording: Recording, unplaced: int) -> dict[str, int]:
    assert cycles.drives is not None and cycles.tactile is not None
    assembler = cycles.tactile.assembler
    return {
        "cycles": len(cycles.sync_times_s),
        "lost_syncs": cycles.lost_syncs,
        "missed_pdos": cycles.drives.missed,
        "late_pdos": cycles.drives.late,
        "malformed_pdos": recording.malformed,
        "torn_frames": assembler.torn + assembler.crc_errors + assembler.orphans,
        "lost_frames": assembler.lost,
        "stale_frames": cycles.tactile.stale,
        "unplaced_contacts": unplaced,
        "error_frames": recording.error_frames,
    }


def _last(records: Sequence[ShapeRecord], start_s: float) -> dict[str, Any]:
    """Number of answers of an estimator, and the last one."""
    if not records:
        return {"count": 0, "t_s": None, "kappa_per_m": None, "observed": None}
    record = records[-1]
    return {
        "count": len(records),
        "t_s": start_s + record.t_s,
        "kappa_per_m": finite_or_none(record.estimate.kappa),
        "observed": [bool(o) for o in record.estimate.observed],
    }


def _online(folder: Path, records: Sequence[ShapeRecord]) -> dict[str, Any] | None:
    """Difference of the replayed curvature of the estimator in the loop and the logged one, number by number."""
    path = folder / "log.npz"
    logged = read_npz(path).get("K_per_m") if path.is_file() else None
    if logged is None:
        return None
    online = _changes(logged[np.isfinite(logged).all(axis=(1, 2))])
    replayed = _changes(np.array([r.estimate.K for r in records if np.isfinite(r.estimate.K).all()]).reshape(-1, 2, 2))
    same = len(online) == len(replayed) > 0
    return {
        "estimates": len(online),
        "replayed": len(replayed),
        "K_max_difference_per_m": float(np.abs(online - replayed).max()) if same else None,
    }


def _changes(K: Array) -> Array:
    """The rows (m, 2, 2) of (n, 2, 2) that differ from the row before."""
    new = np.ones(len(K), bool)
    new[1:] = (K[1:] != K[:-1]).any(axis=(1, 2))
    return K[new]


def replay_text(summary: dict[str, Any]) -> str:
    """A summary as text."""
    cycle, targets, online = summary["cycle"], summary["targets"], summary["online"]
    if summary["driven_by"] == "task":
        how = "the scene's task drove: its scan is replayed"
        if targets["differing"]:
            how += f" ({targets['differing']} of {targets['compared']} targets differ)"
        if targets["lifted_s"] is not None:
            how += f"; lifted off at {targets['lifted_s']:.2f} s"
    elif targets["parted_s"] is None and 2 * targets["differing"] < targets["compared"]:
        how = "the scene's task drove, but not to its scan: every contact is fed to the estimators"
    elif targets["compared"]:
        since = "" if targets["parted_s"] is None else f" (since {targets['parted_s']:.2f} s)"
        how = f"another controller drove{since}: every contact is fed to the estimators"
    else:
        how = "no targets are in the log: every contact is fed to the estimators"
    lines = [
        f"{summary['log']}, {summary['channel']}: scene {summary['scene']}",
        f"  replay     {how}",
        f"  cycle      {cycle['cycles']}, {cycle['missed_pdos']} missed PDOs, {cycle['torn_frames']} torn frames,"
        f" {cycle['lost_syncs']} lost SYNCs; {summary['contacts']} contacts",
        *_estimate_lines(summary),
    ]
    if online is not None:
        difference = online["K_max_difference_per_m"]
        lines.append(
            f"  online     {online['replayed']} of {online['estimates']} estimates"
            + (f", largest difference {difference:.3g} 1/m" if difference is not None else "")
        )
    return "\n".join(lines)


def _estimate_lines(summary: dict[str, Any]) -> list[str]:
    if summary["shape"]["kappa_true_per_m"] is not None:
        return shape_lines(summary["shape"])
    return [
        f"  curvature  {name}: {curvature_text(last['kappa_per_m'])}, the last of {last['count']} estimates"
        for name, last in summary["estimates"].items()
    ]


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """One replayed log.

    Attributes:
        plan: of the scene.
        summary: ``schema, scene, log, channel``; ``driven_by`` (``task``: the scene's task made the recorded targets
            and was stepped again; ``other``: every contact was used) with the comparison of ``targets``; ``cycle``
            (counts of what is missing); ``contacts``; ``estimates`` (the last of each estimator); ``shape`` as in
            ``summary.json``; ``online`` (the difference to the run's log, None without one).
        estimates: the answers of each estimator, by name; all times are on the log's clock, as in the summary.
        tracker: the contacts, and the answers of the scene's estimator, with times since the first SYNC.
    """

    plan: Plan
    summary: dict[str, Any]
    estimates: dict[str, list[ShapeRecord]]
    tracker: ShapeTracker

    def text(self) -> str:
        """The summary as text."""
        return replay_text(self.summary)

    def save(self, path: Path | str) -> None:
        """Write the estimates as columns, ``<method>_<column>``, into a compressed npz file, exactly that file."""
        columns: dict[str, Array] = {}
        for method, records in self.estimates.items():
            columns |= {f"{method}_{name}": values for name, values in estimate_columns(records).items()}
        write_npz(Path(path), columns)


def replay(
    log: Path | str, *, scene: Scene | str | Path | None = None, method: str | Sequence[str] | None = None
) -> ReplayResult:
    """Estimate the shape again from a recorded bus.

    The log of a run of canprobe gives the online result again. From a log of the same nodes under another master, every
    contact is used. The summary states which of the two was done.

    Args:
        log: folder of a run, or a candump file.
        scene: describes nodes and estimators; by default the ``scene.toml`` beside the log.
        method: the estimators, one or several; by default the scene's.

    Raises:
        UsageError: no log or scene, an unknown method, a line that is not candump's, a node without any TPDO, no SYNC,
            or no contact.
    """
    path, folder = find_log(Path(log))
    plan = make_plan(resolve(scene_of(path, folder, scene)))
    methods = _methods(plan.scene, method)
    as_taken = folder is not None and plan.scene.bus.interface != LOCKSTEP
    recording = read_recording(path, plan, as_taken=as_taken)
    try:
        cycles = LogCycles(plan, recording, as_taken=as_taken, drifts=folder is None)
        task = replay_task(plan, cycles)
        tracker, unplaced = task.task.shape, task.task.record().unplaced
        if not task.drove or tracker is None:
            cycles = LogCycles(plan, recording, as_taken=as_taken, on_deadlines=False)
            tracker, unplaced = replay_contacts(plan, cycles)
    except ProtocolError as error:
        raise UsageError(f"{path}: on {recording.channel}: {error}") from error
    if not tracker.samples:
        raise UsageError(f"{path}: nothing was touched in this log: no contact to estimate from")
    estimates = estimates_of(plan.setup, tracker, methods)
    summary = summarise_replay(
        plan, recording, cycles, task, tracker=tracker, unplaced=unplaced, estimates=estimates, folder=folder
    )
    start_s = cycles.start_ns * 1e-9
    on_clock = {name: on_run_clock(records, start_s) for name, records in estimates.items()}
    return ReplayResult(plan, summary, on_clock, tracker)


def find_log(log: Path) -> tuple[Path, Path | None]:
    """The candump file, and the run's folder if `log` is one; UsageError where either is missing."""
    if not log.exists():
        raise UsageError(f"{log}: no such folder or file; expected the folder of a run, or a candump file")
    if not log.is_dir():
        return log, None
    path = log / "bus.log"
    if not path.is_file():
        _refuse_direct(log)
        raise UsageError(f"{log}: no bus.log in this folder; expected the folder of a run, or a candump file")
    return path, log


def _refuse_direct(folder: Path) -> None:
    """A run without a bus has no frames to estimate from."""
    if (folder / "scene.toml").is_file() and load_scene(folder / "scene.toml").bus.direct:
        raise UsageError(
            f"{folder}: a run with --bus direct has no bus.log to replay; run the scene with --bus lockstep, which"
            " writes one"
        )


def scene_of(path: Path, folder: Path | None, scene: Scene | str | Path | None) -> Scene:
    """The given scene, or the one beside the log; UsageError without either."""
    if isinstance(scene, Scene):
        return scene
    if scene is not None:
        return load_scene(scene)
    if folder is None:
        raise UsageError(f"{path}: a log alone does not describe its nodes: name the scene (--scene)")
    if not (folder / "scene.toml").is_file():
        raise UsageError(f"{folder}: no scene.toml in this folder: name the scene (--scene)")
    return load_scene(folder / "scene.toml")


def _methods(scene: Scene, method: str | Sequence[str] | None) -> tuple[str, ...]:
    if scene.shape is None or scene.task.kind != "scan":
        raise UsageError(f"scene {scene.name}: task {scene.task.kind} estimates no shape; there is nothing to replay")
    if method is None:
        return (scene.shape.method, *scene.shape.also)
    names = (method,) if isinstance(method, str) else tuple(method)
    for name in names:
        if name not in METHODS:
            raise unknown_method(name)
    return names or (scene.shape.method,)
