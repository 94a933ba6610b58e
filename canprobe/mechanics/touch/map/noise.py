"""The noise of contacts, as the map takes it: the one place where the sensor's figures stand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.types import Floats

USUAL_SIGMA_M = 50e-6
"""Usual standard deviation of a contact, m."""
REPEATED_SHARE = 0.1
"""Share of a pad's variance that every pass over the same ground repeats: gains of the taxels under the patch, and
hysteresis of the same way. On scans that go 3 to 25 times over a rod, a wave and a free form normals stay off by 0.4 to
1.2 mrad; as if all passes were independent, 0.4 mrad would be stated on the rod and 0.9 mrad be true."""


@dataclass(frozen=True, slots=True)
class MapNoise:
    """Noise of a contact, and the errors that a whole scan has in common.

    A contact on a sphere that is tangent to the surface errs along the pad (lateral) and along the normal (height). The
    lateral error e turns the reported normal by (1/R_p + H) e and hardly moves the height. Errors of neighbours on the
    path are alike: the path per independent sample stands for that, so that nothing has to be whitened.

    Attributes:
        lateral: usual standard deviation along the surface, m.
        height: standard deviation of a height, m; infinite: heights are not used.
        normal: standard deviation of a normal that does not come from the lateral error, rad; infinite: not used.
        height_path, normal_path: path per independent sample, m; 0: every contact is independent.
        image_path: the same for the part of the lateral error that changes from image to image; the other part changes
            as the contact moves over the pad and has `normal_path`.
        common: prior standard deviations of the common errors: lag along the heading (m), relative scale of the pad,
            offsets of the centroid along both axes of the pad (m). All 0: none.
        place: standard deviation of where the whole surface is along its normals, m: tool and arm displace it in one
            piece.
    """

    lateral: float
    height: float
    normal: float
    height_path: float = 0.0
    normal_path: float = 0.0
    image_path: float = 0.0
    common: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    place: float = 0.0

    @property
    def used(self) -> int:
        """Number of rows that a node has: one height, two slopes."""
        return 1 * math.isfinite(self.height) + 2 * math.isfinite(self.normal)

    def lateral2(self, sample: ContactSample) -> float:
        """Variance of the lateral error of a contact, m², as if all of it had `normal_path`."""
        lateral2 = (self.lateral if sample.sigma_point is None else sample.sigma_point) ** 2
        share = self.image_path / self.normal_path if self.normal_path else 1.0
        return share * (lateral2 - sample.sigma_slow**2) + sample.sigma_slow**2 + sample.sigma_motion**2

    def height2(self, sample: ContactSample) -> float:
        """Variance of the height of a contact, m²."""
        return (self.height if sample.sigma_height is None else sample.sigma_height) ** 2

    def scatter2(self, excess: Floats) -> Floats:
        """Variance of heights, m², which no path shrinks, where contacts scatter by `excess` more than their noise."""
        return 2.0 * excess * self.height**2 if math.isfinite(self.height) else np.zeros_like(excess)

    def independent(self, count: Floats, path: Floats, once: float) -> tuple[Floats, Floats]:
        """Independent heights and normals in nodes of some contacts (n,) along some path (n,), m.

        One pass over a node is of the path `once`, m. Errors that are alike along a path are alike on the next pass: n
        passes with a correlation ρ (`REPEATED_SHARE`) are worth n / (1 + (n − 1) ρ), at most 1/ρ.
        """
        passes = np.maximum(path / once, 1.0)
        worth = 1.0 / (1.0 + REPEATED_SHARE * (passes - 1.0))
        heights, normals = (
            count if each == 0.0 else worth * np.minimum(count, path / each)
            for each in (self.height_path, self.normal_path)
        )
        return heights, normals


PAD_NOISE = MapNoise(USUAL_SIGMA_M, 14e-6, 0.3e-3, 0.5e-3, 2e-3, 0.9e-3, (25e-6, 0.08, 20e-6, 20e-6))
"""Noise of a pad whose contacts state theirs. It belongs to how a pad errs, and not to one array. The paths were
measured on 41 development shapes without edges, each of another array: over 4 to 8 mm of path means of heights err as
if each 0.3 to 0.5 mm were independent, and over 8 to 16 mm means of normals, on the 33 shapes that are formulae and
without the common errors, as if each 1.4 to 2 mm were. That is with the depth by the right curvature, which the map
finds; by the curvature that the loop knows heights have 0.7 mm and more."""
