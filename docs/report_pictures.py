"""Draw docs/img/conform.png and judge.png, the tops of two reports. `python docs/measure.py screens`

Chromium draws them, as it shows the files of --html.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from canprobe.fieldbus import LockstepBus, VirtualClock, load_eds, make_eds_node
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.tools import Examination, FaultyNode, Report, inject
from canprobe.fieldbus.tools.reports import read_json, write_html

DOCS = Path(__file__).resolve().parent
WIDTH = 900
HEIGHTS = {"conform": 560, "judge": 722}
"""Of a window, CSS pixels: a report without what is below its first rows."""
SCALE = 2
COLOURS = 128
CHROMIUM = ("chromium", "chromium-browser", "google-chrome")


def examined() -> Report:
    """The emulated node of the page of `conform`, with a wrong toggle bit in the segments that it sends."""
    eds, bus = load_eds("puma260_joint", 5), LockstepBus(VirtualClock(), "lockstep")
    node = FaultyNode(make_eds_node(eds, 5, eds="puma260_joint"))
    bus.attach(node)
    with inject(node, "node 5: sdo-toggle"):
        return Examination(bus.port(), 5, Description(eds)).run()


def judged(folder: Path) -> Report:
    """What the lines of the page of `judge` find, without the versions of this machine."""
    page = (DOCS / "judge.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"```sh\npipx install \.\n(printf .*?)```", page, re.S)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    command = lines.rstrip() + " --json >judge.json"
    subprocess.run(["bash", "-c", command], cwd=folder, env=os.environ | {"PATH": path}, check=False)
    report = read_json(folder / "judge.json")
    report.facts["command"] = report.facts["command"].removesuffix(" --json")
    del report.facts["versions"]
    return report


def draw_reports(images: Path) -> None:
    """Draw both into a folder."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for name, report in (("conform", examined()), ("judge", judged(folder))):
            page, path = folder / f"{name}.html", images / f"{name}.png"
            write_html(report, page)
            screenshot(page, path, (WIDTH, HEIGHTS[name]), [f"--force-device-scale-factor={SCALE}"])
            Image.open(path).convert("RGB").quantize(COLOURS).save(path, optimize=True)


def screenshot(page: Path, path: Path, window: tuple[int, int], words: Sequence[str]) -> None:
    """Draw a page of HTML as chromium shows it in a window, CSS pixels."""
    chromium = next(filter(None, map(shutil.which, CHROMIUM)))
    size = f"--window-size={window[0]},{window[1]}"
    command = [chromium, "--headless", "--no-sandbox", "--hide-scrollbars", size, *words, f"--screenshot={path}"]
    subprocess.run([*command, page.as_uri()], check=True, capture_output=True)
