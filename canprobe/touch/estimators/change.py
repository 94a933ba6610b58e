"""Whether the surface has changed under a filter: an innovation test that wrong single samples do not set off.

A change of the surface makes every following sample disagree with the prediction, a wrong centroid makes one. So two
running innovations must both have risen: that of all samples, and that of the better half of each step. Each is
measured by what it usually is, since stated standard deviations are often generous.
"""

from __future__ import annotations

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.nonlinear import CHI2_999

ALARM = 2.2
"""Running innovations, over their long-term means, at which the surface is taken to have changed."""
USUAL = (0.3, 2.0)
"""Bounds of the long-term innovation that an alarm is measured by. It is small where the stated noise is generous;
above the upper bound no innovation, capped as it is, could ever set off an alarm."""
BETTER_HALF = 0.4
"""Innovation of the better half of a step over that of all, about, when nothing is wrong."""
RUNNING, LONG_TERM = 0.1, 0.004
"""Weights of one sample in the running and in the long-term innovations."""


class ChangeTest:
    """Running innovation of a filter, and an alarm.

    Attributes:
        alarms: how often the surface was taken to have changed.
    """

    def __init__(self) -> None:
        self.alarms = 0
        self._running = np.array([1.0, BETTER_HALF])
        self._usual = self._running.copy()

    @property
    def innovation(self) -> float:
        """Mean squared whitened innovation per degree of freedom over the last samples; about 1."""
        return float(self._running[0])

    @property
    def usual(self) -> float:
        """The same in the long term, within `USUAL`."""
        return min(max(float(self._usual[0]), USUAL[0]), USUAL[1])

    def take(self, d2: Array) -> bool:
        """Take the squared innovations (n,) of a step, χ² of 3 each; whether they say that the surface has changed."""
        n = len(d2)
        capped = np.sort(np.minimum(d2, CHI2_999)) / 3.0
        now = np.array([capped.mean(), capped[: (n + 1) // 2].mean()])
        self._running = self._running + min(1.0, RUNNING * n) * (now - self._running)
        limits = ALARM * np.clip(self._usual, *np.outer(USUAL, (1.0, BETTER_HALF)))
        if not (self._running >= limits).all():
            self._usual = self._usual + min(1.0, LONG_TERM * n) * (now - self._usual)
            return False
        self._running = self._usual.copy()
        self.alarms += 1
        return True
