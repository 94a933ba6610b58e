"""What a filter knows about the terms that a quadric leaves out, in constant time and memory.

The filter fits a quadric. Beside it, its samples' rows of the cubic and quartic terms are summed with those of its
parameters, forgotten alike and carried from frame to frame: as much as `misfit` needs of a batch. The terms are what
the samples say at terms of zero; they are never put into the filter, only into its answers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array, eigen, solved
from canprobe.touch.estimators.score import Score
from canprobe.touch.misfit import averaged, scales, sharpest
from canprobe.touch.noise import Correlation
from canprobe.touch.nonlinear import size_of
from canprobe.touch.terms import shifted

_REGULAR = 1e-9
"""What keeps the covariance of the terms' score regular, over its mean."""


class Amended(NamedTuple):
    """An answer of a filter, averaged over what its quadric leaves out.

    Attributes:
        c: (9,) parameters.
        covariance: (9, 9) of what the terms add to that of the noise; symmetric, not definite by itself.
        misfit: probability of there being one.
        trusted: the change of K is small enough for a linear step.
    """

    c: Array
    covariance: Array
    misfit: float
    trusted: bool


class Expected(NamedTuple):
    """What is known beforehand of what a filter is given.

    Attributes:
        noise: variance of the residuals over what is stated. Generous deviations make a misfit look like noise.
        curvature: least ‖K‖ · length whose usual changes are reckoned with: a flat place need not lie on a plane.
        sigma_point: stated standard deviation of a point over the length.
    """

    noise: float = 1.0
    curvature: float = 0.0
    sigma_point: float = 0.0


AS_STATED = Expected()


class _Along(NamedTuple):
    """The terms along directions in which what the samples say about them is independent.

    Attributes:
        information, score: (9,) as for `averaged`.
        off: (9, 9) what a unit along each does to the parameters.
        terms: (9, 9) the terms of such a unit.
        shared: (18, 9) covariance of the score with that of the terms.
        weighted: (9, 9) weights of what the samples say.
        curvature, blur: as for `averaged`.
    """

    information: Array
    score: Array
    off: Array
    terms: Array
    shared: Array
    weighted: Array
    curvature: float
    blur: float


class LeftOut:
    """Sums over the rows of parameters and terms.

    Args:
        prior: (9, 9) information of what is always known about the parameters.
        correlation: of the rows along the path; None for independent samples.

    Attributes:
        score: (`Score`) covariance of the score of parameters and terms.
    """

    def __init__(self, prior: Array, correlation: Correlation | None) -> None:
        wide = np.zeros((18, 18))
        wide[:9, :9] = prior
        self.score = Score(wide, correlation)
        self.reset()

    def reset(self) -> None:
        """No samples."""
        self.score.reset()
        self._information = np.zeros((18, 18))
        self._slope = np.zeros(9)

    def start(self, rows: Array, residuals: Array, travelled: float) -> None:
        """Take a batch's rows (n, 3, 18) and minus residuals (n, 3), evenly spread over a path (m)."""
        self.score.start(rows, travelled)
        flat = rows.reshape(-1, 18)
        self._information = flat.T @ flat
        self._slope = flat[:, 9:].T @ residuals.reshape(-1)

    def take(  # noqa: PLR0917 - as `Score.take`, and what the sums need
        self, rows: Array, residuals: Array, step: Array, moved: float, kept: float, known: float
    ) -> None:
        """Take new rows (3n, 18), minus their residuals (3n,) before the parameters made a step (9,)."""
        self.score.take(rows, moved, kept, known)
        self._information = kept * self._information + rows.T @ rows
        self._slope = kept * self._slope + rows[:, 9:].T @ residuals - self._information[9:, :9] @ step

    def carry(self, back: Array, x: float, y: float) -> None:
        """Go over to a frame at (x, y); back (9, 9) is d(old)/d(new) of the parameters."""
        A, Q = shifted(x, y)
        away = 2.0 * np.eye(9) - A  # its inverse: a quartic term leaves cubic ones behind, a cubic one none
        wide = np.zeros((18, 18))
        wide[:9, :9], wide[:9, 9:], wide[9:, 9:] = back, -(back @ Q) @ away, away
        self.score.carry(wide)
        self._information = wide.T @ self._information @ wide
        self._slope = away.T @ self._slope

    def amend(self, c: Array, H: Array, place: Array, expected: Expected = AS_STATED) -> Amended:
        """Average an answer over the terms.

        Args:
            c: (9,) parameters of the filter.
            H: (9, 9) inverse of their information.
            place: (3,) where the answer is wanted, in the filter's frame.
            expected: of the samples.
        """
        a = self._along(c, H, expected)
        off = a.off.copy()
        off[6:] += shifted(float(place[0]), float(place[1]))[1][6:] @ a.terms
        found = averaged(a.information, a.score, -off, a.curvature, a.blur)
        both = H @ a.shared[:9] @ (a.weighted * found.share) @ off.T
        return Amended(c + found.shift, found.spread + both + both.T, found.misfit, found.trusted)

    def explanation(self, c: Array, H: Array, expected: Expected = AS_STATED) -> Array:
        """What the terms most likely are: (18,) what they add to the filter's parameters, and the terms."""
        a = self._along(c, H, expected)
        found = averaged(a.information, a.score, -a.off, a.curvature, a.blur)
        return np.concatenate([found.shift, a.terms @ found.terms])

    def _along(self, c: Array, H: Array, expected: Expected) -> _Along:
        """The terms along directions in which the samples know them independently."""
        curvature = max(size_of(c), expected.curvature)
        D = scales(curvature)
        X = np.zeros((18, 9))  # what a unit of each term does to the parameters, and the term itself
        X[:9] = H @ self._information[:9, 9:] * -D
        X[9:].flat[::10] = D
        shared = self.score.matrix @ X
        V = X.T @ shared  # of y = m a + noise, all that the samples say about the terms
        V.flat[::10] += _REGULAR * V.trace()
        m = D[:, None] * (self._information[9:] @ X)
        weighted = solved(V, m)
        values, U = eigen(m @ weighted)
        information = np.maximum(values, 0.0) / expected.noise
        s = U.T @ (weighted.T @ (D * self._slope)) / expected.noise
        blur = sharpest(c) * expected.sigma_point * math.sqrt(expected.noise)
        return _Along(information, s, X[:9] @ U, D[:, None] * U, shared, weighted @ U, curvature, blur)
