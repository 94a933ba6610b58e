"""The cubic and quartic terms of a surface's height over its tangent plane, which a quadric leaves out.

Terms `Σ a_j φ_j(x, y)`, φ all monomials of third and fourth degree, each times the root of its binomial coefficient, so
that independent a of one variance mean the same in all directions.
"""

from __future__ import annotations

import math

import numpy as np

from canprobe.touch._arrays import Array

_POWER_Y = np.array([0, 1, 2, 3, 0, 1, 2, 3, 4])
DEGREE = np.array([3, 3, 3, 3, 4, 4, 4, 4, 4])
"""(9,) degree of each term."""
_POWER_X = DEGREE - _POWER_Y
_FACTOR = np.sqrt([math.comb(int(n), int(k)) for n, k in zip(DEGREE, _POWER_Y, strict=True)])
_LESS_X, _LESS_Y = np.maximum(_POWER_X - 1, 0), np.maximum(_POWER_Y - 1, 0)
_BY_X, _BY_Y = _FACTOR * _POWER_X, _FACTOR * _POWER_Y
_POWERS = np.arange(5)
_CHOOSE = np.array([[math.comb(n, k) for n in range(5)] for k in range(5)], dtype=np.float64)
_REST = np.maximum(_POWERS - _POWERS[:, None], 0)
_LOW_X, _LOW_Y = np.array([1, 0, 0, 2, 1, 0]), np.array([0, 1, 0, 0, 1, 2])
_LOW = np.array([0, 1, 2, 6, 7, 8])
"""Rows of the parameters of `quadric` to which x, y, 1, x², xy, y² belong, and what one of each adds to its own."""
_PER_LOW = np.array([0.5, 0.5, 1.0, 1.0, 0.5, 1.0])[:, None]


def terms(x: Array, y: Array) -> Array:
    """Values and derivatives by x and y (n, 3, 9) of the terms at places (n,), (n,)."""
    X, Y = x[:, None] ** _POWERS, y[:, None] ** _POWERS
    X_all, Y_all = X[:, _POWER_X], Y[:, _POWER_Y]
    found = np.empty((len(X), 3, 9))
    found[:, 0] = _FACTOR * X_all * Y_all
    found[:, 1] = _BY_X * X[:, _LESS_X] * Y_all
    found[:, 2] = _BY_Y * X_all * Y[:, _LESS_Y]
    return found


def shifted(x: float, y: float) -> tuple[Array, Array]:
    """The same terms about another place (x, y).

    Returns:
        A (9, 9) and Q (9, 9): terms a become terms `A a` there, and `Q a` more in the parameters of `quadric`.
    """
    X, Y = _CHOOSE * x**_REST, _CHOOSE * y**_REST
    columns_x, columns_y = X[:, _POWER_X] * _FACTOR, Y[:, _POWER_Y]
    A = columns_x[_POWER_X] * columns_y[_POWER_Y] / _FACTOR[:, None]
    Q = np.zeros((9, 9))
    Q[_LOW] = _PER_LOW * columns_x[_LOW_X] * columns_y[_LOW_Y]
    return A, Q
