"""Ideal arm: decoupled second-order position loops, one per motor, solved exactly.

Each motor position q (counts) follows its reference r: ``q'' = w^2 (r - q) - 2 w q'``. References are ramps, for
which the solution is closed: behind a steady ramp by the lag 2/w, plus a decaying transient. The state is a function
of time alone: calling ``advance`` more or less often changes nothing. The object's push moves no joint: it only shows
in the torque that the drives report. Not modelled: gravity, coupling of the links, saturation.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import exp, pi, sqrt, tanh

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.robot.model import ArmModel, joints_to_units

PEAK_PERMILLE = 2000
"""Peak torque of a drive, permille of its rated torque (assumed)."""
STICTION_RATE = 0.01
"""Speed over which the Coulomb torque changes its sign, rad/s; of a prismatic joint m/s."""
NEVER = 1 << 62
"""A time, ns, that no run reaches."""
Ramp = tuple[int, int, float, float]
"""Of a reference: start and end time (ns), start and end (counts)."""
Transition = tuple[float, float, float, float]
State = tuple[float, float, float]
"""Position, rate and reference of one motor: counts, counts/s, counts."""


def natural_frequency(bandwidth_hz: float) -> float:
    """Undamped frequency w in rad/s of the critically damped loop whose response falls by 3 dB at ``bandwidth_hz``."""
    return 2 * pi * bandwidth_hz / sqrt(sqrt(2.0) - 1.0)


def transition(w: float, t: float) -> Transition:
    """Transition matrix (rows of position and rate) of ``e'' = -w^2 e - 2 w e'`` over t seconds.

    Args:
        w: undamped frequency, rad/s.
        t: s.
    """
    decay = exp(-w * t)
    grown = decay * t
    return decay + w * grown, grown, -w * w * grown, decay - w * grown


class _Axis:
    """One loop: its state at an anchor time, the ramp that acts from there, and ramps to come."""

    __slots__ = ("coming", "end", "end_ns", "event_ns", "lag", "q", "r", "slope", "t_ns", "v")

    def __init__(self, q: float, lag: float) -> None:
        self.t_ns, self.q, self.v, self.r, self.slope = 0, q, 0.0, q, 0.0
        self.end, self.end_ns, self.event_ns, self.lag = q, NEVER, NEVER, lag
        self.coming: list[Ramp] = []

    def at(self, phi: Transition, tau: float) -> State:
        """Position, rate and reference at a time before the next event."""
        p11, p12, p21, p22 = phi
        e, de = self.q - self.r + self.lag * self.slope, self.v - self.slope
        r = self.r + self.slope * tau
        return r - self.lag * self.slope + p11 * e + p12 * de, self.slope + p21 * e + p22 * de, r

    def begin(self, ramp: Ramp) -> None:
        """Follow a ramp from the anchor on (the anchor is at or after the ramp's start)."""
        t0, t1, start, end = ramp
        if self.t_ns >= t1:
            self.r, self.slope, self.end_ns = end, 0.0, NEVER
        else:
            self.slope = (end - start) / (1e-9 * (t1 - t0))
            self.r, self.end, self.end_ns = start + self.slope * 1e-9 * (self.t_ns - t0), end, t1
        self.plan_event()

    def plan_event(self) -> None:
        self.event_ns = min(self.end_ns, self.coming[0][0]) if self.coming else self.end_ns

    def pass_event(self) -> None:
        """The anchor stands at the next event: end of the ramp or start of a coming one."""
        if self.coming and self.coming[0][0] <= self.t_ns:
            self.begin(self.coming.pop(0))
        else:
            self.r, self.slope, self.end_ns = self.end, 0.0, NEVER
            self.plan_event()


class IdealArm:
    """Motors that track ramps of counts with equal bandwidth.

    Args:
        model: the arm.
        q0: (n,) joint positions at time 0, at rest, rad or m.
        bandwidth_hz: -3 dB frequency of every loop.

    Attributes:
        push: gives the object's push now, (n,) torques on the motors in motor coordinates, N m or N. It is asked for
            only where a torque is: an arm whose drives report none costs no contact.
    """

    def __init__(self, model: ArmModel, q0: npt.ArrayLike, bandwidth_hz: float = 30.0) -> None:
        self.model = model
        self.w = w = natural_frequency(bandwidth_hz)
        self.lag_s = 2.0 / w
        """Lag of the motors behind a steady ramp, s."""
        self._stiffness, self._damping = w * w, 2 * w
        self.t_ns = 0
        self._axes = [_Axis(c, self.lag_s) for c in joints_to_units(model, q0).tolist()]
        self._transition = lru_cache(maxsize=256)(lambda dt_ns: transition(w, 1e-9 * dt_ns))
        rows = [[(motor, share) for motor, share in enumerate(row) if share] for row in model.q_per_unit.tolist()]
        own = np.diag(model.units_per_q).tolist()
        self._loads = [  # a drive reports torque in its own sense
            (row, j.rotor_inertia, j.viscous, j.coulomb, j.rated_torque if units > 0.0 else -j.rated_torque)
            for row, j, units in zip(rows, model.joints, own, strict=True)
        ]
        self._evaluated: list[State] | None = None
        free = (0.0,) * model.n
        self.push: Callable[[], Sequence[float]] = lambda: free

    def set_ramp(self, axis: int, start_counts: float, end_counts: float, t0_ns: int, t1_ns: int) -> None:
        """Give one motor a ramp; it holds the end afterwards. Replaces whatever was to come from t0 on.

        A ramp that began in the past acts from the present time on.

        Args:
            axis: number of the motor, from 0.
            start_counts: reference at t0.
            end_counts: reference at t1 and after.
            t0_ns: start.
            t1_ns: end; not after t0 for a step.
        """
        a = self._axes[axis]
        ramp = (t0_ns, t1_ns, start_counts, end_counts)
        if t0_ns > self.t_ns:
            a.coming = [*(r for r in a.coming if r[0] < t0_ns), ramp]
            a.plan_event()
            return
        states = self._evaluated or self._states()
        a.t_ns, (a.q, a.v, a.r) = self.t_ns, states[axis]
        a.coming.clear()
        a.begin(ramp)
        states[axis] = (a.q, a.v, a.r)  # the other motors know nothing of this ramp

    def advance(self, t_ns: int) -> None:
        """Move the present time on; earlier times and repeats change nothing.

        Args:
            t_ns: ns.
        """
        if t_ns > self.t_ns:
            self.t_ns = t_ns
            self._evaluated = None

    def motors(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Positions (counts) and rates (counts/s) of the motors now."""
        positions, rates, _ = zip(*(self._evaluated or self._states()), strict=True)
        return positions, rates

    def motor_counts(self, axis: int) -> float:
        """Position of one motor now, counts, continuous.

        Args:
            axis: number of the motor, from 0.
        """
        return (self._evaluated or self._states())[axis][0]

    def torque_permille(self, axis: int) -> int:
        """Torque of one joint over its continuous limit, as a drive reports it (6077h).

        Model: reflected motor inertia, viscous and Coulomb friction, and what the motor gives against the object's
        push; no gravity, no link inertia.

        Args:
            axis: number of the motor, from 0.

        Returns:
            Permille, within the peak of +-2000.
        """
        stiffness, damping = self._stiffness, self._damping
        row, inertia, viscous, coulomb, rated = self._loads[axis]
        states = self._evaluated or self._states()
        rate = acceleration = 0.0
        for motor, share in row:
            q, v, r = states[motor]
            rate += share * v
            acceleration += share * (stiffness * (r - q) - damping * v)
        torque = inertia * acceleration + viscous * rate
        torque += coulomb * tanh(rate / STICTION_RATE) - self.push()[axis]
        permille = round(1000.0 * torque / rated)
        return max(-PEAK_PERMILLE, min(PEAK_PERMILLE, permille))

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        """Do nothing: these motors follow their reference whatever torque that takes.

        Args:
            axis: number of the motor, from 0.
            limit_permille, speed, torque_permille: see ``DynamicArm.set_loop``.
        """

    def _states(self) -> list[State]:
        """All states at once. At the very end of a ramp its own formula still holds."""
        self._evaluated = states = []
        for a in self._axes:
            if self.t_ns > a.event_ns or a.coming:
                self._pass_events(a)
            dt_ns = self.t_ns - a.t_ns
            states.append(a.at(self._transition(dt_ns), 1e-9 * dt_ns))
        return states

    def _pass_events(self, a: _Axis) -> None:
        """Anchor a loop at the last event up to now."""
        while self.t_ns >= a.event_ns:
            span_ns = a.event_ns - a.t_ns
            a.q, a.v, a.r = a.at(self._transition(span_ns), 1e-9 * span_ns)
            a.t_ns = a.event_ns
            a.pass_event()
