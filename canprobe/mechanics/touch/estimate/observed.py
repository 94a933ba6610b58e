"""Which combinations of curvature the data observed.

The decision is made on K alone, in q = (K11, √2 K12, K22), where a turn of the frame is orthogonal, so that it does
not depend on the choice of axes. A combination of K counts as observed when

1. the points were spread: their mean square distance from their mean, along the axes that the combination weighs, is
   at least `MIN_SPREAD · σ_p²` (noise alone would give σ_p²). Below, an answer would be drawn towards 0 with a small
   but false σ. This is decided first, on the places alone, so that no fit can talk itself into it;
2. its standard deviation, all other parameters unknown, is at most `SIGMA_LIMIT · max(‖K‖, 1/L)`, L the length of the
   path;
3. its information is at least `MIN_INFORMATION_SHARE` times the largest: rounding.

A straight path passes two of three: the normal curvature along it and the twist. Combinations that fail are held at
the value nearest to flat.

Before that decision, what one source says about curvature is its evidence: a value of q with its information.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.estimate.noise import CHI2_99
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q, TO_Q_SQUARED
from canprobe.mechanics.touch.estimate.residuals import curvature_jacobian
from canprobe.mechanics.touch.linear_algebra import eigen, inverted, principal, solved
from canprobe.mechanics.types import Floats

MIN_SPREAD = 10.0
"""Least mean square distance of points from their mean over σ_p² (rule 1)."""
SIGMA_LIMIT = 0.3
"""Largest standard deviation of a combination over `max(‖K‖, 1/L)` (rule 2)."""
MIN_INFORMATION_SHARE = 1e-12
"""Least information of a combination over the largest (rule 3)."""


class Decision(NamedTuple):
    """Information about q, combination by combination, and which combinations were observed.

    Attributes:
        information: (3,) information 1/σ² about each; 0 where the points were not spread for it.
        vectors: (3, 3) columns: the combinations, orthonormal in q.
        passed: (3,) whether each combination counts as observed.
    """

    information: Floats
    vectors: Floats
    passed: NDArray[np.bool_]

    @property
    def rank(self) -> int:
        """Number of observed combinations."""
        return int(self.passed.tolist().count(True))

    def turned(self, angle: float) -> Decision:
        """The decision in axes turned by an angle in rad."""
        return self._replace(vectors=turned(angle).dot(self.vectors))

    def with_covariance(self, covariance: Floats) -> Decision:
        """The decision with the information about the observed combinations taken from a covariance (3, 3) of q."""
        if not self.passed.any():
            return self
        seen = self.vectors[:, self.passed]
        variances, turn = eigen(seen.T.dot(covariance).dot(seen))
        vectors, information = self.vectors.copy(), self.information.copy()
        vectors[:, self.passed], information[self.passed] = seen.dot(turn), 1.0 / variances
        return self._replace(vectors=vectors, information=information)


def nothing_observed() -> Decision:
    """The decision where the model does not hold: nothing was observed."""
    return Decision(np.zeros(3), np.eye(3), np.zeros(3, dtype=bool))


def decide(root_q: Floats, spread: Floats, curvature: float) -> Decision:
    """Rank decision by the rules of this module.

    Args:
        root_q: (m, 3) root of the data's information about q, all else unknown, dimensionless.
        spread: (2, 2) covariance of the points in the tangent plane over the variance of their noise.
        curvature: norm ‖K‖, dimensionless.
    """
    axes, wide = excited(spread)
    if wide.all():
        root = root_q.dot(axes)
        values, turn = eigen(root.T.dot(root))
        return Decision(values, axes.dot(turn), values >= _least(curvature, float(values[-1])))
    seen = axes[:, wide]
    root = root_q.dot(seen)
    values, turn = eigen(root.T.dot(root)) if seen.size else (np.zeros(0), np.zeros((0, 0)))
    least = _least(curvature, float(values.max(initial=0.0)))
    unseen = int(np.count_nonzero(~wide))
    return Decision(
        np.concatenate([np.zeros(unseen), values]),
        np.concatenate([axes[:, ~wide], seen.dot(turn)], axis=1),
        np.concatenate([np.zeros(unseen, dtype=bool), values >= least]),
    )


def _least(curvature: float, largest: float) -> float:
    return max(1.0 / (SIGMA_LIMIT * max(curvature, 1.0)) ** 2, MIN_INFORMATION_SHARE * largest)


def excited(spread: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Combinations of q along the main axes of a spread, and whether the points were spread for them (rule 1).

    Args:
        spread: (2, 2) as for `decide`.

    Returns:
        Columns (3, 3) in q: curvature along the main axis, twist, curvature across; and a flag (3,) for each.
    """
    mean, radius, angle = principal(spread)
    # the twist weighs both axes alike, so that its spread is the mean of theirs
    return turned(angle).T, np.array([mean + radius, mean, mean - radius]) >= MIN_SPREAD


def turned(angle: float) -> Floats:
    """The (3, 3) orthogonal matrix that takes q = (K11, √2 K12, K22) to axes turned by an angle in rad."""
    c, s = math.cos(angle), math.sin(angle)
    cs = math.sqrt(2.0) * c * s
    return np.array([[c * c, cs, s * s], [-cs, c * c - s * s, cs], [s * s, -cs, c * c]])


def spread_of(points: Floats, variance: Floats) -> Floats:
    """Covariance (2, 2) of points (n, 2 or 3) in the tangent plane, over the variance (n,) of their noise per axis."""
    weight = 1.0 / variance
    offset = points[:, :2] - weight @ points[:, :2] / weight.sum()
    result: Floats = (offset * weight[:, None]).T @ offset / len(points)
    return result


def outside(decision: Decision, q: Floats) -> float:
    """Length of the part of q (3,) that the data did not observe, relative to q."""
    hidden = decision.vectors[:, np.logical_not(decision.passed)].T @ q
    return math.sqrt(float(hidden @ hidden) / float(q @ q))


def tensor(q: Floats) -> Floats:
    """The symmetric (2, 2) matrix of q."""
    k11, k12, k22 = q / TO_Q
    return np.array([[k11, k12], [k12, k22]])


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
