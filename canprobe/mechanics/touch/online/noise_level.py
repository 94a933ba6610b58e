"""The level of the noise, by the innovations: all variances of an answer are multiplied by it.

The stated noise of contacts is that of a usual scan. On one scan it is less, where the contact rests on one place of
the pad, on another more, where it runs over the pad, or where curvature varies faster than the estimator follows. The
innovations show it: over 120 random scenes the squared error of K over its stated variance is proportional to their
mean over the last memory, from half of the stated variance to three times. So all variances are multiplied by that
mean. It begins at 1, what is stated, and does not fall below a half: what all contacts of a scan have in common, no
innovation shows.

Where the curvature varies within a patch, images do not fit a quadric either, and no innovation of theirs shows it. So
the level belongs on the answer that motion and patch gave together. Why not on that of the motion before it: a misfit
that its terms correct raises the innovations too, and would be counted twice in the weight of the motion.

Source: Birge, "The calculation of errors by the method of least squares", Phys. Rev. 40, 1932, the ratio of external to
internal consistency.
"""

from __future__ import annotations

import math

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.online.estimator import AnswerPath, AnswerStage
from canprobe.mechanics.touch.online.regions import scaled

MIN_LEVEL = 0.5
"""Least level of the variances."""


class NoiseLevel(AnswerStage):
    """Multiplies variances by the mean of the innovations over the path.

    Args:
        memory_m: path over which the mean falls to 1/e, m.

    Attributes:
        level: the mean, from `MIN_LEVEL` on.
    """

    def __init__(self, memory_m: float) -> None:
        self._memory = memory_m
        self.reset()

    def reset(self) -> None:
        self._mean = self.level = 1.0
        self._path = AnswerPath()

    def refine(self, answer: SurfaceEstimate | None, sample: ContactSample) -> SurfaceEstimate | None:
        if answer is None:
            return None
        new = 1.0 - math.exp(-self._path.step(answer) / self._memory)
        self._mean += new * (answer.innovation - self._mean)
        self.level = max(self._mean, MIN_LEVEL)
        return scaled(answer, math.sqrt(self.level))
