"""What a source says about curvature: value and information, before any decision on what is observed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array, inverted, solved
from canprobe.touch.quadric import UNIT, curvature_jacobian
from canprobe.touch.rank import spread_share

TO_Q = np.array([1.0, math.sqrt(2.0), 1.0])
"""K11, K12, K22 to q."""
_TO_Q2 = np.outer(TO_Q, TO_Q)
REFUTED = 11.34
"""χ² of 3 from which a surface is no plane: its 99 % point."""


class CurvatureInformation(NamedTuple):
    """What a source says about q = (K11, √2 K12, K22) in some contact frame.

    Attributes:
        q: (3,) its own value, 1/m; counts only where there is information.
        information: (3, 3) inverse covariance, m².
    """

    q: Array
    information: Array


def evidence_of(c: Array, covariance: Array, spread: Array | None, length: float) -> CurvatureInformation:
    """The evidence of a solution with all its parameters free.

    Args:
        c: (9,) parameters in the contact frame, in units of `length`.
        covariance: (3, 3) of (K11, K12, K22) (`curvature_covariance`).
        spread: (2, 2) covariance of the points in the tangent plane over the variance of their noise: what they were
            not spread for is weighed down (`rank.spread_share`). None where that has been seen to.
        length: m.
    """
    information = inverted(_TO_Q2 * covariance)
    if spread is not None:
        share = spread_share(spread)
        information = share @ information @ share
    return CurvatureInformation(c[6:] / (UNIT * length), information * length**2)


def mean_of(a: CurvatureInformation, b: CurvatureInformation) -> Array:
    """(3,) the mean weighted with the information of both, which together must be definite."""
    return solved(a.information + b.information, a.information @ a.q + b.information @ b.q)


def curvature_covariance(c: Array, deviation: Array) -> Array:
    """Covariance (3, 3) of (K11, K12, K22) by the delta method, dimensionless.

    What c13, c23, c33 put K off by is proportional to K. Where the K found is its own noise so is that part, and it is
    largest where the noise is: a region round a plane would grow with its own error and hold K = 0 always. So it
    counts only where K = 0 is refuted, by 1 − (q/χ²)², χ² that of K = 0 with c13, c23, c33 known, q its 99 % point.

    Args:
        c: (9,) parameters in the contact frame.
        deviation: (9, k) root of their covariance: `deviation @ deviationᵀ`.

    Source: Judge and Bock, "The statistical implications of pre-test and Stein-rule estimators in econometrics", 1978.
    """
    D, others = curvature_jacobian(c) @ deviation, deviation[3:6]
    cross = D @ others.T
    by_others = cross @ solved(others @ others.T, cross.T)
    own = D @ D.T - by_others
    chi2 = 4.0 * float(c[6:] @ solved(own, c[6:]))
    refuted = 1.0 - (REFUTED / max(chi2, REFUTED)) ** 2
    return np.asarray(own + refuted * by_others, dtype=np.float64)
