"""All ten unknowns of the surface matrix of an answer with their covariance, in a frame of one's choice.

The unknowns are the upper triangle of S, row by row: c11, c12, c13, c14, c22, c23, c24, c33, c34, c44 (`UPPER`). A new
frame, `S' = Tᵀ S T` (8), is linear in them, so the covariance is carried over exactly.

S and any multiple of it are one surface. The gauge is that of the contact frame of the answer, c34 = −½ there: in that
frame c34 has no error, in every other the covariance (10, 10) has rank 9. In the contact frame c14 and c24 are half the
error of the normal and c44 is that of the height, so these are 0 with a variance.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from canprobe.mechanics.touch.checks import checked
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q, TO_Q_SQUARED, parameters_of
from canprobe.mechanics.touch.estimate.residuals import curvature_jacobian
from canprobe.mechanics.touch.linear_algebra import inverted_upper, upper_root
from canprobe.mechanics.types import Floats

MAX_HIDDEN_ENTRY = 0.02
"""Largest unobserved part of curvature in an entry that is still given as a number."""
UPPER = np.triu_indices(4)
"""Rows and columns in S of the ten unknowns, in their order."""
_OF_MODEL = np.array([3, 6, 9, 2, 5, 7, 0, 1, 4])
"""The nine parameters of `quadric`, in their order, among the ten."""
_OF_K = _OF_MODEL[6:]
_UNIT = np.zeros((10, 4, 4))
_UNIT[np.arange(10), UPPER[0], UPPER[1]] = _UNIT[np.arange(10), UPPER[1], UPPER[0]] = 1.0


class UncertainMatrix(NamedTuple):
    """A surface matrix with the covariance of its ten unknowns, in some frame.

    Attributes:
        S: (4, 4) symmetric; XᵀSX = 0 with X = [x, y, z, 1] in m, negative inside: S[:3, :3] in 1/m, S[:3, 3] without
            unit, S[3, 3] in m. NaN where an entry was not observed.
        covariance: (10, 10) covariance of `S[UPPER]`, in the products of their units. The variance of what was not
            observed is infinite, its covariances are NaN.
    """

    S: Floats
    covariance: Floats

    def transformed(self, T: ArrayLike) -> UncertainMatrix:
        """The same surface in new coordinates, `S' = Tᵀ S T`, exact; NaN spreads to each entry that it enters.

        Args:
            T: (4, 4) transform that takes new coordinates to the present ones, m.
        """
        return _mapped(linear_map(checked("T", T, (4, 4))), self.S[UPPER], self.covariance)


def matrix_behind(L: Floats, S: Floats, K: tuple[Floats, Floats, Floats], model_root: Floats | None) -> UncertainMatrix:
    """The matrix of an answer behind a map of its ten unknowns (`linear_map`), from fields of the answer.

    Args:
        L: (10, 10) map to the frame.
        S: (4, 4) in the contact frame.
        K: covariance, combinations and information of K.
        model_root: (n, 9) root of the information about the nine parameters; None where it is not known.
    """
    covariance, combinations, information = K
    stated = bool(np.isfinite(covariance).all())
    V = np.eye(3) if stated else combinations
    # an entry in the frame may hold observed combinations alone, where each entry in the contact frame holds others too
    of_q = L[:, _OF_K] * C_PER_Q
    hidden = np.linalg.norm(of_q - of_q.dot(V.T).dot(V), axis=1) > MAX_HIDDEN_ENTRY * np.linalg.norm(of_q, axis=1)
    C = np.full((10, 10), np.nan)
    C[8] = C[:, 8] = 0.0  # c34, the gauge
    if model_root is None:
        C[np.ix_(_OF_K, _OF_K)] = 0.25 * covariance
    else:
        # the model says how the others depend on K; K has the covariance that the answer states, which is not quite the
        # model's (`curvature_covariance`)
        known = TO_Q_SQUARED * covariance if stated else np.linalg.inv(V.dot(information).dot(V.T))
        of_known = V.dot(TO_Q[:, None] * curvature_jacobian(parameters_of(S)))
        deviation = inverted_upper(upper_root(model_root))
        cross = deviation.dot(of_known.dot(deviation).T)
        gain = cross.dot(np.linalg.inv(of_known.dot(cross)))
        change = gain.dot(known - of_known.dot(cross)).dot(gain.T)
        C[np.ix_(_OF_MODEL, _OF_MODEL)] = deviation.dot(deviation.T) + change
    return _mapped(L, S[UPPER], C, hidden)


def linear_map(T: Floats) -> Floats:
    """(10, 10) map of the ten unknowns to those of Tᵀ S T."""
    L: Floats = (T.T @ _UNIT @ T)[:, UPPER[0], UPPER[1]].T
    # rounding would carry NaN to entries that are not touched: of a quarter turn 20 instead of 10 entries are not 0
    return np.where(np.abs(L) > 1e-12 * np.abs(L).max(axis=1, keepdims=True), L, 0.0)


def _mapped(L: Floats, s: Floats, covariance: Floats, hidden: Any = False) -> UncertainMatrix:
    """Unknowns (10,) and their covariance behind L; NaN where `hidden` there, and where L takes NaN."""
    S = np.empty((4, 4))
    # 0 · NaN is NaN
    S[UPPER] = S.T[UPPER] = np.where(hidden, np.nan, np.where(L == 0.0, 0.0, L * s).sum(axis=1))
    lost = hidden | ((L != 0.0) & ~np.isfinite(covariance.diagonal())).any(axis=1)
    C = L.dot(np.where(np.isfinite(covariance), covariance, 0.0)).dot(L.T)
    C[lost] = C[:, lost] = np.nan
    C[lost, lost] = np.inf
    return UncertainMatrix(S, 0.5 * (C + C.T))  # L C Lᵀ is symmetric up to rounding only
