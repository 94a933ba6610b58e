"""An axis for a drive that has no plant: the motor is exactly where its reference is.

Nothing loads it: there is no torque, and a following error never arises. Only a drive that controls torque asks how
the motor would answer to it; it is told an inertia and a viscous damping, without Coulomb friction.
"""

from __future__ import annotations

from canprobe.emulator.plant.motor import MotorDynamics


class IdealAxis:
    """Follows straight references without a lag. The axis number that calls carry means nothing here."""

    def __init__(self) -> None:
        self._start = self._end = 0.0
        self._t0 = self._t1 = self._now = 0

    def advance(self, t_ns: int) -> None:
        """Time has come to `t_ns`."""
        self._now = max(self._now, t_ns)

    def motor_counts(self, axis: int) -> float:
        """Position, counts."""
        if self._now >= self._t1:
            return self._end
        return self._start + (self._end - self._start) * max(0, self._now - self._t0) / (self._t1 - self._t0)

    def torque_permille(self, axis: int) -> int:
        """Always 0."""
        return 0

    def motor_dynamics(self, axis: int) -> MotorDynamics:
        """Of a motor of its own: from rest 100 permille give 10⁵ counts/s², in the end 10⁵ counts/s."""
        return MotorDynamics(gain=1000.0, coulomb=0.0, damping=1.0)

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        """Nothing: there is no loop and no torque."""

    def set_ramp(self, axis: int, start_counts: float, end_counts: float, t0_ns: int, t1_ns: int) -> None:
        """Follow a straight reference from `t0_ns` to `t1_ns`, then hold its end."""
        self._start, self._end, self._t0, self._t1 = start_counts, end_counts, t0_ns, t1_ns
