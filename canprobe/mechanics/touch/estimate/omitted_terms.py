"""What a filter knows about the terms that a quadric leaves out, in constant time and memory.

The filter fits a quadric. Beside it, the rows of the cubic and quartic terms are summed with those of the parameters,
forgotten alike and carried from frame to frame: the same sums that `misfit` takes of a batch. The terms are estimated
from residuals at terms of zero. They correct the answers of the filter and never its state: a correction that turns out
wrong would otherwise stay in the memory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.misfit import Averaged, averaged, scales
from canprobe.mechanics.touch.estimate.noise import Correlation, SlowErrors
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, sharpest, shifted, size_of
from canprobe.mechanics.touch.estimate.sandwich import Score
from canprobe.mechanics.touch.linear_algebra import eigen, solved
from canprobe.mechanics.types import Floats, Vec

_REGULARISATION_SHARE = 1e-9
"""Share of the trace of the covariance of the terms' score that is added to its diagonal, to keep it regular."""


class Amended(NamedTuple):
    """An answer of a filter, averaged over what its quadric leaves out.

    Attributes:
        average: the average over the terms.
        covariance: (9, 9) covariance that the terms add to that of the noise; symmetric, not definite by itself.
        terms: (9,) most likely terms.
    """

    average: Averaged
    covariance: Floats
    terms: Floats


class ExpectedMisfit(NamedTuple):
    """What is assumed where a filter looks for a misfit.

    Attributes:
        curvature: least ‖K‖ · length whose usual changes are allowed for: a flat place need not lie on a plane.
        sigma_point: stated standard deviation of a point over the length.
    """

    curvature: float = 0.0
    sigma_point: float = 0.0


class OmittedTerms:
    """Sums over the rows of parameters and terms; `score` is the `Score` of all eighteen.

    Args:
        prior: (9, 9) information of the prior about the nine parameters.
        correlation: correlation of the rows along the path; None for independent samples.
    """

    def __init__(self, prior: Floats, correlation: Correlation | None) -> None:
        wide = np.zeros((18, 18))
        wide[:9, :9] = prior
        self.score = Score(wide, correlation)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self.score.reset()
        self._information = np.zeros((18, 18))
        self._slope = np.zeros(9)

    def start(self, rows: Floats, residuals: Floats, travelled: float, slow: SlowErrors | None = None) -> None:
        """Take a batch's rows (n, 3, 18) and minus residuals (n, 3), evenly spread over a path (m)."""
        self.score.start(rows, travelled, slow)
        flat = rows.reshape(-1, 18)
        self._information = flat.T @ flat
        self._slope = flat[:, 9:].T @ residuals.reshape(-1)

    def take(  # noqa: PLR0917 - as `Score.take`, and what the sums need
        self,
        rows: Floats,
        residuals: Floats,
        step: Floats,
        moved: float,
        kept: float,
        known: float,
        slow: SlowErrors | None = None,
    ) -> None:
        """Take new rows (3n, 18), and minus their residuals (3n,) before the parameters made a step (9,)."""
        self.score.take(rows, moved, kept, known, slow)
        self._information = kept * self._information + rows.T.dot(rows)
        self._slope = kept * self._slope + rows[:, 9:].T.dot(residuals) - self._information[9:, :9].dot(step)

    def carry(self, back: Floats, x: float, y: float) -> None:
        """Change to a frame at (x, y); back (9, 9) is d(old)/d(new) of the parameters."""
        A, Q = shifted(x, y)
        away = 2.0 * np.eye(9) - A  # its inverse: a quartic term leaves cubic ones behind, a cubic one none
        wide = np.zeros((18, 18))
        wide[:9, :9], wide[:9, 9:], wide[9:, 9:] = back, -back.dot(Q).dot(away), away
        self.score.carry(wide)
        self._information = wide.T.dot(self._information).dot(wide)
        self._slope = away.T.dot(self._slope)

    def amend(self, c: Floats, H: Floats, place: Vec, expected: ExpectedMisfit, observed: Floats) -> Amended:
        """Average an answer at a place over the terms.

        Args:
            c: (9,) parameters of the filter.
            H: (9, 9) inverse of their information.
            place: the place in the working frame, dimensionless.
            expected: what is assumed.
            observed: (3, k) columns: the observed combinations of q in the working frame.
        """
        # a curvature that was not observed is noise: it must not set the usual size of the terms
        if observed.shape[1] < 3:
            c = c.copy()
            c[6:] = C_PER_Q * observed.dot(observed.T.dot(c[6:] / C_PER_Q))
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
        values, U = eigen(m.dot(weighted))  # directions in which the samples' information about the terms is diagonal
        information = np.maximum(values, 0.0)
        s = U.T.dot(weighted.T.dot(D * self._slope))
        blur = sharpest(c) * expected.sigma_point
        off, terms = X[:9].dot(U), D[:, None] * U  # what a unit along each does to the parameters, and its terms
        off[6:] += shifted(place[0], place[1])[1][6:].dot(terms)
        found = averaged(information, s, -off, curvature, blur, observed)
        both = H.dot(shared[:9]).dot(weighted.dot(U) * found.share).dot(off.T)
        return Amended(found, found.spread + both + both.T, terms @ found.terms)
