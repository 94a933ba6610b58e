"""One HTML file that replays a run: viser's own client with the scene in it, and a panel of plots beside it.

Nothing is loaded when it is opened, so that it can be mailed, and looked at years later, from any disk.
"""

from __future__ import annotations

import base64
import json
import math
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.bridge.view.colours import UNKNOWN, heat, scale
from canprobe.bridge.view.curves import NAMES, curves_of
from canprobe.bridge.view.path_nodes import LoadedPath
from canprobe.bridge.view.recorded import RecordedRun
from canprobe.bridge.view.replay import shape_of, trail_of
from canprobe.bridge.view.server import open_server
from canprobe.bridge.view.stage import Stage
from canprobe.bridge.view.trail import error_scale
from canprobe.whole_file import write_text

FRAME_S = 0.04
MOST_FRAMES = 900
"""A longer run is shown in larger steps: the file stays below ten megabytes."""


def write_page(run: RecordedRun, file: Path) -> None:
    """Write the replay of a run into one file.

    Args:
        run: from `read_run`.
        file: to write; an older one is replaced.

    Raises:
        UsageError: viser is not installed.
        ResultsError: the file cannot be written.
    """
    times = run.times(max(FRAME_S, run.duration_s / MOST_FRAMES))
    page = _record(run, times)
    head, middle, tail = page.partition("</head>")
    panel = files(__package__).joinpath("panel.html").read_text(encoding="utf-8")
    data = json.dumps(_panel_data(run, times), allow_nan=False, separators=(",", ":")).replace("</", "<\\/")
    title = _escaped(f"canprobe: {run.title}")
    head = head.replace("<title>Viser</title>", f"<title>{title}</title>")
    write_text(file, f"{head}{panel.replace('/*DATA*/null', data)}{middle}{tail}")


def _record(run: RecordedRun, times: Any) -> str:
    """Viser's page with every frame in it."""
    with open_server(0) as server:
        stage = Stage(server, run.scene)
        path = LoadedPath(server.scene, trail_of(run), error_scale(shape_of(run)))
        recorder = server.get_scene_serializer()
        before = float(times[0])
        with server.atomic():  # nobody listens: nothing is sent
            for t in times.tolist():
                recorder.insert_sleep(t - before)
                before = t
                stage.show(run.at(t))
                path.until(t)
        return str(recorder.as_html())


def _panel_data(run: RecordedRun, times: Any) -> dict[str, Any]:
    """What the panel plots: columns, taxel images, colours; None for what is not finite."""
    moments = [run.at(t) for t in times.tolist()]
    curves = curves_of(moments)
    shape = shape_of(run)
    errors = error_scale(shape)
    task = run.scene.task
    blank = np.zeros((16, 16), np.uint8)
    taxels = b"".join((blank if m.taxels is None else m.taxels).tobytes() for m in moments) if run.taxels else b""
    return {
        "title": run.title,
        "scene": run.scene.name,
        "start": float(times[0]),
        "curves": {name: [_short(x) for x in curves[name].tolist()] for name in NAMES},
        "phases": [m.phase for m in moments],
        "target": task.force_n if task.kind in ("scan", "press") else None,
        "truth": shape is not None,
        "shape": run.scene.shape is not None,
        "sensor": run.scene.sensor is not None,
        "taxels": base64.b64encode(taxels).decode("ascii"),
        "scale": {"high": errors.high, "text": errors.text, "colours": scale(np.linspace(0, 1, 64), 0, 1).tolist()},
        "heat": heat(np.sqrt(np.arange(256.0)), 0.0, math.sqrt(255.0)).tolist(),
        "unknown": list(UNKNOWN),
    }


def _short(x: float) -> float | None:
    return float(f"{x:.5g}") if math.isfinite(x) else None


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
