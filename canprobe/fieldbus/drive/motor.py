"""How a motor answers to torque: what a drive that controls torque needs to know of its plant."""

from __future__ import annotations

from typing import NamedTuple


class MotorDynamics(NamedTuple):
    """``v' = gain (torque - coulomb sign v) - damping v``, v in counts/s and torques in 1/1000 of the rated torque.

    Attributes:
        gain: acceleration per permille of torque, counts/s²; positive.
        coulomb: friction torque, permille; what is below it does not move a motor at rest.
        damping: viscous friction over inertia, 1/s; positive.
    """

    gain: float
    coulomb: float
    damping: float
