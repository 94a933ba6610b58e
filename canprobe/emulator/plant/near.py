"""Contact of the probe near a posture: from the object's closest points to forces on the motors."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from canprobe.emulator.plant.pushing import Contact, OneTouch, Rubbing
from canprobe.robot.kinematics import forward_jacobian
from canprobe.robot.puma260 import Array, PumaModel
from canprobe.touch.objects import ObjectShape

LEAST_CURVATURE = 1e-2
"""Of the gap, in probe curvatures: a hollow nearer to the probe's own radius counts as this much wider."""
_REACH_M = 2e-3  # gaps larger than this cannot close within a cycle


def point_coefficient(kappa: tuple[float, float], radius: float, stiffness_n_m3: float) -> float:
    """Force over squared depth of one small patch, N/m^2, see ``contact.elastic_contact``.

    Args:
        kappa: principal curvatures of the body, 1/m, larger first.
        radius: of the probe, m.
        stiffness_n_m3: of the layer.
    """
    least = LEAST_CURVATURE / radius
    A, B = (0.5 * max(least, 1.0 / radius + k) for k in kappa)
    return pi * stiffness_n_m3 / (2.0 * sqrt(A * B))


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
        centre = T[:3, 3] + self.base_offset
        foot = self.shape.closest(centre)
        depth = self.radius - foot.distance
        if depth < -_REACH_M:
            return None
        n, (d1, d2) = foot.normal, foot.directions
        J = J @ self.joints_per_motor
        # Velocity of the probe's material point that touches: centre plus rotation about it, arm -r n.
        lever = -(self.radius - max(depth, 0.0))
        rows = np.array((n, d1, d2)) @ J[:3]
        turning = lever * np.array((d2, -d1)) @ J[3:]  # tangents d1, d2 of omega x lever n
        rows[1:] += turning
        k1, k2 = foot.kappa.tolist()
        coefficient = point_coefficient((k1, k2), self.radius, self.stiffness_n_m3)
        return OneTouch(theta, depth, rows, coefficient, self.rubbing)
