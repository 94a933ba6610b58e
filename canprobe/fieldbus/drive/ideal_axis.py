"""An axis for a drive that has no plant: the motor is exactly where its reference is.

It has no load: the torque is 0, and there is never a following error. It answers the torque of a drive as an inertia
with viscous damping, without Coulomb friction.
"""

from __future__ import annotations

from math import inf

from canprobe.fieldbus.drive.motor import MotorDynamics
from canprobe.fieldbus.drive.reference import AxisPlant


class IdealAxis(AxisPlant):
    """Follows straight references without a lag. The axis number in calls has no meaning here.

    Args:
        position: place of the motor at first, counts.
    """

    def __init__(self, position: float = 0.0) -> None:
        self._start = self._end = position
        self._t0 = self._t1 = self._now = 0

    def begin(self, t_ns: int) -> None:
        """Do nothing: the axis rests until it gets a reference."""

    def advance(self, t_ns: int) -> None:
        self._now = max(self._now, t_ns)

    def motor_counts(self, axis: int) -> float:
        if self._now >= self._t1:
            return self._end
        return self._start + (self._end - self._start) * max(0, self._now - self._t0) / (self._t1 - self._t0)

    def torque_permille(self, axis: int) -> int:
        """Motor torque, which is always 0."""
        return 0

    def limit_switches(self, axis: int) -> tuple[float, float]:
        """Positions of limit switches, at infinity as there are none."""
        return -inf, inf

    def motor_dynamics(self, axis: int) -> MotorDynamics:
        """Dynamics of the motor: 100 permille give 10⁵ counts/s² from rest, and in the end 10⁵ counts/s."""
        return MotorDynamics(gain=1000.0, coulomb=0.0, damping=1.0)

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        """Do nothing: there is no loop and no torque."""

    def set_ramp(self, axis: int, start_counts: float, end_counts: float, t0_ns: int, t1_ns: int) -> None:
        self._start, self._end, self._t0, self._t1 = start_counts, end_counts, t0_ns, t1_ns
