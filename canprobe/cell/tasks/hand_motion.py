"""One motion that a person asks for, watched: it brakes when nobody wants it, and goes back from what it touches.

The drives follow a way that was looked at as a whole (`hand_way`). What the array feels on it ends the motion, and the
probe goes back the way that it came, which was free; joints that do not follow are seen by the supervision.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import numpy as np

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.patch_reader import PatchReader
from canprobe.cell.planning.model import Plan
from canprobe.cell.tasks.hand_way import HandWay
from canprobe.cell.tasks.task import MotionTime
from canprobe.mechanics.robot.motion_profile import MotionProfile
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.types import Floats

ELSEWHERE_RAD = 0.002
"""Distance from the way's start, rad, by which an arm has been moved since; of a sliding joint by `ArmModel.radian`."""
ARRIVAL_S = 0.5
"""Longest time from the end of the way until the joints have arrived, s."""
UNWANTED = "no longer asked for"
BACK_M = 5e-3
"""Way of the probe back from what it has touched, m."""


class HandMotion(Controller):
    """Follows a way once.

    Args:
        plan: plan of a cell with an arm.
        way: the way, from where the arm stands.
        renewed: asked in each cycle whether the motion is still wanted; where it is not, it brakes.
        begin: place of the way from which it goes.
        reader: reader of the tactile samples; None makes one.

    Attributes:
        place: place of the way where the motion is.
        stop_s: time in which it would come to rest now, s.
        ended_by: why the motion ended before its end; None where it did not.
    """

    def __init__(
        self,
        plan: Plan,
        way: HandWay,
        renewed: Callable[[], bool] = lambda: True,
        *,
        begin: float = 0.0,
        reader: PatchReader | None = None,
    ) -> None:
        arm = plan.setup.needed_arm()
        self._model, self._way, self._renewed = arm.model, way, renewed
        self._jog_force = plan.setup.limits.jog_force
        self._count = np.abs(arm.model.q_per_unit).sum(axis=1)
        self.reader = reader or make_patch_reader(plan.setup)
        self._time = MotionTime(plan.sync.period_ns)
        self._motion = way.profile(begin)
        self._back: MotionProfile | None = None
        self._t = self._touched_at = self.stop_s = 0.0
        self._begin = self.place = begin
        self._late_ns = 0
        self._interrupt: KeyboardInterrupt | None = None
        self.ended_by: str | None = None

    def inspect(self, q: Floats) -> str | None:
        away = np.abs(q - self._way.q[0]) / self._model.radian
        if away.max() <= ELSEWHERE_RAD:
            return None
        joint = int(away.argmax())
        its = self._model.joints[joint]
        stands, was = its.text(q[joint], ".2f"), its.text(self._way.q[0][joint], ".2f")
        return f"joint {joint + 1} stands at {stands}, and was at {was} when the way was planned: plan it again"

    def brake(self, interrupt: KeyboardInterrupt) -> bool:
        self._end("interrupted")
        self._interrupt = interrupt
        return True

    def step(self, measurement: Measurement) -> Command:
        self._t += 1e-9 * self._time.step(measurement.t_ns)
        self._feel(measurement)
        if self.ended_by is None:
            stop = copy(self._motion)
            stop.brake(self._t)
            self.stop_s = stop.duration_s - self._t
            if not self._renewed():
                self._end(UNWANTED)
            # up to where it would stop now, and a place more: in the next cycle it would stop further on
            elif (why := self._way.look(self._begin + stop.length + 1.0)) is not None:
                self._end(why)
        motion = self._motion if self._back is None else self._back
        gone = motion.at(self._t)[0]
        self.place = self._begin + gone if self._back is None else self._touched_at - gone
        q = self._way.at(self.place)
        if self._t < motion.duration_s:
            return Command(q)
        self._late_ns = self._late_ns or measurement.t_ns + round(1e9 * ARRIVAL_S)
        assert measurement.q is not None
        if measurement.t_ns < self._late_ns and (np.abs(measurement.q - q) > self._count).any():
            return Command(q)
        if self._interrupt is not None:
            raise self._interrupt
        return Command(q, done=True, stop_reason=self.ended_by if self._back is not None else None)

    def _end(self, why: str) -> None:
        """Brake, once."""
        self.ended_by = why
        self._motion.brake(self._t)

    def _feel(self, measurement: Measurement) -> None:
        """Begin the way back where the array shows the force of a jog."""
        sample = measurement.tactile
        if self.reader is None or sample is None or self._back is not None:
            return
        force = self.reader.read(sample).force
        if force < max(self._jog_force, TOUCH_FORCE):
            return
        self._touched_at = self._begin + self._motion.at(self._t)[0]
        self.ended_by = (
            f"the array showed {force:.2f} N (limits.jog_force_n = {self._jog_force:g}) after {self._t:.1f} s: the"
            " probe went back the way that it came"
        )
        way = self._way
        length = min(self._touched_at, BACK_M / max(way.tip_way(), 1e-9))
        self._back, self._t = MotionProfile(length, way.speed, way.acceleration, way.jerk), 0.0
