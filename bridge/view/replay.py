"""A recorded run in a browser, with a time slider, play and pause."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from canprobe.bridge.view.curves import curves_of
from canprobe.bridge.view.panel import Panel
from canprobe.bridge.view.path_nodes import LoadedPath
from canprobe.bridge.view.recorded import RecordedRun
from canprobe.bridge.view.server import address, open_server
from canprobe.bridge.view.stage import Stage
from canprobe.bridge.view.trail import OFF_PATH, Trail, error_scale
from canprobe.bus.clock import MonotonicClock
from canprobe.scene_geometry import true_object
from canprobe.touch.objects import PlacedShape

FRAME_S = 0.04
MOST_POINTS = 600
"""Points of a curve in a plot."""


def serve_run(
    run: RecordedRun,
    *,
    port: int,
    host: str,
    ready: Callable[[str], None],
    whole: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> None:
    """Show a run until it is interrupted.

    Args:
        run: from `read_run`.
        port, host: see `open_server`.
        ready: called with the address.
        whole: what is done within it is not to be interrupted; pictures are made by libraries that take it ill.
    """
    with open_server(port, host) as server:
        player = Player(server, run)
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
    """

    def __init__(self, server: Any, run: RecordedRun) -> None:
        self._server = server
        self._run = run
        errors = error_scale(shape_of(run))
        self._stage = Stage(server, run.scene)
        self._path = LoadedPath(server.scene, trail_of(run), errors)
        gui = server.gui
        start = float(run.log["t_s"][0])
        with gui.add_folder("Replay"):
            self._slider = gui.add_slider("time (s)", start, max(run.duration_s, start + 0.01), 0.01, start)
            self._play = gui.add_checkbox("play", True)
            self._speed = gui.add_dropdown("speed", ("0.25", "0.5", "1", "2", "4"), initial_value="1")
        self._panel = Panel(server, run.scene, errors)
        self._curves = curves_of(run.at(t) for t in run.times(max(FRAME_S, run.duration_s / MOST_POINTS)))
        self._panel.show(run.at(start), self._curves)
        self._shown = math.nan

    def step(self, dt_s: float) -> None:
        """Go on by so much of the wall's time, and show where the slider stands."""
        t = float(self._slider.value)
        if self._play.value:
            t += dt_s * float(self._speed.value)
            t = t if t <= self._run.duration_s else float(self._run.log["t_s"][0])
            self._slider.value = t
        if t == self._shown:
            return
        self._shown = t
        moment = self._run.at(t)
        with self._server.atomic():
            self._stage.show(moment)
            self._path.until(t)
            self._panel.show(moment)


def shape_of(run: RecordedRun) -> PlacedShape | None:
    """The true object of a run's scene."""
    return None if run.scene.object is None else true_object(run.scene.object)


def trail_of(run: RecordedRun) -> Trail:
    """The path of a run's contact, coloured by the error of its estimates; by their deviation without a true object."""
    trail, log = Trail(), run.log
    if "contact_mm" not in log:
        return trail
    touched = np.isfinite(log["contact_mm"]).all(axis=1) & ~np.isin(log["phase"], OFF_PATH)
    rows = np.nonzero(touched)[0]
    answers = np.searchsorted(run.answers, rows, side="right") - 1
    known = run.sigmas if run.scene.object is None else run.errors
    values = np.append(known, math.nan)[answers].tolist()  # the last for −1: before the first answer
    times, points = log["t_s"][rows].tolist(), log["contact_mm"][rows] * 1e-3
    for t_s, point, normal, value in zip(times, points, log["normal"][rows], values, strict=True):
        trail.add(t_s, point, normal, value)
    return trail
