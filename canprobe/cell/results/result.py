"""The result of a run for Python users: its data, and figures, tables and scores on request."""

from __future__ import annotations

import html
import importlib
import os
import sys
import tempfile
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.options import quiet
from canprobe.cell.npz import write_npz
from canprobe.cell.planning.bridges import check_view
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.run_files import LOG, TACTILE, to_frame, write_parquet
from canprobe.cell.results.scores import Contacts, Scores, estimate_columns, score_estimators
from canprobe.cell.results.summary import writers_of
from canprobe.cell.results.text import summary_text
from canprobe.cell.scene.setup import Setup, Touch
from canprobe.cell.session.folder import write_scene
from canprobe.cell.tasks.shape import OwnEstimator, ShapeRecord
from canprobe.errors import UsageError, needed_module
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from canprobe.mechanics.touch.map.surface_map import SurfaceMap


@dataclass(frozen=True, slots=True)
class Page:
    """One HTML file, which a notebook shows and which can be kept and mailed.

    Attributes:
        path: path of the file.
    """

    path: Path

    def _repr_html_(self) -> str:
        text = html.escape(self.path.read_text(encoding="utf-8"))
        return f'<iframe srcdoc="{text}" style="width: 100%; height: 640px; border: 0"></iframe>'


def write_page_of(folder: Path, setup: Setup) -> None:
    """Write ``report.html`` into a run's folder.

    Args:
        folder: folder with the files of the run.
        setup: setup of the run.

    Raises:
        UsageError: a controller's column has the name of one of ours.
    """
    page = importlib.import_module("canprobe.lab.bridge.view.page")
    recorded = importlib.import_module("canprobe.lab.bridge.view.recorded")
    page.write_page(recorded.read_run(folder, setup), folder / "report.html", quiet)


def has_display() -> bool:
    """Whether a browser has a screen to open on."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def page_of(folder: Path, setup: Setup) -> Page:
    """The page of a run's folder, written where it is missing, and opened in a browser outside of a notebook.

    Raises:
        UsageError: the extra `view` is missing, or a controller's column has the name of one of ours.
    """
    page = Page(folder / "report.html")
    if not page.path.is_file():
        check_view()
        write_page_of(folder, setup)
    if "ipykernel" not in sys.modules and has_display():
        webbrowser.open(page.path.resolve().as_uri())
    return page


class RunResult:
    """One finished run; printing it shows its summary.

    The result of `canprobe.open_cell` is complete when its block is left: until then the drives may be enabled, and
    reading an attribute raises.

    Attributes:
        plan: the plan of the run.
        summary: the content of ``summary.json``.
        log: the columns of ``log.npz``, one row per cycle; the suffix of a name is its unit. ``t_s`` here, in the truth
            and in the estimates counts from the instant that is 0 in ``bus.log``.
        truth: the plant's true values, one row per SYNC; empty where nothing was emulated.
        estimates: the answers of each estimator, by name; the online one first.
        taxels: counts of the task's last tactile frame (rows, columns), or None.
        tactile: the columns of ``tactile.npz``, one row per tactile frame that the cell used: ``t_s`` of the cycle,
            ``t_sample_s``, ``taxels`` (m, rows, columns), their ``window``, ``features``; empty where there was none.
        surface_map: one surface of all contacts of the scan, with its uncertainty; None without a shape.
        out: the folder with the files, or None.
        contacts: measured contacts of the scan; None without a shape.
    """

    __slots__ = ("_data",)

    plan: Plan
    summary: dict[str, Any]
    log: Mapping[str, Floats]
    truth: Mapping[str, Floats]
    estimates: dict[str, list[ShapeRecord]]
    taxels: NDArray[np.uint8] | None
    tactile: Mapping[str, NDArray[Any]]
    surface_map: SurfaceMap | None
    out: Path | None
    contacts: Contacts | None

    def __init__(self) -> None:
        self._data: RunData | None = None

    def complete(self, data: RunData) -> None:
        """Take the data of the finished run."""
        self._data = data

    @property
    def data(self) -> RunData:
        """All attributes in one object.

        Raises:
            UsageError: when the run is under way.
        """
        return self._known("data")

    def _known(self, name: str) -> RunData:
        if self._data is None:
            raise UsageError(f"result.{name}: complete when the block of open_cell is left; read it after the block")
        return self._data

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name not in RunResult.__annotations__:
                raise AttributeError(f"RunResult has no attribute {name!r}")
            return getattr(self._known(name), name)

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *RunResult.__annotations__]

    def text(self) -> str:
        """The summary as text."""
        return summary_text(self.summary, self.out)

    def __repr__(self) -> str:
        try:
            return self.text()
        except UsageError:
            return "a run that is under way; complete when the block of open_cell is left"

    def plot(self) -> Figure:
        """The figure of ``report.png``; a notebook shows it.

        Raises:
            UsageError: when matplotlib is missing, or nothing was measured.
        """
        needed_module("matplotlib", "study", "plot needs matplotlib:")
        from canprobe.cell.results.figures import run_figure

        return run_figure(self.data)

    def view(self) -> Page:
        """The page that replays the run in three dimensions: in a notebook, else in a browser.

        It is ``report.html`` of the run's folder, or of a temporary one.

        Raises:
            UsageError: the extra `view` is missing.
        """
        folder = self.out
        if folder is None:
            folder = Path(tempfile.mkdtemp(prefix="canprobe-view-"))
            self._write_all(folder)
        return page_of(folder, self.plan.setup)

    def score(self, *methods: str, **own: Callable[[], OwnEstimator]) -> Scores:
        """The errors of estimators on the contacts of this scan, all asked every 0.1 s, against the plant's truth.

        Example::

            result.score("recursive", "ml", mine=MyEstimator)

        Args:
            methods: names of packaged methods; by default those of the scene.
            own: functions that make your estimators, such as their classes, by their names in the table. Each has
                ``add(sample)``, which takes a `canprobe.ContactSample`, and ``estimate()``, which returns a
                `canprobe.SurfaceEstimate` or None. After a loss of contact a new one is made.

        Raises:
            UsageError: when nothing was scanned, no truth is known, or a method is unknown.
        """
        task, scene = self.plan.setup.task, self.plan.scene
        if self.contacts is None or not len(self.contacts) or scene.shape is None or not isinstance(task, Touch):
            raise UsageError("score: expected a scan that touched its object, got no contacts")
        if "kappa_per_m" not in self.truth:
            raise UsageError("score: expected an emulated object and outputs.truth = true, got a run without truth")
        ours = {name: name for name in methods or (scene.shape.method, *scene.shape.also)}
        return score_estimators(self.contacts, task, {**ours, **own}, self.truth, self.log["t_s"])

    def to_pandas(self, what: Literal["log", "truth", "estimates"] = "log") -> pandas.DataFrame:
        """A table of the run, by time; vectors are spread over columns, and `attrs["units"]` has every unit.

        Args:
            what: `log` (one row per cycle), `truth` (per SYNC), or `estimates` (per answer of the estimator in the
                loop; the attribute `estimates` has the others).

        Raises:
            UsageError: the extra `data` is missing.
        """
        return to_frame(self._columns(what), self._attrs)

    def to_parquet(self, path: Path | str, what: Literal["log", "truth", "estimates"] = "log") -> None:
        """Write a table of the run as Parquet; `canprobe.load_table` reads it.

        Raises:
            UsageError: the extra `data` is missing.
        """
        write_parquet(self._columns(what), path, self._attrs)

    def to_lerobot(self, folder: Path | str, *, fps: int | None = None) -> None:
        """Write the run as a LeRobotDataset v3.0 of one episode; `canprobe export` writes several runs.

        Args:
            folder: folder of the dataset, which must not exist.
            fps: rows a second, a whole divisor of the cycle's rate; None for the rate.

        Raises:
            UsageError: the folder exists, `fps` does not divide the rate, or the extra `data` is missing.
        """
        from canprobe.cell.results.lerobot import export_lerobot

        with self._folder() as run:
            export_lerobot([run], folder, fps=fps)

    @contextmanager
    def _folder(self) -> Iterator[Path]:
        """The folder with the files of the run; a temporary one where it has none."""
        if self.out is not None:
            yield self.out
            return
        with tempfile.TemporaryDirectory(prefix="canprobe-run-") as name:
            self._write_all(Path(name))
            yield Path(name)

    def _write_all(self, folder: Path) -> None:
        write_scene(self.plan, folder)
        write_npz(folder / LOG, self.log)
        write_npz(folder / TACTILE, self.tactile)
        for write in writers_of(self.data):
            write(folder)

    @property
    def _attrs(self) -> dict[str, Any]:
        return {name: self.summary[name] for name in ("scene", "bus", "seed")}

    def _columns(self, what: str) -> Mapping[str, Floats]:
        if what == "estimates":
            return estimate_columns(next(iter(self.estimates.values()), []))
        if what not in ("log", "truth"):
            raise UsageError(f"to_pandas: expected log, truth or estimates, got {what!r}")
        return self.log if what == "log" else self.truth
