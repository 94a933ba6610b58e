"""The folder of a run: the measurements of its master, and the scene's task stepped through them again."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.tactile_frame import TactileFrame, TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.run_files import LOG, TACTILE, is_recorded, needed, read_log, read_summary, read_tactile
from canprobe.cell.rows import joint_positions
from canprobe.cell.scene.setup import Setup
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.probing import Phase
from canprobe.cell.tasks.touch import TouchTask
from canprobe.errors import UsageError
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.tactile import Features, TactileHeader, TactileMode

LEAVING_PHASES = (Phase.RETREAT, Phase.DONE)


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The measurements in the folder of a run.

    Attributes:
        path: the folder.
        log, tactile: the columns of ``log.npz`` and ``tactile.npz``.
    """

    path: Path
    log: dict[str, NDArray[Any]]
    tactile: dict[str, NDArray[Any]]

    @property
    def start_s(self) -> float:
        """Time of the first cycle, s, on the run's clock."""
        return float(self.log["t_s"][0])

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """Time of each cycle (n,), ns, since the first."""
        return self._ns(self.log["t_s"])

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Time of each cycle (n,), s, since the first; equal to the times of the run's estimates to the last bit."""
        return self.times_ns.astype(np.float64) * 1e-9

    def measurements(self) -> Iterator[Measurement]:
        """The measurement of each cycle in the cell; times count from the first cycle."""
        log, samples = self.log, self._samples()
        rows = len(log["t_s"])
        joints = joint_positions(log)
        if joints is None:
            joints = np.full((rows, 1), np.nan)
        ages, words = (
            np.nan_to_num(log.get(name, np.zeros((rows, 0)))).astype(int) for name in ("q_age", "statusword")
        )
        torques = log.get("torque_permille", np.zeros((rows, 0)))
        tactile_ages = log.get("tactile_age", np.full(rows, np.nan))
        for k, t_ns in enumerate(self.times_ns.tolist()):
            statuswords = tuple(words[k].tolist())
            yield Measurement(
                cycle=k,
                t_ns=t_ns,
                q=joints[k].copy() if np.isfinite(joints[k]).all() else None,
                q_age=tuple(ages[k].tolist()),
                torque_permille=tuple(torques[k].tolist()),
                statuswords=statuswords,
                enabled=all(known_state(word) is DriveState.OPERATION_ENABLED for word in statuswords),
                tactile=samples.get(t_ns),
                tactile_age=int(tactile_ages[k]) if np.isfinite(tactile_ages[k]) else None,
            )

    def _samples(self) -> dict[int, TactileSample]:
        """The tactile samples by the time of the cycle in which they were usable."""
        columns = self.tactile
        if not columns:
            return {}
        used, sampled = self._ns(columns["t_s"]).tolist(), self._ns(columns["t_sample_s"]).tolist()
        sigmas = columns["t_sigma_s"].tolist()
        triggers = np.searchsorted(self.times_ns, sampled).tolist()
        rows = zip(columns["taxels"], columns["window"].tolist(), columns["features"].tolist(), strict=True)
        return {
            used[i]: TactileSample(_frame(taxels, tuple(window), features), sampled[i], triggers[i], sigmas[i])
            for i, (taxels, window, features) in enumerate(rows)
        }

    def _ns(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.round((times_s - self.start_s) * 1e9).astype(np.int64)


def _frame(taxels: NDArray[np.uint8], window: tuple[int, int, int, int], features: list[float]) -> TactileFrame:
    """A tactile frame that the cell used; its header has only what the file states."""
    sent = None
    if np.isfinite(features).all():
        force, row, col, rr, rc, cc, peak = features
        sent = Features(force, row, col, rr, rc, cc, int(peak))
    whole = TactileMode.IMAGE if window[2] == len(taxels) else TactileMode.WINDOW
    mode = whole if sent is None else TactileMode.FEATURES
    header = TactileHeader(0, 0, window[0], window[1], mode, False, 0, window=window[2])
    return TactileFrame(header, taxels, window, sent, 0)


def read_run(folder: Path, setup: Setup) -> RunFolder | None:
    """The measurements of a run; None where the folder has none.

    Args:
        folder: folder of the run.
        setup: setup of its scene.

    Raises:
        UsageError: when a file is of another version of canprobe, or cannot be read.
    """
    read_summary(folder)
    log, tactile = folder / LOG, folder / TACTILE
    if not is_recorded(log) or not is_recorded(tactile):
        return None
    columns, images = read_log(log, setup), read_tactile(tactile, setup)
    needed(columns, ("q_age", *(("q_rad",) if joint_positions(columns) is None else ())), log)
    if not len(columns["t_s"]):
        raise UsageError(f"{log}: expected a row for each cycle, got none: the run was stopped before its first")
    return RunFolder(folder, columns, images)


def replay_task(plan: Plan, run: RunFolder) -> TouchTask | None:
    """Step the scene's task through the measurements of a run, as the cell did.

    Returns:
        The task at its end; None where the phases of the run differ: it had another scene or controller, or got
        requests from another tool.
    """
    task = make_task(plan)
    assert isinstance(task, TouchTask)
    phases = run.log.get("phase", np.full(len(run.log["t_s"]), np.nan)).tolist()
    if not np.isfinite(phases).any():
        return None
    for measurement, phase in zip(run.measurements(), phases, strict=True):
        if not np.isfinite(phase):  # the cell enabled, held, lifted off or stopped: it did not step its controller
            continue
        task.step(measurement)
        if phase in LEAVING_PHASES and task.phase not in LEAVING_PHASES:  # the cell asked it to let go
            return task
        if phase != task.phase:
            return None
        task.update()
    return task
