"""Answer of a motor to torque, which a drive that controls torque needs to know of its plant."""

from __future__ import annotations

from typing import NamedTuple


class MotorDynamics(NamedTuple):
    """Dynamics of a motor: ``v' = gain (torque - coulomb sign v) - damping v``.

    The velocity v is in counts/s, torques are in 1/1000 of the rated torque.

    Attributes:
        gain: acceleration per permille of torque, counts/s²; positive.
        coulomb: friction torque, permille; a smaller torque does not move a motor at rest.
        damping: viscous friction over inertia, 1/s; positive.
    """

    gain: float
    coulomb: float
    damping: float
