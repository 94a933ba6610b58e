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
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.estimate.quadric import TO_Q
from canprobe.mechanics.touch.linear_algebra import eigen, principal
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
