"""The evidence of one source about curvature: value and information, before any decision on what is observed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.noise import CHI2_99
from canprobe.mechanics.touch.estimate.observed import excited
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q_SQUARED
from canprobe.mechanics.touch.estimate.residuals import curvature_jacobian
from canprobe.mechanics.touch.linear_algebra import inverted, solved
from canprobe.mechanics.types import Floats


class CurvatureInformation(NamedTuple):
    """What a source says about q = (K11, √2 K12, K22) in some contact frame.

    Attributes:
        q: (3,) value, 1/m; it counts only where there is information.
        information: (3, 3) inverse covariance, m².
    """

    q: Floats
    information: Floats


def evidence_of(c: Floats, covariance: Floats, spread: Floats | None, length: float) -> CurvatureInformation:
    """The evidence of a solution with all its parameters free.

    Args:
        c: (9,) parameters in the contact frame, in units of `length` (m).
        covariance: (3, 3) covariance of (K11, K12, K22) (`curvature_covariance`).
        spread: (2, 2) covariance of the points in the tangent plane over the variance of their noise. Combinations
            that the points were not spread for are marginalised: noise alone would answer for them, with −1/R_p where
            it is that of centroids on a probe. None where a prior answers for them.
    """
    covariance = TO_Q_SQUARED * covariance / length**2
    q = c[6:] / (C_PER_Q * length)
    axes, wide = (np.eye(3), np.ones(3, dtype=bool)) if spread is None else excited(spread)
    if wide.all():
        return CurvatureInformation(q, inverted(covariance))
    seen = axes[:, wide]
    known = inverted(seen.T.dot(covariance).dot(seen)) if wide.any() else np.zeros((0, 0))
    return CurvatureInformation(q, seen.dot(known).dot(seen.T))


def curvature_covariance(c: Floats, deviation: Floats) -> Floats:
    """Covariance (3, 3) of (K11, K12, K22) by the delta method, dimensionless.

    The error of K by c13, c23, c33 is proportional to K. On a plane the K that is found is noise, and so is that part:
    a region would grow with its own error and contain K = 0 always. So the part counts only as far as K = 0 is refuted,
    by the factor 1 − (q/χ²)²: χ² is the statistic of K = 0 with c13, c23, c33 known, q its 99 % point.

    Args:
        c: (9,) parameters in the contact frame.
        deviation: (9, k) root of their covariance, which is `deviation @ deviationᵀ`.

    Source: Judge and Bock, "The statistical implications of pre-test and Stein-rule estimators in econometrics", 1978.
    """
    D, others = curvature_jacobian(c).dot(deviation), deviation[3:6]
    cross = D.dot(others.T)
    by_others = cross.dot(solved(others.dot(others.T), cross.T))
    own = D.dot(D.T) - by_others
    chi2 = 4.0 * float(c[6:].dot(solved(own, c[6:])))
    refuted = 1.0 - (CHI2_99 / max(chi2, CHI2_99)) ** 2
    return np.asarray(own + refuted * by_others, dtype=np.float64)
