"""Whether the surface has changed under a filter: an innovation test that single wrong samples do not trigger.

After a change of the surface every sample disagrees with the prediction; a wrong centroid is one sample. So two
innovations must both have risen: the running one of all samples, and that of the best of the last few. Why not the
running one alone: three gross outliers would raise it as much. Each is compared with its usual value, since stated
standard deviations are often too large.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from canprobe.mechanics.touch.estimate.noise import CHI2_999, CHI2_MEDIAN
from canprobe.mechanics.types import Floats

LAST_SAMPLES, BEST_SAMPLES = 8, 3
"""Number of last samples, and number of those with the least innovation, which are right while at most five of eight
are wrong."""
BEST_INNOVATION_SHARE = 0.37
"""Innovation of the best three of eight over that of all, when no sample is wrong."""
ALARM_RATIO, BEST_ALARM_RATIO = 2.2, 3.5
"""Running innovation and innovation of the best, over the usual ones, at which the surface counts as changed. By chance
one in a thousand is above the second; with three wrong samples among the eight, one in a hundred."""
CHANGING_RATIO = 3.25
"""Mean innovation of the last samples, over the usual one, from which the surface may be changing. On scenes of a
development draw 0.6 % of the answers on smooth surfaces are above it; of those on the first 1.5 mm behind an edge a
quarter, all of them wrong."""
USUAL_INNOVATION = (0.3, 2.0)
"""Bounds of the usual innovation with which an alarm compares. It is small where the stated noise is too large; above
the upper bound no innovation could trigger an alarm, as innovations are capped."""
MAX_AGREEING_RESIDUAL = 4.8
"""Largest squared residual, over the median one, of a sample that may belong to the surface before a change: 99 % of χ²
with three degrees of freedom."""
RUNNING_WEIGHT, LONG_TERM_WEIGHT = 0.1, 0.004
"""Weights of one sample in the running and in the long-term innovation."""


class ChangeTest:
    """Running innovation of a filter, and an alarm.

    Attributes:
        alarms: number of changes of the surface so far.
        innovation: mean squared whitened innovation per degree of freedom over the last samples; about 1.
    """

    def __init__(self) -> None:
        self.alarms = 0
        self.innovation = self._all = 1.0
        self._of_best = BEST_INNOVATION_SHARE
        self._last: deque[float] = deque(maxlen=LAST_SAMPLES)

    @property
    def usual(self) -> float:
        """Innovation in the long term, within `USUAL_INNOVATION`."""
        return _bounded(self._all)

    @property
    def changing(self) -> bool:
        """Whether the last samples disagree so much that the surface may be changing: an alarm needs some more."""
        return len(self._last) == LAST_SAMPLES and sum(self._last) >= CHANGING_RATIO * LAST_SAMPLES * self.usual

    def take(self, square: float, caution: float = 1.0) -> bool:
        """Take a sample's squared innovation, χ² of 3; returns whether the surface looks changed now.

        `caution` is a factor on both thresholds.
        """
        now = min(square, CHI2_999) / 3.0
        self._last.append(now)
        best = sum(sorted(self._last)[:BEST_SAMPLES]) / BEST_SAMPLES if len(self._last) == LAST_SAMPLES else 0.0
        self.innovation += RUNNING_WEIGHT * (now - self.innovation)
        usual_best = BEST_INNOVATION_SHARE * _bounded(self._of_best / BEST_INNOVATION_SHARE)
        if self.innovation >= caution * ALARM_RATIO * self.usual and best >= caution * BEST_ALARM_RATIO * usual_best:
            return True
        # behind the alarm: the usual innovation must not learn from a change
        self._all += LONG_TERM_WEIGHT * (now - self._all)
        if len(self._last) == LAST_SAMPLES:
            self._of_best += LONG_TERM_WEIGHT * (best - self._of_best)
        return False

    def usual_again(self, squares: Floats) -> bool:
        """Whether squared innovations (n,), recomputed with an explanation, are too small for an alarm."""
        return float(np.minimum(squares, CHI2_999).mean()) / 3.0 < ALARM_RATIO * self.usual

    def alarm(self) -> None:
        """Count a change; the running innovation begins again at the usual one."""
        self.alarms += 1
        self.innovation = self.usual
        self._last.clear()


def _bounded(usual: float) -> float:
    return min(max(usual, USUAL_INNOVATION[0]), USUAL_INNOVATION[1])


def looks_changed(squares: Floats) -> bool:
    """The same test on a batch: whether the last of its squared residuals (n,), in the order of time, have risen."""
    usual = _bounded(float(np.median(squares)) / CHI2_MEDIAN)
    last = np.sort(np.minimum(squares[-LAST_SAMPLES:], CHI2_999)) / 3.0
    return bool(
        last.mean() >= ALARM_RATIO * usual
        and last[:BEST_SAMPLES].mean() >= BEST_ALARM_RATIO * BEST_INNOVATION_SHARE * usual
    )
