"""Motors, gears and friction of the arm, each seen at its own joint.

Motor coordinates: the angle of motor i divided by its gear ratio, so that without the wrist's coupling they are the
joint angles. Rotor inertia, friction and drive torque act there, one motor each; the rigid body lives at the joints.

Source: PUMA 560 (Corke & Armstrong-Helouvry 1994) scaled by size; torque limits of a CRS A255-like arm, peak assumed.
"""

from __future__ import annotations

import numpy as np

from canprobe.robot.puma260 import GEAR_RATIOS, Array, PumaModel, coupling_matrix

REFLECTED_INERTIA = (0.030, 0.088, 0.022, 0.0072, 0.0064, 0.0073)
"""Motor inertia at the joint, kg m^2."""
COULOMB_NM = (2.2, 1.1, 0.57, 0.10, 0.083, 0.064)
VISCOUS_NMS = (0.32, 0.52, 0.22, 0.023, 0.023, 0.012)
CONTINUOUS_TORQUE_NM = (6.4, 6.4, 6.4, 1.4, 0.7, 0.7)
PEAK_PERMILLE = 2000
"""Of the continuous torque."""
STICTION_RATE = 0.01
"""rad/s over which the Coulomb torque turns its sign."""


def motors_per_joint() -> Array:
    """(6, 6) motor coordinates per joint angle: one on the diagonal, the wrist's coupling below it."""
    turns: Array = coupling_matrix() / np.array(GEAR_RATIOS)[:, None]
    return turns


def joints_per_motor() -> Array:
    """(6, 6) joint angles per motor coordinate, the inverse of ``motors_per_joint``."""
    return np.array(np.linalg.inv(motors_per_joint()), dtype=np.float64)


def counts_per_radian(model: PumaModel) -> Array:
    """(6,) encoder counts per radian of each motor coordinate.

    Args:
        model: the arm.
    """
    return np.diag(model.counts).copy()
