"""One HTML file that replays a run: viser's own client with the scene in it, and a panel of plots beside it.

It loads nothing when it is opened, so that it can be mailed, and opened years later from any disk.
"""

from __future__ import annotations

import base64
import html
import json
import math
from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.fieldbus.bus.files import write_text
from canprobe.lab.bridge.view.array_dome import taxel_colours
from canprobe.lab.bridge.view.instants import NAMES, curves_of, row_of
from canprobe.lab.bridge.view.path import deviation_scale
from canprobe.lab.bridge.view.recorded import RecordedRun
from canprobe.lab.bridge.view.replay import FRAME_S, RecordedScene
from canprobe.lab.bridge.view.server import open_server
from canprobe.lab.bridge.view.stage import legend_of, place_of
from canprobe.mechanics.types import Floats

MOST_FRAMES = 900
"""Most frames of a page; a longer run has larger steps, so that the file stays below ten megabytes."""


def write_page(run: RecordedRun, file: Path, say: Callable[[str], None]) -> None:
    """Write the replay of a run into one file.

    Args:
        run: a run that `read_run` has read.
        file: file that is written; an older one is replaced.
        say: called with a line for each part that cannot be drawn.

    Raises:
        UsageError: when viser is not installed.
        ResultsError: when the file cannot be written.
    """
    times = run.times(max(FRAME_S, run.duration_s / MOST_FRAMES))
    recorded, notes = _record(run, times)
    for note in notes:
        say(note)
    head, middle, tail = recorded.partition("</head>")
    panel = files(__package__).joinpath("panel.html").read_text(encoding="utf-8")
    data = json.dumps(_panel_data(run, times, notes), allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    title = html.escape(f"canprobe: {run.title}", quote=False)
    head = head.replace("<title>Viser</title>", f"<title>{title}</title>")
    write_text(file, f"{head}{panel.replace('/*DATA*/null', data)}{middle}{tail}")


def _record(run: RecordedRun, times: Floats) -> tuple[str, list[str]]:
    """Viser's page with every frame in it, and lines about parts that cannot be drawn."""
    with open_server(0) as (server, _):
        scene = RecordedScene(server, run)
        recorder = server.get_scene_serializer()
        before = 0.0  # the page's time is that of the run: the first picture stands until its first cycle
        with server.atomic():  # nobody listens: nothing is sent
            scene.show(0.0)
            for t in times.tolist():
                recorder.insert_sleep(t - before)
                before = t
                scene.show(t)
        return str(recorder.as_html()), scene.stage.notes


def _panel_data(run: RecordedRun, times: Floats, notes: list[str]) -> dict[str, Any]:
    """Data of the panel: columns, taxel images, colours; None for a value that is not finite."""
    moments = [run.at(t) for t in times.tolist()]
    curves = curves_of(map(row_of, moments))
    errors = deviation_scale(run.setup.truth.object, run.setup.scan)
    colours = errors.colours(np.linspace(0, errors.high, 64))
    scene, task, sensor = run.setup.scene, run.setup.scene.task, run.setup.scene.sensor
    blank = np.zeros((1, 1) if sensor is None else (sensor.rows, sensor.columns), np.uint8)
    taxels = b"".join((blank if m.taxels is None else m.taxels).tobytes() for m in moments) if run.taxels else b""
    return {
        "title": run.title,
        "notes": notes,
        "scene": scene.name,
        "curves": {name: [_short(x) for x in curves[name].tolist()] for name in NAMES},
        "phases": [m.phase for m in moments],
        "target": task.force_n if task.kind in ("scan", "press") and not isinstance(task.force_n, Mapping) else None,
        "truth": run.setup.truth.object is not None,
        "shape": scene.shape is not None,
        "sensor": sensor is not None,
        "rows": blank.shape[0],
        "columns": blank.shape[1],
        "taxels": base64.b64encode(taxels).decode("ascii"),
        "scale": {"high": errors.high, "text": errors.text, "colours": colours.tolist()},
        "heat": taxel_colours(np.arange(256, dtype=np.uint8)).tolist(),
        "legend": legend_of(scene),
        "centre": place_of(run.setup).tolist(),
    }


def _short(x: float) -> float | None:
    return float(f"{x:.5g}") if math.isfinite(x) else None
