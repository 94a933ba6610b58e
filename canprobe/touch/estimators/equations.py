"""Whitened equations of single contacts in a filter's frame, and how well they agree with what it says."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.noise import Noise
from canprobe.touch.nonlinear import CHI2_999
from canprobe.touch.quadric import Design, design
from canprobe.touch.quadric_row import SampleRows, sample_rows
from canprobe.touch.terms import terms


class Touch(NamedTuple):
    """What a contact gives the filter: place (3,) m and outward unit normal (3,) in base, and their noise (m, rad)."""

    point: Array
    normal: Array
    sigma_point: float
    sigma_normal: float


def equations(c: Array, T_base_work: Array, length: float, touch: Touch) -> SampleRows:
    """The rows of one contact at parameters (9,).

    Args:
        c: parameters in the working frame, in units of `length`.
        T_base_work: (4, 4), m.
        length: m.
        touch: the contact.
    """
    R, origin = T_base_work[:3, :3], T_base_work[:3, 3]
    x = ((touch.point - origin) @ R / length).tolist()
    n = (touch.normal @ R).tolist()
    return sample_rows(c.tolist(), x, n, (touch.sigma_point / length) ** 2, touch.sigma_normal**2)


def joined(contacts: Sequence[SampleRows]) -> tuple[Array, Array]:
    """Rows of parameters and terms (`terms`) of contacts (n, 3, 18), and minus the residuals (n, 3)."""
    own = np.array([c.rows for c in contacts])
    x, y = np.array([c.place for c in contacts]).T
    rows = np.empty((len(contacts), 3, 18))
    rows[:, :, :9] = own[:, :, :9]
    rows[:, :, 9:] = np.array([c.weights for c in contacts]) @ terms(x, y)
    return rows, own[:, :, 9]


def squared_innovation(contact: SampleRows, inverse: Array) -> float:
    """Squared innovation of one contact, χ² of 3, under an inverse root (9, 9) of the information."""
    rows = np.array(contact.rows)
    predicted = rows[:, :9] @ inverse
    total = 0.0
    for residual, row in zip(rows[:, 9].tolist(), predicted, strict=True):
        total += residual * residual / (1.0 + float(row @ row))
    return total


def weight_of(square: float) -> float:
    """Weight of a contact with a squared innovation: 1 up to the 99.9 % point of χ², then as in `nonlinear.robust`."""
    ratio = CHI2_999 / max(square, CHI2_999)
    return ratio * ratio


def batch_design(T_base_work: Array, length: float, touches: Sequence[Touch]) -> Design:
    """The constant parts of many contacts at once (`quadric.design`)."""
    R = T_base_work[:3, :3]
    points = (np.array([t.point for t in touches]) - T_base_work[:3, 3]) @ R / length
    normals = np.array([t.normal for t in touches]) @ R
    sigma_point = np.array([t.sigma_point for t in touches]) / length
    return design(points, normals, Noise(sigma_point, np.array([t.sigma_normal for t in touches])))
