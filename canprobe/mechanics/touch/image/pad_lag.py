"""The lag of the centroid behind the contact on an array with hysteresis, and its correction.

A taxel under the patch's front reads too little and one under its end too much, and creep lags behind as well. So the
centroid lies back along its way, by some tens of micrometres: much more than its noise, and nearly constant for
millimetres of path over the object, which tilts the measured normals.

Model: with x the way from the mean place of the last `SLOW_S` to that of the last `QUICK_S`, the centroid lies `most
· x / (|x| + reach)` back. It was fitted to scans at one speed; the bound `most` keeps it harmless at others. It does
not depend on the patch: of a roll of 0.1 mm to and fro the centroid shows 68 to 88 % by object, corrected 88 to 109 %.

The means have the noise of the centroids, mostly that of the quick one, with a variance v per axis. So the way is
shrunk by x² / (x² + 2 v), its share of signal: with light patches most of it is noise, and the whole correction would
add more of this noise to the centroids than it takes away of the lag.

Source: Wiener, "Extrapolation, interpolation, and smoothing of stationary time series", 1949.
"""

from __future__ import annotations

import math

from canprobe.mechanics.touch.image.calibration import Lag

QUICK_S, SLOW_S = 0.02, 0.3
"""Time constants of the mean places between which the way is taken, s."""
GAP_S = 0.1
"""Time without contact, s, after which the lag starts afresh."""


class PadWay:
    """Way of a contact over the pad, from its slow to its quick mean place.

    Attributes:
        elapsed_s: time between the last two centroids, s.
    """

    def __init__(self) -> None:
        self.elapsed_s = math.inf
        self._t_s = -math.inf
        self._quick = self._slow = (0.0, 0.0)

    def step(self, t_s: float, u: float, v: float) -> tuple[float, float]:
        """Take a centroid (m) at a time (s); the way up to it, m."""
        self.elapsed_s, self._t_s = t_s - self._t_s, t_s
        if self.elapsed_s > GAP_S:
            self._quick = self._slow = (u, v)
        self._quick = _nearer(self._quick, u, v, self.elapsed_s / QUICK_S)
        self._slow = _nearer(self._slow, u, v, self.elapsed_s / SLOW_S)
        return self._quick[0] - self._slow[0], self._quick[1] - self._slow[1]


class PadLag:
    """Follows a contact over the pad and corrects its centroid.

    Args:
        lag: lag of the array.
    """

    def __init__(self, lag: Lag) -> None:
        self._lag, self._way = lag, PadWay()

    def step(self, t_s: float, u: float, v: float, sigma: float = 0.0) -> tuple[float, float]:
        """Take a centroid (m) at a time (s), with its standard deviation from image to image per axis (m).

        Returns:
            The place of the contact, m.
        """
        x, y = self._way.step(t_s, u, v)
        square = x * x + y * y
        # an exponential mean of images dt apart has the variance of one times dt / (2 QUICK_S)
        noise = min(self._way.elapsed_s / QUICK_S, 1.0) * sigma * sigma
        share = self._lag.most / (math.sqrt(square) + self._lag.reach) * (square / (square + noise) if noise else 1.0)
        return u + share * x, v + share * y


def _nearer(mean: tuple[float, float], u: float, v: float, times: float) -> tuple[float, float]:
    """An exponential mean after a number of time constants, with (u, v) as the new value."""
    new = 1.0 - math.exp(-max(times, 0.0))
    return mean[0] + new * (u - mean[0]), mean[1] + new * (v - mean[1])
