"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

State (18): motor angles (rad), their rates (rad/s), the integrators of the six velocity loops (N m); all in motor
coordinates. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact can be held over a while
(``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import tanh

import numpy as np

from canprobe.emulator.plant.cascade import Cascade
from canprobe.emulator.plant.integrators import Linearised
from canprobe.emulator.plant.loops import DriveLoops, Drives, LoopSlopes
from canprobe.emulator.plant.pushing import Contact
from canprobe.robot.actuation import REFLECTED_INERTIA, STICTION_RATE, joints_per_motor
from canprobe.robot.dynamics import RigidBody, dense
from canprobe.robot.puma260 import Array

State = Sequence[float]
"""(18,) plain floats."""
Touching = Callable[[State], Contact | None]
"""Motor angles (6,), rad -> the contact near there, None where nothing is near."""
_AT_REST = (0.0,) * 6


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

    Attributes:
        loops: of the drives; references and feed-forwards are set there.
        lower_mass, bias: held, motor coordinates: (21,) entries ``LOWER``, kg m^2; (6,) N m.
        contact: held; None where nothing is near.
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
        self.body, self.effects, self.held = body, effects, held
        self.loops = DriveLoops(cascade, friction=effects.friction)
        self.contact: Contact | None = None
        self._touching = touching
        self._driven = body.along(joints_per_motor(), REFLECTED_INERTIA, weight=effects.gravity)
        alone = [x if i == j else 0.0 for i, x in enumerate(REFLECTED_INERTIA) for j in range(i + 1)]
        self._take((*alone, *(0.0,) * 6))

    def hold(self, y: Array) -> None:
        """Evaluate mass matrix, bias and contact geometry at a state.

        Args:
            y: (18,) state.
        """
        state: list[float] = y.tolist()
        self.hold_at(state[:6], state[6:12])

    def hold_at(self, theta: State, rate: State) -> None:
        """As ``hold``, in plain floats.

        Args:
            theta: (6,) motor angles, rad.
            rate: (6,) rad/s.
        """
        if self.effects.links:
            self._take(self._driven.lower_terms(theta, rate if self.effects.coriolis else _AT_REST))
        if self.effects.contact:
            self.contact = self._touching(theta)

    def _take(self, terms: tuple[float, ...]) -> None:
        self.lower_mass, self.bias = terms[:21], terms[21:]
        self._dense: tuple[Array, Array] | None = None

    def mass(self) -> tuple[Array, Array]:
        """(6, 6) held mass matrix in motor coordinates, kg m^2, and its inverse."""
        if self._dense is None:
            mass = dense(self.lower_mass)
            self._dense = mass, np.array(np.linalg.inv(mass), dtype=np.float64)
        return self._dense

    def resting(self, theta: Array) -> Array:
        """(18,) state at rest that the drives hold: the integrators carry the weight.

        Args:
            theta: (6,) motor angles, rad.
        """
        bias = self._driven.gravity(theta) if self.effects.links else np.zeros(6)
        return np.concatenate((theta, np.zeros(6), bias))

    def torque(self, t: float, y: State) -> list[float]:
        """(6,) torque of the motors, motor coordinates, N m.

        Args:
            t: s.
            y: (18,) state.
        """
        return self.loops.drives(t, y)[2]

    def rate(self, t: float, y: Array) -> Array:
        """f(t, y)."""
        if not self.held:
            self.hold(y)
        state = y.tolist()
        return self._rate(state, self.loops.drives(t, state))

    def _rate(self, state: list[float], drives: Drives) -> Array:
        v, unwind = state[6:12], self.loops.unwind
        net = np.array(
            [
                given - b - viscous * rate - coulomb * tanh(rate / STICTION_RATE)
                for given, b, viscous, coulomb, rate in zip(
                    drives[2], self.bias, self.loops.viscous, self.loops.coulomb, v, strict=True
                )
            ]
        )
        if self.contact is not None:
            push = self.contact.push(state[:6], v)
            if push is not None:
                net += push
        out = np.empty(18)
        out[:6] = v
        out[12:] = [i * e - unwind * (a - g) for i, e, a, g in zip(self.loops.integral, *drives, strict=True)]
        np.matmul(self.mass()[1], net, out=out[6:12])
        return out

    def drift(self, t: float, y: Array) -> Array:
        """Partial derivative of f by t: the reference moves on."""
        return self._drift(self.loops.slopes(y.tolist()[6:12], self.loops.drives(t, y.tolist())))

    def _drift(self, motors: LoopSlopes) -> Array:
        pull = np.array(self.loops.slope) * self.loops.position
        out = np.zeros(18)
        np.matmul(self.mass()[1], motors.gain * pull, out=out[6:12])
        out[12:] = pull * motors.sum_by_error
        return out

    def jacobian(self, t: float, y: Array) -> Array:
        """(18, 18) of f by y; mass matrix, bias and contact geometry held."""
        state = y.tolist()
        m = self.loops.slopes(state[6:12], self.loops.drives(t, state))
        theta, rate = np.diag(m.by_theta), np.diag(m.by_rate)
        push = self.contact.slopes(state[:6], state[6:12]) if self.contact is not None else None
        if push is not None:
            theta -= push.rows.T @ push.by_theta @ push.rows
            rate -= push.rows.T @ push.by_rate @ push.rows
        J, inverse = np.zeros((18, 18)), self.mass()[1]
        J[:6, 6:12] = np.eye(6)
        J[6:12, :6], J[6:12, 6:12], J[6:12, 12:] = inverse @ theta, inverse @ rate, inverse * m.by_sum
        J[12:, :6], J[12:, 6:12] = np.diag(-self.loops.position * m.sum_by_error), np.diag(-m.sum_by_error)
        J[12:, 12:] = np.diag(m.sum_by_sum)
        return J

    def linearised(self, t: float, y: Array, g: float) -> Linearised:
        """Rate, drift, and the solver of (I - g J) x = r by elimination: one 6 x 6 system for the rates."""
        if not self.held:
            self.hold(y)
        state, kp, mass = y.tolist(), self.loops.position, self.mass()[0]
        drives = self.loops.drives(t, state)
        m = self.loops.slopes(state[6:12], drives)
        leak = 1.0 / (1.0 - g * m.sum_by_sum)
        fed = g * m.by_sum * leak  # torque per right-hand side of the integrator
        back = (g * (1.0 + g * kp)) * m.sum_by_error
        first_back, by_theta = (g * kp) * m.sum_by_error, g * m.by_theta
        inner = mass.copy()
        inner.flat[::7] += fed * back - g * m.by_rate - g * by_theta
        push = self.contact.slopes(state[:6], state[6:12]) if self.contact is not None else None
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
