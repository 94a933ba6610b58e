"""The eighteen terms of f: nine of the quadric, and the cubic and quartic ones that it leaves out.

The latter are terms `Σ a_j φ_j(x, y)` of the height over the tangent plane. φ are all monomials of third and fourth
degree, each times the root of its binomial coefficient: then independent a of one variance have the same distribution
in axes that are turned. All terms are polynomials of the place, so values, gradients and changes of the origin are each
one product of a constant matrix with the place's monomials.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from canprobe.mechanics.types import Floats

_POWER_Y = (0, 1, 2, 3, 0, 1, 2, 3, 4)
DEGREE = np.array([3, 3, 3, 3, 4, 4, 4, 4, 4])
"""(9,) degree of each term that a quadric leaves out."""
_HIGHER_FACTOR = [math.sqrt(math.comb(int(n), k)) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
"""Root of the binomial coefficient of each of them."""
_HIGHER = [(int(n) - k, k, 0) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
"""Powers of x, y, z in each of them."""
_QUADRIC = [(1, 0, 0), (0, 1, 0), (0, 0, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (2, 0, 0), (1, 1, 0), (0, 2, 0)]
"""Powers of x, y, z in the terms of the nine parameters, in their order."""
_QUADRIC_FACTOR = [2.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 1.0]
"""Factors of these terms: an entry off the diagonal of S stands in it twice."""
_POWERS = [
    (0, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (2, 0, 0),
    (1, 1, 0),
    (0, 2, 0),
    (1, 0, 1),
    (0, 1, 1),
    (0, 0, 2),
    *_HIGHER,
]


def _monomials(x: Any, y: Any, z: Any) -> Floats:
    """The 19 monomials of `_POWERS` at a place, (19,), or at places given as arrays, (19, n)."""
    xx, xy, yy = x * x, x * y, y * y
    rest = [xx * x, xx * y, x * yy, yy * y, xx * xx, xx * xy, xx * yy, xy * yy, yy * yy]
    return np.array((1.0 + 0.0 * x, x, y, z, xx, xy, yy, x * z, y * z, z * z, *rest))


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
