"""The local model: a quadric near the origin of a working frame, with c34 = −½, and the terms that it leaves out.

Its nine parameters, in this order: `c14, c24, c44` (tilt and height of the working frame), `c13, c23, c33`, and
`c11, c12, c22`, the half of K, last, so that the trailing 3x3 block of an upper triangular information root is the
information about K with all else unknown. Lengths are in units of some length L: a dimensionless problem.

A quadric leaves out the cubic and quartic terms `Σ a_j φ_j(x, y)` of the height over the tangent plane. φ are all
monomials of third and fourth degree, each times the root of its binomial coefficient: then independent a of one
variance have the same distribution in axes that are turned. All eighteen terms of f are polynomials of the place, so
values, gradients and changes of the origin are each one product of a constant matrix with the place's monomials.
"""

from __future__ import annotations

import math
from typing import Any

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

_POWER_Y = (0, 1, 2, 3, 0, 1, 2, 3, 4)
DEGREE = np.array([3, 3, 3, 3, 4, 4, 4, 4, 4])
"""(9,) degree of each term that a quadric leaves out."""
_HIGHER_FACTOR = [math.sqrt(math.comb(int(n), k)) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
"""Root of the binomial coefficient of each of them."""
_HIGHER = [(int(n) - k, k, 0) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
"""Powers of x, y, z in each of them."""
_QUADRIC = [((i == 0) + (j == 0), (i == 1) + (j == 1), (i == 2) + (j == 2)) for i, j in _ENTRY_INDICES]
"""Powers of x, y, z in the terms of the nine parameters, in their order."""
_QUADRIC_FACTOR = [1.0 if i == j else 2.0 for i, j in _ENTRY_INDICES]
"""Factors of these terms: an entry off the diagonal of S stands in it twice."""
_POWERS = [
    (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1),
    (2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), *_HIGHER,
]  # fmt: skip


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


def _monomials(x: Any, y: Any, z: Any) -> Floats:
    """The 19 monomials of `_POWERS` at a place, (19,), or at places given as arrays, (19, n)."""
    xx, xy, yy = x * x, x * y, y * y
    rest = [xx * x, xx * y, x * yy, yy * y, xx * xx, xx * xy, xx * yy, xy * yy, yy * yy]
    return np.array((1.0 + 0.0 * x, x, y, z, xx, xy, yy, x * z, y * z, z * z, *rest))  # 1 in the shape of x


def _derivatives() -> Floats:
    """(19, 4, 18): values and derivatives by x, y, z of the 18 terms, per monomial."""
    found = np.zeros((len(_POWERS), 4, 18))
    for column, (powers, factor) in enumerate(zip(_QUADRIC + _HIGHER, _QUADRIC_FACTOR + _HIGHER_FACTOR, strict=True)):
        found[_POWERS.index(powers), 0, column] = factor
        for axis in range(3):
            i, k, n = np.array(powers) - np.eye(3, dtype=int)[axis]
            if powers[axis]:
                found[_POWERS.index((i, k, n)), 1 + axis, column] = factor * powers[axis]
    return found


def _shift() -> Floats:
    """(19, 162): A and Q of `shifted`, per monomial of the new place."""
    found = np.zeros((len(_POWERS), 18, 9))
    own = {powers: (row, factor) for row, (powers, factor) in enumerate(zip(_HIGHER, _HIGHER_FACTOR, strict=True))}
    low = {
        powers: (9 + row, factor) for row, (powers, factor) in enumerate(zip(_QUADRIC, _QUADRIC_FACTOR, strict=True))
    }
    for column, ((i, k, _), factor) in enumerate(zip(_HIGHER, _HIGHER_FACTOR, strict=True)):
        for a in range(i + 1):
            for b in range(k + 1):
                row, per = (own if a + b > 2 else low)[a, b, 0]
                size = factor * math.comb(i, a) * math.comb(k, b) / per
                found[_POWERS.index((i - a, k - b, 0)), row, column] = size
    return found.reshape(len(_POWERS), -1)


_SHIFT_TABLE = _shift()
_DERIVATIVE_TABLES = {count: _derivatives()[:, :, :count].reshape(len(_POWERS), -1) for count in (9, 18)}


def terms(X: Floats, count: int = 18) -> Floats:
    """Values and derivatives by x, y, z (n, 4, count) of the first `count` terms of f at places (n, 3).

    The quadric's nine terms come first; `count` is 9 or 18.
    """
    values: Floats = _monomials(*X.T).T.dot(_DERIVATIVE_TABLES[count]).reshape(len(X), 4, count)
    return values


def shifted(x: float, y: float) -> tuple[Floats, Floats]:
    """The terms that a quadric leaves out about another place (x, y).

    Returns:
        A (9, 9) and Q (9, 9): terms a become terms `A a` there, and `Q a` more in the nine parameters.
    """
    both = _monomials(x, y, 0.0).dot(_SHIFT_TABLE).reshape(18, 9)
    return both[:9], both[9:]
