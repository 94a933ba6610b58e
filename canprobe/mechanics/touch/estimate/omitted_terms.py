"""What a filter knows about the terms that a quadric leaves out, in constant time and memory.

The filter fits a quadric. Beside it, its samples' rows of the cubic and quartic terms are summed with those of its
parameters, forgotten alike and carried from frame to frame: as much as `nonlinear` needs of a batch. The terms are
what the samples say at terms of zero; they are never put into the filter, only into its answers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.misfit import Averaged, averaged, scales
from canprobe.mechanics.touch.estimate.noise import Correlation
from canprobe.mechanics.touch.estimate.quadric import sharpest, size_of
from canprobe.mechanics.touch.estimate.sandwich import Score
from canprobe.mechanics.touch.estimate.terms import shifted
from canprobe.mechanics.touch.linear_algebra import eigen, solved
from canprobe.mechanics.types import Floats, Vec

_REGULARISATION_SHARE = 1e-9
"""What keeps the covariance of the terms' score regular, over its mean."""


class Amended(NamedTuple):
    """An answer of a filter, averaged over what its quadric leaves out; misfit, trusted: as of `nonlinear.Averaged`.

    The covariance (9, 9) is what the terms add to that of the noise; symmetric, not definite by itself.
    """

    c: Floats
    covariance: Floats
    misfit: float
    trusted: bool


class ExpectedMisfit(NamedTuple):
    """What is known beforehand of what a filter is given.

    Attributes:
        noise: variance of the residuals over what is stated. Generous deviations make a misfit look like noise.
        curvature: least ‖K‖ · length whose usual changes are reckoned with: a flat place need not lie on a plane.
        sigma_point: stated standard deviation of a point over the length.
    """

    noise: float = 1.0
    curvature: float = 0.0
    sigma_point: float = 0.0


class _Along(NamedTuple):
    """The average over the terms, in directions in which what the samples say about them is independent.

    Attributes:
        found: the average.
        off: (9, 9) what a unit along each direction does to the parameters.
        terms: (9, 9) the terms of such a unit.
        shared: (18, 9) covariance of the score with that of the terms.
        weighted: (9, 9) weights of what the samples say.
    """

    found: Averaged
    off: Floats
    terms: Floats
    shared: Floats
    weighted: Floats


class OmittedTerms:
    """Sums over the rows of parameters and terms; `score` is that of both.

    Args:
        prior, correlation: as of `Score`, for the nine parameters.
    """

    def __init__(self, prior: Floats, correlation: Correlation | None) -> None:
        wide = np.zeros((18, 18))
        wide[:9, :9] = prior
        self.score = Score(wide, correlation)
        self.reset()

    def reset(self) -> None:
        """No samples."""
        self.score.reset()
        self._information = np.zeros((18, 18))
        self._slope = np.zeros(9)

    def start(self, rows: Floats, residuals: Floats, travelled: float) -> None:
        """Take a batch's rows (n, 3, 18) and minus residuals (n, 3), evenly spread over a path (m)."""
        self.score.start(rows, travelled)
        flat = rows.reshape(-1, 18)
        self._information = flat.T @ flat
        self._slope = flat[:, 9:].T @ residuals.reshape(-1)

    def take(  # noqa: PLR0917 - as `Score.take`, and what the sums need
        self, rows: Floats, residuals: Floats, step: Floats, moved: float, kept: float, known: float
    ) -> None:
        """Take new rows (3n, 18), minus their residuals (3n,) before the parameters made a step (9,)."""
        self.score.take(rows, moved, kept, known)
        self._information = kept * self._information + rows.T.dot(rows)
        self._slope = kept * self._slope + rows[:, 9:].T.dot(residuals) - self._information[9:, :9].dot(step)

    def carry(self, back: Floats, x: float, y: float) -> None:
        """Go over to a frame at (x, y); back (9, 9) is d(old)/d(new) of the parameters."""
        A, Q = shifted(x, y)
        away = 2.0 * np.eye(9) - A  # its inverse: a quartic term leaves cubic ones behind, a cubic one none
        wide = np.zeros((18, 18))
        wide[:9, :9], wide[:9, 9:], wide[9:, 9:] = back, -back.dot(Q).dot(away), away
        self.score.carry(wide)
        self._information = wide.T.dot(self._information).dot(wide)
        self._slope = away.T.dot(self._slope)

    def amend(self, c: Floats, H: Floats, place: Vec, expected: ExpectedMisfit) -> Amended:
        """Average an answer at a place over the terms; c (9,) of the filter, H (9, 9) the inverse of its
        information.
        """
        a = self._along(c, H, expected, place)
        both = H.dot(a.shared[:9]).dot(a.weighted * a.found.share).dot(a.off.T)
        return Amended(c + a.found.shift, a.found.spread + both + both.T, a.found.misfit, a.found.trusted)

    def explanation(self, c: Floats, H: Floats, expected: ExpectedMisfit) -> Floats:
        """What the terms most likely are: (18,) what they add to the filter's parameters, and the terms."""
        a = self._along(c, H, expected, (0.0, 0.0, 0.0))
        return np.concatenate([a.found.shift, a.terms @ a.found.terms])

    def _along(self, c: Floats, H: Floats, expected: ExpectedMisfit, place: Vec) -> _Along:
        curvature = max(size_of(c), expected.curvature)
        D = scales(curvature)
        X = np.zeros((18, 9))  # what a unit of each term does to the parameters, and the term itself
        X[:9] = H.dot(self._information[:9, 9:]) * -D
        X[9:].flat[::10] = D
        shared = self.score.matrix.dot(X)
        V = X.T.dot(shared)  # of y = m a + noise, all that the samples say about the terms
        V.flat[::10] += _REGULARISATION_SHARE * V.trace()
        m = D[:, None] * self._information[9:].dot(X)
        weighted = solved(V, m)
        values, U = eigen(m.dot(weighted))
        information = np.maximum(values, 0.0) / expected.noise
        s = U.T.dot(weighted.T.dot(D * self._slope)) / expected.noise
        blur = sharpest(c) * expected.sigma_point * math.sqrt(expected.noise)
        off, terms = X[:9].dot(U), D[:, None] * U
        off[6:] += shifted(place[0], place[1])[1][6:].dot(terms)
        found = averaged(information, s, -off, curvature, blur)
        return _Along(found, off, terms, shared, weighted.dot(U))
