"""Find the probe's centre on the flange: touch a ball of known radius from several sides, gently, and let go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Calibrate
from canprobe.cell.tasks.probing import Phase, ProbingTask
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.cell.tasks.task import TaskRecord
from canprobe.mechanics.robot.tool_calibration import BallModel, BallTouch, ToolEstimate, calibrate_tool
from canprobe.mechanics.touch import ContactSample, Patch
from canprobe.mechanics.touch.layer_stiffness import PushFit
from canprobe.mechanics.touch.probe_motion import EXTRA_CLEARANCE_M, ROUND_SPEED_M_S, ArcMotion
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.types import Floats

PRESS_SPEED = 0.8e-3
"""Speed from the first touch to the wanted force, m/s: the motion that is then still under way presses in 0.02 mm."""
MAX_SLOPE_SIGMA_SHARE = 0.06
"""Share of itself to which the slope of √F over the push must be known (1σ) for the depth to be read off it."""
SETTLE_S = 0.15
LISTEN_S = 0.25
"""Time at rest before samples count, and the time in which they count."""


class CalibrateTask(ProbingTask):
    """Touches the ball again and again, and estimates the tool in the end.

    Args:
        plan: plan of the cell.
        task: settings of the calibration.
        sensing: contacts from measurements.

    Attributes:
        touches: the touches so far.
        estimate: estimate of the tool; None before the end, or with too few touches.
    """

    def __init__(self, plan: Plan, task: Calibrate, sensing: ContactSensing) -> None:
        super().__init__(plan, task.lag_s, sensing, holds=True)
        self._phases |= {Phase.APPROACH: self._approach, Phase.SETTLE: self._settle, Phase.SCAN: self._scan}
        sensing.set_kappa(np.full(2, 1.0 / task.ball_radius))
        radii = sensing.radius + task.ball_radius
        self._ball = BallModel(sensing.flange_probe[:3, 3], task.ball_centre, radii, sigma_c=task.ball_sigma)
        self.touches: list[BallTouch] = []
        self.estimate: ToolEstimate | None = None
        self._task = task
        self._number = 0
        self._gone = 0.0
        self._felt: list[ContactSample] = []
        self._push = PushFit()
        self._depths: list[tuple[float, float]] = []

    def stop(self) -> None:
        """Let go, and estimate from the touches so far."""
        self._number = len(self._task.approaches)
        super().stop()

    def record(self) -> TaskRecord:
        return replace(super().record(), tool=self.estimate)

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        self._touch.update_force(patch, sample.t_sample_ns)
        contact = self.sensing.contact(sample, patch) if patch.force > TOUCH_FORCE / 2 else None
        if contact is not None and self.phase in (Phase.APPROACH, Phase.SETTLE):
            self._push.add(self._pushed(contact.T_base_probe[:3, 3]), contact.force_n)
        if self.phase is Phase.SCAN:
            self.taxels = sample.frame.taxels
            if contact is not None and self._t > SETTLE_S:
                self._felt.append(contact)
        self._columns = self._felt_columns(sample, patch, contact) | {"touch": float(self._number + 1)}
        return contact

    # phases: each returns the pose for this cycle

    def _at(self, gap: float) -> ProbePose:
        """Probe at a distance from the expected ball, with this touch's direction and pole."""
        touch = self._task.approaches[self._number]
        return ProbePose(self._ball.c_base + (self._ball.radii + gap) * touch.n_base, touch.pole_base)

    def _begin(self, pose: ProbePose) -> None:
        """Go to the next touch, round the ball, or end."""
        if self.reason is not None or self._number >= len(self._task.approaches):
            if self.reason is None and len(self.touches) >= 2:
                self.estimate = calibrate_tool(self._corrected(), self._ball)
            return self._enter(Phase.DONE)
        self._push = PushFit()
        self.depth.restart()
        self._line = ArcMotion(self._ball.c_base, pose, self._at(self._task.approach.clearance), ROUND_SPEED_M_S)
        self._enter(Phase.MOVE)

    def _off(self) -> None:
        self._begin(self._motion.pose)

    def _approach(self) -> ProbePose:
        self._gone = self._task.approach.speed * self._t - self._task.approach.clearance
        if self._touch.force > TOUCH_FORCE:
            self._enter(Phase.SETTLE)
        elif self._gone > (way := self._search_way(self._task.approach)):
            nothing = self._found_nothing(f"touch {self._number + 1}: no ball found", way)
            self.retreat(f"{nothing}; or correct task.start_mm and task.ball_radius_mm, or raise task.search_mm")
        return self._at(-self._gone)

    def _settle(self) -> ProbePose:
        """Press on slowly until the force is reached."""
        if self._touch.force >= self._task.force:
            self._felt = []
            self._enter(Phase.SCAN)
        elif self._gone > self._task.approach.search:
            self.retreat(
                f"touch {self._number + 1}: expected {self._task.force:g} N at the ball, got {self._touch.force:.2f} N"
                f" {self._task.approach.search * 1e3:g} mm beyond: fix the ball in its place, or correct task.start_mm"
            )
        else:
            self._gone += PRESS_SPEED * self._dt
        return self._at(-self._gone)

    def _scan(self) -> ProbePose:
        if self._t >= SETTLE_S + LISTEN_S:
            if self._felt:
                self.touches.append(self._ball_touch(self._felt))
                self._number += 1
                self._let_go()
            else:
                self.retreat(f"touch {self._number + 1}: no tactile sample while the probe rested: check the array")
        return self._at(-self._gone) if self.phase is Phase.SCAN else self._retreat()

    def _ball_touch(self, felt: Sequence[ContactSample]) -> BallTouch:
        """Mean of the samples of a touch at rest."""
        n = np.mean([contact.n_base for contact in felt], axis=0)
        T_base_probe = felt[len(felt) // 2].T_base_probe.copy()
        T_base_probe[:3, 3] = np.mean([contact.T_base_probe[:3, 3] for contact in felt], axis=0)
        T_base_flange = T_base_probe @ np.linalg.inv(self.sensing.flange_probe)
        d_flange = -(T_base_flange[:3, :3].T @ n) / float(np.linalg.norm(n))
        depth = float(np.mean([self.sensing.depth(contact.force_n) for contact in felt]))
        if self._push.certain(MAX_SLOPE_SIGMA_SHARE):
            self._depths.append((depth, self._pushed(T_base_probe[:3, 3]) - self._push.start))
        return BallTouch(T_base_flange, d_flange, depth)

    def _pushed(self, centre: Floats) -> float:
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
        n = self._motion.pose.centre - self._ball.c_base
        self._draw_back(n / np.linalg.norm(n) * (self._task.approach.clearance + EXTRA_CLEARANCE_M))
