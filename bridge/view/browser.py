"""A cell in a browser: live, recorded with a time slider, or as one HTML file that replays a run."""

from __future__ import annotations

import base64
import html
import json
import math
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.scene.geometry import true_object
from canprobe.fieldbus.bus.files import write_text
from canprobe.fieldbus.bus.port import MonotonicClock
from canprobe.lab.bridge.sample import Context, Sample
from canprobe.lab.bridge.view.instants import NAMES, Answer, Follower, Moment, curves_of, row_of
from canprobe.lab.bridge.view.meshes import MAGMA, Array, scale
from canprobe.lab.bridge.view.path import OFF_PATH, GrowingPath, LoadedPath, Trail, deviation_scale
from canprobe.lab.bridge.view.recorded import RecordedRun
from canprobe.lab.bridge.view.stage import Panel, Stage, address, legend_of, open_server, place_of
from canprobe.lab.bridge.view.surface import GrowingSurface, LoadedSurface
from canprobe.mechanics.touch.shapes import PlacedShape

# The bridge `view`: the cell in a browser while it runs.

FRAME_NS, PLOT_NS = 40_000_000, 250_000_000
"""Time on the wall between two pictures, and between two drawings of the plots."""
ROW_S, WINDOW_S = 0.05, 30.0
"""Time between two points of a plot, and how much of the past it shows."""
_OFF_PATH = tuple(phase.name.lower() for phase in OFF_PATH)


class LiveView:
    """A sink of samples that shows the newest of them, as often as a browser wants to see it.

    Args:
        context: the plan, and where to listen.
    """

    def __init__(self, context: Context) -> None:
        scene, settings = context.plan.scene, context.settings
        shape = None if scene.object is None else true_object(scene.object)
        errors = deviation_scale(shape)
        self._stack = ExitStack()
        server = self._server = self._stack.enter_context(open_server(settings.view_port, settings.view_host))
        self._stage = Stage(server, scene)
        self._panel = Panel(server, scene, errors, self._stage)
        self._trail = Trail()
        self._path = GrowingPath(server.scene, self._trail)
        self._surface = GrowingSurface(server.scene, errors)
        self._follower = Follower(shape)
        self._rows: deque[tuple[float, ...]] = deque(maxlen=round(WINDOW_S / ROW_S))
        self._clock = MonotonicClock()
        self._frame_ns = self._plot_ns = 0

    @property
    def where(self) -> str:
        """Its address."""
        return address(self._server)

    def start(self, epoch_ns: int) -> None:
        """Nothing to do: times are shown from the opening of the bus."""

    def write(self, sample: Sample) -> None:
        """Take one sample; now and then show where the cell is."""
        moment = self._follower.take(sample)
        contact = sample.touch.contact if sample.touch is not None else None
        if contact is not None and moment.phase not in _OFF_PATH:
            self._trail.add(moment.t_s, contact.point, contact.normal)
        if sample.patch is not None and moment.answer is not None:
            self._surface.add(moment.answer)
        if sample.cycle is not None and (not self._rows or moment.t_s >= self._rows[-1][0] + ROW_S):
            self._rows.append(row_of(moment))
        now_ns = self._clock.now_ns()
        if now_ns - self._frame_ns >= FRAME_NS:
            self._frame_ns = now_ns
            self._show(moment, now_ns)

    def _show(self, moment: Moment, now_ns: int) -> None:
        curves = None
        if now_ns - self._plot_ns >= PLOT_NS:
            self._plot_ns = now_ns
            curves = curves_of(self._rows)
            self._surface.refresh()
        with self._server.atomic():
            self._stage.show(moment)
            self._path.refresh()
            self._panel.show(moment, curves)

    def close(self, summary: str | None) -> None:
        """Take the page away."""
        self._show(self._follower.moment, self._plot_ns + PLOT_NS)
        self._stack.close()


open_sink = LiveView


# A recorded run in a browser, with a time slider, play and pause.

FRAME_S = 0.04
MOST_POINTS = 600
"""Points of a curve in a plot."""


def serve_run(
    run: RecordedRun,
    *,
    port: int,
    host: str,
    ready: Callable[[str], None],
    say: Callable[[str], None],
    whole: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> None:
    """Show a run until it is interrupted.

    Args:
        run: from `read_run`.
        port, host: see `open_server`.
        ready: called with the address.
        say: called with each line about what cannot be drawn.
        whole: what is done within it is not to be interrupted; pictures are made by libraries that take it ill.
    """
    with open_server(port, host) as server:
        player = Player(server, run)
        for note in player.notes:
            say(note)
        ready(address(server))
        clock = MonotonicClock()
        next_ns = clock.now_ns()
        while True:
            with whole():
                player.step(FRAME_S)
            next_ns = max(next_ns + round(FRAME_S * 1e9), clock.now_ns())
            clock.sleep_until_ns(next_ns)


class Player:
    """The slider and what follows it; `step` moves the time on.

    Args:
        server: a `viser.ViserServer`.
        run: what is shown.

    Attributes:
        notes: lines about what cannot be drawn.
    """

    def __init__(self, server: Any, run: RecordedRun) -> None:
        self._server = server
        self._run = run
        errors = deviation_scale(shape_of(run))
        self._stage = Stage(server, run.scene)
        self._path = LoadedPath(server.scene, trail_of(run))
        self._surface = LoadedSurface(server.scene, answers_of(run), errors)
        gui = server.gui
        start = round(float(run.log["t_s"][0]), 2)
        self._slider = gui.add_slider("time (s)", start, max(round(run.duration_s, 2), start + 0.01), 0.01, start)
        self._play = gui.add_checkbox("play", True)
        self._speed = gui.add_dropdown("speed", ("0.25", "0.5", "1", "2", "4"), initial_value="1")
        self.notes = self._stage.notes
        self._panel = Panel(server, run.scene, errors, self._stage)
        times = run.times(max(FRAME_S, run.duration_s / MOST_POINTS))
        self._panel.show(run.at(start), curves_of(row_of(run.at(t)) for t in times))
        self._shown = math.nan

    def step(self, dt_s: float) -> None:
        """Go on by so much of the wall's time, and show where the slider stands."""
        t = float(self._slider.value)
        if self._play.value:
            t = round(t + dt_s * float(self._speed.value), 2)
            t = t if t <= self._run.duration_s else self._slider.min
            self._slider.value = t
        if t == self._shown:
            return
        self._shown = t
        moment = self._run.at(t)
        with self._server.atomic():
            self._stage.show(moment)
            self._path.until(t)
            self._surface.until(t)
            self._panel.show(moment)


def shape_of(run: RecordedRun) -> PlacedShape | None:
    """The true object of a run's scene."""
    return None if run.scene.object is None else true_object(run.scene.object)


def answers_of(run: RecordedRun) -> Iterator[tuple[float, Answer]]:
    """The answers of a run's estimator, each with the instant from which it counted, s."""
    yield from zip(run.log["t_s"][run.answer_rows].tolist(), run.answers, strict=True)


def trail_of(run: RecordedRun) -> Trail:
    """The path of a run's contact."""
    trail, log = Trail(), run.log
    if "contact_mm" not in log:
        return trail
    touched = np.isfinite(log["contact_mm"]).all(axis=1) & ~np.isin(log["phase"], OFF_PATH)
    rows = np.nonzero(touched)[0]
    times, points = log["t_s"][rows].tolist(), log["contact_mm"][rows] * 1e-3
    for t_s, point, normal in zip(times, points, log["normal"][rows], strict=True):
        trail.add(t_s, point, normal)
    return trail


# One HTML file that replays a run: viser's own client with the scene in it, and a panel of plots beside it.
#
# Nothing is loaded when it is opened, so that it can be mailed, and looked at years later, from any disk.

MOST_FRAMES = 900
"""A longer run is shown in larger steps: the file stays below ten megabytes."""


def write_page(run: RecordedRun, file: Path, say: Callable[[str], None]) -> None:
    """Write the replay of a run into one file.

    Args:
        run: from `read_run`.
        file: to write; an older one is replaced.
        say: called with each line about what cannot be drawn.

    Raises:
        UsageError: viser is not installed.
        ResultsError: the file cannot be written.
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


def _record(run: RecordedRun, times: Array) -> tuple[str, list[str]]:
    """Viser's page with every frame in it, and lines about what cannot be drawn."""
    with open_server(0) as server:
        stage = Stage(server, run.scene)
        errors = deviation_scale(shape_of(run))
        path = LoadedPath(server.scene, trail_of(run))
        surface = LoadedSurface(server.scene, answers_of(run), errors)
        recorder = server.get_scene_serializer()
        before = 0.0  # the page's time is that of the run: the first picture stands until its first cycle
        with server.atomic():  # nobody listens: nothing is sent
            stage.show(run.at(0.0))
            for t in times.tolist():
                recorder.insert_sleep(t - before)
                before = t
                stage.show(run.at(t))
                path.until(t)
                surface.until(t)
        return str(recorder.as_html()), stage.notes


def _panel_data(run: RecordedRun, times: Array, notes: list[str]) -> dict[str, Any]:
    """What the panel plots: columns, taxel images, colours; None for what is not finite."""
    moments = [run.at(t) for t in times.tolist()]
    curves = curves_of(map(row_of, moments))
    shape = shape_of(run)
    errors = deviation_scale(shape)
    task = run.scene.task
    sensor = run.scene.sensor
    blank = np.zeros((1, 1) if sensor is None else (sensor.rows, sensor.columns), np.uint8)
    taxels = b"".join((blank if m.taxels is None else m.taxels).tobytes() for m in moments) if run.taxels else b""
    return {
        "title": run.title,
        "notes": notes,
        "scene": run.scene.name,
        "curves": {name: [_short(x) for x in curves[name].tolist()] for name in NAMES},
        "phases": [m.phase for m in moments],
        "target": task.force_n if task.kind in ("scan", "press") else None,
        "truth": shape is not None,
        "shape": run.scene.shape is not None,
        "sensor": sensor is not None,
        "rows": blank.shape[0],
        "columns": blank.shape[1],
        "taxels": base64.b64encode(taxels).decode("ascii"),
        "scale": {
            "high": errors.high,
            "text": errors.text,
            "colours": errors.colours(np.linspace(0, errors.high, 64)).tolist(),
        },
        "heat": scale(np.sqrt(np.arange(256.0)), 0.0, math.sqrt(255.0), MAGMA).tolist(),
        "legend": legend_of(run.scene),
        "centre": place_of(run.scene).tolist(),
    }


def _short(x: float) -> float | None:
    return float(f"{x:.5g}") if math.isfinite(x) else None
