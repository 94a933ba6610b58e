"""Whitened equations of single contacts in a filter's frame, and how well they agree with what it says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.noise import Noise
from canprobe.touch.nonlinear import CHI2_999
from canprobe.touch.quadric import Design, design
from canprobe.touch.quadric_row import sample_rows
from canprobe.touch.terms import basis, monomials


class Touch(NamedTuple):
    """What a contact gives the filter: place (3,) m and outward unit normal (3,) in base, and their noise.

    The noise is in m, rad and, what couples them (`Noise.coupling`), 1/m.
    """

    point: Array
    normal: Array
    sigma_point: float
    sigma_normal: float
    coupling: float = 0.0


class Equations(NamedTuple):
    """Of n contacts in a filter's frame.

    Attributes:
        rows: (n, 3, 18) whitened: of the parameters and of the terms that a quadric leaves out.
        residuals: (n, 3) their signs turned.
    """

    rows: Array
    residuals: Array


def equations(c: Array, T_base_work: Array, length: float, touches: Sequence[Touch]) -> Equations:
    """The rows of contacts at parameters (9,).

    Args:
        c: parameters in the working frame, in units of `length`.
        T_base_work: (4, 4), m.
        length: m.
        touches: the contacts.
    """
    points, normals = _in_frame(T_base_work, length, touches)
    at, square = c.tolist(), 1.0 / length**2
    found = [
        sample_rows(at, x, n, (square * t.sigma_point**2, t.sigma_normal**2), t.coupling * length)
        for x, n, t in zip(points.tolist(), normals.tolist(), touches, strict=True)
    ]
    table = np.array([[*s.weights, *s.residuals, *monomials(*s.place)] for s in found])
    return Equations(table[:, :12].reshape(-1, 3, 4) @ basis(table[:, 15:]), table[:, 12:15])


def squared_innovations(rows: Array, residuals: Array, inverse: Array) -> list[float]:
    """Squared innovation of contacts with rows (n, 3, 18) and residuals (n, 3), χ² of 3.

    Args:
        rows, residuals: as of `Equations`.
        inverse: (9, 9) of the root of the information.
    """
    predicted = rows[:, :, :9] @ inverse
    variance = 1.0 + np.square(predicted).sum(axis=2)
    found: list[float] = (np.square(residuals) / variance).sum(axis=1).tolist()
    return found


def weight_of(square: float) -> float:
    """Weight of a contact with a squared innovation: 1 up to the 99.9 % point of χ², then as in `nonlinear.robust`."""
    ratio = CHI2_999 / max(square, CHI2_999)
    return ratio * ratio


def batch_design(T_base_work: Array, length: float, touches: Sequence[Touch]) -> Design:
    """The constant parts of many contacts at once (`quadric.design`)."""
    points, normals = _in_frame(T_base_work, length, touches)
    sigma_point = np.array([t.sigma_point for t in touches]) / length
    sigma_normal = np.array([t.sigma_normal for t in touches])
    return design(points, normals, Noise(sigma_point, sigma_normal, touches[0].coupling * length))


def _in_frame(T_base_work: Array, length: float, touches: Sequence[Touch]) -> tuple[Array, Array]:
    """Places, dimensionless, and normals (n, 3) in the working frame."""
    R = T_base_work[:3, :3]
    points = (np.array([t.point for t in touches]) - T_base_work[:3, 3]) @ R / length
    return points, np.array([t.normal for t in touches]) @ R
