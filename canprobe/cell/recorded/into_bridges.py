"""A recorded run for bridges: the observations of the cell, rebuilt from its log."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.master.controller import Command
from canprobe.cell.master.observers import Observation
from canprobe.cell.master.options import Say
from canprobe.cell.planning.bridges import BRIDGES, check_bridges
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.recorded.recording import LogCycles, read_recording
from canprobe.cell.recorded.reestimate import ReplayResult, find_log, replay, scene_of
from canprobe.cell.recorded.run_folder import RunFolder, read_run
from canprobe.cell.scene.model import BridgeSettings, Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.children import Bridges
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.clock_steps import RecordedBus
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.protocol.frames import is_sync
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate

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
        for observation in _in_real_time(observations) if live else observations:
            for one in bridges.observers:
                one.observe(observation)
        return RecordedBridges(result, bridges.end(None) or {})


def _in_real_time(observations: Iterator[Observation]) -> Iterator[Observation]:
    clock = MonotonicClock()
    start_ns: int | None = None
    for observation in observations:
        if start_ns is None:
            start_ns = clock.now_ns() - observation.t_ns
        clock.sleep_until_ns(start_ns + observation.t_ns)
        yield observation


def _observations(plan: Plan, path: Path, folder: Path | None, result: ReplayResult | None) -> Iterator[Observation]:
    """The observations of a recorded log; `folder` is that of a run, None for another log."""
    estimates = _estimates(result)
    run = read_run(folder, plan.setup) if folder is not None else None
    if run is not None:
        yield from _observations_of(run, path, plan, estimates)
        return
    recording = read_recording(path, plan)
    groups = frames_by_sync(path, recording.channel, plan)
    before = next(groups)
    if before:
        yield Observation(before[-1][2], None, None, before)
    cycles = LogCycles(plan, recording)
    for m, frames in zip(cycles, groups, strict=True):
        estimate = estimates.get(m.t_ns)
        command = None if estimate is None else Command(estimate=estimate)
        yield Observation(cycles.start_ns + m.t_ns, m, command, frames)


def _observations_of(
    run: RunFolder, path: Path, plan: Plan, estimates: dict[int, SurfaceEstimate]
) -> Iterator[Observation]:
    """The observations of a run: the measurements of its master, with the frames from each SYNC to the next."""
    groups = frames_by_sync(path, plan.buses[0].channel, plan) if path.is_file() else iter(())
    if before := next(groups, []):
        yield Observation(before[-1][2], None, None, before)
    start_ns = round(run.start_s * 1e9)
    waiting = next(groups, [])
    deadlines = [*run.times_ns[1:].tolist(), math.inf]
    names = [name for name in TASK_COLUMNS if name in run.log]
    for k, m in enumerate(run.measurements()):
        frames: list[TimedFrame] = []
        while waiting and waiting[0][2] - start_ns < deadlines[k]:
            frames += waiting
            waiting = next(groups, [])
        columns = {name: float(run.log[name][k]) for name in names if np.isfinite(run.log[name][k])}
        estimate = estimates.get(m.t_ns)
        command = Command(columns=dict(columns), estimate=estimate) if columns or estimate is not None else None
        yield Observation(start_ns + m.t_ns, m, command, frames)


def _estimates(result: ReplayResult | None) -> dict[int, SurfaceEstimate]:
    """The answers of the scene's estimator, by the cycle's time since the first, ns."""
    return {} if result is None else {round(r.reported_s * 1e9): r.estimate for r in result.tracker.records}


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
