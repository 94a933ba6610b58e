"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators, which are here too.

State (3n): motor positions (rad), their rates (rad/s), the integrators of the n velocity loops (N m); all in motor
coordinates, of prismatic joints in m, m/s and N. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact
can be held over a while (``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the
reference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import sqrt
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np

from canprobe.cell.plant.ideal_arm import STICTION_RATE, natural_frequency
from canprobe.cell.plant.pushing import Contact
from canprobe.cell.scene.setup import Dynamics
from canprobe.mechanics.robot.chain import Array
from canprobe.mechanics.robot.dynamics import RigidBody
from canprobe.mechanics.robot.model import ArmModel, joints_per_motor

# Steps of ordinary differential equations y' = f(t, y), each one function of (problem, t, y, h).
#
# | step | order | for |
# |---|---|---|
# | ``semi_implicit_euler`` | 1 | mechanics that is not stiff; velocities first, positions with the new ones |
# | ``runge_kutta_4`` | 4 | smooth and not stiff |
# | ``implicit_euler`` | 1 | stiff; linearly implicit, one linear solve |
# | ``rosenbrock2`` | 2 | stiff; two stages, one matrix, L-stable; second order whatever matrix the problem gives |
# | ``exponential`` | 2 | exact where f is linear in y and t; else the exponential Rosenbrock-Euler step |
# | ``adaptive`` | 2 | ``rosenbrock2`` in as many parts as its own error estimate asks for |
#
# Source: Hairer & Wanner, Solving ODEs II, IV.7; Verwer, Spee, Blom & Hundsdorfer, SIAM J. Sci. Comput. 20, 1999
# (ROS2); Hochbruck & Ostermann, Acta Numerica 2010 (exponential).

GAMMA = 1.0 - sqrt(0.5)
"""Of ROS2."""
_MOST_PARTS = 4096


class Linearised(NamedTuple):
    """The equations near one place.

    Attributes:
        rate: f.
        drift: partial derivative of f by t.
        solve: r -> x of (I - g J) x = r; J may be an approximation of the Jacobian.
    """

    rate: Array
    drift: Array
    solve: Callable[[Array], Array]


class Problem(Protocol):
    """What a step asks of the equations. States begin with n positions, then their n rates, then anything."""

    @property
    def positions(self) -> int:
        """n."""

    def rate(self, t: float, y: Array) -> Array:
        """f(t, y)."""

    def drift(self, t: float, y: Array) -> Array:
        """Partial derivative of f by t."""

    def jacobian(self, t: float, y: Array) -> Array:
        """Partial derivative of f by y."""

    def linearised(self, t: float, y: Array, g: float) -> Linearised:
        """All that a linearly implicit step asks for at one place."""


Step = Callable[[Problem, float, Array, float], Array]


def semi_implicit_euler(problem: Problem, t: float, y: Array, h: float) -> Array:
    """Explicit Euler, but positions advance with the new rates."""
    n = problem.positions
    new = y + h * problem.rate(t, y)
    new[:n] = y[:n] + h * new[n : 2 * n]
    return new


def runge_kutta_4(problem: Problem, t: float, y: Array, h: float) -> Array:
    """The classical explicit step."""
    k1 = problem.rate(t, y)
    k2 = problem.rate(t + 0.5 * h, y + 0.5 * h * k1)
    k3 = problem.rate(t + 0.5 * h, y + 0.5 * h * k2)
    k4 = problem.rate(t + h, y + h * k3)
    new: Array = y + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)
    return new


def implicit_euler(problem: Problem, t: float, y: Array, h: float) -> Array:
    """One Newton iteration of backward Euler."""
    rate, drift, solve = problem.linearised(t, y, h)
    new: Array = y + h * solve(rate + h * drift)
    return new


def rosenbrock2(problem: Problem, t: float, y: Array, h: float) -> Array:
    """ROS2 with gamma = 1 - 1/sqrt(2)."""
    return _rosenbrock2(problem, t, y, h)[0]


def _rosenbrock2(problem: Problem, t: float, y: Array, h: float) -> tuple[Array, Array]:
    """The step, and how far its own first-order step lies off."""
    rate, drift, solve = problem.linearised(t, y, GAMMA * h)
    drift *= GAMMA * h
    k1 = solve(rate + drift)
    k2 = solve(problem.rate(t + h, y + h * k1) - 2.0 * k1 - drift)
    return y + (1.5 * h) * k1 + (0.5 * h) * k2, (0.5 * h) * (k1 + k2)


def exponential(problem: Problem, t: float, y: Array, h: float) -> Array:
    """y + h phi1(hJ) f + h^2 phi2(hJ) f_t, both from one matrix exponential."""
    from scipy.linalg import expm

    size = len(y)
    augmented = np.zeros((size + 2, size + 2))
    augmented[:size, :size] = h * problem.jacobian(t, y)
    augmented[:size, size] = h * h * problem.drift(t, y)
    augmented[:size, size + 1] = h * problem.rate(t, y)
    augmented[size, size + 1] = 1.0
    new: Array = y + expm(augmented)[:size, size + 1]
    return new


def adaptive(problem: Problem, t: float, y: Array, h: float, *, rtol: float = 1e-3, atol: float = 1e-5) -> Array:
    """``rosenbrock2`` in parts whose estimated error stays within ``atol + rtol |y|``, component by component.

    Raises:
        ArithmeticError: when it would take more than 4096 parts.
    """
    done, part = 0.0, h
    for _ in range(_MOST_PARTS):
        part = min(part, h - done)
        new, error = _rosenbrock2(problem, t + done, y, part)
        size = float(np.max(np.abs(error) / (atol + rtol * np.maximum(np.abs(y), np.abs(new)))))
        if size <= 1.0:
            y, done = new, done + part
            if done >= h * (1.0 - 1e-12):
                return y
        # NaN counts as an error too large
        part *= min(4.0, max(0.2, 0.9 / sqrt(size))) if size > 0.0 else 4.0 if size == 0.0 else 0.2
    raise ArithmeticError(f"a step of {h:g} s at t = {t:g} s needs more than {_MOST_PARTS} parts")


STEPS: Mapping[str, Step] = MappingProxyType(
    {
        "semi-implicit": semi_implicit_euler,
        "rk4": runge_kutta_4,
        "implicit": implicit_euler,
        "rosenbrock": rosenbrock2,
        "exponential": exponential,
        "adaptive": adaptive,
    }
)
"""Name in a scene -> step."""


# Drive cascade of a motor: position loop, velocity loop, torque limit, feed-forwards.
#
# Position: ``v* = kp (r - x) + share r'``. Velocity: ``u = Kv (v* - v) + s + tau_ff``, ``s' = Ki (v* - v)``, where s
# also unwinds while the torque is at its limit. Torque: ``min(max(u, -limit), limit)``, without a lag of its own. All
# in motor coordinates (``robot.model``). The loops are continuous; a real drive samples them at some kHz.
#
# With ``kp = w / 2z`` and ``Kv = 2 z w J`` a motor with the inertia J and nothing else is the second-order system of
# the ideal arm: same bandwidth, same lag behind a ramp.


class Drives(NamedTuple):
    """(n,) each: velocity error, torque asked for and torque given."""

    error: Array
    asked: Array
    given: Array


class DriveLoops:
    """Position and velocity loops, torque limits and friction of the n motors, on straight references.

    Args:
        model: the arm, for rated torques and friction.
        inertia: (n,) what each drive takes for its motor's inertia, kg m^2.
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
        inertia: Array,
        bandwidth_hz: float,
        damping_ratio: float,
        dynamics: Dynamics,
        *,
        friction: bool,
    ) -> None:
        w, reset_s = natural_frequency(bandwidth_hz, damping_ratio), dynamics.integral_s
        self.position, self.unwind = w / (2.0 * damping_ratio), 1.0 / reset_s if reset_s > 0.0 else 0.0
        self.gain: Array = 2.0 * damping_ratio * w * inertia
        self.integral: Array = self.gain * self.unwind
        rated = np.array([joint.rated_torque for joint in model.joints])
        self._most: Array = rated * (1e-3 * dynamics.torque_limit_permille)
        self.limit = self._most.copy()
        self.viscous = np.array([friction * joint.viscous for joint in model.joints])
        self.coulomb = np.array([friction * joint.coulomb for joint in model.joints])
        self._share = dynamics.velocity_feed_forward
        self.fed, self._speed_fed = np.zeros(model.n), np.zeros(model.n)
        self.set_reference(0.0, np.zeros(model.n), np.zeros(model.n))

    def set_reference(self, t: float, theta: Array, slope: Array) -> None:
        """Straight reference of all motors from now on.

        Args:
            t: s.
            theta: (n,) at t, rad.
            slope: (n,) rad/s.
        """
        self.start, self.slope = theta - slope * t, slope
        self.ahead: Array = self._share * slope + self._speed_fed

    def set_loop(self, axis: int, limit: float, speed: float, torque: float) -> None:
        """Torque limit and feed-forwards of one motor from now on.

        Args:
            axis: from 0.
            limit: largest torque, N m; the configured one if that is less.
            speed: added behind the position loop, rad/s.
            torque: added behind the velocity loop, N m.
        """
        self.limit[axis] = min(limit, self._most[axis])
        self._speed_fed[axis], self.fed[axis] = speed, torque
        self.ahead = self._share * self.slope + self._speed_fed

    def drives(self, t: float, y: Array) -> Drives:
        """What the cascades do.

        Args:
            t: s.
            y: (3n,) state of the arm.
        """
        x, v, s = y.reshape(3, -1)
        error = self.position * (self.start + self.slope * t - x) + self.ahead - v
        asked = self.gain * error + s + self.fed
        return Drives(error, asked, np.minimum(np.maximum(asked, -self.limit), self.limit))

    def slopes(self, v: Array, drives: Drives) -> tuple[Array, Array, Array, Array]:
        """(n,) each: slope of torque by velocity error, of friction by rate; of the integrator's rate by velocity error
        and by the integrator itself. At its limit the torque depends on nothing, and the integrator unwinds.

        Args:
            v: (n,) rates of the motors, rad/s.
            drives: what the cascades do.
        """
        free = drives.asked == drives.given
        bent = np.tanh(v / STICTION_RATE)
        drag = self.viscous + self.coulomb / STICTION_RATE * (1.0 - bent * bent)
        unwind = np.where(free, 0.0, self.unwind)
        return free * self.gain, drag, self.integral - unwind * self.gain, -unwind


# Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

Touching = Callable[[Array], Contact | None]
"""Motor positions (n,) -> the contact near there, None where nothing is near."""


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
        model: the arm.
        body: links and payload.
        loops: the drives; references and feed-forwards are set there.
        touching: contact near a posture.
        effects: what acts; whether there is gravity is the body's.
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
        self.contact: Contact | None = None
        self._touching = touching
        self._joints_per_motor = joints_per_motor(model)
        self._rotors = np.diag([joint.rotor_inertia for joint in model.joints])
        self._take(self._rotors, np.zeros(model.n))

    def hold(self, y: Array) -> None:
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

    def _driven(self, theta: Array, rate: Array) -> tuple[Array, Array]:
        """Mass matrix and bias of links and rotors in motor coordinates."""
        back = self._joints_per_motor
        mass, bias = self.body.terms(back @ theta, back @ rate)
        return back.T @ mass @ back + self._rotors, back.T @ bias

    def _take(self, mass: Array, bias: Array) -> None:
        self.mass, self.bias = mass, bias
        self.inverse: Array = np.asarray(np.linalg.inv(mass), dtype=np.float64)

    def resting(self, theta: Array) -> Array:
        """(3n,) state at rest that the drives hold: the integrators carry the weight.

        Args:
            theta: (n,) motor positions, rad.
        """
        still = np.zeros(self.positions)
        bias = self._driven(theta, still)[1] if self.effects.links else still
        return np.concatenate((theta, still, bias))

    def rate(self, t: float, y: Array) -> Array:
        """f(t, y)."""
        if not self.held:
            self.hold(y)
        x, v, _ = y.reshape(3, -1)
        return self._rate(v, self.loops.drives(t, y), self.contact.push(x, v) if self.contact is not None else None)

    def _rate(self, v: Array, drives: Drives, push: Array | None) -> Array:
        loops = self.loops
        net = drives.given - self.bias - loops.viscous * v - loops.coulomb * np.tanh(v / STICTION_RATE)
        if push is not None:
            net += push
        wound = loops.integral * drives.error - loops.unwind * (drives.asked - drives.given)
        return np.concatenate((v, self.inverse @ net, wound))

    def drift(self, t: float, y: Array) -> Array:
        """Partial derivative of f by t: the reference moves on."""
        by_error, _, sum_by_error, _ = self.loops.slopes(y.reshape(3, -1)[1], self.loops.drives(t, y))
        return self._drift(by_error, sum_by_error)

    def _drift(self, by_error: Array, sum_by_error: Array) -> Array:
        pull = self.loops.slope * self.loops.position
        return np.concatenate((np.zeros(self.positions), self.inverse @ (by_error * pull), sum_by_error * pull))

    def jacobian(self, t: float, y: Array) -> Array:
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

    def linearised(self, t: float, y: Array, g: float) -> Linearised:
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

        def solve(r: Array) -> Array:
            first, second, third = r.reshape(3, -1)
            third = third - first_back * first
            torque = fed * third - by_theta * first
            if pushed is not None:
                torque -= springs @ first
            rates = inverse @ (self.mass @ second + torque)
            return np.concatenate((first + g * rates, rates, leak * (third - back * rates)))

        rate = self._rate(v, drives, None if pushed is None else pushed[0])
        return Linearised(rate, self._drift(by_error, sum_by_error), solve)
