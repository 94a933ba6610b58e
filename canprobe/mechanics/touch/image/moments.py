"""Second moments of a tactile image, its centroid, and the traces of earlier places that creep leaves in them.

A taxel's reading goes on growing under a constant load, by some percent a decade of time, and falls as slowly after the
load is gone. So an image is that of the present patch with a faint and blurred trace of earlier ones: the second
moments of a patch that rolls over the pad are larger than those of one at rest, by a share of its squared distance from
earlier places. The share is calibrated (`ImageParameters.memory`); with it images at rest and in motion give the same
curvature.

Model: traces that fade exponentially, with time constants a decade apart and of equal strength. A trace is so faint
that it shows only where it overlaps the patch: one further away lies below the level that is taken off an image. So the
traces' share in the moments stops growing with their distance (`overlapping`).

Source: logarithmic creep as a sum of exponentials a decade apart: Findley, Lai and Onaran, "Creep and relaxation of
nonlinear viscoelastic materials", ch. 5.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.checks import read_only
from canprobe.mechanics.touch.image.patch import PatchCalibration

LEVEL_COUNTS = 6
"""Counts that are subtracted from every taxel: the first count above the sensor's threshold of 2 %."""

Moments = tuple[float, float, float]
"""xx, xy, yy of a symmetric tensor in the tangent plane."""


class MomentImage:
    """Second central moments of the pressure above a level.

    A taxel at the patch's rim has the longest lever. Why not just cut at the threshold: a taxel would enter and leave
    with a jump, and the moments would depend on where a patch lies on the grid, by 2.5–4 % of the moment across a
    cylinder of 36 mm at 2 N. With the level subtracted the pressure fades out, and 0.6 % are left.

    Args:
        calibration: pressures and weights of the taxels.
        level_counts: the level, in counts.
    """

    def __init__(self, calibration: PatchCalibration, level_counts: int = LEVEL_COUNTS) -> None:
        self.level_pa = float(calibration.pascals[level_counts])
        self._table = read_only(np.maximum(calibration.pascals - self.level_pa, 0.0))
        self._weights = calibration.weights
        self._square = calibration.pad.pitch_m**2

    def moments(self, taxels: NDArray[np.uint8]) -> Moments | None:
        """Moments uu, uv, vv (m²) of an image (rows, columns) in pad coordinates; None where they are no ellipse."""
        # about the middle of the pad, by one product with constant weights: it costs two digits of sixteen
        total, u, v, uu, uv, vv = self._table.take(taxels).reshape(-1).dot(self._weights).tolist()
        if total <= 0.0:
            return None
        scale = self._square / total
        u, v = u / total, v / total
        uu, uv, vv = (
            scale * uu - self._square * u * u,
            scale * uv - self._square * u * v,
            scale * vv - self._square * v * v,
        )
        return (uu, uv, vv) if uu > 0.0 and uu * vv > uv * uv else None


TIME_CONSTANTS_S = np.array([[0.3], [3.0], [30.0]])
"""Time constants of the traces, s."""
OVERLAP_RATIO = 1.0
"""Moments of the traces, over those of the patch, up to which they overlap it. On random scenes in which the contact
runs over the pad they stay at 3.5 % of the image's moments while the squared distance of the places grows 40-fold."""


def overlapping(traces: Moments, moments: Moments) -> Moments:
    """The part of the traces (xx, xy, yy, m²) that shows in an image of these moments: no larger than the patch."""
    apart = (traces[0] + traces[2]) / (OVERLAP_RATIO * (moments[0] + moments[2]))
    shown = 1.0 / math.hypot(1.0, apart)
    return shown * traces[0], shown * traces[1], shown * traces[2]


class PadMemory:
    """Fading traces of the places of the patch on the pad since the contact began."""

    def __init__(self) -> None:
        self._t_s: float | None = None
        self._sums = np.zeros((len(TIME_CONSTANTS_S), 6))  # of 1, u, v, uu, uv, vv

    def add(self, t_s: float, u: float, v: float) -> Moments:
        """Take the centroid (m) of an image at a time (s).

        Returns:
            Second moments uu, uv, vv of the earlier places about this one, summed over the traces, m².
        """
        dt = 0.0 if self._t_s is None else max(t_s - self._t_s, 0.0)
        self._t_s = t_s
        kept = np.exp(-dt / TIME_CONSTANTS_S)
        self._sums = kept * self._sums + (1.0 - kept) * [1.0, u, v, u * u, u * v, v * v]
        mass, su, sv, uu, uv, vv = self._sums.sum(axis=0).tolist()
        return (
            uu - 2.0 * u * su + u * u * mass,
            uv - u * sv - v * su + u * v * mass,
            vv - 2.0 * v * sv + v * v * mass,
        )
