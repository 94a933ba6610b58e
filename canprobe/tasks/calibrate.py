"""Find the probe's centre on the flange: touch a ball of known radius from several sides, gently, and let go."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.controller import Command, Measurement
from canprobe.cell.supervision import TOUCH_FORCE, Contact, Limits
from canprobe.cell.supervisor import touch_finding
from canprobe.robot.tool_calibration import BallModel, BallTouch, ToolEstimate, calibrate_tool
from canprobe.scene.setup import Calibrate
from canprobe.tasks.probing import LineMotion, Phase, ProbeMotion, ProbingTask, smooth_step
from canprobe.tasks.sensing import ContactSensing
from canprobe.tasks.task import TaskRecord
from canprobe.touch.contact import ContactSample, PushFit
from canprobe.touch.servo import ProbePose

# A move round a ball that never comes nearer to it than its ends do.

Vector = NDArray[np.float64]


class ArcMotion:
    """Round a centre: direction along a great circle, distance and pole by a quintic time law.

    Args:
        centre: of the ball (3,), m.
        start: pose to leave, not at the centre.
        end: pose to reach; not opposite to the first.
        speed: mean speed, m/s.
        angular_speed: mean angular speed of the pole, rad/s.
    """

    def __init__(
        self, centre: Vector, start: ProbePose, end: ProbePose, speed: float, angular_speed: float = 0.7
    ) -> None:
        self._centre, self._poles = centre, (start.pole, end.pole)
        a, b = start.centre - centre, end.centre - centre
        self._radii = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        self._a, self._b = a / self._radii[0], b / self._radii[1]
        self._angle = math.acos(max(-1.0, min(1.0, float(self._a @ self._b))))
        pole_angle = math.acos(max(-1.0, min(1.0, float(start.pole @ end.pole))))
        way = math.hypot(self._angle * max(self._radii), self._radii[1] - self._radii[0])
        self.duration = max(way / speed, pole_angle / angular_speed, 0.05)

    def at(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the start; the end pose afterwards."""
        s = smooth_step(t / self.duration)
        if self._angle > 1e-6:
            direction = math.sin((1 - s) * self._angle) * self._a + math.sin(s * self._angle) * self._b
            direction = direction / math.sin(self._angle)
        else:
            direction = self._b
        radius = self._radii[0] + s * (self._radii[1] - self._radii[0])
        pole = self._poles[0] + s * (self._poles[1] - self._poles[0])
        return ProbePose(self._centre + radius * direction, pole / math.sqrt(float(pole @ pole)))


# Find the probe's centre on the flange: touch a ball of known radius from several sides, gently, and let go.

PRESS_SPEED = 0.8e-3
"""m/s, from the first touch to the wanted force: what is still under way then sinks in by 0.02 mm."""
CERTAIN = 0.06
"""Share of itself to which the slope of √F over the push must be known (1σ) for the depth to be read off it."""
SETTLE_S = 0.15
LISTEN_S = 0.25
"""At rest before samples count, and while they do."""
MOVE_SPEED = 40e-3
RETREAT_SPEED = 20e-3


class CalibrateTask(ProbingTask):
    """Touch after touch; the estimate in the end.

    Args:
        task: what to do.
        limits: of the cell; beyond them the probe retreats and the cell stops.
        sensing: contacts from measurements.
        motion_from: makes the probe's motion from the first joint angles.

    Attributes:
        touches: what was felt so far.
        estimate: of the tool; None before the end, or with too few touches.
    """

    def __init__(
        self,
        task: Calibrate,
        limits: Limits,
        sensing: ContactSensing,
        motion_from: Callable[[Vector], ProbeMotion],
    ) -> None:
        super().__init__(task.lag_s, limits, sensing, motion_from)
        sensing.set_kappa(np.full(2, 1.0 / task.ball_radius))
        radii = sensing.radius + task.ball_radius
        self._ball = BallModel(sensing.flange_probe[:3, 3], task.ball_centre, radii, sigma_c=task.ball_sigma)
        self.touches: list[BallTouch] = []
        self.estimate: ToolEstimate | None = None
        self._task = task
        self._line: LineMotion | ArcMotion | None = None
        self._number = 0
        self._gone = 0.0
        self._felt: list[ContactSample] = []
        self._push = PushFit()
        self._depths: list[tuple[float, float]] = []

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        if self._motion is None:
            assert measurement.q is not None
            self._motion = self._motion_from(measurement.q)
            self._move_on()
        self._pass_time(measurement.t_ns)
        self._sense(measurement)
        self._watch(measurement)
        pose = _STEPS[self.phase](self)
        self._t += self._dt
        return self._command(pose)

    def retreat(self, reason: str) -> None:
        """Let go and end for a reason that the cell has."""
        if self.reason is None and self.phase is not Phase.DONE and self._motion is not None:
            self.reason = reason
            self._let_go()

    def stop(self) -> None:
        """Let go, and estimate from what was felt so far."""
        self._number = len(self._task.approaches)
        if self.phase not in (Phase.RETREAT, Phase.DONE) and self._motion is not None:
            self._let_go()

    def record(self) -> TaskRecord:
        """What it knows so far."""
        return replace(super().record(), tool=self.estimate)

    # sensing and supervision

    def _sense(self, measurement: Measurement) -> None:
        patch = self.sensing.step(measurement)
        if patch is None or measurement.tactile is None:
            return
        self._force = patch.force
        self._hidden.add(patch.saturated, measurement.tactile.t_sample_ns)
        touching = patch.force > TOUCH_FORCE / 2
        self._off_pad.add(touching and patch.off_pad, measurement.tactile.t_sample_ns)
        contact = self.sensing.contact(measurement.tactile, patch) if touching else None
        if contact is not None and self.phase in (Phase.APPROACH, Phase.SETTLE):
            self._push.add(self._pushed(contact.T_base_probe[:3, 3]), contact.force_n)
        if self.phase is Phase.SCAN:
            self.taxels = measurement.tactile.frame.taxels
            if contact is not None and self._t > SETTLE_S:
                self._felt.append(contact)
        touch: dict[str, float | Vector] = {"touch": float(self._number + 1)}
        self._columns = self._felt_columns(measurement.tactile, patch, contact) | touch

    def _watch(self, measurement: Measurement) -> None:
        if self.reason is not None or self.phase is Phase.DONE:
            return
        hidden, off_pad = self._hidden.hidden_s, self._off_pad.hidden_s
        age = measurement.tactile_age
        finding = touch_finding(Contact(self._limits, self._force, age, hidden_s=hidden, off_pad_s=off_pad))
        if finding is not None:
            self.retreat(str(finding.error))

    # phases: each returns the pose for this cycle

    def _at(self, gap: float) -> ProbePose:
        """Probe at a distance from the expected ball, with this touch's direction and pole."""
        touch = self._task.approaches[self._number]
        return ProbePose(self._ball.c_base + (self._ball.radii + gap) * touch.n_base, touch.pole_base)

    def _move_on(self) -> None:
        """To the next touch, round the ball; or to the end."""
        assert self._motion is not None
        if self.reason is not None or self._number >= len(self._task.approaches):
            if self.reason is None and len(self.touches) >= 2:
                self.estimate = calibrate_tool(self._corrected(), self._ball)
            return self._enter(Phase.DONE)
        self._push = PushFit()
        self._line = ArcMotion(
            self._ball.c_base, self._motion.pose, self._at(self._task.approach.clearance), MOVE_SPEED
        )
        self._enter(Phase.MOVE)

    def _move(self) -> ProbePose:
        assert self._line is not None
        pose = self._line.at(self._t)
        if self._t >= self._line.duration + self._lead_s + 0.1:
            self._enter(Phase.APPROACH)
        return pose

    def _approach(self) -> ProbePose:
        self._gone = self._task.approach.speed * self._t - self._task.approach.clearance
        if self._force > TOUCH_FORCE:
            self._enter(Phase.SETTLE)
        elif self._gone > self._task.approach.search:
            self.retreat(
                f"touch {self._number + 1}: no ball found up to {self._task.approach.search * 1e3:.0f} mm beyond the"
                " expected place"
            )
        return self._at(-self._gone)

    def _settle(self) -> ProbePose:
        """On, slowly, until the force is there."""
        if self._force >= self._task.force:
            self._felt = []
            self._enter(Phase.SCAN)
        elif self._gone > self._task.approach.search:
            self.retreat(f"touch {self._number + 1}: {self._task.force:g} N are not reached where the ball is expected")
        else:
            self._gone += PRESS_SPEED * self._dt
        return self._at(-self._gone)

    def _listen(self) -> ProbePose:
        if self._t >= SETTLE_S + LISTEN_S:
            if self._felt:
                self.touches.append(self._touch(self._felt))
                self._number += 1
                self._let_go()
            else:
                self.retreat(f"touch {self._number + 1}: no tactile sample while it rested")
        return self._at(-self._gone) if self.phase is Phase.SCAN else self._retreat()

    def _touch(self, felt: Sequence[ContactSample]) -> BallTouch:
        """Mean of the samples of a touch at rest."""
        n = np.mean([contact.n_base for contact in felt], axis=0)
        T_base_probe = felt[len(felt) // 2].T_base_probe.copy()
        T_base_probe[:3, 3] = np.mean([contact.T_base_probe[:3, 3] for contact in felt], axis=0)
        T_base_flange = T_base_probe @ np.linalg.inv(self.sensing.flange_probe)
        d_flange = -(T_base_flange[:3, :3].T @ n) / float(np.linalg.norm(n))
        depth = float(np.mean([self.sensing.depth(contact.force_n) for contact in felt]))
        if self._push.certain(CERTAIN):
            self._depths.append((depth, self._pushed(T_base_probe[:3, 3]) - self._push.start))
        return BallTouch(T_base_flange, d_flange, depth)

    def _pushed(self, centre: Vector) -> float:
        """Way of the probe's centre (3,), m, towards the ball along this touch's direction, from the ball's centre."""
        return -float(self._task.approaches[self._number].n_base @ (centre - self._ball.c_base))

    def _corrected(self) -> list[BallTouch]:
        """The touches with depths as the arm made them, from where the force began to where the probe rested.

        A depth by the force is off by what the layer's stiffness and the array's gain are: an array that was only
        pressed reads 8 % low. All touches are of one ball and share that factor; by itself the arm's way of one touch
        is known no better than its encoders' counts.
        """
        felt, pushed = np.sum(self._depths or [(1.0, 1.0)], axis=0)
        return [replace(touch, depth=touch.depth * float(pushed / felt)) for touch in self.touches]

    def _let_go(self) -> None:
        assert self._motion is not None
        pose = self._motion.pose
        n = pose.centre - self._ball.c_base
        away = ProbePose(pose.centre + n / np.linalg.norm(n) * (self._task.approach.clearance + 2e-3), pose.pole)
        self._line = LineMotion(pose, away, RETREAT_SPEED, at_once=True)
        self._enter(Phase.RETREAT)

    def _retreat(self) -> ProbePose:
        assert self._line is not None
        pose = self._line.at(self._t)
        if self._t >= self._line.duration + self._lead_s:
            self._move_on()
        return pose


_STEPS: dict[Phase, Callable[[CalibrateTask], ProbePose]] = {
    Phase.MOVE: CalibrateTask._move,
    Phase.APPROACH: CalibrateTask._approach,
    Phase.SETTLE: CalibrateTask._settle,
    Phase.SCAN: CalibrateTask._listen,
    Phase.RETREAT: CalibrateTask._retreat,
    Phase.DONE: CalibrateTask._done,
}
