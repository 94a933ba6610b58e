"""Contact of the probe near a posture: from the object's closest points to forces on the motors."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from canprobe.emulator.plant.pushing import Contact, OneTouch, Rubbing
from canprobe.emulator.plant.pushing_many import ManyTouches
from canprobe.emulator.plant.resting import LEAST_CURVATURE, NEAR_M, force_laws
from canprobe.robot.kinematics import forward_jacobian
from canprobe.robot.puma260 import Array, PumaModel
from canprobe.touch.objects import ObjectShape, Touches


@dataclass(frozen=True, slots=True, eq=False)
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

    model: PumaModel
    joints_per_motor: Array
    T_flange_probe: Array
    base_offset: Array
    shape: ObjectShape
    radius: float
    stiffness_n_m3: float
    rubbing: Rubbing

    def __call__(self, theta: Array) -> Contact | None:
        """Contact held at a posture of the motors; None where the object is farther than a cycle's way.

        Args:
            theta: (6,) motor coordinates, rad.
        """
        T, J = forward_jacobian(self.model, self.joints_per_motor @ theta, self.T_flange_probe)
        centre, J = T[:3, 3] + self.base_offset, J @ self.joints_per_motor
        foot = self.shape.closest(centre)
        depth = self.radius - foot.distance
        if depth < -NEAR_M:
            return None
        touches = self.shape.touches(centre, self.radius + NEAR_M)
        if touches is not None:
            return self._many(theta, J, touches)
        d1, d2 = foot.directions
        least, (k1, k2) = LEAST_CURVATURE / self.radius, foot.kappa.tolist()
        A, B = 0.5 * max(least, 1.0 / self.radius + k1), 0.5 * max(least, 1.0 / self.radius + k2)
        # Velocity of the probe's point that touches: the centre's, and its rotation about the centre by an arm -n r.
        rows = np.array((foot.normal, d1, d2)) @ J[:3]
        rows[1:] += (max(depth, 0.0) - self.radius) * np.array((d2, -d1)) @ J[3:]
        return OneTouch(theta, depth, rows, pi * self.stiffness_n_m3 / (2.0 * sqrt(A * B)), self.rubbing)

    def _many(self, theta: Array, J: Array, touches: Touches) -> Contact:
        """Several places at once."""
        depth, n = self.radius - touches.distances, touches.normals
        d1 = np.cross(n, np.where(np.abs(n[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        d1 /= np.linalg.norm(d1, axis=1)[:, None]
        d2 = np.cross(n, d1)
        arm = (np.maximum(depth, 0.0) - self.radius)[:, None, None]
        rows = np.stack((n, d1, d2), axis=1) @ J[:3]
        rows[:, 1:] += arm * np.stack((d2, -d1), axis=1) @ J[3:]
        coefficient, exponent = force_laws(touches, self.radius, self.stiffness_n_m3)
        return ManyTouches(theta, depth, rows, coefficient=coefficient, exponent=exponent, rubbing=self.rubbing)
