"""The probe's pose → joint targets within what the cell allows, one step a cycle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg.lapack import dgesv

from canprobe.cell.master.supervisor import outside_workspace
from canprobe.cell.scene.setup import Arm, Probe, SafetyLimits
from canprobe.mechanics.robot.chain import pose_of
from canprobe.mechanics.touch.probe_motion import PoseSteps
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.types import Floats


def _solve(J: Floats, twist: Any) -> list[float] | None:
    """Solve as `probe_motion.solve` does, by LAPACK itself: numpy's wrapper costs four times as much in each cycle."""
    _, _, dq, info = dgesv(J, twist)
    step: list[float] = dq.tolist()
    return step if info == 0 else None


class ProbeMotion:
    """Keeps the commanded joint positions of a probe whose pose is asked for cycle by cycle.

    Each cycle one damped step from the *commanded* joints, never from the measured ones: encoder noise stays out of the
    command, and the step is small enough that its second-order error is gone in the next cycle.

    Args:
        arm, probe: the arm and the probe that move.
        safety: limits of the joints and of the probe's tip.
        period_s: period of the cycle.
        q: joint positions to start from (n,), rad or m; more than six joints stay near them.

    Attributes:
        limit: message of a joint or workspace limit that is reached; None without one.
        slowed: cycles in which a joint could not keep up.
        step_max: largest step of each joint in a period (n,), rad or m.
    """

    def __init__(self, arm: Arm, probe: Probe, safety: SafetyLimits, period_s: float, q: Floats) -> None:
        self.q = np.array(q, dtype=float)
        self._model = model = arm.model
        self._steps = PoseSteps(model, probe.T_flange_probe, self.q, _solve)
        self._workspace, self._radius = safety.workspace, probe.radius
        self.step_max: Floats = model.qd_max * safety.speed_share * period_s
        self._step_max: list[float] = self.step_max.tolist()
        self._period_s = period_s
        margin = safety.joint_margin
        self._low, self._high = model.q_min + margin, model.q_max - margin
        self._range: list[tuple[float, float]] = list(zip(self._low.tolist(), self._high.tolist(), strict=True))
        self._last: list[float] = [0.0] * len(self._range)
        self.limit: str | None = None
        self.slowed = 0

    @property
    def pose(self) -> ProbePose:
        """The commanded pose."""
        at = self._steps.at
        return ProbePose(np.array(at.flange), np.array(at.z))

    @property
    def pose_matrix(self) -> Floats:
        """The commanded pose with the turn about the pole, (4, 4), m."""
        return pose_of(self._steps.at)

    def step(self, pose: ProbePose) -> Floats:
        """Joint targets (n,), rad or m, one step nearer to ``pose``."""
        before = self.q.tolist()
        dq = self._steps.step(before, pose, self._period_s)
        at = self._steps.at
        if self._workspace is not None:
            self.limit = outside_workspace(np.array(at.flange) + self._radius * np.array(at.z), self._workspace)
        share = max([abs(step) / most for step, most in zip(dq, self._step_max, strict=True)])
        if share > 1.0:
            dq = [step / share for step in dq]
            self.slowed += 1
        self._last = dq
        targets = [q + step for q, step in zip(before, dq, strict=True)]
        self.q = np.array(targets)
        if not self._allows(targets):
            self._stop_at_limit()
        return self.q

    def near_limit(self, time_s: float) -> bool:
        """Whether a joint comes to its limit within a time, s, if it goes on as in the last step."""
        steps = time_s / self._period_s
        ahead = [q + steps * step for q, step in zip(self.q.tolist(), self._last, strict=True)]
        return not self._allows(ahead)

    def _allows(self, joints: Sequence[float]) -> bool:
        """Whether joints (n,), rad or m, are within their limits."""
        return all([low <= q <= high for q, (low, high) in zip(joints, self._range, strict=True)])

    def _stop_at_limit(self) -> None:
        joint = int(np.flatnonzero((self.q < self._low) | (self.q > self._high))[0])
        self.limit = f"joint {joint + 1} at {self._model.joints[joint].text(self.q[joint])}, its stop"
        self.q = np.clip(self.q, self._low, self._high)
