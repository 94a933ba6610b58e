"""The folder of a run and the file of its steps, and the files of what a cell keeps from one run to the next."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from canprobe.cell.master.options import Say
from canprobe.cell.npz import read_npz, write_npz
from canprobe.cell.planning.model import Plan
from canprobe.cell.rows import ROWS_FOLDER, RowFiles
from canprobe.cell.scene.setup import Arm
from canprobe.errors import ResultsError
from canprobe.fieldbus.bus.files import make_folder, whole_file, writing
from canprobe.fieldbus.bus.real.interrupts import interrupts_held

BUS_LOG, STEPS = "bus.log", "steps.log"
"""Files of the frames on the bus, and of the steps of a run that comes back from losses."""
LEFT_BY_RUNS = (
    STEPS,
    *("log.npz", "report.html", "report.png", "run.mcap", "scene.toml", "summary.json", "surface.npz"),
    *("surface.png", "tactile.npz", "tool.toml", "truth.npz"),
)
"""Files of a run's folder besides ``bus.log``."""


class KeptFiles:
    """The files of a run's folder, and those that could not be written.

    Args:
        out: the folder; None: nothing is written.
        note: called with each fault.

    Attributes:
        note: that function.
        unwritten: files that could not be written, each with the reason; the cell's notes list them too.
    """

    def __init__(self, out: Path | None, note: Callable[[str], None]) -> None:
        self.note = note
        self.unwritten: list[str] = []
        self._out = out

    def note_unwritten(self, failure: str | None) -> None:
        """Note that a file could not be written, and why; None notes nothing."""
        if failure is not None:
            self.unwritten.append(failure)
            self.note(failure)

    def keep(self, name: str, rows: RowFiles) -> Mapping[str, NDArray[Any]]:
        """Write the columns of rows into a file of the folder; each is read back when it is asked for.

        A failure is noted, and the files of the rows stay. The columns then are in memory, as without a folder.
        """
        columns = rows.columns()
        if self._out is None or not columns:
            return dict(columns)
        try:
            with interrupts_held():
                write_npz(self._out / name, columns)
        except ResultsError as error:
            self.note_unwritten(str(error))
            return dict(columns)
        rows.remove()
        return read_npz(self._out / name)


def prepare_folder(plan: Plan, out: Path) -> None:
    """Make the folder of a run, with its scene and without the files of an earlier run.

    Raises:
        ResultsError: a file cannot be written or removed.
    """
    make_folder(out)
    shutil.rmtree(out / ROWS_FOLDER, ignore_errors=True)
    for name in LEFT_BY_RUNS if BUS_LOG in plan.outputs else (*LEFT_BY_RUNS, BUS_LOG):
        with writing(out / name):
            (out / name).unlink(missing_ok=True)
    write_scene(plan, out)


def write_scene(plan: Plan, folder: Path) -> None:
    """Write `scene.toml` into a folder, with the files that it names beside it, as they were read for the plan.

    Raises:
        ResultsError: a file cannot be written; no part of it is left.
    """
    for name, content in reversed(plan.files.items()):
        with whole_file(folder / name) as part:
            part.write_bytes(content)


def zeros_file(plan: Plan) -> Path | None:
    """File of the zeros of a cell's real drives; None where no drive is homed."""
    if all(drive.zero is None or drive.emulated for drive in plan.setup.drives):
        return None
    return record_file("zeros", plan.setup.needed_arm())


def record_file(kind: str, arm: Arm) -> Path:
    """File of a record of an arm's drives, in the user's state folder."""
    folder = os.environ.get("XDG_STATE_HOME") or "~/.local/state"
    return Path(folder).expanduser() / "canprobe" / f"{kind}-{arm.model.name}.json"


class StepLog:
    """Reports each step to the user, and appends it to a file with its time on the run's clock.

    Args:
        say: called with each step.
        path: path of the file; None writes none.

    Attributes:
        time_s: function that gives the time on the run's clock, s; None before the bus is open. What is said before
            then is written as soon as it is.
        failure: why a line could not be written; None while all could.
    """

    def __init__(self, say: Say, path: Path | None) -> None:
        self._say, self._path = say, path
        self.time_s: Callable[[], float] | None = None
        self.failure: str | None = None
        self._waiting: list[str] = []

    def __call__(self, text: str) -> None:
        """Report a step."""
        if self._path is not None and self.failure is None:
            self._waiting.append(f"{self.time_s() if self.time_s is not None else 0.0:12.4f}  {text}\n")
            if self.time_s is not None:
                self._write(self._path)
        self._say(text)

    def _write(self, path: Path) -> None:
        try:
            with path.open("a", encoding="utf-8") as file:
                file.writelines(self._waiting)
        except OSError as error:
            self.failure = f"{path}: cannot be written: {error.strerror}"
        self._waiting.clear()
