"""A recorded run for bridges: the observations of the cell, made again from its log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.disk import read_candump, read_npz
from canprobe.bus.port import MonotonicClock, TimedFrame
from canprobe.cell.controller import Command
from canprobe.cell.cycle import Observation
from canprobe.planning.bridges import BRIDGES, check_bridges
from canprobe.planning.make import make_plan
from canprobe.planning.model import Plan
from canprobe.protocol.frames import SYNC_ID
from canprobe.recorded.cycles import LogCycles
from canprobe.recorded.recording import Recording, read_recording
from canprobe.recorded.reestimate import ReplayResult, find_log, replay, scene_of
from canprobe.results.summary import check_clock
from canprobe.scene.model import BridgeSettings, Scene
from canprobe.scene.resolve import resolve
from canprobe.session.children import Bridges
from canprobe.session.session import Say
from canprobe.session.target import LOCKSTEP
from canprobe.touch.estimate.answer import SurfaceEstimate

LOGGED = ("phase", "depth_at_1n_mm")
"""Columns of the task that the bridges use."""


@dataclass(frozen=True, slots=True)
class RecordedBridges:
    """The result of a log that was fed to bridges.

    Attributes:
        result: of its estimators; None where the scene has none.
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
        scene: describes the nodes; by default the ``scene.toml`` beside the log.
        method: estimators, as for :func:`canprobe.replay`.
        say: called with the address or file of each bridge.

    Raises:
        UsageError: as :func:`canprobe.replay`; or a bridge is not available.
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
    """The observations of a recorded log; `folder` of the run, None for another log; `result` of the estimators."""
    as_taken = folder is not None and plan.scene.bus.interface != LOCKSTEP
    ours = folder is not None if result is None else result.summary["driven_by"] == "task"
    recording = read_recording(path, plan, as_taken=as_taken)
    groups = _frames_by_sync(path, recording, plan)
    before = next(groups)
    if before:
        yield Observation(before[-1][2], None, None, before)
    cycles = LogCycles(plan, recording, as_taken=as_taken, on_deadlines=ours, drifts=folder is None)
    columns = _columns(folder, cycles.start_ns, plan.sync.period_ns) if ours else {}
    estimates = _estimates(result)
    for cycle, frames in zip(cycles, groups, strict=True):
        m = cycle.measurement
        logged, estimate = columns.get(m.t_ns, {}), estimates.get(m.t_ns)
        command = Command(columns=logged, estimate=estimate) if logged or estimate is not None else None
        yield Observation(cycles.start_ns + m.t_ns, m, command, frames)


def _estimates(result: ReplayResult | None) -> dict[int, SurfaceEstimate]:
    """The answers of the scene's estimator, by the cycle's time since the first, ns."""
    return {} if result is None else {round(r.told_s * 1e9): r.estimate for r in result.tracker.records}


def _columns(folder: Path | None, start_ns: int, period_ns: int) -> dict[int, dict[str, float | NDArray[np.float64]]]:
    """The columns of the task that bridges use, from the run's log, by the cycle's time since the first, ns.

    ``start_ns`` comes from the stamps of SYNCs, of which some are late by less than half a period.
    """
    if folder is None or not (folder / "log.npz").is_file():
        return {}
    log = read_npz(folder / "log.npz")
    check_clock(folder / "log.npz", log)
    names = [name for name in LOGGED if name in log]
    cycles = np.round((log["t_s"] * 1e9 - start_ns) / period_ns) if names else np.empty(0)
    times = (cycles.astype(np.int64) * period_ns).tolist()
    rows = zip(*(log[name].tolist() for name in names), strict=True)
    return {
        t_ns: {name: value for name, value in zip(names, row, strict=True) if np.isfinite(value)}
        for t_ns, row in zip(times, rows, strict=False)
    }


def _frames_by_sync(path: Path, recording: Recording, plan: Plan) -> Iterator[list[TimedFrame]]:
    """All frames of the cell's buses: those before the first SYNC, then from each SYNC to the next."""
    others = {bus.channel for bus in plan.buses[1:]}
    frames: list[TimedFrame] = []
    for t_ns, channel, can_id, data in read_candump(path):
        if channel != recording.channel and channel not in others:
            continue
        if can_id == SYNC_ID and len(data) <= 1 and channel not in others:
            yield frames
            frames = []
        frames.append((can_id, data, t_ns))
    yield frames
