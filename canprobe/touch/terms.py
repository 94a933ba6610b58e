"""The terms of a surface's polynomial f: the nine of a quadric, and the cubic and quartic ones that it leaves out.

The latter are terms `Σ a_j φ_j(x, y)` of the height over the tangent plane, φ all monomials of third and fourth degree,
each times the root of its binomial coefficient, so that independent a of one variance mean the same in all directions.

All are polynomials of the place, so values, gradients and changes of the origin are each one product of a constant
matrix with the place's monomials.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from canprobe.touch._arrays import Array

_POWER_Y = np.array([0, 1, 2, 3, 0, 1, 2, 3, 4])
DEGREE = np.array([3, 3, 3, 3, 4, 4, 4, 4, 4])
"""(9,) degree of each term that a quadric leaves out."""
_FACTOR = [math.sqrt(math.comb(int(n), int(k))) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
_HIGHER = [(int(n - k), int(k), 0) for n, k in zip(DEGREE, _POWER_Y, strict=True)]
_QUADRIC = [(1, 0, 0), (0, 1, 0), (0, 0, 0), (1, 0, 1), (0, 1, 1), (0, 0, 2), (2, 0, 0), (1, 1, 0), (0, 2, 0)]
"""Powers of x, y, z in the terms of the parameters of `quadric`, in their order."""
_OWN = [2.0, 2.0, 1.0, 2.0, 2.0, 1.0, 1.0, 2.0, 1.0]
_POWERS = [_QUADRIC[k] for k in (2, 0, 1)] + [(0, 0, 1), (2, 0, 0), (1, 1, 0), (0, 2, 0), (1, 0, 1), (0, 1, 1)]
_POWERS += [(0, 0, 2), *_HIGHER]


def monomials(x: Any, y: Any, z: Any) -> list[Any]:
    """The 19 monomials at a place, or at places given as arrays."""
    xx, xy, yy = x * x, x * y, y * y
    rest = [xx * x, xx * y, x * yy, yy * y, xx * xx, xx * xy, xx * yy, xy * yy, yy * yy]
    return [1.0 + 0.0 * x, x, y, z, xx, xy, yy, x * z, y * z, z * z, *rest]


def _basis() -> Array:
    """(19, 72): values and derivatives by x, y, z of the 18 terms, per monomial."""
    found = np.zeros((len(_POWERS), 4, 18))
    for column, (powers, factor) in enumerate(zip(_QUADRIC + _HIGHER, _OWN + _FACTOR, strict=True)):
        found[_POWERS.index(powers), 0, column] = factor
        for axis in range(3):
            i, k, n = np.array(powers) - np.eye(3, dtype=int)[axis]
            if powers[axis]:
                found[_POWERS.index((i, k, n)), 1 + axis, column] = factor * powers[axis]
    return found.reshape(len(_POWERS), -1)


def _shift() -> Array:
    """(19, 162): A and Q of `shifted`, per monomial of the new place."""
    found = np.zeros((len(_POWERS), 18, 9))
    own = {powers: (row, factor) for row, (powers, factor) in enumerate(zip(_HIGHER, _FACTOR, strict=True))}
    low = {powers: (9 + row, factor) for row, (powers, factor) in enumerate(zip(_QUADRIC, _OWN, strict=True))}
    for column, ((i, k, _), factor) in enumerate(zip(_HIGHER, _FACTOR, strict=True)):
        for a in range(i + 1):
            for b in range(k + 1):
                row, per = (own if a + b > 2 else low)[a, b, 0]
                size = factor * math.comb(i, a) * math.comb(k, b) / per
                found[_POWERS.index((i - a, k - b, 0)), row, column] = size
    return found.reshape(len(_POWERS), -1)


_BASIS, _SHIFT = _basis(), _shift()


def basis(places: Array) -> Array:
    """Values and derivatives by x, y, z (n, 4, 18) of all terms, a quadric's first, from the `monomials` (n, 19)."""
    return (places @ _BASIS).reshape(len(places), 4, 18)


def terms(x: Array, y: Array) -> Array:
    """Values and derivatives by x and y (n, 3, 9) of the terms that a quadric leaves out, at places (n,), (n,)."""
    return basis(np.array(monomials(x, y, np.zeros(len(x)))).T)[:, :3, 9:]


def shifted(x: float, y: float) -> tuple[Array, Array]:
    """The terms that a quadric leaves out about another place (x, y).

    Returns:
        A (9, 9) and Q (9, 9): terms a become terms `A a` there, and `Q a` more in the parameters of `quadric`.
    """
    both = (np.array(monomials(x, y, 0.0)) @ _SHIFT).reshape(18, 9)
    return both[:9], both[9:]
