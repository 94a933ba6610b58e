"""The reference that one drive gives to its axis of the plant: ramps, trajectories, hold, slowing to standstill."""

from __future__ import annotations

from collections.abc import Callable
from math import inf
from typing import Protocol

from canprobe.fieldbus.drive.profile import MotorDynamics, Profile, Rates, braking, trapezoid
from canprobe.fieldbus.node.timers import Timers

STEP_NS = 2_500_000
"""Time between two steps of a motion that the drive makes itself."""
STANDSTILL_COUNTS = 0.1
"""Motion in one step below which the motor counts as at rest."""
MAX_WAIT_STEPS = 400
"""Most steps that standstill is waited for: one second."""
END_TOLERANCE_S = 1e-9
"""Remaining time of a trajectory below which it has ended."""

Done = Callable[[int], None] | None
"""Called with the time, ns, when a motion is over."""


class AxisPlant(Protocol):
    """The plant as a drive needs it. Positions are motor counts; calls at one instant are idempotent."""

    def begin(self, t_ns: int) -> None:
        """Let time pass from `t_ns` on, if it does not yet: a SYNC came, or a drive was enabled without one."""

    def advance(self, t_ns: int) -> None:
        """Bring the plant to `t_ns`."""

    def motor_counts(self, axis: int) -> float:
        """True motor position, counts."""

    def torque_permille(self, axis: int) -> int:
        """Motor torque, 1/1000 of the rated torque."""

    def limit_switches(self, axis: int) -> tuple[float, float]:
        """Motor positions (counts) at and beyond which the limit switches are active, lower first; infinite for none.

        Where motors are coupled they follow from where the other motors are now.
        """

    def motor_dynamics(self, axis: int) -> MotorDynamics:
        """Answer of the motor to torque."""

    def set_loop(self, axis: int, limit_permille: int, speed: float, torque_permille: float) -> None:
        """Set limit and feed-forward of the position loop; called when one of them changes.

        Args:
            axis: number of the axis, 0-based.
            limit_permille: largest torque, 1/1000 of the rated torque.
            speed: speed that is added behind the position loop, counts/s.
            torque_permille: torque that is added behind the velocity loop, 1/1000 of the rated torque.
        """

    def set_ramp(self, axis: int, start_counts: float, end_counts: float, t0_ns: int, t1_ns: int) -> None:
        """Follow a straight reference from `t0_ns` to `t1_ns`, then hold its end."""


class Motion:
    """Reference of one axis, with the last ramp that it gave.

    A trajectory goes to the plant as straight ramps of one step each, whose ends lie on it.

    Attributes:
        axis: number of the axis in the plant, 0-based.
        plant: plant, which the drives share.
        blocked: whether the motor gets no reference, as with a stuck brake.
    """

    blocked = False

    def __init__(self, axis: int, plant: AxisPlant, timers: Timers) -> None:
        self.axis, self.plant = axis, plant
        self._timer = timers.new(self._step)
        self._start = self._end = 0.0
        self._t0 = self._t1 = 0
        self._trajectory: Profile | None = None
        self._begin_ns = 0
        self._patience = 0
        self._was = 0.0
        self._done: Done = None

    @property
    def busy(self) -> bool:
        """Whether a trajectory or a deceleration is under way."""
        return self._timer.due_ns is not None

    def hold(self, t_ns: int) -> float:
        """Hold the motor where it is; return that position, counts."""
        self._stop()
        self.plant.advance(t_ns)
        here = self.plant.motor_counts(self.axis)
        self._ramp(here, here, t_ns, t_ns + STEP_NS)
        return here

    def onset(self, t_ns: int) -> float:
        """Start of a new ramp, counts: the target before it, whenever the SYNC comes, or a place on the trajectory."""
        return self._end if self._timer.due_ns is None else self.demand(t_ns)

    def reach(self, onset: float, counts: float, t_ns: int, end_ns: int) -> None:
        """Move the reference from `onset` to `counts`, from now to `end_ns`."""
        if self._timer.due_ns is not None:
            self._stop()
        self._start, self._end, self._t0, self._t1 = onset, counts, t_ns, end_ns  # inlined `_ramp`, for speed
        if not self.blocked:
            self.plant.set_ramp(self.axis, onset, counts, t_ns, end_ns)

    def demand(self, t_ns: int) -> float:
        """The reference at `t_ns`, counts."""
        if t_ns >= self._t1:
            return self._end
        return self._start + (self._end - self._start) * max(0, t_ns - self._t0) / (self._t1 - self._t0)

    def speed(self, t_ns: int) -> float:
        """Speed of the reference, counts/s; a ramp that has just ended still counts, as SYNC comes when it ends."""
        if self._trajectory is not None:
            return self._trajectory.at((t_ns - self._begin_ns) * 1e-9)[1]
        moving = self._t0 <= t_ns <= self._t1 + STEP_NS // 2
        return (self._end - self._start) / (self._t1 - self._t0) * 1e9 if moving else 0.0

    def move(self, target: float, t_ns: int, rates: Rates, done: Done = None) -> None:
        """Move to `target`, counts, from the present position and speed, as `follow` does."""
        self.follow(trapezoid(self.demand(t_ns), self.speed(t_ns), target, rates), t_ns, done)

    def follow(self, trajectory: Profile, t_ns: int, done: Done = None) -> None:
        """Follow a trajectory from now on; call `done(t_ns)` when the motor is at rest at its end."""
        self._trajectory, self._begin_ns, self._done = trajectory, t_ns, done
        self._patience, self._was = MAX_WAIT_STEPS, inf
        if trajectory.duration_s < END_TOLERANCE_S:
            here = self.demand(t_ns)
            self._ramp(here, here, t_ns, t_ns + STEP_NS)
        self._step(t_ns)

    def decelerate(self, t_ns: int, rate: float, done: Done = None) -> None:
        """Slow the reference down by `rate` counts/s² and call `done(t_ns)` at standstill, one step from now or later.

        Standstill is that of the motor, not of the reference; it is waited for, a second at most. A rate of 0 stops the
        reference at once.
        """
        here, speed = self.demand(t_ns), self.speed(t_ns) if rate > 0 else 0.0
        if speed:
            self.follow(braking(here, speed, rate), t_ns, done)
            return
        self._stop()
        self.plant.advance(t_ns)
        self._was = self.plant.motor_counts(self.axis)
        self._patience, self._done = MAX_WAIT_STEPS, done
        self._ramp(here, here, t_ns, t_ns + STEP_NS)
        self._timer.arm(t_ns + STEP_NS)

    def _step(self, due_ns: int) -> None:
        trajectory = self._trajectory
        if trajectory is None:
            self._await_standstill(due_ns)
            return
        begun_s = (due_ns - self._begin_ns) * 1e-9
        left_s = trajectory.duration_s - begun_s
        if left_s < END_TOLERANCE_S:
            self._trajectory, self._start = None, self._end  # the ramp that has just ended no longer counts as motion
            self._await_standstill(due_ns)
            return
        step_s = STEP_NS * 1e-9
        last = left_s <= step_s
        step_ns = max(1, round(left_s * 1e9)) if last else STEP_NS
        end = trajectory.at(trajectory.duration_s if last else begun_s + step_s)[0]
        self._ramp(self.demand(due_ns), end, due_ns, due_ns + step_ns)
        self._timer.arm(due_ns + STEP_NS)

    def _await_standstill(self, due_ns: int) -> None:
        if self._done is None:
            return
        self.plant.advance(due_ns)
        here = self.plant.motor_counts(self.axis)
        # of the motor: its reference stands up to 30 ms before
        moved, self._was = abs(here - self._was), here
        self._patience -= 1
        if moved > STANDSTILL_COUNTS and self._patience > 0:
            self._timer.arm(due_ns + STEP_NS)
        else:
            self._done(due_ns)

    def _stop(self) -> None:
        self._timer.cancel()
        self._trajectory = None

    def _ramp(self, start: float, end: float, t0_ns: int, t1_ns: int) -> None:
        self._start, self._end, self._t0, self._t1 = start, end, t0_ns, t1_ns
        if not self.blocked:
            self.plant.set_ramp(self.axis, start, end, t0_ns, t1_ns)

    def block(self, t_ns: int) -> None:
        """Let the motor stay where it is, whatever the reference: the brake is stuck."""
        self.plant.advance(t_ns)
        here = self.plant.motor_counts(self.axis)
        self.plant.set_ramp(self.axis, here, here, t_ns, t_ns + STEP_NS)
        self.blocked = True
