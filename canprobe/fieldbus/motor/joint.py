"""A joint that a motor in MIT mode turns: inertia and friction under the motor's law, stable at any step."""

from __future__ import annotations

from canprobe.fieldbus.motor.protocol import MitCommand, Ranges


class MotorJoint:
    """Inertia with viscous and Coulomb friction, at the motor's output. It has no load, gravity, play or elasticity.

    Args:
        ranges: what the motor is made for: TMAX accelerates the joint by 1000 rad/s², and turns it at twice VMAX in the
            end; 1/200 of it is needed to move it at all.
        q: position at first, rad.

    Attributes:
        inertia, viscous, coulomb: kg·m², N·m·s/rad, N·m.
        q, qd: position, rad, and velocity, rad/s.
        tau: last torque of the motor, N·m.
    """

    def __init__(self, ranges: Ranges, q: float = 0.0) -> None:
        self.inertia, self.viscous, self.coulomb = ranges.t / 1000, ranges.t / (2 * ranges.v), ranges.t / 200
        self.q, self.qd, self.tau = q, 0.0, 0.0

    def step(self, h: float, command: MitCommand, limit: float) -> None:
        """Go `h` seconds on under a command whose torque the motor limits to `limit`, N·m.

        Implicit Euler, with the limit and the friction of the new velocity in closed form: torque and friction fall
        with it, so the solution without a limit, clamped between those at both limits, is the one with it. No step,
        stiffness or damping makes it diverge, or swing where the limit acts; its error is of first order.
        """
        p, v, kp, kd, t = command
        gain, drag = h / self.inertia, 1 + h / self.inertia * self.viscous
        free, stiff = self.qd + gain * (kp * (p - self.q) + kd * v + t), drag + gain * (kp * h + kd)
        low, high = self.qd - gain * limit, self.qd + gain * limit

        def solved(friction: float) -> float:
            return min(max((free - friction) / stiff, (low - friction) / drag), (high - friction) / drag)

        # Friction of either sign that leaves the joint moving its way is the right one; else the joint sticks.
        self.qd = max(solved(gain * self.coulomb), 0.0) or min(solved(-gain * self.coulomb), 0.0)
        self.q += h * self.qd
        self.tau = min(max(kp * (p - self.q) + kd * (v - self.qd) + t, -limit), limit)
