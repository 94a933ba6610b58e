"""Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators, which are here too.

State (18): motor angles (rad), their rates (rad/s), the integrators of the six velocity loops (N m); all in motor
coordinates. Mass matrix, bias (gravity, Coriolis) and the geometry of the contact can be held over a while
(``hold``), which is the usual way, or evaluated in every call (``held=False``), which is the reference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt, tanh
from types import MappingProxyType
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from canprobe.emulator.plant.ideal_arm import PEAK_PERMILLE, STICTION_RATE, natural_frequency
from canprobe.emulator.plant.pushing import Contact
from canprobe.robot.dynamics import RigidBody, dense
from canprobe.robot.model import ArmModel, joints_per_motor

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

Array = npt.NDArray[np.float64]

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


@dataclass(frozen=True, slots=True)
class DriveSettings:
    """How the six drives are tuned.

    Args:
        bandwidth_hz: -3 dB frequency of position.
        damping_ratio: 1 is critical.
        integral_s: reset time of the velocity loop; 0 for none.
        velocity_feed_forward: share of the reference's speed that is added behind the position loop; 1 removes the lag.
        torque_limit_permille: of the continuous torque.
    """

    bandwidth_hz: float = 30.0
    damping_ratio: float = 1.0
    integral_s: float = 0.02
    velocity_feed_forward: float = 0.0
    torque_limit_permille: int = PEAK_PERMILLE


class Cascade:
    """Gains of six drives, motor coordinates, SI.

    Args:
        settings: the tuning.
        inertia: (6,) what each drive takes for its motor's inertia, kg m^2.
        model: the arm, for the rated torques.
    """

    def __init__(self, settings: DriveSettings, inertia: Array, model: ArmModel) -> None:
        w, z = natural_frequency(settings.bandwidth_hz, settings.damping_ratio), settings.damping_ratio
        self.position = w / (2.0 * z)
        self.velocity: Array = 2.0 * z * w * inertia
        self.integral: Array = self.velocity / settings.integral_s if settings.integral_s > 0.0 else 0.0 * inertia
        self.unwind = 1.0 / settings.integral_s if settings.integral_s > 0.0 else 0.0
        self.share = settings.velocity_feed_forward
        rated = np.array([joint.rated_torque for joint in model.joints])
        self.limit: Array = rated * (1e-3 * settings.torque_limit_permille)

    @property
    def lag_s(self) -> float:
        """How far a motor stays behind a steady ramp, s."""
        return (1.0 - self.share) / self.position


# The six drive loops in plain floats: what each motor gives for what it is asked.

Drives = tuple[list[float], list[float], list[float]]
"""Velocity error, torque asked for and torque given, of every motor."""


class LoopSlopes(NamedTuple):
    """(6,) each: slope of torque by velocity error, by angle, by rate and by integrator; slope of the integrator's own
    rate by velocity error and by itself."""

    gain: Array
    by_theta: Array
    by_rate: Array
    by_sum: Array
    sum_by_error: Array
    sum_by_sum: Array


class DriveLoops:
    """Position and velocity loops, torque limits and friction of the six motors, on straight references.

    Args:
        cascade: the drives.
        model: the arm, for its friction.
        friction: whether motors and gears rub.

    Attributes:
        start, slope: (6,) reference at time 0 (rad) and its slope (rad/s).
        ahead, fed: (6,) speed (rad/s) and torque (N m) added behind the position and the velocity loop.
        gain, integral, limit: (6,) of the velocity loops and the largest torque.
        viscous, coulomb: (6,) friction.
    """

    def __init__(self, cascade: Cascade, model: ArmModel, *, friction: bool) -> None:
        on = 1.0 if friction else 0.0
        self.cascade = cascade
        self.position, self.unwind = cascade.position, cascade.unwind
        self.viscous, self.coulomb = [on * j.viscous for j in model.joints], [on * j.coulomb for j in model.joints]
        self.gain: list[float] = cascade.velocity.tolist()
        self.integral: list[float] = cascade.integral.tolist()
        self.limit: list[float] = cascade.limit.tolist()
        self.fed, self._speed_fed = [0.0] * 6, [0.0] * 6
        self.set_reference(0.0, (0.0,) * 6, (0.0,) * 6)

    def set_reference(self, t: float, theta: Sequence[float], slope: Sequence[float]) -> None:
        """Straight reference of all motors from now on.

        Args:
            t: s.
            theta: (6,) at t, rad.
            slope: (6,) rad/s.
        """
        self.start = [x - v * t for x, v in zip(theta, slope, strict=True)]
        self.slope = list(slope)
        self._add_speeds()

    def set_loop(self, axis: int, limit: float, speed: float, torque: float) -> None:
        """Torque limit and feed-forwards of one motor from now on.

        Args:
            axis: 0 to 5.
            limit: largest torque, N m; the cascade's own if that is less.
            speed: added behind the position loop, rad/s.
            torque: added behind the velocity loop, N m.
        """
        self.limit[axis] = min(limit, float(self.cascade.limit[axis]))
        self._speed_fed[axis], self.fed[axis] = speed, torque
        self._add_speeds()

    def _add_speeds(self) -> None:
        self.ahead = [self.cascade.share * v + f for v, f in zip(self.slope, self._speed_fed, strict=True)]

    def drives(self, t: float, y: Sequence[float]) -> Drives:
        """What the cascades do.

        Args:
            t: s.
            y: (18,) state of the arm.
        """
        kp = self.position
        errors, asked, given = [], [], []
        for start, slope, ahead, gain, fed, limit, x, v, s in zip(
            self.start, self.slope, self.ahead, self.gain, self.fed, self.limit, y[:6], y[6:12], y[12:], strict=True
        ):
            error = kp * (start + slope * t - x) + ahead - v
            torque = gain * error + s + fed
            errors.append(error)
            asked.append(torque)
            given.append(limit if torque > limit else -limit if torque < -limit else torque)
        return errors, asked, given

    def slopes(self, rates: Sequence[float], drives: Drives) -> LoopSlopes:
        """Slopes of every motor's torque, friction included, and of its integrator's rate.

        Args:
            rates: (6,) of the motors, rad/s.
            drives: what the cascades do.
        """
        found = []
        for asked, given, rate, gain, integral, viscous, coulomb in zip(
            *drives[1:], rates, self.gain, self.integral, self.viscous, self.coulomb, strict=True
        ):
            free = asked == given
            slope, held = (gain, 0.0) if free else (0.0, self.unwind)
            bent = tanh(rate / STICTION_RATE)
            drag = viscous + coulomb / STICTION_RATE * (1.0 - bent * bent)
            found.append((slope, -self.position * slope, -slope - drag, float(free), integral - held * gain, -held))
        return LoopSlopes(*np.array(found).T)


# Equations of motion of the driven arm in contact, as a ``Problem`` for the integrators.

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
        self.loops = DriveLoops(cascade, body.model, friction=effects.friction)
        self.contact: Contact | None = None
        self._touching = touching
        rotors = [joint.rotor_inertia for joint in body.model.joints]
        self._driven = body.along(joints_per_motor(body.model), rotors, weight=effects.gravity)
        alone = [x if i == j else 0.0 for i, x in enumerate(rotors) for j in range(i + 1)]
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
