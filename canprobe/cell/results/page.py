"""The page of a run in three dimensions, for a notebook or a browser."""

from __future__ import annotations

import html
import importlib
import os
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path

from canprobe.cell.master.options import quiet
from canprobe.cell.planning.bridges import check_bridges
from canprobe.cell.scene.setup import Setup


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


def page_of(folder: Path, setup: Setup) -> Page:
    """The page of a run's folder, written where it is missing, and opened in a browser outside of a notebook.

    Raises:
        UsageError: the extra `view` is missing, or a controller's column has the name of one of ours.
    """
    page = Page(folder / "report.html")
    if not page.path.is_file():
        check_bridges(["view"], "")
        write_page_of(folder, setup)
    if "ipykernel" not in sys.modules and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        webbrowser.open(page.path.resolve().as_uri())
    return page
