"""The bridge `view`: the cell in a browser while it runs."""

from __future__ import annotations

from collections import deque
from contextlib import ExitStack

from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.lab.bridge.sample import Context, Sample
from canprobe.lab.bridge.view.instants import Follower, Moment, curves_of, row_of
from canprobe.lab.bridge.view.panel import Panel
from canprobe.lab.bridge.view.path import OFF_PATH, GrowingPath, PathAhead, Trail, deviation_scale
from canprobe.lab.bridge.view.server import open_server
from canprobe.lab.bridge.view.stage import Stage
from canprobe.lab.bridge.view.surface import GrowingSurface

FRAME_NS, PLOT_NS = 40_000_000, 250_000_000
"""Time on the wall between two pictures, and between two drawings of the plots."""
SURFACE_REST = 4
"""Time without a new surface, over that which the last one took: all of it is solved and sent each time."""
ROW_S, WINDOW_S = 0.05, 30.0
"""Time between two points of a plot, and length of the past that it shows."""
_OFF_PATH = tuple(phase.name.lower() for phase in OFF_PATH)


class LiveView:
    """A sink of samples that shows the newest one at the rate of a browser.

    Args:
        context: plan, and address of the server.
    """

    def __init__(self, context: Context) -> None:
        setup, settings = context.plan.setup, context.settings
        shape = setup.truth.object
        errors = deviation_scale(shape, setup.scan)
        self._stack = ExitStack()
        server, self.where = self._stack.enter_context(
            open_server(settings.view_port, settings.view_host, settings.origins)
        )
        self._server = server
        self._stage = Stage(server, setup)
        self._panel = Panel(server, setup.scene, errors, self._stage)
        self._trail = Trail()
        self._path, self._ahead = GrowingPath(server.scene, self._trail), PathAhead(server.scene)
        self._surface = None if setup.shape is None else GrowingSurface(server.scene, errors, setup.probe.radius)
        self._follower = Follower(shape)
        self._rows: deque[tuple[float, ...]] = deque(maxlen=round(WINDOW_S / ROW_S))
        self._clock = MonotonicClock()
        self._frame_ns = self._plot_ns = self._surface_ns = 0

    def start(self, epoch_ns: int) -> None:
        """Do nothing: times are shown from the opening of the bus."""

    def write(self, sample: Sample) -> None:
        """Take one sample, and from time to time show the cell."""
        moment = self._follower.take(sample)
        contact = sample.touch.contact if sample.touch is not None else None
        if contact is not None and moment.phase not in _OFF_PATH:
            self._trail.add(moment.t_s, contact.point, contact.normal)
            if self._surface is not None:
                self._surface.add(contact)
        if sample.ahead is not None:
            self._ahead.take(sample.ahead)
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
        if self._surface is not None and now_ns >= self._surface_ns:
            self._surface.refresh()
            after_ns = self._clock.now_ns()
            self._surface_ns = after_ns + max(PLOT_NS, SURFACE_REST * (after_ns - now_ns))
        with self._server.atomic():
            self._stage.show(moment)
            self._path.refresh()
            self._ahead.refresh()
            self._panel.show(moment, curves)

    def close(self, summary: str | None) -> None:
        """Stop the server."""
        self._show(self._follower.moment, max(self._plot_ns + PLOT_NS, self._surface_ns))
        self._stack.close()


open_sink = LiveView
