"""The path in the browser: a node for each stretch of it, so that a growing path is not sent again and again."""

from __future__ import annotations

from typing import Any

import numpy as np

from canprobe.bridge.view.colours import linear_light
from canprobe.bridge.view.trail import ErrorScale, Trail

THICKNESS_M = 1.5e-3
STRETCH = 150
"""Segments of one node of a live path."""


class LoadedPath:
    """A whole recorded path, shown up to an instant.

    Args:
        api: of viser's scene.
        trail: of the run.
        scale: of its colours.
    """

    def __init__(self, api: Any, trail: Trail, scale: ErrorScale) -> None:
        self._starts: list[float] = []
        self._nodes: list[Any] = []
        self._shown = 0
        for chunk in trail.chunks():
            self._starts.append(trail.times[chunk.start])
            name = f"/path/{len(self._nodes):03d}"
            self._nodes.append(_add(api, name, trail, chunk, scale, visible=False))

    def until(self, t_s: float) -> None:
        """Show what was touched until then."""
        wanted = int(np.searchsorted(self._starts, t_s, side="right"))
        low, high = sorted((self._shown, wanted))
        for node in self._nodes[low:high]:
            node.visible = wanted > self._shown
        self._shown = wanted


class GrowingPath:
    """A path that grows while the cell runs.

    Args:
        api: of viser's scene.
        trail: which grows elsewhere.
        scale: of its colours.
    """

    def __init__(self, api: Any, trail: Trail, scale: ErrorScale) -> None:
        self._api, self._trail, self._scale = api, trail, scale
        self._done = 0
        self._sent = 0

    def refresh(self) -> None:
        """Send what has come since."""
        while self._sent < len(self._trail):
            end = min(self._done + STRETCH, len(self._trail))
            name = f"/path/{self._done // STRETCH:04d}"
            _add(self._api, name, self._trail, slice(self._done, end), self._scale, visible=True)
            self._sent = end
            if end - self._done == STRETCH:
                self._done = end


def _add(api: Any, name: str, trail: Trail, chunk: slice, scale: ErrorScale, *, visible: bool) -> Any:
    colours = linear_light(scale.colours(np.array(trail.values[chunk])))
    return api.add_line_segments(
        name, np.array(trail.segments[chunk], np.float32), np.repeat(colours[:, None], 2, axis=1),
        thickness=THICKNESS_M, thickness_units="world", visible=visible,
    )  # fmt: skip
