"""Contact forces on the arm near one posture: the geometry held, the force law exact.

Near the posture the depth of a touch is taken as linear in the motors and its curvature as constant: over one 2.5 ms
cycle at 25 mm/s the probe moves 0.06 mm, which bends the surface by 0.05 um. The elastic force, its damping and the
friction follow from depth and velocities as in ``contact``. One touch is worked out in plain floats, the usual case.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Six = list[float]

SLIP_M_S = 1e-3
"""Sliding speed over which friction grows to its full size."""


@dataclass(frozen=True, slots=True)
class Rubbing:
    """What acts besides the layer's elasticity.

    Args:
        damping_s_m: Hunt-Crossley alpha.
        friction: Coulomb coefficient; 0 for none.
    """

    damping_s_m: float = 0.3
    friction: float = 0.3


class Slopes(NamedTuple):
    """How the push changes: ``-rows.T by_theta rows`` with the motors' angles, ``-rows.T by_rate rows`` with rates.

    What friction owes to the depth is left out.
    """

    rows: Array
    by_theta: Array
    by_rate: Array


class Contact(Protocol):
    """The object's push on the motors near a posture."""

    def push(self, theta: Six, rate: Six) -> Array | None:
        """(6,) torque on the motors, N m; None where nothing touches.

        Args:
            theta: (6,) motor angles, rad.
            rate: (6,) rad/s.
        """

    def slopes(self, theta: Six, rate: Six) -> Slopes | None:
        """Partial derivatives of ``push``; None where nothing touches."""


class OneTouch:
    """One point of a smooth surface.

    Args:
        theta: (6,) posture in motor coordinates, rad.
        depth: indentation there, m; negative for a gap.
        rows: (3, 6) velocity of the touched point of the probe per motor rate: along the object's outward normal and
            along two tangents, m.
        coefficient: force is ``coefficient depth^2``, N/m^2.
        rubbing: damping and friction.
    """

    def __init__(self, theta: Array, depth: float, rows: Array, coefficient: float, rubbing: Rubbing) -> None:
        self._rows = rows
        self._n, self._s, self._t = rows.tolist()
        self._offset = depth + float(rows[0] @ theta)
        self._coefficient = coefficient
        self._damping, self._friction = 1.5 * rubbing.damping_s_m, rubbing.friction

    def push(self, theta: Six, rate: Six) -> Array | None:
        """See ``Contact``."""
        depth = self._offset - _dot(self._n, theta)
        if depth <= 0.0:
            return None
        force = self._coefficient * depth * depth * max(0.0, 1.0 - self._damping * _dot(self._n, rate))
        if self._friction == 0.0:
            plain: Array = force * self._rows[0]
            return plain
        s, t = _dot(self._s, rate), _dot(self._t, rate)
        drag = self._friction * force / sqrt(s * s + t * t + SLIP_M_S**2)
        torque: Array = np.array((force, -drag * s, -drag * t)) @ self._rows
        return torque

    def slopes(self, theta: Six, rate: Six) -> Slopes | None:
        """See ``Contact``."""
        depth = self._offset - _dot(self._n, theta)
        if depth <= 0.0:
            return None
        elastic = self._coefficient * depth * depth
        factor = max(0.0, 1.0 - self._damping * _dot(self._n, rate))
        stiffness, damping = 2.0 * elastic * factor / depth, self._damping * elastic if factor > 0.0 else 0.0
        s, t = _dot(self._s, rate), _dot(self._t, rate)
        square = s * s + t * t + SLIP_M_S**2
        drag = self._friction * elastic * factor / sqrt(square)
        across = -drag * s * t / square
        return Slopes(
            self._rows,
            np.array(((stiffness, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))),
            np.array(
                (
                    (damping, 0.0, 0.0),
                    (0.0, drag * (1.0 - s * s / square), across),
                    (0.0, across, drag * (1.0 - t * t / square)),
                )
            ),
        )


def _dot(a: Six, b: Six) -> float:
    a0, a1, a2, a3, a4, a5 = a
    b0, b1, b2, b3, b4, b5 = b
    return a0 * b0 + a1 * b1 + a2 * b2 + a3 * b3 + a4 * b4 + a5 * b5
