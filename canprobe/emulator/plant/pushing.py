"""Contact forces on the arm near one posture: the geometry held, the force law exact.

Near the posture the depth of a touch is taken as linear in the motors and its curvature as constant: over one 2.5 ms
cycle at 25 mm/s the probe moves 0.06 mm, which bends the surface by 0.05 um. The elastic force, its damping and the
friction follow from depth and velocities as in ``contact``. One touch is worked out in plain floats, the usual case.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Six = Sequence[float]

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
        rows: velocity of the touched point of the probe per motor rate, (6,) each: along the object's outward normal
            and along two tangents, m.
        plane: (21,) entries ``LOWER`` of s s' + t t', m^2.
        coefficient: force is ``coefficient depth^2``, N/m^2.
        rubbing: damping and friction.

    Attributes:
        n, s, t: the rows.
        law: offset of the depth, coefficient, factor of damping, friction.
    """

    def __init__(
        self,
        theta: Six,
        depth: float,
        rows: tuple[Six, Six, Six],
        plane: Sequence[float],
        *,
        coefficient: float,
        rubbing: Rubbing,
    ) -> None:
        (self.n, self.s, self.t), self.plane = rows, plane
        self.law = depth + _dot(self.n, theta), coefficient, 1.5 * rubbing.damping_s_m, rubbing.friction

    @property
    def rows(self) -> Array:
        """(3, 6) n, s, t."""
        return np.array((self.n, self.s, self.t))

    def push(self, theta: Six, rate: Six) -> Array | None:
        """See ``Contact``."""
        offset, coefficient, damping, friction = self.law
        depth = offset - _dot(self.n, theta)
        if depth <= 0.0:
            return None
        force = coefficient * depth * depth * max(0.0, 1.0 - damping * _dot(self.n, rate))
        s, t = _dot(self.s, rate), _dot(self.t, rate)
        drag = friction * force / sqrt(s * s + t * t + SLIP_M_S**2)
        torque: Array = np.array((force, -drag * s, -drag * t)) @ self.rows
        return torque

    def slopes(self, theta: Six, rate: Six) -> Slopes | None:
        """See ``Contact``."""
        offset, coefficient, hunt_crossley, friction = self.law
        depth = offset - _dot(self.n, theta)
        if depth <= 0.0:
            return None
        elastic = coefficient * depth * depth
        factor = max(0.0, 1.0 - hunt_crossley * _dot(self.n, rate))
        stiffness, damping = 2.0 * elastic * factor / depth, hunt_crossley * elastic if factor > 0.0 else 0.0
        s, t = _dot(self.s, rate), _dot(self.t, rate)
        square = s * s + t * t + SLIP_M_S**2
        drag = friction * elastic * factor / sqrt(square)
        across = -drag * s * t / square
        return Slopes(
            self.rows,
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
