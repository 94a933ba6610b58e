"""The stiffness of the probe's layer: from the push of a touch, and as a state of a scan.

A touch shows the layer's compliance: how the force grows while the probe is pushed into an object that stands still. On
a Winkler layer `F = π k δ² / (2 √(AB))`, so the root of the force is a straight line over the push, whatever the
curvatures: its slope b is what the servo needs, `δ = √F / b`; with the curvatures known it gives `k = 2 √(AB) b² /
π`. Stops being true where the patch is cut by the pad's edge or the object slides away.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from canprobe.mechanics.touch.checks import positive

ROOT_FORCE_SIGMA = 0.03
"""Noise of √F, √N: a force of 1 N known to 6 %, its slow errors (hysteresis, creep) included."""
MAX_SCATTER_RATIO = 3.3
"""Largest RMS distance of the samples from the line, over their noise, at which they count as a line."""
MIN_FORCE_N = 0.1
"""Least force of a sample, N: below it threshold and noise of the array bend the line."""
MIN_PUSH_SAMPLES = 6
"""Least number of samples that give a slope."""
COMMON_SIGMA = 0.035
"""Standard deviation of ln k that no number of images averages: the errors of an array's calibration are common to all
its images. Touch and images together err by −5 to +4 % over 59 scenes."""


class PushFit:
    """Straight line of √F over the push, from running means (Welford): constant time and memory.

    Push and force have errors, and on a stiff contact a micrometre of push is a large force. The line is the regression
    of the root on the measured push, which errors of the push make flatter. Why not the true slope: the servo knows the
    push from the same encoders, and this line predicts the force at what they report.

    Example: `fit.add(push, force)` for every tactile frame of a touch; `fit.slope` once `fit.certain(0.1)`.

    Args:
        push_sigma: standard deviation of a push, m, independent from sample to sample.
    """

    def __init__(self, push_sigma: float = 0.0) -> None:
        self._push_variance = push_sigma * push_sigma
        self._n = 0
        self._push = self._root = 0.0  # means
        self._spread = self._joint = self._root_spread = 0.0  # sums of products about them

    def add(self, push: float, force: float) -> None:
        """Take a push of the probe towards the object (m, from any zero) and the force (N); a small one is left out."""
        if not (force >= MIN_FORCE_N and math.isfinite(push)):
            return
        root = math.sqrt(force)
        self._n += 1
        from_mean = push - self._push
        self._push += from_mean / self._n
        root_from_mean = root - self._root
        self._root += root_from_mean / self._n
        self._spread += from_mean * (push - self._push)
        self._joint += from_mean * (root - self._root)
        self._root_spread += root_from_mean * (root - self._root)

    @property
    def slope(self) -> float:
        """Slope b, √N per m; NaN before it is determined."""
        return self._joint / self._spread if self._determined else math.nan

    @property
    def start(self) -> float:
        """Push at which the line has no force any more, m: where the touch began; NaN where there is no slope yet."""
        return self._push - self._root / self.slope if self._determined else math.nan

    @property
    def sigma(self) -> float:
        """Standard deviation of the slope, √N per m; infinite where there is no slope."""
        return self._noise / math.sqrt(self._spread) if self._determined else math.inf

    def certain(self, share: float) -> bool:
        """Whether the slope is positive, known to this share of itself (1σ), and the samples lie on the line.

        A sensor that sends nonsense has a slope too; its samples are off the line.
        """
        return self.slope > 0.0 and self.sigma < share * self.slope and self.scatter < MAX_SCATTER_RATIO * self._noise

    @property
    def scatter(self) -> float:
        """RMS distance of √F from the line, √N; infinite where there is no slope."""
        if not self._determined:
            return math.inf
        return math.sqrt(max(self._root_spread - self._joint**2 / self._spread, 0.0) / (self._n - 2))

    @property
    def _noise(self) -> float:
        """Standard deviation of a sample about the line, √N: noise of the root, and of the push times the slope."""
        return math.sqrt(ROOT_FORCE_SIGMA**2 + self.slope**2 * self._push_variance)

    @property
    def _determined(self) -> bool:
        return self._n >= MIN_PUSH_SAMPLES and self._spread > 0.0


def stiffness_from_slope(slope: float, radius: float, kappa: ArrayLike) -> float:
    """K/h of the layer (N/m³) from the slope b (√N per m) on an object of known curvature (2,) above −1/R_p, 1/m.

    The inverse of `indentation_from_force`.
    """
    k1, k2 = (float(k) for k in np.asarray(kappa, dtype=np.float64))
    return 2.0 * math.sqrt(0.25 * (1.0 / radius + k1) * (1.0 / radius + k2)) * slope * slope / math.pi


class ScanStiffness:
    """Stiffness k of the layer as a state of a scan: ln k and its standard deviation.

    It begins with what is stated. The touch settles it as far as the curvature there is known; every answer of the scan
    adds what its images say at the curvature that is known by then. Why a state, and not the k of each answer: a
    contact's depth follows from k, and with a k that moves along the path the heights of contacts would bend.

    Args:
        stated: stiffness K/h that is stated, N/m³.
        sigma: standard deviation of its logarithm.

    Attributes:
        log: logarithm of `value`.
        information: inverse variance of `log`.
    """

    def __init__(self, stated: float, sigma: float) -> None:
        self.log = math.log(positive("stated", stated))
        self.information = positive("sigma", sigma) ** -2

    @property
    def value(self) -> float:
        """Stiffness K/h, N/m³."""
        return math.exp(self.log)

    def take(self, log: float, information: float, share: float = 1.0) -> None:
        """Take ln k of an answer that used this state as its prior.

        Args:
            log: ln k of the answer.
            information: its inverse variance, that of this state included.
            share: share of the answer's contacts that no earlier answer had.
        """
        kept = self.information + share * max(information - self.information, 0.0)
        # the answer had this state as its prior, whose own pull here is 0: nothing is counted twice
        self.log += share * information / kept * (log - self.log)
        # the cap does not widen a state that was stated with more certainty
        self.information = max(min(kept, COMMON_SIGMA**-2), self.information)
