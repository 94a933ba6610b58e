"""The local model: a quadric near the origin of a working frame, with c34 = −½.

Its nine parameters, in this order: `c14, c24, c44` (tilt and height of the working frame), `c13, c23, c33`, and
`c11, c12, c22`, the half of K, last, so that the trailing 3x3 block of an upper triangular information root is the
information about K with all else unknown. Lengths are in units of some length L: a dimensionless problem.
"""

from __future__ import annotations

import math

import numpy as np

from canprobe.mechanics.types import Floats

TO_Q = np.array([1.0, math.sqrt(2.0), 1.0])
"""Factors from K11, K12, K22 to q = (K11, √2 K12, K22), in which a rotation of the frame is orthogonal."""
TO_Q_SQUARED = np.outer(TO_Q, TO_Q)
"""A covariance of (K11, K12, K22) to that of q, entry by entry."""
C_PER_Q = 0.5 / TO_Q
"""c11, c12, c22 per unit of q."""

_ENTRY_INDICES = ((0, 3), (1, 3), (3, 3), (0, 2), (1, 2), (2, 2), (0, 0), (0, 1), (1, 1))
_BASIS = np.zeros((9, 4, 4))
"""S = Σ c_k _BASIS_k + _CONSTANT."""
for _k, (_i, _j) in enumerate(_ENTRY_INDICES):
    _BASIS[_k, _i, _j] = _BASIS[_k, _j, _i] = 1.0
_FLAT_BASIS = _BASIS.reshape(9, 16)
_FLAT_INDICES = np.array([4 * i + j for i, j in _ENTRY_INDICES])
_CONSTANT = np.zeros((4, 4))
_CONSTANT[2, 3] = _CONSTANT[3, 2] = -0.5
STACKED_BASIS = np.concatenate([_BASIS, _CONSTANT[None]]).transpose(1, 0, 2).reshape(4, 40)
"""S as the sum of ten matrices, side by side."""
STACKED_ENTRIES = np.array([[40 * i + 4 * k + j for k in range(10)] for i, j in (*_ENTRY_INDICES, (2, 3))])
"""Flat indices of the nine parameters, and of c34, in each of those ten matrices."""


def matrix_of(c: Floats) -> Floats:
    """S (4, 4) of parameters (9,)."""
    S: Floats = c.dot(_FLAT_BASIS).reshape(4, 4)
    S += _CONSTANT
    return S


def parameters_of(S: Floats) -> Floats:
    """Parameters (9,) of S (4, 4), scaled to c34 = −½."""
    result: Floats = S.take(_FLAT_INDICES)
    result *= -0.5 / S[2, 3]
    return result


def size_of(c: Floats) -> float:
    """‖K‖ of parameters (9,), Frobenius."""
    c11, c12, c22 = c[6:].tolist()
    return 2.0 * math.sqrt(c11 * c11 + 2.0 * c12 * c12 + c22 * c22)


def sharpest(c: Floats) -> float:
    """Largest |κ| of parameters (9,)."""
    c11, c12, c22 = c[6:].tolist()
    return float(abs(c11 + c22) + math.hypot(c11 - c22, 2.0 * c12))
