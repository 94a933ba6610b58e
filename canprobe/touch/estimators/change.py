"""Whether the surface has changed under a filter: an innovation test that wrong single samples do not set off.

A change of the surface makes every following sample disagree with the prediction; a wrong centroid makes one. So the
test leaves out the worst quarter of each step's samples. It is relative to what the innovations usually are, since
stated standard deviations are often generous.
"""

from __future__ import annotations

import math

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.nonlinear import CHI2_999

ALARM = 2.2
"""Running innovation, over its long-term mean, at which the surface is taken to have changed."""
LEAST_USUAL = 0.3
"""Least long-term innovation that an alarm is measured by; it is below 1 where the stated noise is generous."""
RUNNING, LONG_TERM = 0.1, 0.004
"""Weights of one sample in the running and in the long-term innovation."""
_TRIMMED = 0.25


class ChangeTest:
    """Running innovation of a filter, and an alarm.

    Attributes:
        innovation: mean squared whitened innovation per degree of freedom, over the last samples; about 1.
        alarms: how often the surface was taken to have changed.
    """

    def __init__(self) -> None:
        self.innovation = self._running = self._usual = 1.0
        self.alarms = 0

    @property
    def usual(self) -> float:
        """Long-term innovation of the better three quarters, never taken below `LEAST_USUAL`."""
        return max(LEAST_USUAL, self._usual)

    def take(self, d2: Array) -> bool:
        """Take the squared innovations (n,) of a step, χ² of 3 each; whether they say that the surface has changed."""
        capped = np.minimum(d2, CHI2_999)
        n = len(d2)
        common = float(np.sort(capped)[: math.ceil((1.0 - _TRIMMED) * n)].mean()) / 3.0
        short = min(1.0, RUNNING * n)
        self.innovation += short * (float(capped.mean()) / 3.0 - self.innovation)
        self._running += short * (common - self._running)
        if self._running < ALARM * self.usual:
            self._usual += min(1.0, LONG_TERM * n) * (common - self._usual)
            return False
        self._running = self._usual
        self.alarms += 1
        return True
