"""Contact of the probe near a posture: from the object's closest points to forces on the motors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from math import pi, sqrt

import numpy as np

from canprobe.emulator.plant.pushing import Contact, OneTouch, Rubbing
from canprobe.emulator.plant.pushing_many import ManyTouches
from canprobe.emulator.plant.resting import LEAST_CURVATURE, NEAR_M, force_laws
from canprobe.robot.dynamics import LOWER
from canprobe.robot.kinematics import Vec, chain, forward_jacobian, point_jacobian, point_on_flange
from canprobe.robot.puma260 import Array, PumaModel
from canprobe.robot.straight_line import Value, compiled, matrix_product
from canprobe.touch.objects import ObjectShape, Touches


class Neighbourhood:
    """What ``ArmEquations`` asks for the contact.

    Args:
        model: the arm.
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
        model: PumaModel,
        joints_per_motor: Array,
        T_flange_probe: Array,
        base_offset: Array,
        shape: ObjectShape,
        *,
        radius: float,
        stiffness_n_m3: float,
        rubbing: Rubbing,
    ) -> None:
        self.model, self.shape, self.radius = model, shape, radius
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
        c = chain(self.model, self._joints(theta))
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
        J = forward_jacobian(self.model, back @ theta, self._T_flange_probe)[1] @ back
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
