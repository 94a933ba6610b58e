"""Draw docs/img/view.png, the view in the middle of the default scan. `python docs/measure.py screens`"""

from __future__ import annotations

import tempfile
from pathlib import Path

from report_pictures import screenshot

import canprobe
from canprobe.cli import main

WINDOW = 1280, 800
SHOWN_S = 15.8
"""Time of the replay that is shown, s."""
NO_NOTES = "<style>[class*=Notification]{display:none !important}</style></head>"
"""The page without the note that no graphics processor draws it."""


def draw_view(path: Path) -> None:
    """Run the scan, write its page, and let chromium play it until then."""
    with tempfile.TemporaryDirectory() as made:
        run, page = Path(made) / "run", Path(made) / "view.html"
        canprobe.run("cylinder", {"outputs.figures": False}, bus="direct", out=run)
        main(["view", str(run), "--html", str(page), "--quiet"])
        page.write_text(page.read_text(encoding="utf-8").replace("</head>", NO_NOTES, 1), encoding="utf-8")
        drawn = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        screenshot(page, path, WINDOW, [*drawn, f"--virtual-time-budget={1000 * SHOWN_S:.0f}"])
