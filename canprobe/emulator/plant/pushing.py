"""Contact forces on the arm near one posture: the geometry held, the force law exact.

Near the posture the depth of a touch is taken as linear in the motors and its curvature as constant: over one 2.5 ms
cycle at 25 mm/s the probe moves 0.06 mm, which bends the surface by 0.05 um. The elastic force, its damping and the
friction follow from depth and velocities as in ``contact``. One touch is worked out in plain floats, the usual case.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from math import pi, sqrt
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from canprobe.robot.chain import Chain, Vec, forward_jacobian, point_jacobian, point_on_flange, posture
from canprobe.robot.dynamics import LOWER
from canprobe.robot.straight_line import Value, compiled, matrix_product
from canprobe.touch.shapes import PlacedShape, Touches

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


# Push of several touches on the motors, near one posture; ``pushing`` with arrays in the place of floats.


class ManyTouches:
    """Several places at once.

    Args:
        theta: (6,) posture in motor coordinates, rad.
        depth: (n,) indentations there, m; negative for gaps.
        rows: (n, 3, 6) velocity of each touched point of the probe per motor rate: along the object's outward normal
            and along two tangents, m.
        coefficient, exponent: (n,) of the force laws, N and m.
        rubbing: damping and friction.
    """

    def __init__(
        self, theta: Six, depth: Array, rows: Array, *, coefficient: Array, exponent: Array, rubbing: Rubbing
    ) -> None:
        self._rows = rows
        self._normal = np.ascontiguousarray(rows[:, 0])
        self._offset = depth + self._normal @ np.array(theta)
        self._coefficient, self._exponent = coefficient, exponent
        self._damping, self._friction = 1.5 * rubbing.damping_s_m, rubbing.friction

    def push(self, theta: Six, rate: Six) -> Array | None:
        """See ``pushing.Contact``."""
        depth = self._offset - self._normal @ np.array(theta)
        if depth.max() <= 0.0:
            return None
        velocity = self._rows @ np.array(rate)
        loads = np.empty_like(velocity)
        loads[:, 0] = self._elastic(depth) * np.maximum(0.0, 1.0 - self._damping * velocity[:, 0])
        speed = np.sqrt(np.sum(velocity[:, 1:] ** 2, axis=1) + SLIP_M_S**2)
        loads[:, 1:] = (-self._friction * loads[:, 0] / speed)[:, None] * velocity[:, 1:]
        torque: Array = loads.reshape(-1) @ self._rows.reshape(-1, 6)
        return torque

    def slopes(self, theta: Six, rate: Six) -> Slopes | None:
        """See ``pushing.Contact``."""
        depth = self._offset - self._normal @ np.array(theta)
        if depth.max() <= 0.0:
            return None
        velocity, elastic = self._rows @ np.array(rate), self._elastic(depth)
        factor = np.maximum(0.0, 1.0 - self._damping * velocity[:, 0])
        stiffness = self._exponent * elastic * factor / np.maximum(depth, 1e-12)
        slip = velocity[:, 1:]
        square = np.sum(slip * slip, axis=1) + SLIP_M_S**2
        drag = self._friction * elastic * factor / np.sqrt(square)
        by_rate = np.zeros((len(depth), 3, 3))
        by_rate[:, 0, 0] = self._damping * elastic * (factor > 0.0)
        by_rate[:, 1:, 1:] = np.eye(2) - slip[:, :, None] * slip[:, None, :] / square[:, None, None]
        by_rate[:, 1:, 1:] *= drag[:, None, None]
        turned = self._rows.transpose(0, 2, 1)
        pushed = (turned[:, :, :1] * stiffness[:, None, None] @ self._rows[:, :1]).sum(axis=0)
        return Slopes(np.eye(6), pushed, (turned @ by_rate @ self._rows).sum(axis=0))

    def _elastic(self, depth: Array) -> Array:
        force: Array = self._coefficient * np.maximum(depth, 0.0) ** self._exponent
        return force


# A ball that touches in several places at once: the force of each, and their sum.
#
# A point of a smooth surface presses as in ``contact``. A piece of an edge of radius r presses as a long cylinder:
# ``(4/3) k depth^1.5 / sqrt(A)`` a metre, A = (1/R + 1/r) / 2; summed along an edge that is shorter than the ball is
# wide it gives the law of the point again.

LEAST_CURVATURE = 1e-2
"""Of the gap, in curvatures of the ball: a hollow nearer to the ball's own radius counts as this much wider."""
NEAR_M = 2e-3
"""Gaps wider than this cannot close within a cycle of the cell."""


def widened(kappa: Array, radius: float) -> Array:
    """Curvatures of a surface, hollows as tight as the ball replaced by the least that the laws can take.

    Args:
        kappa: (..., 2) 1/m.
        radius: of the ball, m.
    """
    return np.maximum(kappa, (LEAST_CURVATURE - 1.0) / radius)


def force_laws(touches: Touches, radius: float, stiffness_n_m3: float) -> tuple[Array, Array]:
    """Coefficient and exponent of ``force = coefficient depth^exponent`` of every place.

    Args:
        touches: n places.
        radius: of the ball, m.
        stiffness_n_m3: of its layer.

    Returns:
        (n,) in N and m, and (n,).
    """
    A, B = (0.5 * (1.0 / radius + widened(touches.kappa, radius))).T
    edge = touches.edge_m > 0.0
    point = 0.5 * np.pi * stiffness_n_m3 / np.sqrt(A * B)
    line = 4.0 / 3.0 * stiffness_n_m3 * touches.edge_m / np.sqrt(A)
    return np.where(edge, line, point), np.where(edge, 1.5, 2.0)


def total_force(touches: Touches, radius: float, stiffness_n_m3: float, rates: Array, damping: float) -> Array:
    """(3,) sum of the forces on the ball, N.

    Args:
        touches: n places.
        radius: of the ball, m.
        stiffness_n_m3: of its layer.
        rates: (n,) of indentation, m/s.
        damping: Hunt-Crossley alpha, s/m.
    """
    coefficient, exponent = force_laws(touches, radius, stiffness_n_m3)
    depth = np.maximum(radius - touches.distances, 0.0)
    force = coefficient * depth**exponent * np.maximum(0.0, 1.0 + 1.5 * damping * rates)
    total: Array = force @ touches.normals
    return total


# Contact of the probe near a posture: from the object's closest points to forces on the motors.


class Neighbourhood:
    """What ``ArmEquations`` asks for the contact.

    Args:
        chain: the arm.
        joints_per_motor: (6, 6) joint angles per motor coordinate.
        T_flange_probe: (4, 4) probe centre on the flange, m.
        base_offset: (3,) of the arm's base, m.
        shape: the object.
        radius: of the probe, m.
        stiffness_n_m3: of the layer.
        rubbing: damping and friction.
    """

    def __init__(
        self,
        chain: Chain,
        joints_per_motor: Array,
        T_flange_probe: Array,
        base_offset: Array,
        shape: PlacedShape,
        *,
        radius: float,
        stiffness_n_m3: float,
        rubbing: Rubbing,
    ) -> None:
        self.chain, self.shape, self.radius = chain, shape, radius
        self.stiffness_n_m3, self.rubbing = stiffness_n_m3, rubbing
        self._T_flange_probe, self._joints_per_motor = T_flange_probe, joints_per_motor
        self._tool: Vec = tuple(T_flange_probe[:3, 3].tolist())
        self._base: Vec = tuple(base_offset.tolist())
        self._back: tuple[float, ...] = tuple(joints_per_motor.ravel().tolist())
        self._joints = matrix_product(joints_per_motor.tolist())
        self._rows = _rows_for(tuple(float(g != 0.0) for g in self._back))

    def __call__(self, theta: Sequence[float]) -> Contact | None:
        """Contact held at a posture of the motors; None where the object is farther than a cycle's way.

        Args:
            theta: (6,) motor coordinates, rad.
        """
        c = posture(self.chain, self._joints(theta))
        x, y, z = self._base
        at = point_on_flange(c, self._tool)  # of the arm's own base
        centre = at[0] + x, at[1] + y, at[2] + z
        foot = self.shape.nearest(centre)
        depth = self.radius - foot.distance
        if depth < -NEAR_M:
            return None
        touches = self.shape.touches(centre, self.radius + NEAR_M)
        if touches is not None:
            return self._many(theta, touches)
        least, (k1, k2) = LEAST_CURVATURE / self.radius, foot.kappa
        A, B = 0.5 * max(least, 1.0 / self.radius + k1), 0.5 * max(least, 1.0 / self.radius + k2)
        # The probe's point that touches lies by an arm -n r off its centre.
        normal, (d1, d2), arm = foot.normal, foot.directions, max(depth, 0.0) - self.radius
        touched = at[0] + arm * normal[0], at[1] + arm * normal[1], at[2] + arm * normal[2]
        x6, y6, z6 = point_jacobian(c, touched)
        rows = self._rows(x6, y6, z6, normal, (*d1, *d2), self._back)
        return OneTouch(
            theta,
            depth,
            (rows[:6], rows[6:12], rows[12:18]),
            rows[18:],
            coefficient=pi * self.stiffness_n_m3 / (2.0 * sqrt(A * B)),
            rubbing=self.rubbing,
        )

    def _many(self, theta: Sequence[float], touches: Touches) -> Contact:
        """Several places at once."""
        back = self._joints_per_motor
        J = forward_jacobian(self.chain, back @ theta, self._T_flange_probe)[1] @ back
        depth, n = self.radius - touches.distances, touches.normals
        d1 = np.cross(n, np.where(np.abs(n[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        d1 /= np.linalg.norm(d1, axis=1)[:, None]
        d2 = np.cross(n, d1)
        arm = (np.maximum(depth, 0.0) - self.radius)[:, None, None]
        rows = np.stack((n, d1, d2), axis=1) @ J[:3]
        rows[:, 1:] += arm * np.stack((d2, -d1), axis=1) @ J[3:]
        coefficient, exponent = force_laws(touches, self.radius, self.stiffness_n_m3)
        return ManyTouches(theta, depth, rows, coefficient=coefficient, exponent=exponent, rubbing=self.rubbing)


@cache
def _rows_for(back: tuple[float, ...]) -> Callable[..., tuple[float, ...]]:
    """(18,) velocities along three directions n, s and t per motor rate, then the (21,) entries of s s' + t t'; of (6,)
    velocities along x, y and z per joint rate."""
    return compiled("touch_rows", _touch_rows, {}, x=6, y=6, z=6, normal=3, tangents=6, back=back)


def _touch_rows(
    *, x: list[Value], y: list[Value], z: list[Value], normal: list[Value], tangents: list[Value], back: list[Value]
) -> list[Value]:
    rows = []
    for a, b, c in (normal, tangents[:3], tangents[3:]):
        joints = [a * u + b * v + c * w for u, v, w in zip(x, y, z, strict=True)]
        rows += [sum((joints[i] * back[6 * i + j] for i in range(6)), 0.0) for j in range(6)]
    return [*rows, *(rows[6 + i] * rows[6 + j] + rows[12 + i] * rows[12 + j] for i, j in LOWER)]
