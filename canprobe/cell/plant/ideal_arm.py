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


class Reference:
    """Reference of one motor: straight ramps of counts, one after the other; the end of a ramp is held.

    Args:
        counts: position until the first ramp.
    """

    __slots__ = ("_ramps",)

    def __init__(self, counts: float) -> None:
        self._ramps: list[Ramp] = [(-1, -1, counts, counts)]

    def add(self, ramp: Ramp, now_ns: int) -> None:
        """Follow a ramp from its start on, or from now on where it began in the past; drops what was to come later.

        Args:
            ramp: not before the ramps that act already.
            now_ns: the present time.
        """
        last = self._ramps[-1]
        if last[0] <= now_ns and last[0] < ramp[0]:  # the usual case, in every cycle
            self._ramps = [last, ramp]
            return
        start = max(ramp[0], now_ns)
        kept = [r for r in self._ramps if r[0] < start]
        past = [r for r in kept if r[0] <= now_ns]
        self._ramps = [*past[-1:], *kept[len(past) :], ramp]

    def at(self, t_ns: int) -> tuple[float, float]:
        """Reference (counts) and its slope (counts/s) from t on.

        Args:
            t_ns: not before the last ramp that began.
        """
        t0, t1, start, end = self._ramps[-1]
        if t0 > t_ns:
            t0, t1, start, end = next(r for r in reversed(self._ramps) if r[0] <= t_ns)
        if t_ns >= t1:
            return end, 0.0
        slope = (end - start) / (1e-9 * (t1 - t0))
        return start + slope * 1e-9 * (t_ns - t0), slope

    def next_bend(self, t_ns: int) -> int:
        """First time after t at which the slope may change, ns.

        Args:
            t_ns: ns.
        """
        bend = NEVER
        for t0, t1, _, _ in self._ramps:
            if t_ns < t0 < bend:
                bend = t0
            if t_ns < t1 < bend:
                bend = t1
        return bend


class _Axis:
    """One loop: its state at an anchor time, and the reference that it follows from there."""

    __slots__ = ("event_ns", "lag", "q", "r", "reference", "slope", "t_ns", "v")

    def __init__(self, q: float, lag: float) -> None:
        self.lag, self.reference = lag, Reference(q)
        self.anchor(0, (q, 0.0, q))

    def anchor(self, t_ns: int, state: State) -> None:
        """Begin anew at a time, in a state."""
        self.t_ns, (self.q, self.v, _) = t_ns, state
        self.r, self.slope = self.reference.at(t_ns)
        self.event_ns = self.reference.next_bend(t_ns)

    def at(self, phi: Transition, tau: float) -> State:
        """Position, rate and reference at a time before the next event."""
        p11, p12, p21, p22 = phi
        e, de = self.q - self.r + self.lag * self.slope, self.v - self.slope
        r = self.r + self.slope * tau
        return r - self.lag * self.slope + p11 * e + p12 * de, self.slope + p21 * e + p22 * de, r


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
        a, states = self._axes[axis], self._evaluated or self._states()
        a.reference.add((t0_ns, t1_ns, start_counts, end_counts), self.t_ns)
        a.anchor(self.t_ns, states[axis])
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
            while self.t_ns > a.event_ns:
                span_ns = a.event_ns - a.t_ns
                a.anchor(a.event_ns, a.at(self._transition(span_ns), 1e-9 * span_ns))
            dt_ns = self.t_ns - a.t_ns
            states.append(a.at(self._transition(dt_ns), 1e-9 * dt_ns))
        return states
