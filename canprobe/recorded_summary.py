"""What a replay tells: its summary, its text, its estimates as columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.log_cycles import LogCycles
from canprobe.cell.mapping import map_of_scan, summarise_map
from canprobe.cell.recording import Recording
from canprobe.cell.replay import TaskReplay
from canprobe.cell.tasks.shape import ShapeRecord, ShapeTracker
from canprobe.errors import UsageError
from canprobe.npz_file import read_npz
from canprobe.planning import Plan
from canprobe.results import curvature_text, finite_or_none, shape_lines, summarise_shape
from canprobe.touch.consistency import check_consistency

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
    """The summary of :class:`canprobe.recorded.ReplayResult`; what does not apply is None.

    Args:
        plan: of the scene.
        recording: the log.
        cycles: what was made of it, iterated to the end.
        task: the comparison with the scene's task.
        tracker: the contacts.
        unplaced: contacts without the joints of their instant.
        estimates: by name.
        folder: of the run, for ``truth.npz`` and ``log.npz``; None for a log alone.
    """
    truth = _truth(folder / "truth.npz") if folder is not None else {}
    start_s = cycles.start_ns * 1e-9
    return {
        "schema": SCHEMA,
        "scene": plan.scene.name,
        "log": str(recording.path),
        "channel": recording.channel,
        "driven_by": "task" if task.drove else "other",
        "targets": _targets(task, start_s),
        "cycle": _cycle(cycles, recording, unplaced),
        "contacts": len(tracker.samples),
        "estimates": {name: _last(records, start_s) for name, records in estimates.items()},
        "shape": summarise_shape(
            plan.scene,
            tracker,
            estimates,
            truth,
            np.array(cycles.sync_times_s),
            map_summary=_map_summary(plan, tracker),
        ),
        "online": _online(folder, tracker.records) if folder is not None and task.drove else None,
    }


def _map_summary(plan: Plan, tracker: ShapeTracker) -> dict[str, Any] | None:
    if plan.scene.shape is None:
        return None
    surface_map = map_of_scan(tracker, plan.scene.shape.method)
    return summarise_map(surface_map, check_consistency(surface_map))


def _arrays(path: Path) -> dict[str, Array]:
    return read_npz(path) if path.is_file() else {}


def _truth(path: Path) -> dict[str, Array]:
    """The plant's truth, one row a SYNC."""
    columns = _arrays(path)
    for name in _SCORED if columns else ():
        column = columns.get(name, np.zeros(0))
        if column.dtype.kind != "f" or column.ndim != 2:
            raise UsageError(
                f"{path}: {name}: expected a row of numbers for each SYNC, got {column.dtype} of shape {column.shape}"
            )
    return columns


def _targets(task: TaskReplay, start_s: float) -> dict[str, float | None]:
    return {
        "compared": task.compared,
        "differing": task.differing,
        "worst_counts": task.worst_counts,
        "lifted_s": None if task.lifted_s is None else start_s + task.lifted_s,
        "parted_s": None if task.parted_s is None else start_s + task.parted_s,
    }


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
    """How many answers an estimator gave, and its last one."""
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
    """How far the replayed curvature of the estimator in the loop is from what the run logged, number by number."""
    logged = _arrays(folder / "log.npz").get("K_per_m")
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


def estimate_columns(records: Sequence[ShapeRecord]) -> dict[str, Array]:
    """Estimates as columns, one row each; the suffix of a name is its unit."""
    return {
        "t_s": np.array([r.t_s for r in records]),
        "travelled_m": np.array([r.travelled_m for r in records]),
        "K_per_m": np.array([r.estimate.K for r in records]).reshape(-1, 2, 2),
        "K_covariance_per_m2": np.array([r.estimate.covariance for r in records]).reshape(-1, 3, 3),
        "kappa_per_m": np.array([r.estimate.kappa for r in records]).reshape(-1, 2),
        "observed": np.array([r.estimate.observed for r in records], bool).reshape(-1, 2),
        "T_base_contact_m": np.array([r.estimate.T_frame_contact for r in records]).reshape(-1, 4, 4),
    }


def replay_text(summary: dict[str, Any]) -> str:
    """A summary as lines for people."""
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
