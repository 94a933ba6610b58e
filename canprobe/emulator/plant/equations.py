"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

State (18): motor angles (rad), their rates (rad/s), the integrators of the six velocity loops (N m); all in motor
coordinates. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact can be held over a while
(``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import tanh

import numpy as np

from canprobe.emulator.plant.cascade import Cascade
from canprobe.emulator.plant.pushing import Contact
from canprobe.robot.actuation import COULOMB_NM, REFLECTED_INERTIA, STICTION_RATE, VISCOUS_NMS, joints_per_motor
from canprobe.robot.dynamics import RigidBody
from canprobe.robot.puma260 import Array

Touching = Callable[[Array], Contact | None]
"""Motor angles (6,), rad -> the contact near there, None where nothing is near."""


@dataclass(frozen=True, slots=True)
class Effects:
    """What acts on the arm; each can be switched off.

    Args:
        gravity, coriolis: of the links.
        friction: viscous and Coulomb, of motors and gears.
        links: False leaves the motors alone with the inertia at their own joint, without coupling.
        contact: the object pushes back.
    """

    gravity: bool = True
    coriolis: bool = True
    friction: bool = True
    links: bool = True
    contact: bool = True


class ArmEquations:
    """The driven arm.

    Args:
        body: links and payload.
        cascade: the drives.
        touching: contact near a posture.
        effects: what acts.
        held: whether ``hold`` sets what the calls use; else each call evaluates everything.
    """

    positions = 6

    def __init__(
        self,
        body: RigidBody,
        cascade: Cascade,
        touching: Touching = lambda theta: None,
        effects: Effects = Effects(),
        *,
        held: bool = True,
    ) -> None:
        self.body, self.cascade, self.effects, self.held = body, cascade, effects, held
        self._touching = touching
        self.joints_per_motor = joints_per_motor()
        self._rotors = np.diag(REFLECTED_INERTIA)
        on = 1.0 if effects.friction else 0.0
        self._viscous, self._coulomb = [on * x for x in VISCOUS_NMS], [on * x for x in COULOMB_NM]
        self._gain: list[float] = cascade.velocity.tolist()
        self._integral: list[float] = cascade.integral.tolist()
        self._limit: list[float] = cascade.limit.tolist()
        self._mass, self._bias = self._rotors, [0.0] * 6
        self._inverse: Array = np.array(np.linalg.inv(self._rotors), dtype=np.float64)
        self._contact: Contact | None = None
        self.set_reference(0.0, np.zeros(6), np.zeros(6))

    def set_reference(self, t: float, theta: Array, slope: Array) -> None:
        """Straight reference of all motors from now on.

        Args:
            t: s.
            theta: (6,) at t, rad.
            slope: (6,) rad/s.
        """
        self._r0: list[float] = (theta - slope * t).tolist()
        self._slope: list[float] = slope.tolist()
        self._ahead = [self.cascade.share * x for x in self._slope]

    def hold(self, y: Array) -> None:
        """Evaluate mass matrix, bias and contact geometry at a state.

        Args:
            y: (18,) state.
        """
        if self.effects.links:
            self._mass, bias = self._rigid(y[:6], y[6:12])
            self._bias = bias.tolist()
            self._inverse = np.array(np.linalg.inv(self._mass), dtype=np.float64)
        if self.effects.contact:
            self._contact = self._touching(y[:6])

    def _rigid(self, theta: Array, rate: Array) -> tuple[Array, Array]:
        """Mass matrix and bias in motor coordinates."""
        back = self.joints_per_motor
        q = back @ theta
        mass, bias = self.body.terms(q, back @ rate)
        if not self.effects.coriolis:
            bias = self.body.gravity(q)
        if not self.effects.gravity:
            bias = bias - self.body.gravity(q)
        return back.T @ mass @ back + self._rotors, bias @ back

    def resting(self, theta: Array) -> Array:
        """(18,) state at rest that the drives hold: the integrators carry the weight.

        Args:
            theta: (6,) motor angles, rad.
        """
        bias = self._rigid(theta, np.zeros(6))[1] if self.effects.links else np.zeros(6)
        return np.concatenate((theta, np.zeros(6), bias))

    def torque(self, t: float, y: Array) -> Array:
        """(6,) torque of the motors, motor coordinates, N m.

        Args:
            t: s.
            y: (18,) state.
        """
        return np.array([given for _, _, given in self._drives(t, y.tolist())])

    def _drives(self, t: float, y: list[float]) -> list[tuple[float, float, float]]:
        """Velocity error, torque asked for and torque given, of every motor."""
        kp, found = self.cascade.position, []
        for r0, slope, ahead, gain, limit, x, v, s in zip(
            self._r0, self._slope, self._ahead, self._gain, self._limit, y[:6], y[6:12], y[12:], strict=True
        ):
            error = kp * (r0 + slope * t - x) + ahead - v
            asked = gain * error + s
            found.append((error, asked, min(max(asked, -limit), limit)))
        return found

    def rate(self, t: float, y: Array) -> Array:
        """f(t, y)."""
        if not self.held:
            self.hold(y)
        state = y.tolist()
        v = state[6:12]
        drives = self._drives(t, state)
        unwind = self.cascade.unwind
        out = np.empty(18)
        out[:6] = v
        out[12:] = [i * e - unwind * (a - g) for i, (e, a, g) in zip(self._integral, drives, strict=True)]
        net = np.array(
            [
                given - b - viscous * rate - coulomb * tanh(rate / STICTION_RATE)
                for (_, _, given), b, viscous, coulomb, rate in zip(
                    drives, self._bias, self._viscous, self._coulomb, v, strict=True
                )
            ]
        )
        if self._contact is not None:
            push = self._contact.push(state[:6], v)
            if push is not None:
                net += push
        np.matmul(self._inverse, net, out=out[6:12])
        return out

    def drift(self, t: float, y: Array) -> Array:
        """Partial derivative of f by t: the reference moves on."""
        kp, unwind = self.cascade.position, self.cascade.unwind
        out, torque = np.zeros(18), np.zeros(6)
        for i, (_, asked, given) in enumerate(self._drives(t, y.tolist())):
            pull, gain, free = kp * self._slope[i], self._gain[i], asked == given
            torque[i] = gain * pull if free else 0.0
            out[12 + i] = pull * (self._integral[i] if free else self._integral[i] - unwind * gain)
        np.matmul(self._inverse, torque, out=out[6:12])
        return out

    def _slopes(self, t: float, state: list[float]) -> tuple[Array, Array, Array, Array, Array]:
        """(6,) partial derivatives, one motor each: torque by angle, by rate, by integrator; the integrator's own
        rate by velocity error and by itself."""
        kp, unwind, found = self.cascade.position, self.cascade.unwind, []
        for i, (_, asked, given) in enumerate(self._drives(t, state)):
            free = 1.0 if asked == given else 0.0
            gain, held = self._gain[i] * free, unwind * (1.0 - free)
            bent = tanh(state[6 + i] / STICTION_RATE)
            drag = self._viscous[i] + self._coulomb[i] / STICTION_RATE * (1.0 - bent * bent)
            found.append((-kp * gain, -gain - drag, free, self._integral[i] - held * self._gain[i], -held))
        columns = np.array(found).T
        return columns[0], columns[1], columns[2], columns[3], columns[4]

    def jacobian(self, t: float, y: Array) -> Array:
        """(18, 18) of f by y; mass matrix, bias and contact geometry held."""
        state = y.tolist()
        by_theta, by_rate, by_sum, sum_by_error, sum_by_sum = self._slopes(t, state)
        theta, rate = np.diag(by_theta), np.diag(by_rate)
        push = self._contact.slopes(state[:6], state[6:12]) if self._contact is not None else None
        if push is not None:
            theta -= push.rows.T @ push.by_theta @ push.rows
            rate -= push.rows.T @ push.by_rate @ push.rows
        J = np.zeros((18, 18))
        J[:6, 6:12] = np.eye(6)
        J[6:12, :6], J[6:12, 6:12], J[6:12, 12:] = self._inverse @ theta, self._inverse @ rate, self._inverse * by_sum
        J[12:, :6], J[12:, 6:12] = np.diag(-self.cascade.position * sum_by_error), np.diag(-sum_by_error)
        J[12:, 12:] = np.diag(sum_by_sum)
        return J

    def shifted(self, t: float, y: Array, g: float) -> Callable[[Array], Array]:
        """Solver of (I - g J) x = r by elimination: one 6 x 6 system for the rates."""
        state, kp, mass = y.tolist(), self.cascade.position, self._mass
        by_theta, by_rate, by_sum, sum_by_error, sum_by_sum = self._slopes(t, state)
        leak = 1.0 / (1.0 - g * sum_by_sum)
        fed = g * by_sum * leak  # torque per right-hand side of the integrator
        back = (g * (1.0 + g * kp)) * sum_by_error
        inner = mass.copy()
        inner.flat[::7] += fed * back - g * by_rate - (g * g) * by_theta
        push = self._contact.slopes(state[:6], state[6:12]) if self._contact is not None else None
        if push is not None:
            inner += push.rows.T @ ((g * push.by_rate + (g * g) * push.by_theta) @ push.rows)
        inverse = np.linalg.inv(inner)

        def solve(r: Array) -> Array:
            x = np.empty(18)
            first, third = r[:6], r[12:] - (g * kp) * sum_by_error * r[:6]
            torque = mass @ r[6:12] + g * (by_theta * first) + fed * third
            if push is not None:
                torque -= g * (push.by_theta @ (push.rows @ first)) @ push.rows
            x[6:12] = v = inverse @ torque
            x[:6] = first + g * v
            x[12:] = leak * (third - back * v)
            return x

        return solve
