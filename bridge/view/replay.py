"""A recorded run in a browser, with a time slider, play and pause."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.lab.bridge.view.instants import Moment, curves_of, row_of
from canprobe.lab.bridge.view.panel import Panel
from canprobe.lab.bridge.view.path import LoadedPath, Trail, deviation_scale
from canprobe.lab.bridge.view.recorded import RecordedRun, contact_rows
from canprobe.lab.bridge.view.server import open_server
from canprobe.lab.bridge.view.stage import Stage
from canprobe.lab.bridge.view.surface import LoadedSurface

FRAME_S = 0.04
MOST_POINTS = 600
"""Most points of a curve in a plot."""


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
        run: a run that `read_run` has read.
        port, host: see `open_server`.
        ready: called with the address.
        say: called with a line for each part that cannot be drawn.
        whole: block that must not be interrupted: libraries that draw pictures fail then.
    """
    with open_server(port, host, run.setup.bridge.origins) as (server, address):
        player = Player(server, run)
        for note in player.notes:
            say(note)
        ready(address)
        clock = MonotonicClock()
        next_ns = clock.now_ns()
        while True:
            with whole():
                player.step(FRAME_S)
            next_ns = max(next_ns + round(FRAME_S * 1e9), clock.now_ns())
            clock.sleep_until_ns(next_ns)


class RecordedScene:
    """Stage, path and surface of a recorded run.

    Args:
        server: a `viser.ViserServer`.
        run: run to show.

    Attributes:
        stage: arm, probe, object and contact.
        errors: scale of the surface's colours.
    """

    def __init__(self, server: Any, run: RecordedRun) -> None:
        self._run = run
        self.stage, trail = Stage(server, run.setup), trail_of(run)
        self.errors = deviation_scale(run.setup.truth.object, run.setup.scan)
        self._path = LoadedPath(server.scene, trail)
        self._surface = LoadedSurface(server.scene, run.surface_map, trail, self.errors)

    def show(self, t_s: float) -> Moment:
        """Show an instant, s; returns its moment."""
        moment = self._run.at(t_s)
        self.stage.show(moment)
        self._path.until(t_s)
        self._surface.until(t_s)
        return moment


class Player:
    """The slider and what follows it; `step` moves the time on.

    Args:
        server: a `viser.ViserServer`.
        run: run to show.

    Attributes:
        notes: lines about parts that cannot be drawn.
    """

    def __init__(self, server: Any, run: RecordedRun) -> None:
        self._server = server
        self._run = run
        self._scene = RecordedScene(server, run)
        gui = server.gui
        start = round(float(run.log["t_s"][0]), 2)
        self._slider = gui.add_slider("time (s)", start, max(round(run.duration_s, 2), start + 0.01), 0.01, start)
        self._play = gui.add_checkbox("play", True)
        self._speed = gui.add_dropdown("speed", ("0.25", "0.5", "1", "2", "4"), initial_value="1")
        self.notes = self._scene.stage.notes
        self._panel = Panel(server, run.setup.scene, self._scene.errors, self._scene.stage)
        times = run.times(max(FRAME_S, run.duration_s / MOST_POINTS))
        self._panel.show(run.at(start), curves_of(row_of(run.at(t)) for t in times))
        self._shown = math.nan

    def step(self, dt_s: float) -> None:
        """Go on by a time on the wall, s, and show the moment of the slider."""
        t = float(self._slider.value)
        if self._play.value:
            t = round(t + dt_s * float(self._speed.value), 2)
            t = t if t <= self._run.duration_s else self._slider.min
            self._slider.value = t
        if t == self._shown:
            return
        self._shown = t
        with self._server.atomic():
            self._panel.show(self._scene.show(t))


def trail_of(run: RecordedRun) -> Trail:
    """The path of a run's contact."""
    trail, rows = Trail(), contact_rows(run.log)
    if len(rows):
        points = run.log["contact_mm"][rows] * 1e-3
        for t_s, point, normal in zip(run.log["t_s"][rows].tolist(), points, run.log["normal"][rows], strict=True):
            trail.add(t_s, point, normal)
    return trail
