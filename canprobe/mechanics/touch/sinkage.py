"""How far a probe has sunk along its way, beyond what the measured force accounts for.

A probe that goes over any surface moves along the surface's normal by as much as its depth changes. Where it moves in
by more it sinks, by a depth that the array does not show, as when the array fades: each contact then lies a little
deeper than the last one, and together they look like a surface that falls away.

The sum of these motions is compared with what it was at the places of the last way. Its error grows with the distance
between two places, by normals and ways of the arm that are off by a constant angle; where the path comes back, it
does not.
"""

from __future__ import annotations

import numpy as np

from canprobe.mechanics.types import Floats

WAY = 30e-3
"""Way along the surface for which the sum is followed, m."""
STEP = 0.2e-3
"""Way between two places that are kept, m."""
NEAR_ROOT = 0.2
"""Difference of √F, √N, within which two places are compared: d₁ is not known well enough for more."""
HEIGHT_SIGMA, SLOPE_SIGMA = 25e-6, 4e-3
"""Standard deviation of the sum at rest, m, and its growth by the distance, rad."""
CERTAIN_SIGMAS = 2.5
"""Standard deviations below which a depth says nothing: of the sum, and of the surface that was touched before."""


class Sinkage:
    """Follows one touch that goes on over a surface.

    Example: `sunk = sinkage.step(centre, normal, root, d1)` for each image.

    Args:
        slope_sigma: standard deviation of a way of the arm against where it says that it goes, rad.
    """

    def __init__(self, slope_sigma: float = 0.0) -> None:
        self._slope_sigma = float(np.hypot(SLOPE_SIGMA, slope_sigma))
        self._last: tuple[Floats, Floats, float] | None = None
        self._way = self._sunk = 0.0
        self._kept: list[tuple[float, ...]] = []

    def step(self, centre: Floats, normal: Floats, root: float, d1: float) -> float:
        """Take a contact.

        Args:
            centre: (3,) centre of the probe, m.
            normal: (3,) outward unit normal of the object at the contact.
            root: root of the measured force, √N.
            d1: depth at 1 N, m.

        Returns:
            Depth since the place that shows most for certain, which the force does not account for, m; 0 where no
            place shows any.
        """
        if self._last is not None:
            last_centre, last_normal, last_root = self._last
            moved, along = centre - last_centre, 0.5 * (normal + last_normal)
            off = float(moved @ along)
            self._sunk -= off + d1 * (root - last_root)
            self._way += float(np.linalg.norm(moved - off * along))
        self._last = (centre, normal, root)
        if not self._kept or self._way - self._kept[-1][0] >= STEP:
            self._kept.append((self._way, self._sunk, root, *centre.tolist()))
            while self._way - self._kept[0][0] > WAY:
                self._kept.pop(0)
        if len(self._kept) < 3:
            return 0.0
        kept = np.array(self._kept)
        # why not each place by itself: a pose of the probe that is wrong once, as behind a lost PDO, would stay as one
        before = np.maximum(np.maximum(kept[:-2, 1], kept[1:-1, 1]), kept[2:, 1])
        sunk, kept = self._sunk - before, kept[1:-1]
        sigma = np.hypot(HEIGHT_SIGMA, self._slope_sigma * np.linalg.norm(kept[:, 3:] - centre, axis=1))
        certain = np.where(np.abs(kept[:, 2] - root) < NEAR_ROOT, sunk - CERTAIN_SIGMAS * sigma, 0.0)
        return float(sunk[np.argmax(certain)]) if certain.max() > 0.0 else 0.0
