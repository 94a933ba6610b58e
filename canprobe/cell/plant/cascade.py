"""Drive cascade of a motor: position loop, velocity loop, torque limit, feed-forwards.

Position: ``v* = kp (r - x) + share r'``. Velocity: ``u = Kv (v* - v) + s + tau_ff``, ``s' = Ki (v* - v)``, where s
also unwinds while the torque is at its limit. Torque: ``min(max(u, -limit), limit)``, without a lag of its own. All
in motor coordinates (``robot.model``). The loops are continuous; a real drive samples them at some kHz.

With ``kp = w / 2z`` and ``Kv = 2 z w J`` a motor with the inertia J and nothing else is the second-order system of
the ideal arm: same bandwidth, same lag behind a ramp.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from canprobe.cell.plant.ideal_arm import STICTION_RATE, natural_frequency
from canprobe.cell.scene.setup import Dynamics
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats


class Drives(NamedTuple):
    """(n,) each: velocity error, torque asked for and torque given."""

    error: Floats
    asked: Floats
    given: Floats


class DriveLoops:
    """Position and velocity loops, torque limits and friction of the n motors, on straight references.

    Args:
        model: the arm, for rated torques and friction.
        inertia: (n,) inertia of the motors as the drives are tuned for, kg m^2.
        bandwidth_hz: -3 dB frequency of position.
        damping_ratio: 1 is critical.
        dynamics: the rest of the tuning.
        friction: whether motors and gears rub.

    Attributes:
        start, slope: (n,) reference at time 0 (rad) and its slope (rad/s).
        ahead, fed: (n,) speed (rad/s) and torque (N m) added behind the position and the velocity loop.
        position, unwind: gain of the position loops, and rate of unwinding, 1/s.
        gain, integral, limit: (n,) of the velocity loops and the largest torque.
        viscous, coulomb: (n,) friction.
    """

    def __init__(
        self,
        model: ArmModel,
        inertia: Floats,
        bandwidth_hz: float,
        damping_ratio: float,
        dynamics: Dynamics,
        *,
        friction: bool,
    ) -> None:
        w, reset_s = natural_frequency(bandwidth_hz, damping_ratio), dynamics.integral_s
        self.position, self.unwind = w / (2.0 * damping_ratio), 1.0 / reset_s if reset_s > 0.0 else 0.0
        self.gain: Floats = 2.0 * damping_ratio * w * inertia
        self.integral: Floats = self.gain * self.unwind
        rated = np.array([joint.rated_torque for joint in model.joints])
        self._most: Floats = rated * (1e-3 * dynamics.torque_limit_permille)
        self.limit = self._most.copy()
        self.viscous = np.array([friction * joint.viscous for joint in model.joints])
        self.coulomb = np.array([friction * joint.coulomb for joint in model.joints])
        self._share = dynamics.velocity_feed_forward
        self.fed, self._speed_fed = np.zeros(model.n), np.zeros(model.n)
        self.set_reference(0.0, np.zeros(model.n), np.zeros(model.n))

    def set_reference(self, t: float, theta: Floats, slope: Floats) -> None:
        """Straight reference of all motors from now on.

        Args:
            t: s.
            theta: (n,) at t, rad.
            slope: (n,) rad/s.
        """
        self.start, self.slope = theta - slope * t, slope
        self.ahead: Floats = self._share * slope + self._speed_fed

    def set_loop(self, axis: int, limit: float, speed: float, torque: float) -> None:
        """Torque limit and feed-forwards of one motor from now on.

        Args:
            axis: number of the motor, from 0.
            limit: largest torque, N m; the configured one if that is less.
            speed: added behind the position loop, rad/s.
            torque: added behind the velocity loop, N m.
        """
        self.limit[axis] = min(limit, self._most[axis])
        self._speed_fed[axis], self.fed[axis] = speed, torque
        self.ahead = self._share * self.slope + self._speed_fed

    def drives(self, t: float, y: Floats) -> Drives:
        """Velocity errors and torques of the cascades.

        Args:
            t: s.
            y: (3n,) state of the arm.
        """
        x, v, s = y.reshape(3, -1)
        error = self.position * (self.start + self.slope * t - x) + self.ahead - v
        asked = self.gain * error + s + self.fed
        return Drives(error, asked, np.minimum(np.maximum(asked, -self.limit), self.limit))

    def slopes(self, v: Floats, drives: Drives) -> tuple[Floats, Floats, Floats, Floats]:
        """(n,) each: slope of torque by velocity error, of friction by rate; of the integrator's rate by velocity error
        and by the integrator itself. At its limit the torque depends on nothing, and the integrator unwinds.

        Args:
            v: (n,) rates of the motors, rad/s.
            drives: result of `drives`.
        """
        free = drives.asked == drives.given
        bent = np.tanh(v / STICTION_RATE)
        drag = self.viscous + self.coulomb / STICTION_RATE * (1.0 - bent * bent)
        unwind = np.where(free, 0.0, self.unwind)
        return free * self.gain, drag, self.integral - unwind * self.gain, -unwind
