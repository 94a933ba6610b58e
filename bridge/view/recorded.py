"""The folder of a run → its moments to show, instant by instant."""

from __future__ import annotations

import contextlib
import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.results import run_files
from canprobe.cell.results.surface_file import SURFACE, load_surface_map
from canprobe.cell.rows import joint_positions
from canprobe.cell.scene.load import SAVED_AS
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Setup
from canprobe.cell.tasks.task import Phase
from canprobe.errors import UsageError
from canprobe.lab.bridge.sample import ContactFrame, SurfacePatch
from canprobe.lab.bridge.view.instants import JudgedAnswer, Moment, judge
from canprobe.lab.bridge.view.path import OFF_PATH
from canprobe.lab.bridge.view.surface import map_of_points
from canprobe.mechanics.touch.map.surface_map import SurfaceMap
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

ROWS_SHOWN, ANSWERS_SHOWN = 72_000, 4_000
"""Cycles, images and answers that are shown, evenly over the run: all of three minutes at 400 Hz. An hour takes no
longer to draw, and no more memory."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedRun:
    """The data of a run that the view shows.

    Attributes:
        setup: resolved scene.
        log: the columns of ``log.npz``; every row one cycle, of a long run every k-th.
        q: joint positions (rows, n), rad or m; None without an arm.
        answer_rows: rows at which the estimator gave a new answer.
        answers: estimate at each of them.
        taxels: time, s, and counts (rows, columns) of each tactile frame, by rising time of the cycle that used it.
        surface_map: map of the surface; None where nothing was touched.
    """

    setup: Setup
    log: dict[str, Floats]
    q: Floats | None
    answer_rows: NDArray[np.int64]
    answers: tuple[JudgedAnswer, ...]
    taxels: tuple[tuple[float, NDArray[np.uint8]], ...]
    surface_map: SurfaceMap | None

    @property
    def title(self) -> str:
        """Name of the scene."""
        return self.setup.scene.title or self.setup.scene.name

    @property
    def duration_s(self) -> float:
        """Time of the last cycle, s."""
        return float(self.log["t_s"][-1])

    def times(self, step_s: float) -> Floats:
        """Instants at an even distance from the first cycle to the last, s."""
        start = float(self.log["t_s"][0])
        return np.append(np.arange(start, self.duration_s - 1e-9, step_s), self.duration_s)

    def at(self, t_s: float) -> Moment:
        """The moment of an instant, with what the cell knew then."""
        log, q = self.log, self.q
        row = max(int(np.searchsorted(log["t_s"], t_s + 1e-9, side="right")) - 1, 0)
        answer = int(np.searchsorted(self.answer_rows, row, side="right")) - 1
        frame = bisect_right(self.taxels, t_s + 1e-9, key=lambda item: item[0]) - 1
        return Moment(
            t_s=float(log["t_s"][row]),
            phase=self._phase(row),
            q=q[row] if q is not None and np.isfinite(q[row]).all() else None,
            contact=self._contact(row),
            answer=self.answers[answer] if answer >= 0 else None,
            taxels=self.taxels[frame][1] if frame >= 0 else None,
            force=float(log["force_n"][row]) if "force_n" in log else math.nan,
            T_base_carrier=None if (carrier := self.setup.carrier) is None else carrier.frame(log[carrier.column][row]),
        )

    def _phase(self, row: int) -> str | None:
        value = self.log["phase"][row] if "phase" in self.log else math.nan
        return Phase(int(value)).name.lower() if math.isfinite(value) else None

    def _contact(self, row: int) -> ContactFrame | None:
        if "contact_mm" not in self.log or not np.isfinite(self.log["contact_mm"][row]).all():
            return None
        turn = tangent_rotation(-self.log["normal"][row])
        return ContactFrame(homogeneous(turn, self.log["contact_mm"][row] * 1e-3))


def read_run(folder: Path, setup: Setup | None = None) -> RecordedRun:
    """Read the data of a run that the view shows.

    Args:
        folder: folder that `canprobe run` wrote: ``scene.toml``, ``log.npz`` and, for the taxels, ``tactile.npz``.
        setup: setup that the run had; None reads ``scene.toml``.

    Raises:
        UsageError: no such folder, a file that is missing or of another canprobe, or a column that is not as it should
            be; with the file's name.
        SceneError: a scene that cannot be loaded.
    """
    run_files.check_run_folder(folder, SAVED_AS, run_files.LOG)
    run_files.read_summary(folder)
    if setup is None:
        setup = resolve(run_files.read_scene(folder))
    log = run_files.read_log(folder / run_files.LOG, setup)
    every = -(-len(log["t_s"]) // ROWS_SHOWN) or 1
    log = {name: np.array(log.pop(name)[::every]) for name in tuple(log)}  # one after the other: each is let go
    if not len(log["t_s"]):
        raise UsageError(f"{folder / run_files.LOG}: expected a row for each cycle, got none")
    rows = _new_answers(log)
    rows = rows[:: -(-len(rows) // ANSWERS_SHOWN) or 1]
    shape = setup.truth.object
    return RecordedRun(
        setup=setup,
        log=log,
        q=joint_positions(log),
        answer_rows=rows,
        answers=tuple(judge(_patch(log, row), shape) for row in rows.tolist()),
        taxels=tuple(_read_taxels(folder / run_files.TACTILE, setup)),
        surface_map=_surface_map(folder / SURFACE, log, setup),
    )


def _surface_map(file: Path, log: dict[str, Floats], setup: Setup) -> SurfaceMap | None:
    """The map of a run; of one that was killed, or of an older canprobe, that of the contacts in its log."""
    if file.exists():
        with contextlib.suppress(UsageError):
            found = load_surface_map(file)
            return found if len(found) else None
    rows = contact_rows(log)
    if setup.shape is None or not len(rows):
        return None
    found = map_of_points(setup.probe.radius)
    found.add(log["contact_mm"][rows] * 1e-3, log["normal"][rows])
    return found


def contact_rows(log: dict[str, Floats]) -> NDArray[np.intp]:
    """Rows of a log at which the probe was on its path over the object."""
    if "contact_mm" not in log:
        return np.zeros(0, np.intp)
    return np.flatnonzero(np.isfinite(log["contact_mm"]).all(axis=1) & ~np.isin(log["phase"], OFF_PATH))


def _read_taxels(file: Path, setup: Setup) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """The images that the cell used; none where there is no file, or of an array that sends features."""
    columns = run_files.read_tactile(file, setup) if run_files.is_recorded(file) else {}
    if columns and np.isnan(columns["features"]).all():
        every = -(-len(columns["t_s"]) // ROWS_SHOWN) or 1
        yield from zip(columns["t_s"][::every].tolist(), columns["taxels"][::every], strict=True)


def _new_answers(log: dict[str, Floats]) -> NDArray[np.int64]:
    """Rows at which the estimate changed; the log repeats each until the next."""
    if "K_per_m" not in log or "T_base_contact_m" not in log:
        return np.empty(0, np.int64)
    key = np.concatenate([log[name].reshape(len(log["t_s"]), -1) for name in ("T_base_contact_m", "K_per_m")], axis=1)
    known = np.isfinite(log["T_base_contact_m"]).all(axis=(1, 2))
    return np.flatnonzero(np.append(True, (key[1:] != key[:-1]).any(axis=1)) & known)


def _patch(log: dict[str, Floats], row: int) -> SurfacePatch:
    unknown = np.full((3, 3), np.nan)
    observed = np.isfinite(log["kappa_per_m"][row]) if "kappa_per_m" in log else (True, True)
    return SurfacePatch(
        t_ns=round(float(log["t_s"][row]) * 1e9),
        T_base_contact=log["T_base_contact_m"][row],
        K=log["K_per_m"][row],
        covariance=log["K_covariance_per_m2"][row] if "K_covariance_per_m2" in log else unknown,
        observed=(bool(observed[0]), bool(observed[1])),
    )
