"""Second moments and centroids of tactile images, and what an array remembers in them of where the patch has been."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.linear_algebra import read_only
from canprobe.mechanics.touch.patch.array_calibration import Lag
from canprobe.mechanics.touch.patch.image import PatchCalibration

LEVEL_COUNTS = 6
"""Taken off every taxel: the first count above the sensor's threshold of 2 %."""

Moments = tuple[float, float, float]
"""xx, xy, yy of a symmetric tensor in the tangent plane."""


class MomentImage:
    """Second central moments of the pressure above a level.

    A taxel at the patch's rim has the longest lever. Cut off at the threshold it enters and leaves with a jump, and
    the moments depend on where a resting patch lies on the grid: 2.5–4 % of the moment across a cylinder of 36 mm at
    2 N. With the level taken off it fades; there 0.6 % are left.

    """

    def __init__(self, calibration: PatchCalibration, level_counts: int = LEVEL_COUNTS) -> None:
        self.level_pa = float(calibration.pascals[level_counts])
        self._table = read_only(np.maximum(calibration.pascals - self.level_pa, 0.0))
        self._weights = calibration.weights
        self._square = calibration.pitch_m**2

    def moments(self, taxels: NDArray[np.uint8]) -> Moments | None:
        """Moments uu, uv, vv (m²) of an image (rows, columns) in pad coordinates; None where they are no ellipse."""
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


# What an array that creeps remembers of where the patch has been.
#
# A taxel's reading goes on growing under a constant load, by some percent a decade of time, and falls as slowly when
# the load is gone. So an image is the patch as it is, with a faint and blurred picture of where it was: the second
# moments of a patch that rolls over the pad are larger than those of one that rests, by a share of how far it has been
# away. The share is calibrated (`ImageParameters.memory`); with it images at rest and on the move say the same of the
# surface.
#
# Model: memories that fade exponentially, a decade apart, all of one strength. It stops being true where the patch has
# been further away than its own size.
#
# Source: logarithmic creep as a sum of exponentials a decade apart: Findley, Lai and Onaran, "Creep and relaxation of
# nonlinear viscoelastic materials", ch. 5.

TIMES_S = (0.3, 3.0, 30.0)
"""Time constants of the memories."""


class PadMemory:
    """Places of the patch on the pad since the contact began, as faded memories."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Contact was lost."""
        self._t_s: float | None = None
        self._sums = [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0) for _ in TIMES_S]  # of 1, u, v, uu, uv, vv

    def add(self, t_s: float, u: float, v: float) -> Moments:
        """Take the centroid (m) of an image at a time (s).

        Returns uu, uv, vv of the way from here to where the patch was, mean over what each memory holds, added up, m².
        """
        dt = 0.0 if self._t_s is None else max(t_s - self._t_s, 0.0)
        self._t_s = t_s
        mass = su = sv = uu = uv = vv = 0.0
        for k, tau in enumerate(TIMES_S):
            kept = math.exp(-dt / tau)
            new = 1.0 - kept
            m, a, b, aa, ab, bb = self._sums[k]
            m, a, b = kept * m + new, kept * a + new * u, kept * b + new * v
            aa, ab, bb = kept * aa + new * u * u, kept * ab + new * u * v, kept * bb + new * v * v
            self._sums[k] = m, a, b, aa, ab, bb
            mass, su, sv, uu, uv, vv = mass + m, su + a, sv + b, uu + aa, uv + ab, vv + bb
        return (
            uu - 2.0 * u * su + u * u * mass,
            uv - u * sv - v * su + u * v * mass,
            vv - 2.0 * v * sv + v * v * mass,
        )


# The centroid on an array with hysteresis trails the contact over the pad; what is known of that is taken off.
#
# A taxel under the patch's front reads less than it should and one under its end more, and what has crept lags behind
# as well. So the centroid lies back along its own way, by some tens of micrometres: much more than its noise, and alike
# for millimetres of path over the object, which bends the normals that are felt.
#
# Model: with x the way from the mean place of the last `slow_s` to that of the last `quick_s`, the centroid lies `most
# · x / (|x| + reach)` back. It was fitted to scans at one speed; the bound keeps it harmless at others. It does not
# know the patch: of 0.1 mm to and fro the centroid shows 68 to 88 % by object, corrected 88 to 109 %.

GAP_S = 0.1
"""Time without contact after which the pad remembers nothing that counts."""


class PadLag:
    """Follows a contact over the pad and moves its centroid to where the contact most likely is.

    Args:
        lag: of the array.
    """

    def __init__(self, lag: Lag) -> None:
        self._lag = lag
        self._t_s = -math.inf
        self._quick = self._slow = (0.0, 0.0)

    def step(self, t_s: float, u: float, v: float) -> tuple[float, float]:
        """Take a centroid (m) at a time (s); where the contact is, m."""
        dt, self._t_s = t_s - self._t_s, t_s
        if dt > GAP_S:
            self._quick = self._slow = (u, v)
        self._quick = _nearer(self._quick, u, v, dt / self._lag.quick_s)
        self._slow = _nearer(self._slow, u, v, dt / self._lag.slow_s)
        x, y = self._quick[0] - self._slow[0], self._quick[1] - self._slow[1]
        share = self._lag.most / (math.hypot(x, y) + self._lag.reach)
        return u + share * x, v + share * y


def _nearer(mean: tuple[float, float], u: float, v: float, times: float) -> tuple[float, float]:
    """An exponential mean after so many time constants more."""
    new = 1.0 - math.exp(-max(times, 0.0))
    return mean[0] + new * (u - mean[0]), mean[1] + new * (v - mean[1])
