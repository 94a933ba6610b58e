"""The path in the browser: a node for each stretch of it, so that a growing path is not sent again and again."""

from __future__ import annotations

from typing import Any

import numpy as np

from canprobe.lab.bridge.view.path import Trail
from canprobe.mechanics.types import Floats

PATH, AHEAD = (40, 44, 52), (214, 94, 0)
THICKNESS_M = 4e-4
STRETCH = 150
"""Number of segments in one node of a live path."""


class Parts:
    """Nodes of viser's scene that appear one after the other."""

    def __init__(self) -> None:
        self._starts: list[float] = []
        self._nodes: list[Any] = []
        self._shown = 0

    def add(self, t_s: float, node: Any) -> None:
        """Add a hidden node that appears at an instant, s, no earlier than those before."""
        self._starts.append(t_s)
        self._nodes.append(node)

    def until(self, t_s: float) -> None:
        """Show the nodes that have appeared by an instant, and hide the others."""
        wanted = int(np.searchsorted(self._starts, t_s, side="right"))
        low, high = sorted((self._shown, wanted))
        for node in self._nodes[low:high]:
            node.visible = wanted > self._shown
        self._shown = wanted


class LoadedPath(Parts):
    """A whole recorded path, shown up to an instant.

    Args:
        api: viser's scene.
        trail: path of the contact in the run.
    """

    def __init__(self, api: Any, trail: Trail) -> None:
        super().__init__()
        for number, chunk in enumerate(trail.chunks()):
            self.add(trail.times[chunk.start], _add(api, f"/path/{number:03d}", trail, chunk, visible=False))


class GrowingPath:
    """A path that grows while the cell runs.

    Args:
        api: viser's scene.
        trail: path that the owner extends.
    """

    def __init__(self, api: Any, trail: Trail) -> None:
        self._api, self._trail = api, trail
        self._done = self._sent = 0

    def refresh(self) -> None:
        """Send the new segments."""
        while self._sent < len(self._trail):
            end = min(self._done + STRETCH, len(self._trail))
            name = f"/path/{self._done // STRETCH:04d}"
            _add(self._api, name, self._trail, slice(self._done, end), visible=True)
            self._sent = end
            if end - self._done == STRETCH:
                self._done = end


class PathAhead:
    """The path ahead of an exploration, which is drawn anew where it changes.

    Args:
        api: viser's scene.
    """

    def __init__(self, api: Any) -> None:
        self._api, self._points, self._shown = api, np.zeros((0, 3)), np.zeros((0, 3))

    def take(self, points: Floats) -> None:
        """Take the points (n, 3) of the path ahead, m."""
        self._points = points

    def refresh(self) -> None:
        """Send it if it has changed."""
        if self._points is not self._shown and len(self._points) > 1:
            self._shown = self._points
            segments = np.stack([self._shown[:-1], self._shown[1:]], axis=1).astype(np.float32)
            self._api.add_line_segments(
                "/ahead", segments, AHEAD, thickness=2.0 * THICKNESS_M, thickness_units="world", visible=True
            )


def _add(api: Any, name: str, trail: Trail, chunk: slice, *, visible: bool) -> Any:
    return api.add_line_segments(
        name, np.array(trail.segments[chunk], np.float32), PATH, thickness=THICKNESS_M, thickness_units="world",
        visible=visible,
    )  # fmt: skip
