"""The noise of contacts, as the map takes it: the one place where the sensor's figures stand."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.types import Floats

USUAL_SIGMA_M = 50e-6
"""Usual standard deviation of a contact, m."""


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
        stated_share: true lateral standard deviation over the `sigma_point` that a `ContactSample` states.
        height_path, normal_path: path per independent sample, m; 0: every contact is independent.
        common: prior standard deviations of the common errors: lag along the heading (m), relative scale of the pad,
            offsets of the centroid along both axes of the pad (m). All 0: none.
    """

    lateral: float
    height: float
    normal: float
    stated_share: float = 1.0
    height_path: float = 0.0
    normal_path: float = 0.0
    common: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    @property
    def used(self) -> int:
        """Number of rows that a node has: one height, two slopes."""
        return 1 * math.isfinite(self.height) + 2 * math.isfinite(self.normal)

    def lateral2(self, sample: ContactSample) -> float:
        """Variance of the lateral error of a contact, m²."""
        lateral = self.lateral if sample.sigma_point is None else self.stated_share * sample.sigma_point
        return lateral**2 + sample.sigma_motion**2

    def independent(self, count: Floats, path: Floats) -> tuple[Floats, Floats]:
        """Independent heights and normals in nodes of some contacts (n,) along some path (n,), m."""
        heights, normals = (
            count if each == 0.0 else np.minimum(count, path / each) for each in (self.height_path, self.normal_path)
        )
        return heights, normals


PAD_NOISE = MapNoise(USUAL_SIGMA_M, 14e-6, 0.3e-3, 0.62, 1.6e-3, 3e-3, (25e-6, 0.08, 20e-6, 20e-6))
"""Noise of the emulated array, measured on 38 000 contacts of 59 scenes."""
