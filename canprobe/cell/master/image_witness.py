"""Whether the images of the array live: a pressed array has noise, and an array that has stopped measuring has none.

Two signs. The image repeats byte by byte; or its centroid scatters far less from image to image than the calibration
says. Either counts only where the probe has moved meanwhile, as at rest a coarse array may well repeat itself, and
only after a time, not a number of images. An array whose calibration does not state its noise must have moved along a
surface for millimetres, with many counts in its image, before a repetition counts: no servo keeps a force so exactly.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.mechanics.touch.pad import COUNTS_MAX
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch import Patch

FROZEN_NS = 50_000_000
"""Time for which an image repeats before it counts."""
FROZEN_WAY = 20e-6
"""Way of the probe in this time, m: ten times what changes a count of an image of hundred counts."""
UNSTATED_NS, UNSTATED_WAY, UNSTATED_COUNTS = 250_000_000, 2e-3, 64
"""The same, and the least highest count of the image, for an array whose noise is not known."""
QUIET_SHARE = 0.1
"""Scatter of the centroid over the calibration's below which an image does not live."""
QUIET_NS = 150_000_000
"""Time of such a scatter before it counts."""
SCATTER_S = 0.05
"""Time over which the scatter is taken."""


class ImageWitness:
    """Looks at each image of a touch.

    Attributes:
        dead_since_ns: time since which the images do not live, where that is certain; None otherwise.
        words: how that shows.
    """

    def __init__(self) -> None:
        self.dead_since_ns: int | None = None
        self.words = ""
        self._image: object = None
        self._same_ns = 0
        self._at: Floats | None = None
        self._places: list[tuple[float, float]] = []
        self._scatter2: float | None = None
        self._quiet_ns = 0
        self._quiet_at: Floats | None = None
        self._t_ns = 0

    def look(self, sample: TactileSample, patch: Patch, centre: Floats | None, sigma: float | None = None) -> None:
        """Take an image.

        Args:
            sample: sample with the image or the features, which repeat where the array has stopped.
            patch: patch that it shows.
            centre: (3,) centre of the probe then, m; None where it is not known.
            sigma: standard deviation of the centroid from image to image, m, as a calibration found it; None where
                none states it.
        """
        if centre is None:
            return
        t_ns, image, pressed, uv = sample.t_sample_ns, sample.image, patch.force > TOUCH_FORCE, (patch.u, patch.v)
        highest = COUNTS_MAX if sample.frame.features else int(sample.frame.taxels.max())
        same = image == self._image
        if not same or not pressed or self._at is None:
            self._image, self._same_ns, self._at = image, t_ns, centre
        dead = pressed and (self._repeats(t_ns, highest, centre, sigma) or self._is_quiet(t_ns, uv, centre, sigma))
        if not pressed:
            self._places, self._scatter2 = [], None
        if not dead:
            self.dead_since_ns = None
        self._t_ns = t_ns

    def _repeats(self, t_ns: int, highest: int, centre: Floats, sigma: float | None) -> bool:
        """Whether the image has stayed the same for too long on the way from where it began."""
        assert self._at is not None
        same_ns, way = t_ns - self._same_ns, float(np.linalg.norm(centre - self._at))
        if sigma is None or sigma <= 0.0:
            long = same_ns >= UNSTATED_NS and way >= UNSTATED_WAY and highest >= UNSTATED_COUNTS
        else:
            long = same_ns >= FROZEN_NS and way >= FROZEN_WAY
        if long:
            self.dead_since_ns = self._same_ns
            self.words = f"the array has sent the same image for {same_ns * 1e-6:.0f} ms while the probe moved by"
            self.words += f" {way * 1e3:.2f} mm"
        return long

    def _is_quiet(self, t_ns: int, uv: tuple[float, float], centre: Floats, sigma: float | None) -> bool:
        """Whether the centroid scatters too little, by second differences, which no steady motion changes."""
        self._places = [*self._places[-2:], uv]
        if sigma is None or sigma <= 0.0 or len(self._places) < 3:
            return False
        (u0, v0), (u1, v1), (u2, v2) = self._places
        # a second difference has (1 + 4 + 1) σ², and there are two directions
        scatter2 = ((u2 - 2.0 * u1 + u0) ** 2 + (v2 - 2.0 * v1 + v0) ** 2) / 12.0
        share = 1.0 - math.exp(-(t_ns - self._t_ns) * 1e-9 / SCATTER_S)
        before = self._scatter2 if self._scatter2 is not None else sigma * sigma
        self._scatter2 = before + share * (scatter2 - before)
        if self._scatter2 >= (QUIET_SHARE * sigma) ** 2 or self._quiet_at is None:
            self._quiet_ns, self._quiet_at = t_ns, centre
            return False
        if t_ns - self._quiet_ns < QUIET_NS or np.linalg.norm(centre - self._quiet_at) < FROZEN_WAY:
            return False
        self.dead_since_ns = self._quiet_ns
        self.words = (
            f"the centroid of the images scatters by {1e6 * math.sqrt(self._scatter2):.1f} µm from image to image,"
            f" {1e6 * sigma:.0f} µm by the calibration of the array"
        )
        return True
