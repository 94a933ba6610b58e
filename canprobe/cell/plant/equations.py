"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

State (3n): motor positions (rad), their rates (rad/s), the integrators of the n velocity loops (N m); all in motor
coordinates, of prismatic joints in m, m/s and N. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact
can be held over a while (``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the
reference.

Drive cascade of a motor: position loop, velocity loop, torque limit, feed-forwards. Position: ``v* = kp (r - x) + share
r'``. Velocity: ``u = Kv (v* - v) + s + tau_ff``, ``s' = Ki (v* - v)``, where s also unwinds while the torque is at its
limit. Torque: ``min(max(u, -limit), limit)``, without a lag of its own. All in motor coordinates (``robot.model``). The
loops are continuous; a real drive samples them at some kHz. With ``kp = w / 2z`` and ``Kv = 2 z w J`` a motor with the
inertia J and nothing else is the second-order system of the ideal arm: same bandwidth, same lag behind a ramp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from canprobe.cell.plant.ideal_arm import STICTION_RATE, natural_frequency
from canprobe.cell.plant.integrators import Linearised
from canprobe.cell.plant.pushing import HeldContact
from canprobe.cell.scene.setup import Dynamics
from canprobe.mechanics.robot.dynamics import RigidBody
from canprobe.mechanics.robot.model import ArmModel, joints_per_motor
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


Touching = Callable[[Floats], HeldContact | None]
"""Motor positions (n,) -> the contact near there, None where nothing is near."""


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects that act on the arm; each can be switched off.

    Args:
        gravity, coriolis: forces on the links.
        friction: viscous and Coulomb friction of motors and gears.
        links: False leaves the motors alone with the inertia at their own joint, without coupling.
        contact: the object pushes back.
    """

    gravity: bool = True
    coriolis: bool = True
    friction: bool = True
    links: bool = True
    contact: bool = True


class ArmEquations:
    """Equations of the driven arm.

    Args:
        model: the arm.
        body: links and payload.
        loops: the drives; references and feed-forwards are set there.
        touching: contact near a posture.
        effects: effects that act; gravity is a property of the body.
        held: whether ``hold`` sets what the calls use; else each call evaluates everything.

    Attributes:
        mass, bias: held, motor coordinates: (n, n) kg m^2; (n,) N m.
        contact: held; None where nothing is near.
    """

    def __init__(
        self,
        model: ArmModel,
        body: RigidBody,
        loops: DriveLoops,
        touching: Touching = lambda theta: None,
        effects: Effects = Effects(),
        *,
        held: bool = True,
    ) -> None:
        self.body, self.loops, self.effects, self.held = body, loops, effects, held
        self.positions = model.n
        self.contact: HeldContact | None = None
        self._touching = touching
        self._joints_per_motor = joints_per_motor(model)
        self._rotors = np.diag([joint.rotor_inertia for joint in model.joints])
        self._take(self._rotors, np.zeros(model.n))

    def hold(self, y: Floats) -> None:
        """Evaluate mass matrix, bias and contact geometry at a state.

        Args:
            y: (3n,) state.
        """
        theta, rate, _ = y.reshape(3, -1)
        mass, bias = self._rotors, np.zeros(self.positions)
        if self.effects.links:
            mass, bias = self._driven(theta, rate if self.effects.coriolis else np.zeros(self.positions))
        self._take(mass, bias)
        if self.effects.contact:
            self.contact = self._touching(theta)

    def _driven(self, theta: Floats, rate: Floats) -> tuple[Floats, Floats]:
        """Mass matrix and bias of links and rotors in motor coordinates."""
        back = self._joints_per_motor
        mass, bias = self.body.terms(back @ theta, back @ rate)
        return back.T @ mass @ back + self._rotors, back.T @ bias

    def _take(self, mass: Floats, bias: Floats) -> None:
        self.mass, self.bias = mass, bias
        self.inverse: Floats = np.asarray(np.linalg.inv(mass), dtype=np.float64)

    def resting(self, theta: Floats) -> Floats:
        """(3n,) state at rest that the drives hold: the integrators carry the weight.

        Args:
            theta: (n,) motor positions, rad.
        """
        still = np.zeros(self.positions)
        bias = self._driven(theta, still)[1] if self.effects.links else still
        return np.concatenate((theta, still, bias))

    def rate(self, t: float, y: Floats) -> Floats:
        """f(t, y)."""
        if not self.held:
            self.hold(y)
        x, v, _ = y.reshape(3, -1)
        return self._rate(v, self.loops.drives(t, y), self.contact.push(x, v) if self.contact is not None else None)

    def _rate(self, v: Floats, drives: Drives, push: Floats | None) -> Floats:
        loops = self.loops
        net = drives.given - self.bias - loops.viscous * v - loops.coulomb * np.tanh(v / STICTION_RATE)
        if push is not None:
            net += push
        wound = loops.integral * drives.error - loops.unwind * (drives.asked - drives.given)
        return np.concatenate((v, self.inverse @ net, wound))

    def drift(self, t: float, y: Floats) -> Floats:
        """Partial derivative of f by t: the reference moves on."""
        by_error, _, sum_by_error, _ = self.loops.slopes(y.reshape(3, -1)[1], self.loops.drives(t, y))
        return self._drift(by_error, sum_by_error)

    def _drift(self, by_error: Floats, sum_by_error: Floats) -> Floats:
        pull = self.loops.slope * self.loops.position
        return np.concatenate((np.zeros(self.positions), self.inverse @ (by_error * pull), sum_by_error * pull))

    def jacobian(self, t: float, y: Floats) -> Floats:
        """(3n, 3n) of f by y; mass matrix, bias and contact geometry held."""
        n, kp = self.positions, self.loops.position
        x, v, _ = y.reshape(3, -1)
        drives = self.loops.drives(t, y)
        by_error, drag, sum_by_error, sum_by_sum = self.loops.slopes(v, drives)
        by_sum = np.diag((drives.asked == drives.given) * 1.0)
        theta, rate = np.diag(-kp * by_error), np.diag(-by_error - drag)
        pushed = self.contact.linearised(x, v) if self.contact is not None else None
        if pushed is not None:
            theta, rate = theta - pushed[1], rate - pushed[2]
        J = np.zeros((3 * n, 3 * n))
        J[:n, n : 2 * n] = np.eye(n)
        J[n : 2 * n] = self.inverse @ np.hstack((theta, rate, by_sum))
        J[2 * n :] = np.hstack((np.diag(-kp * sum_by_error), np.diag(-sum_by_error), np.diag(sum_by_sum)))
        return J

    def linearised(self, t: float, y: Floats, g: float) -> Linearised:
        """Rate, drift, and the solver of (I - g J) x = r by elimination: one n x n system for the rates."""
        if not self.held:
            self.hold(y)
        n, kp = self.positions, self.loops.position
        x, v, _ = y.reshape(3, -1)
        drives = self.loops.drives(t, y)
        by_error, drag, sum_by_error, sum_by_sum = self.loops.slopes(v, drives)
        leak = 1.0 / (1.0 - g * sum_by_sum)
        fed = (g * leak) * (drives.asked == drives.given)  # torque per right-hand side of the integrator
        back = (g * (1.0 + g * kp)) * sum_by_error
        first_back, by_theta = (g * kp) * sum_by_error, (g * kp) * by_error
        inner = self.mass.copy()
        inner.flat[:: n + 1] += fed * back + g * (by_error + drag) + g * by_theta
        pushed = self.contact.linearised(x, v) if self.contact is not None else None
        if pushed is not None:
            springs = g * pushed[1]
            inner += g * (pushed[2] + springs)
        inverse = np.linalg.inv(inner)

        def solve(r: Floats) -> Floats:
            first, second, third = r.reshape(3, -1)
            third = third - first_back * first
            torque = fed * third - by_theta * first
            if pushed is not None:
                torque -= springs @ first
            rates = inverse @ (self.mass @ second + torque)
            return np.concatenate((first + g * rates, rates, leak * (third - back * rates)))

        rate = self._rate(v, drives, None if pushed is None else pushed[0])
        return Linearised(rate, self._drift(by_error, sum_by_error), solve)
