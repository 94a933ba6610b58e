"""The lag of the centroid behind the contact on an array with hysteresis, and its correction.

A taxel under the patch's front reads too little and one under its end too much, and creep lags behind as well. So the
centroid lies back along its way, by some tens of micrometres: much more than its noise, and nearly constant for
millimetres of path over the object, which tilts the measured normals.

Model: with x the way from the mean place of the last `slow_s` to that of the last `quick_s`, the centroid lies `most
· x / (|x| + reach)` back. It was fitted to scans at one speed; the bound `most` keeps it harmless at others. It does
not depend on the patch: of a roll of 0.1 mm to and fro the centroid shows 68 to 88 % by object, corrected 88 to 109 %.
"""

from __future__ import annotations

import math

from canprobe.mechanics.touch.patch.array_calibration import Lag

GAP_S = 0.1
"""Time without contact, s, after which the lag starts afresh."""


class PadLag:
    """Follows a contact over the pad and corrects its centroid.

    Args:
        lag: lag of the array.
    """

    def __init__(self, lag: Lag) -> None:
        self._lag = lag
        self._t_s = -math.inf
        self._quick = self._slow = (0.0, 0.0)

    def step(self, t_s: float, u: float, v: float) -> tuple[float, float]:
        """Take a centroid (m) at a time (s); returns the place of the contact, m."""
        dt, self._t_s = t_s - self._t_s, t_s
        if dt > GAP_S:
            self._quick = self._slow = (u, v)
        self._quick = _nearer(self._quick, u, v, dt / self._lag.quick_s)
        self._slow = _nearer(self._slow, u, v, dt / self._lag.slow_s)
        x, y = self._quick[0] - self._slow[0], self._quick[1] - self._slow[1]
        share = self._lag.most / (math.hypot(x, y) + self._lag.reach)
        return u + share * x, v + share * y


def _nearer(mean: tuple[float, float], u: float, v: float, times: float) -> tuple[float, float]:
    """An exponential mean after a number of time constants, with (u, v) as the new value."""
    new = 1.0 - math.exp(-max(times, 0.0))
    return mean[0] + new * (u - mean[0]), mean[1] + new * (v - mean[1])
