"""Whether the surface has changed under a filter: an innovation test that wrong single samples do not set off.

A change of the surface makes every following sample disagree with the prediction, a wrong centroid makes one. So two
running innovations must both have risen: that of all samples, and that of the better half of each step. Each is
measured by what it usually is, since stated standard deviations are often generous.
"""

from __future__ import annotations

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
        self._running = self._usual = (1.0, BETTER_HALF)

    @property
    def innovation(self) -> float:
        """Mean squared whitened innovation per degree of freedom over the last samples; about 1."""
        return self._running[0]

    @property
    def usual(self) -> float:
        """The same in the long term, within `USUAL`."""
        return _bounded(self._usual[0])

    def take(self, d2: Array) -> bool:
        """Take the squared innovations (n,) of a step, χ² of 3 each; whether they say that the surface has changed."""
        n = len(d2)
        capped = sorted([min(d, CHI2_999) / 3.0 for d in d2.tolist()])
        half = (n + 1) // 2
        now = sum(capped) / n, sum(capped[:half]) / half
        self._running = _moved(self._running, now, min(1.0, RUNNING * n))
        better = BETTER_HALF * _bounded(self._usual[1] / BETTER_HALF)
        if self._running[0] < ALARM * self.usual or self._running[1] < ALARM * better:
            self._usual = _moved(self._usual, now, min(1.0, LONG_TERM * n))
            return False
        self._running = self._usual
        self.alarms += 1
        return True


def _bounded(usual: float) -> float:
    return min(max(usual, USUAL[0]), USUAL[1])


def _moved(old: tuple[float, float], now: tuple[float, float], share: float) -> tuple[float, float]:
    return old[0] + share * (now[0] - old[0]), old[1] + share * (now[1] - old[1])
