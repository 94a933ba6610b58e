"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

State (18): motor angles (rad), their rates (rad/s), the integrators of the six velocity loops (N m); all in motor
coordinates. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact can be held over a while
(``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import tanh
from typing import NamedTuple

import numpy as np

from canprobe.emulator.plant.cascade import Cascade
from canprobe.emulator.plant.integrators import Linearised
from canprobe.emulator.plant.pushing import Contact
from canprobe.robot.actuation import COULOMB_NM, REFLECTED_INERTIA, STICTION_RATE, VISCOUS_NMS, joints_per_motor
from canprobe.robot.dynamics import RigidBody
from canprobe.robot.puma260 import Array

Touching = Callable[[Array], Contact | None]
"""Motor angles (6,), rad -> the contact near there, None where nothing is near."""


_Drives = tuple[list[float], list[float], list[float]]
"""Velocity error, torque asked for and torque given, of every motor."""


class _Motors(NamedTuple):
    """(6,) each: slope of torque by velocity error, by angle, by rate and by integrator; slope of the integrator's own
    rate by velocity error and by itself."""

    gain: Array
    by_theta: Array
    by_rate: Array
    by_sum: Array
    sum_by_error: Array
    sum_by_sum: Array


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
        self._speed_fed, self._torque_fed = [0.0] * 6, [0.0] * 6
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

    def set_loop(self, axis: int, limit: float, speed: float, torque: float) -> None:
        """Torque limit and feed-forwards of one motor from now on.

        Args:
            axis: 0 to 5.
            limit: largest torque, N m; the cascade's own if that is less.
            speed: added behind the position loop, rad/s.
            torque: added behind the velocity loop, N m.
        """
        self._limit[axis] = min(limit, float(self.cascade.limit[axis]))
        self._speed_fed[axis], self._torque_fed[axis] = speed, torque

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
        return np.array(self._drives(t, y.tolist())[2])

    def _drives(self, t: float, y: list[float]) -> _Drives:
        """What the cascades do."""
        kp = self.cascade.position
        errors, asked, given = [], [], []
        for r0, slope, ahead, speed, gain, fed, limit, x, v, s in zip(
            self._r0, self._slope, self._ahead, self._speed_fed, self._gain, self._torque_fed, self._limit,
            y[:6], y[6:12], y[12:], strict=True,
        ):  # fmt: skip
            error = kp * (r0 + slope * t - x) + ahead + speed - v
            torque = gain * error + s + fed
            errors.append(error)
            asked.append(torque)
            given.append(limit if torque > limit else -limit if torque < -limit else torque)
        return errors, asked, given

    def rate(self, t: float, y: Array) -> Array:
        """f(t, y)."""
        if not self.held:
            self.hold(y)
        state = y.tolist()
        return self._rate(state, self._drives(t, state))

    def _rate(self, state: list[float], drives: _Drives) -> Array:
        v, unwind = state[6:12], self.cascade.unwind
        net = np.array(
            [
                given - b - viscous * rate - coulomb * tanh(rate / STICTION_RATE)
                for given, b, viscous, coulomb, rate in zip(
                    drives[2], self._bias, self._viscous, self._coulomb, v, strict=True
                )
            ]
        )
        if self._contact is not None:
            push = self._contact.push(state[:6], v)
            if push is not None:
                net += push
        out = np.empty(18)
        out[:6] = v
        out[12:] = [i * e - unwind * (a - g) for i, e, a, g in zip(self._integral, *drives, strict=True)]
        np.matmul(self._inverse, net, out=out[6:12])
        return out

    def drift(self, t: float, y: Array) -> Array:
        """Partial derivative of f by t: the reference moves on."""
        return self._drift(self._motors(y.tolist(), self._drives(t, y.tolist())))

    def _drift(self, motors: _Motors) -> Array:
        pull = np.array(self._slope) * self.cascade.position
        out = np.zeros(18)
        np.matmul(self._inverse, motors.gain * pull, out=out[6:12])
        out[12:] = pull * motors.sum_by_error
        return out

    def _motors(self, state: list[float], drives: _Drives) -> _Motors:
        """Slopes of every motor's torque and of its integrator's rate."""
        kp, unwind, found = self.cascade.position, self.cascade.unwind, []
        for i, (asked, given) in enumerate(zip(drives[1], drives[2], strict=True)):
            gain, held = (self._gain[i], 0.0) if asked == given else (0.0, unwind)
            bent = tanh(state[6 + i] / STICTION_RATE)
            drag = self._viscous[i] + self._coulomb[i] / STICTION_RATE * (1.0 - bent * bent)
            free = 0.0 if held else 1.0
            found.append((gain, -kp * gain, -gain - drag, free, self._integral[i] - held * self._gain[i], -held))
        return _Motors(*np.array(found).T)

    def jacobian(self, t: float, y: Array) -> Array:
        """(18, 18) of f by y; mass matrix, bias and contact geometry held."""
        state = y.tolist()
        m = self._motors(state, self._drives(t, state))
        theta, rate = np.diag(m.by_theta), np.diag(m.by_rate)
        push = self._contact.slopes(state[:6], state[6:12]) if self._contact is not None else None
        if push is not None:
            theta -= push.rows.T @ push.by_theta @ push.rows
            rate -= push.rows.T @ push.by_rate @ push.rows
        J = np.zeros((18, 18))
        J[:6, 6:12] = np.eye(6)
        J[6:12, :6], J[6:12, 6:12], J[6:12, 12:] = self._inverse @ theta, self._inverse @ rate, self._inverse * m.by_sum
        J[12:, :6], J[12:, 6:12] = np.diag(-self.cascade.position * m.sum_by_error), np.diag(-m.sum_by_error)
        J[12:, 12:] = np.diag(m.sum_by_sum)
        return J

    def linearised(self, t: float, y: Array, g: float) -> Linearised:
        """Rate, drift, and the solver of (I - g J) x = r by elimination: one 6 x 6 system for the rates."""
        if not self.held:
            self.hold(y)
        state, kp, mass = y.tolist(), self.cascade.position, self._mass
        drives = self._drives(t, state)
        m = self._motors(state, drives)
        leak = 1.0 / (1.0 - g * m.sum_by_sum)
        fed = g * m.by_sum * leak  # torque per right-hand side of the integrator
        back = (g * (1.0 + g * kp)) * m.sum_by_error
        first_back, by_theta = (g * kp) * m.sum_by_error, g * m.by_theta
        inner = mass.copy()
        inner.flat[::7] += fed * back - g * m.by_rate - g * by_theta
        push = self._contact.slopes(state[:6], state[6:12]) if self._contact is not None else None
        if push is not None:
            inner += push.rows.T @ ((g * push.by_rate + (g * g) * push.by_theta) @ push.rows)
            springs = g * push.by_theta
        inverse = np.linalg.inv(inner)

        def solve(r: Array) -> Array:
            x = np.empty(18)
            first, third = r[:6], r[12:] - first_back * r[:6]
            torque = mass @ r[6:12] + by_theta * first + fed * third
            if push is not None:
                torque -= (springs @ (push.rows @ first)) @ push.rows
            v = np.matmul(inverse, torque, out=x[6:12])
            np.add(first, g * v, out=x[:6])
            np.multiply(leak, third - back * v, out=x[12:])
            return x

        return Linearised(self._rate(state, drives), self._drift(m), solve)
