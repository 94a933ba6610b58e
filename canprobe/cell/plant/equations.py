"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

State (3n): motor positions (rad), their rates (rad/s), the integrators of the n velocity loops (N m); all in motor
coordinates, of prismatic joints in m, m/s and N. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact
can be held over a while (``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the
reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from canprobe.cell.plant.cascade import DriveLoops, Drives
from canprobe.cell.plant.ideal_arm import STICTION_RATE
from canprobe.cell.plant.integrators import Linearised
from canprobe.cell.plant.pushing import HeldContact
from canprobe.mechanics.robot.dynamics import RigidBody
from canprobe.mechanics.robot.model import ArmModel, joints_per_motor
from canprobe.mechanics.types import Floats

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
