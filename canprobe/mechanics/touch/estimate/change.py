"""Whether the surface has changed under a filter: an innovation test that wrong single samples do not set off.

A change of the surface makes every following sample disagree with the prediction, a wrong centroid makes one. So two
innovations must both have risen: the running one of all samples, and that of the best of the last few. Each is
measured by what it usually is, since stated standard deviations are often generous.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from canprobe.mechanics.touch.estimate.noise import CHI2_999, CHI2_MEDIAN
from canprobe.mechanics.types import Floats

LAST_SAMPLES, BEST_SAMPLES = 8, 3
"""Of so many last samples so many are the best: they stay right while no more than five of eight are wrong."""
BEST_INNOVATION_SHARE = 0.37
"""Innovation of the best three of eight over that of all, when nothing is wrong."""
ALARM_RATIO, BEST_ALARM_RATIO = 2.2, 3.5
"""Innovations, over what is usual, at which the surface is taken to have changed. By chance, or with three wrong
samples among the eight, one in a thousand and one in a hundred are above the second."""
USUAL_INNOVATION = (0.3, 2.0)
"""Bounds of the usual innovation that an alarm is measured by. It is small where the stated noise is generous; above
the upper bound no innovation, capped as it is, could ever set off an alarm."""
MAX_AGREEING_RESIDUAL = 4.8
"""Squared residual over the median one up to which a sample may lie on the surface before a change: 99 % of χ² of 3."""
RUNNING_WEIGHT, LONG_TERM_WEIGHT = 0.1, 0.004
"""Weights of one sample in the running and in the long-term innovation."""


class ChangeTest:
    """Running innovation of a filter, and an alarm.

    Attributes:
        alarms: how often the surface was taken to have changed.
        innovation: mean squared whitened innovation per degree of freedom over the last samples; about 1.
    """

    def __init__(self) -> None:
        self.alarms = 0
        self.innovation = self._all = 1.0
        self._of_best = BEST_INNOVATION_SHARE
        self._last: deque[float] = deque(maxlen=LAST_SAMPLES)

    @property
    def usual(self) -> float:
        """The innovation in the long term, within `USUAL_INNOVATION`."""
        return _bounded(self._all)

    def take(self, square: float, caution: float = 1.0) -> bool:
        """Take a sample's squared innovation, χ² of 3; whether the surface now looks changed.

        `caution` multiplies both thresholds.
        """
        now = min(square, CHI2_999) / 3.0
        self._last.append(now)
        best = sum(sorted(self._last)[:BEST_SAMPLES]) / BEST_SAMPLES if len(self._last) == LAST_SAMPLES else 0.0
        self.innovation += RUNNING_WEIGHT * (now - self.innovation)
        usual_best = BEST_INNOVATION_SHARE * _bounded(self._of_best / BEST_INNOVATION_SHARE)
        if self.innovation >= caution * ALARM_RATIO * self.usual and best >= caution * BEST_ALARM_RATIO * usual_best:
            return True
        self._all += LONG_TERM_WEIGHT * (now - self._all)
        if len(self._last) == LAST_SAMPLES:
            self._of_best += LONG_TERM_WEIGHT * (best - self._of_best)
        return False

    def usual_again(self, squares: Floats) -> bool:
        """Whether such squared innovations alone would set off no alarm, once something is taken into account."""
        return float(np.minimum(squares, CHI2_999).mean()) / 3.0 < ALARM_RATIO * self.usual

    def alarm(self) -> None:
        """Count a change; the running innovation begins again at what is usual."""
        self.alarms += 1
        self.innovation = self.usual
        self._last.clear()


def _bounded(usual: float) -> float:
    return min(max(usual, USUAL_INNOVATION[0]), USUAL_INNOVATION[1])


def looks_changed(squares: Floats) -> bool:
    """The same test on a batch's squared residuals (n,), in the order of time: whether the last few disagree with the
    fit of all.
    """
    usual = _bounded(float(np.median(squares)) / CHI2_MEDIAN)
    last = np.sort(np.minimum(squares[-LAST_SAMPLES:], CHI2_999)) / 3.0
    return bool(
        last.mean() >= ALARM_RATIO * usual
        and last[:BEST_SAMPLES].mean() >= BEST_ALARM_RATIO * BEST_INNOVATION_SHARE * usual
    )
