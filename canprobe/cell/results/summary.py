"""The summary of a run, and the files of its measurements."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe import __version__
from canprobe.cell.master.cell import Cell
from canprobe.cell.master.log import since_first_sync
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.run_files import SCHEMA
from canprobe.cell.results.scores import score_contact, score_measured_force, state_force_sigma, summarise_shape
from canprobe.cell.results.tool_file import FILE, summarise_calibration, tool_text
from canprobe.cell.results.traffic import LOG, measure_traffic
from canprobe.cell.scene.setup import Touch
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.cell.tasks.task import TaskRecord
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.files import write_text
from canprobe.mechanics.types import Floats

FORCE_ERRORS = (
    *("force_true_bias_n", "force_true_rms_error_n", "force_within_2_sigma_fraction"),
    *("force_sigma_n", "force_sigma_parts_n", "force_lower_bound_fraction"),
)
"""Keys of the summary about how well the force is known."""


def summarise(
    session: Session,
    record: TaskRecord,
    estimates: dict[str, list[ShapeRecord]],
    stop_reason: str | None,
    *,
    log: Mapping[str, Floats] | None = None,
    bridges: dict[str, dict[str, Any]] | None = None,
) -> dict[str, Any]:
    """The content of ``summary.json``; a value that does not apply is None.

    Args:
        session: the closed session.
        record: results of the task.
        estimates: answers of its estimator, by name.
        stop_reason: why the run ended before its end; None where it did not.
        log: columns of ``log.npz``; None takes them from the session.
        bridges: status of each bridge.
    """
    scene, cell, observers = session.scene, session.cell, session.observers
    cycle, direct = cell.cycle, scene.bus.direct
    sim_time = cycle.t_ns * 1e-9 if cycle is not None else 0.0
    wall = session.wall_ns * 1e-9
    log = dict(cell.log.columns()) if log is None else log
    contact, load = _contact(session, record, log), session.record.load
    buses = session.plan.buses
    loads = {bus.channel: {"planned_worst": bus.load, "measured": load(bus.channel)} for bus in buses}
    summary = {
        "schema": SCHEMA,
        "written_by": f"canprobe {__version__}",
        "scene": scene.name,
        "bus": scene.bus.interface,
        "seed": scene.seed,
        "completed": stop_reason is None,
        "stop_reason": stop_reason,
        "sim_time_s": sim_time,
        "wall_time_s": wall,
        "realtime_factor": sim_time / wall if wall > 0 else None,
        "newtons": None if session.plan.setup.array is None else session.plan.setup.array.newtons,
        "contact": contact,
        "witnesses": _witnesses(session, record),
        "shape": summarise_shape(
            session.plan.setup,
            record.shape,
            estimates,
            truth_of(session),
            since_first_sync(log["t_s"], cell.log.start_s),
        ),
        "calibration": summarise_calibration(scene, record.tool),
        "choices": [f"{choice.key} = {choice.written}: {choice.why}" for choice in session.plan.choices],
        "cycle": _cycle(cell, record)
        | {"observe_us": None if observers is None else percentiles([*observers.cost_ns])},
        "bus_load": None if direct else loads,
        "traffic": None if direct else _traffic(session),
        "left_out": [f"{what}: {why}" for what, why in (*session.plan.left_out, *session.plan.not_available)],
        "warnings": [*session.plan.warnings, *_hidden_force(session, contact["force_max_n"], log)],
        "bridges": bridges,
        "faults": [*cell.notes.lines(), *(observers.faults if observers is not None else ())],
    }
    if record.explored is not None:
        summary["explore"] = record.explored
    if scene.arm is not None and scene.arm.kind == "external":
        from canprobe.cell.master.external_arm import FlangeGroup

        assert isinstance(cell.drives, FlangeGroup)
        summary["external_arm"] = cell.drives.figures()
    if scene.task.kind == "listen":
        summary["listen"] = _listened(log)
    found: dict[str, Any] = without_nan(summary)
    return found


def without_nan(value: Any) -> Any:
    """The value for JSON, null for numbers that are not finite."""
    if isinstance(value, dict):
        return {name: without_nan(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _traffic(session: Session) -> dict[str, Any]:
    """The traffic of each bus beside the plan; on a real bus it is counted afterwards, from the log.

    Without a log, or where it ends before the first SYNC, only the bus errors are known.
    """
    if session.record.meters:
        return {channel: meter.report().as_dict() for channel, meter in session.record.meters.items()}
    plan = session.plan
    with contextlib.suppress(UsageError):
        if session.options.out is not None:
            log = session.options.out / LOG
            return {b.channel: measure_traffic(log, plan, channel=b.channel, exact=False).as_dict() for b in plan.buses}
    errors = {channel: counter.error_frames for channel, counter in session.record.traffic.items()}
    return {channel: {"as_planned": None if n == 0 else False, "error_frames": n} for channel, n in errors.items()}


def truth_of(session: Session) -> Mapping[str, Floats]:
    """The plant's truth; empty where nothing was emulated, or nothing happened."""
    return session.buses.truth if "force_n" in session.buses.truth else {}


def _contact(session: Session, record: TaskRecord, log: Mapping[str, Floats]) -> dict[str, Any]:
    task, scan = session.scene.task, record.scan_cycles if session.options.rows_kept is None else None
    names = ("force_rms_error_n", "force_max_n", "contact_fraction", "speed_mean_m_s")
    touch = session.plan.setup.task
    target = touch.force if isinstance(touch, Touch) else math.nan
    figures: dict[str, float | None] = dict.fromkeys(names)
    measured: float | None = None
    error: dict[str, Any] = dict.fromkeys(FORCE_ERRORS)
    if scan is not None and scan[1] > scan[0]:
        force = log["force_n"][scan[0] : scan[1]]
        moved = log.get("target_force_n", np.full(scan[1], np.nan))[scan[0] : scan[1]]  # by a table, or a request
        targets = np.where(np.isfinite(moved), moved, target)
        target = round(float(targets.mean()), 12)
        off = (force - targets)[np.isfinite(force)]  # a cycle in which the cell held has none
        measured = float(np.sqrt(np.mean(off**2))) if len(off) else None
        if "force_sigma_n" in log:
            error |= state_force_sigma(log, *scan)
        if truth := truth_of(session):
            figures = score_contact(truth, *scan, targets)
            error |= score_measured_force(log, truth, *scan)
            if task.kind != "scan":
                figures["speed_mean_m_s"] = None
        else:
            figures |= {"force_rms_error_n": measured, "force_max_n": float(np.nanmax(log["force_n"], initial=0.0))}
    losses = [loss.summarised for loss in record.losses]
    return {"force_target_n": target, **figures, "force_measured_rms_error_n": measured, **error, "losses": losses}


def _witnesses(session: Session, record: TaskRecord) -> dict[str, Any] | None:
    """What else than the array knew of the force; None without a touch."""
    if session.plan.setup.touch is None:
        return None
    from canprobe.cell.planning.contact import reports_torque

    return {
        "array_seen_alive": session.cell.supervisor.array_alive,
        "depth_watched_fraction": record.depth_watched,
        "torques_reported": reports_torque(session.plan),
    }


def _listened(log: Mapping[str, Floats]) -> dict[str, Any]:
    """Images that the master read, and their force; None where no image came, or its force does not show."""
    cycles = log.get("sample_cycle", np.empty(0))
    sampled = cycles[np.isfinite(cycles)]
    force = log["force_n"][np.isfinite(log["force_n"])] if "force_n" in log else np.empty(0)
    seconds = float(np.ptp(log["t_s"])) if len(log["t_s"]) > 1 else 0.0
    images = len(np.unique(sampled))
    return {
        "images": images,
        "images_per_s": images / seconds if seconds > 0 else None,
        "force_mean_n": float(force.mean()) if len(force) else None,
        "force_max_n": float(force.max()) if len(force) else None,
    }


def _hidden_force(session: Session, highest: float | None, log: Mapping[str, Floats]) -> list[str]:
    """Warning where the true force was above the limit, which acts on the measured force."""
    limit = session.scene.limits.force_max_n
    if not truth_of(session) or highest is None or highest <= limit:
        return []
    return [
        f"the true force rose to {highest:.2f} N, above limits.force_max_n = {limit:g}: the array measured at most"
        f" {np.nanmax(log['force_n'], initial=0.0):.2f} N"
    ]


def _cycle(cell: Cell, record: TaskRecord) -> dict[str, Any]:
    cycle, drives, tactile = cell.cycle, cell.drives, cell.tactile
    statistics = cycle.statistics if cycle is not None else None
    return {
        "rate_hz": cycle.number / (cycle.t_ns * 1e-9) if cycle is not None and cycle.t_ns > 0 else None,
        "cycles": cycle.number + 1 if cycle is not None else 0,
        "overruns": statistics.overruns if statistics is not None else 0,
        "missed_pdos": drives.missed if drives is not None else 0,
        "late_pdos": drives.late if drives is not None else 0,
        "torn_frames": tactile.torn if tactile is not None else 0,
        "stale_frames": tactile.stale if tactile is not None else 0,
        "unplaced_contacts": record.unplaced,
        "slowed_cycles": record.slowed,
        "dropped_frames": cell.port.counters.overruns,
        "clock_steps": cell.port.counters.clock_steps,
        "period_error_us": percentiles(statistics.period_error_ns if statistics is not None else []),
        "response_us": percentiles(statistics.response_ns if statistics is not None else []),
        "compute_us": percentiles(statistics.compute_ns if statistics is not None else []),
    }


def percentiles(values_ns: Sequence[int] | NDArray[np.int64]) -> dict[str, float | None]:
    """Percentiles of times, µs; `observe_us` is the time that observers and bridges add to a cycle, after its work."""
    if not len(values_ns):
        return dict.fromkeys(("p50", "p99", "p999", "max"))
    us = np.asarray(values_ns) / 1000
    p50, p99, p999 = np.percentile(us, (50, 99, 99.9)).tolist()
    return {"p50": p50, "p99": p99, "p999": p999, "max": float(us.max())}


def writers_of(result: RunData) -> list[Callable[[Path], None]]:
    """The functions that write the files of a run into a folder, but those of the session and the figures.

    Each raises `ResultsError` where its file cannot be written; no part of it is left then.
    """
    found = result.summary["calibration"]
    tool = None if found is None else tool_text(found, result.plan.scene.name)
    writers: list[Callable[[Path], None]] = [lambda out: write_summary(result.summary, out)]
    if tool is not None:
        writers.append(lambda out: write_text(out / FILE, tool))
    if (surface_map := result.surface_map) is not None:
        from canprobe.cell.results.surface_file import SURFACE, save_surface_map  # late: it loads scipy.spatial

        answers = next(iter(result.estimates.values()), [])
        writers.append(lambda out: save_surface_map(surface_map, out / SURFACE, answers))
    return writers


def write_summary(summary: Mapping[str, Any], out: Path) -> None:
    """Write ``summary.json``, whole, in the place of an earlier one."""
    write_text(out / "summary.json", json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n")
