"""A recorded run, estimated again from its log alone: candump in, shape out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.log_cycles import LogCycles
from canprobe.cell.recording import read_recording
from canprobe.cell.replay import replay_contacts, replay_task
from canprobe.cell.tasks.build import estimates_of
from canprobe.cell.tasks.shape import ShapeRecord, ShapeTracker, on_run_clock
from canprobe.errors import ProtocolError, UsageError
from canprobe.npz_file import write_npz
from canprobe.planning import Plan, make_plan
from canprobe.recorded_summary import estimate_columns, replay_text, summarise_replay
from canprobe.scene import Scene
from canprobe.scene_loader import load_scene
from canprobe.scene_resolve import resolve
from canprobe.session import LOCKSTEP
from canprobe.touch.estimators import METHODS, unknown_method

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """One replayed log.

    Attributes:
        plan: of the scene.
        summary: ``schema, scene, log, channel``; ``driven_by`` (``task``: the scene's task made the recorded targets
            and was stepped again; ``other``: every contact was fed) with the comparison of ``targets``; ``cycle`` (what
            was missed); ``contacts``; ``estimates`` (the last of each estimator); ``shape`` as in ``summary.json``;
            ``online`` (the difference to what the run logged, None where there is nothing to compare).
        estimates: what each estimator said, by name; its times, as all those of the summary, are on the log's clock.
        tracker: the contacts that they were fed, and what the scene's estimator said of them, with times since the
            first SYNC.
    """

    plan: Plan
    summary: dict[str, Any]
    estimates: dict[str, list[ShapeRecord]]
    tracker: ShapeTracker

    def text(self) -> str:
        """The summary for people."""
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

    The log of a run of ours gives the online result once more. In a log of the same nodes under another master, every
    contact is fed to the estimators. Which of the two was done stands in the summary.

    Args:
        log: folder of a run, or a candump file.
        scene: what the nodes are and how the estimators are set; by default the ``scene.toml`` beside the log.
        method: the estimators, one or several; by default the scene's.

    Raises:
        UsageError: no log or scene, an unknown method, a line that is not candump's, a node that was never heard, no
            SYNC, or no contact at all.
    """
    path, folder = find_log(Path(log))
    plan = make_plan(resolve(scene_of(path, folder, scene)))
    methods = _methods(plan.scene, method)
    as_taken = folder is not None and plan.scene.bus.interface != LOCKSTEP
    recording = read_recording(path, plan, as_taken=as_taken)
    try:
        cycles = LogCycles(plan, recording, as_taken=as_taken, drifts=folder is None)
        task = replay_task(plan, cycles)
        tracker, unplaced = task.task.shape, task.task.unplaced
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


# what to read


def find_log(log: Path) -> tuple[Path, Path | None]:
    """The candump file; and the run's folder where it is one.

    Raises:
        UsageError: nothing is there, or a folder without a log.
    """
    if not log.exists():
        raise UsageError(f"{log}: no such folder or file; expected the folder of a run, or a candump file")
    if not log.is_dir():
        return log, None
    path = log / "bus.log"
    if not path.is_file():
        raise UsageError(f"{log}: no bus.log in this folder; expected the folder of a run, or a candump file")
    return path, log


def scene_of(path: Path, folder: Path | None, scene: Scene | str | Path | None) -> Scene:
    """The scene that was named, or the one beside the log.

    Raises:
        UsageError: there is neither.
    """
    if isinstance(scene, Scene):
        return scene
    if scene is not None:
        return load_scene(scene)
    if folder is None:
        raise UsageError(f"{path}: a log alone does not tell what its nodes are: name the scene (--scene)")
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
