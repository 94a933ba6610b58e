"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

State (3n): motor positions (rad), their rates (rad/s), the integrators of the n velocity loops (N m); all in motor
coordinates, of prismatic joints in m, m/s and N. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact
can be held over a while (``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the
reference.

Drive cascade of a motor: position loop, velocity loop, torque limit, feed-forwards. Position: ``v* = kp (r - x) + share
r'``. Velocity: ``u = Kv (v* - v) + s + tau_ff``, ``s' = Ki (v* - v)``, where s also unwinds while the torque is at its
limit. Torque: ``min(max(u, -limit), limit)``, without a lag of its own. All in motor coordinates (``robot.model``). The
loops are continuous; a real drive samples them at some kHz. With ``kp = w / 2`` and ``Kv = 2 w J`` a motor with the
inertia J and nothing else is the second-order system of the ideal arm: same bandwidth, same lag behind a ramp.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.ideal_arm import STICTION_RATE, natural_frequency
from canprobe.cell.plant.integrators import Linearised
from canprobe.cell.plant.pushing import HeldContact, Neighbourhood
from canprobe.errors import PlanError
from canprobe.mechanics.robot.dynamics import RigidBody, ball, dynamics_problem, joined
from canprobe.mechanics.robot.model import joints_per_motor
from canprobe.mechanics.types import Floats


class Drives(NamedTuple):
    """(n,) each: velocity error, torque asked for and torque given."""

    error: Floats
    asked: Floats
    given: Floats


class DriveLoops:
    """Position and velocity loops, torque limits and friction of the n motors, on straight references.

    Args:
        config: configuration of a plant with an arm: tuning, rated torques, friction.
        inertia: (n,) inertia of the motors as the drives are tuned for, kg m^2.

    Attributes:
        start, slope: (n,) reference at time 0 (rad) and its slope (rad/s).
        ahead, fed: (n,) speed (rad/s) and torque (N m) added behind the position and the velocity loop.
        position, unwind: gain of the position loops, and rate of unwinding, 1/s.
        gain, integral, limit: (n,) of the velocity loops and the largest torque.
        viscous, coulomb: (n,) friction.
    """

    def __init__(self, config: PlantConfig, inertia: Floats) -> None:
        assert config.model is not None
        model, dynamics = config.model, config.dynamics
        w, reset_s = natural_frequency(config.bandwidth_hz), dynamics.integral_s
        self.position, self.unwind = w / 2.0, 1.0 / reset_s if reset_s > 0.0 else 0.0
        self.gain: Floats = 2.0 * w * inertia
        self.integral: Floats = self.gain * self.unwind
        rated = np.array([joint.rated_torque for joint in model.joints])
        self._most: Floats = rated * (1e-3 * dynamics.torque_limit_permille)
        self.limit = self._most.copy()
        self.viscous = np.array([joint.viscous for joint in model.joints])
        self.coulomb = np.array([joint.coulomb for joint in model.joints])
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


class ArmEquations:
    """Equations of the driven arm.

    Args:
        config: configuration of a plant with an arm and the bodies of its links.
        held: whether ``hold`` sets what the calls use; else each call evaluates everything.

    Attributes:
        body: links and payload.
        loops: the drives; references and feed-forwards are set there.
        mass, bias: held, motor coordinates: (n, n) kg m^2; (n,) N m.
        contact: held; None where nothing is near.

    Raises:
        PlanError: the arm has no bodies, or the extra `dynamics` is missing.
    """

    def __init__(self, config: PlantConfig, *, held: bool = True) -> None:
        assert config.model is not None
        model, back = config.model, joints_per_motor(config.model)
        if config.bodies is None:
            raise PlanError([dynamics_problem(model.name, None) or ""])
        centre = (model.chain.T_last_flange @ config.T_flange_probe_centre)[:3, 3]
        payload = ball(config.dynamics.payload, config.radius_m, centre)
        bodies = *config.bodies[:-1], joined(config.bodies[-1], payload)
        self.body = RigidBody(model.chain, bodies)
        self.held, self.positions = held, model.n
        self.contact: HeldContact | None = None
        self._touching = None if config.object is None else Neighbourhood(config)
        self._joints_per_motor = back
        rotors = np.array([joint.rotor_inertia for joint in model.joints])
        self._rotors = np.diag(rotors)
        # a drive is tuned to what its motor moves in the first posture
        moved = np.diag(back.T @ self.body.terms(config.q0, np.zeros(model.n))[0] @ back)
        self.loops = DriveLoops(config, rotors + moved)
        self._take(self._rotors, np.zeros(model.n))

    def hold(self, y: Floats) -> None:
        """Evaluate mass matrix, bias and contact geometry at a state.

        Args:
            y: (3n,) state.
        """
        theta, rate, _ = y.reshape(3, -1)
        self._take(*self._driven(theta, rate))
        if self._touching is not None:
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
        return np.concatenate((theta, still, self._driven(theta, still)[1]))

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

    def jacobian(self, t: float, y: Floats) -> Floats:
        """(3n, 3n) J of f by y, as in `linearised`; mass matrix, bias and contact geometry held."""
        solve, identity = self.linearised(t, y, 1.0).solve, np.eye(len(y))
        return identity - np.linalg.inv(np.array([solve(one) for one in identity])).T

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
        pull = self.loops.slope * kp  # the reference moves on
        return Linearised(
            rate, np.concatenate((np.zeros(n), self.inverse @ (by_error * pull), sum_by_error * pull)), solve
        )
