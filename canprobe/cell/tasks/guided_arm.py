"""An enabled arm that a person guides: it holds its place, and moves as long as somebody renews the motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.units import stated_lag_s
from canprobe.cell.tasks.hand_motion import HandMotion
from canprobe.cell.tasks.hand_way import HandWay
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.port import nothing
from canprobe.mechanics.types import Floats

LIFETIME_S = 0.15
"""Time from the last renewal of a motion until the arm stands, s."""
RENEWED_S = 0.02
"""Time in which a screen renews a motion."""
SETTLE_LAGS, PROFILE_LAGS = 3.0, 1.3
"""Time from the last motion of the targets until the joints stand, in lags of the drives and of profile position.

In profile position a drive is its way to stop behind: v' = a (w / v - 1), where the speed w of the targets falls by a.
By the solution it stands 0.55 v / a after them, and its lag was 0.5 v / a.
"""
USUAL_LAG_S = 6.8e-3
"""Lag of real drives for which nothing is stated, s, as `servo.drive_lag_ms` has it by default."""
CYCLES = 3
"""Cycles from a renewal to the one that takes it, to the one of the last target, and to the SYNC that brings that."""


class GuidedArm(Controller):
    """Holds the arm where it is, and lets one motion after the other go, each as long as it is renewed.

    Args:
        plan: plan of a cell with an arm.
        attend: called in each cycle before the motion goes on, such as to take what a person asks for.
        update: called in each cycle once its commands are on the bus.

    Attributes:
        target: joint positions (n,), rad or m, that the drives have; None before they are enabled.
        motion: the motion that goes on, or has gone last; None before the first.
        moves: whether it goes on.
        leaves: whether the arm is to be disabled as soon as it rests.
        stop_reason: why it is stopped at once; None where it is not.
    """

    def __init__(self, plan: Plan, attend: Callable[[Measurement], None], update: Callable[[], None] = nothing) -> None:
        self._plan, self._attend, self._update = plan, attend, update
        self.reader = make_patch_reader(plan.setup)
        settle_s = SETTLE_LAGS * (stated_lag_s(plan.setup) or USUAL_LAG_S)
        settle_ns = round(1e9 * (settle_s + PROFILE_LAGS * plan.setup.needed_arm().profile_lag))
        self._standing_ns = settle_ns + CYCLES * plan.sync.period_ns
        if 1e-9 * self._standing_ns + RENEWED_S >= LIFETIME_S:
            raise UsageError(
                f"at cycle.rate_hz = {plan.setup.rate_hz:g} and with this lag of the drives the arm cannot stand within"
                f" {1e3 * LIFETIME_S:.0f} ms: expected a higher rate; `canprobe move` goes by this one"
            )
        self._now_ns = self._renewed_ns = 0
        self.target: Floats | None = None
        self.motion: HandMotion | None = None
        self.moves = self.leaves = False
        self.stop_reason: str | None = None

    def inspect(self, q: Floats) -> str | None:
        self.target = q
        return None

    def go(self, way: HandWay, begin: float = 0.0) -> None:
        """Begin a motion along a way, from a place of it on, where the arm stands."""
        self.motion, self.moves = HandMotion(self._plan, way, self._wanted, begin=begin, reader=self.reader), True
        self.renew()

    def renew(self) -> None:
        """Let the motion go on for another `LIFETIME_S`."""
        self._renewed_ns = self._now_ns

    def end_motion(self) -> None:
        """Let the motion brake."""
        self._renewed_ns = self._now_ns - round(1e9 * LIFETIME_S)

    def brake(self, interrupt: KeyboardInterrupt) -> bool:
        return self.moves and self.motion is not None and self.motion.brake(interrupt)

    def step(self, measurement: Measurement) -> Command:
        self._now_ns = measurement.t_ns
        self._attend(measurement)
        if self.stop_reason is not None or self.motion is None or not self.moves:
            return Command(self.target, done=self.leaves, stop_reason=self.stop_reason)
        command = self.motion.step(measurement)
        self.target, self.moves = command.q_target, not command.done
        return replace(command, done=False)

    def update(self) -> None:
        self._update()

    def _wanted(self) -> bool:
        """Whether the motion is renewed so recently that it comes to rest in time, if it brakes in the next cycle."""
        assert self.motion is not None
        stop_ns = round(1e9 * self.motion.stop_s) + self._standing_ns
        return not self.leaves and self._now_ns + stop_ns < self._renewed_ns + round(1e9 * LIFETIME_S)
