"""Base of the tasks that touch with the probe: their phases, the order of a cycle, and the probe's pose → joints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from canprobe.cell.master.conditions import touch_finding
from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.patch_reader import sample_columns
from canprobe.cell.master.supervision import Finding, TouchState, limits_of
from canprobe.cell.master.supervisor import outside_workspace
from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.master.trail import GrowingForce, Retrace, TakenWay
from canprobe.cell.planning.contact import bounds_search
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.sync import CYCLES_TO_EFFECT
from canprobe.cell.scene.setup import Approach, Arm, Probe, SafetyLimits
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.cell.tasks.task import MotionTime, Phase, Task, TaskRecord
from canprobe.mechanics.robot.chain import pose_of
from canprobe.mechanics.touch import ContactSample, Patch
from canprobe.mechanics.touch.depth_witness import DepthWitness
from canprobe.mechanics.touch.probe_motion import RETREAT_SPEED_M_S, ArcMotion, LineMotion, PoseSteps
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch import SurfaceEstimate


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
            # all joints by the slowest of them, so that the probe goes the same way
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


ARM_LENGTH_M = 0.4
"""Length of a small arm, m: one whose flange is off by some share of it goes ways that are off by that share."""
COMING = (Phase.MOVE, Phase.APPROACH, Phase.SETTLE)
"""Phases in which the probe comes from free space: the way that it has taken leads off what it touches."""


LEAVING = (Phase.RETREAT, Phase.DONE)
_IN_CONTACT = (Phase.SETTLE, Phase.SCAN, Phase.REGAIN)


class ProbingTask(Task):
    """Base of the tasks that touch: the order of a cycle, and the phases that all of them have.

    Args:
        plan: plan of a cell with an arm; beyond its limits the probe retreats and the cell stops.
        lag_s: lag of the drives behind a ramp.
        sensing: contacts from measurements.
        holds: each touch stays in one place.

    Attributes:
        phase: what it does now.
        sensing: source of the contacts, as given.
        reason: why it stopped; None as long as it goes on.
        taxels: last image of the touch itself.
        depth: the depth of the probe in what it has touched before, as a witness of the force.
    """

    retreats_itself = True

    def __init__(self, plan: Plan, lag_s: float, sensing: ContactSensing, *, holds: bool = False) -> None:
        self.phase = Phase.MOVE
        self.sensing, self.reader = sensing, sensing.reader
        self.reason: str | None = None
        self.taxels: NDArray[np.uint8] | None = None
        self._setup = plan.setup
        self._touch = TouchState(limits_of(plan))
        probe = plan.setup.probe
        slope_sigma = probe.place_sd / ARM_LENGTH_M
        self.depth = self._touch.depth = DepthWitness(sensing.radius, holds=holds, slope_sigma=slope_sigma)
        self._drives_witness = bounds_search(plan)
        self._follows_depth = not probe.is_flat  # a flat pad has no foot on the object
        self._lever = probe.lever
        self._period_s = self._dt = plan.sync.period_ns * 1e-9
        self._time = MotionTime(plan.sync.period_ns)
        self._lead_s = CYCLES_TO_EFFECT * self._period_s + lag_s
        self._begun = False
        self._motion: ProbeMotion  # from the first cycle on
        self._line: LineMotion | ArcMotion
        self._way_here = TakenWay(plan.setup.needed_arm().model, probe.T_flange_point)
        self._retrace: Retrace | None = None
        self._growing: GrowingForce  # on the way back
        self._measured: Floats | None = None
        self._cycle = 0
        self._t = 0.0
        self._floor = 0.0
        self._columns: dict[str, float | Floats] = {}
        self._estimate: SurfaceEstimate | None = None
        self._phases: dict[Phase, Callable[[], ProbePose]] = {
            Phase.MOVE: self._move,
            Phase.RETREAT: self._retreat,
            Phase.DONE: lambda: self._motion.pose,
        }
        self._T = self._T_next = np.eye(4)  # T_base_carrier where the pose of the motion, and the last command, act

    def record(self) -> TaskRecord:
        slowed = self._motion.slowed if self._begun else 0
        contacts = self.depth.watched + self.depth.silent
        watched = self.depth.watched / contacts if contacts else None
        return TaskRecord(taxels=self.taxels, unplaced=self.sensing.dropped, slowed=slowed, depth_watched=watched)

    @property
    def trail(self) -> TakenWay | None:
        """The way by which the probe has come, until it moves over the object."""
        return self._way_here if self.phase in COMING else None

    def step(self, measurement: Measurement) -> Command:
        self._cycle = measurement.cycle
        self._dt = self._time.step(measurement.t_ns) * 1e-9
        patch, track = self.sensing.step(measurement), self.sensing.track
        if track is not None:
            if not self._begun and measurement.carrier is None:
                return Command(columns=self._columns)
            T_base_carrier = track.T_base_carrier(measurement.t_ns + round(self._lead_s * 1e9))
        if not self._begun:
            setup = self._setup
            assert measurement.q is not None
            self._motion = ProbeMotion(setup.needed_arm(), setup.probe, setup.limits, self._period_s, measurement.q)
            self._begun = True
            if track is not None:
                self._T = self._T_next = T_base_carrier
            self._begin(self._commanded)
        self._measured = measurement.q
        if self.phase in COMING and track is None:  # where it came along there is something else by now
            self._way_here.add(measurement.q, measurement.q_age)
        if patch is not None and measurement.tactile is not None:
            self._witness(measurement.tactile, patch, self._feel(measurement.tactile, patch))
        self._touch.tactile_age = measurement.tactile_age
        self._watch()
        at_rest = self.phase is Phase.DONE
        pose = self._phases[self.phase]()
        self._t += self._dt
        if track is not None and not at_rest:
            self._T, self._T_next = self._T_next, T_base_carrier
            pose = pose.moved(T_base_carrier)
        return self._command(pose)

    @property
    def _commanded(self) -> ProbePose:
        """The commanded pose in the frame of the contacts."""
        if self.sensing.track is None:
            return self._motion.pose
        return self._motion.pose.moved(np.asarray(np.linalg.inv(self._T)))

    def retreat(self, reason: str) -> None:
        if self._begun and self.reason is None and self.phase is not Phase.DONE:
            self.reason = reason
            self._let_go()

    def stop(self) -> None:
        """Let go and be done, from whatever phase."""
        if self._begun and self.phase not in LEAVING:
            self._let_go()

    def _let_go(self) -> None:
        """Begin the way off the object."""
        raise NotImplementedError

    def _begin(self, pose: ProbePose) -> None:
        """Start the first move, from where the probe is."""
        raise NotImplementedError

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        """Take a tactile sample; the contact that it shows."""
        raise NotImplementedError

    def _witness(self, sample: TactileSample, patch: Patch, contact: ContactSample | None) -> None:
        """Ask what else knows of the force: whether the images live, and how deep the probe is."""
        touch, sensing = self._touch, self.sensing
        T = contact.T_base_probe if contact is not None else sensing.probe_at(sample.t_sample_ns)
        centre = None if T is None else T[:3, 3] + self._lever * T[:3, 2]
        normal = contact.n_base if contact is not None else None
        touch.images.look(sample, patch, centre, sensing.image_sigma if contact is not None else None)
        if not self._follows_depth or self.phase not in _IN_CONTACT:
            return
        if centre is None or patch.saturated or patch.off_pad:
            return  # of a force that is only a lower bound no depth follows
        t_s, limit = sample.t_sample_ns * 1e-9, self._setup.limits.force_max
        self.depth.step(t_s, centre, normal, patch.force, d1=sensing.depth(1.0), force_max=limit)

    def _watch(self) -> None:
        """Check the touch by the table of conditions."""
        if self.reason is None and self.phase is not Phase.DONE:
            finding = touch_finding(self._touch)
            if finding is not None:
                self._doubt_array(finding)
                self.retreat(str(finding.error))

    def _doubt_array(self, finding: Finding) -> None:
        """Do not believe the array any more, where that is what was found."""
        if finding.condition.blind and self.array_blind is None:
            self.array_blind = str(finding.error)

    def _command(self, pose: ProbePose) -> Command:
        """One step of the probe to a pose, as the cell takes it; a joint's limit on the way makes the task let go.

        On its trail the probe goes back by joints that were measured, whatever the pose is.
        """
        if self._retrace is not None:
            target = self._retrace.q
        else:
            target = self._motion.step(pose)
            if self._motion.limit is not None:
                self.retreat(self._motion.limit)
        self._columns["phase"] = float(self.phase)
        done = self.phase is Phase.DONE
        return Command(
            q_target=target,
            done=done and self.reason is None,
            stop_reason=self.reason if done else None,
            columns=self._columns,
            estimate=self._estimate,
        )

    # phases: each returns the pose for this cycle

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._t = 0.0
        if phase is Phase.MOVE:
            self._way_here.forget()

    def _move(self) -> ProbePose:
        pose = self._line.at(self._t)
        if self._t >= self._line.duration + self._lead_s + 0.1:
            self._floor = self._touch.force  # an array that was pressed for long shows some of it for a while
            self._enter(Phase.APPROACH)
        return pose

    def _search_way(self, approach: Approach) -> float:
        """Way beyond the expected place up to which an approach goes, m: a blind array ends none."""
        return approach.search if self.array_alive or self._drives_witness else approach.blind_search

    def _found_nothing(self, what: str, way: float) -> str:
        """Words for an approach that went a way beyond the expected place, m, without a contact."""
        words = f"{what} up to {way * 1e3:.2g} mm beyond the expected place"
        if self.array_alive:
            return words
        return (
            f"{words}, and no image of the array has changed since bring-up: the array may be blind; press it with a"
            " finger (`canprobe run listen` shows what it measures), then try again; task.search_mm widens the search"
        )

    def _draw_back(self, way: Floats) -> None:
        """Begin the retreat: back on the way that the probe has come, or where it has moved over the object, by a way.

        Args:
            way: (3,) m, off the object.
        """
        if self._measured is not None and self.phase in COMING:
            self._retrace = self._way_here.back(self._measured, self._motion.step_max)
        pose = self._commanded
        self._line = LineMotion(pose, ProbePose(pose.centre + way, pose.pole), RETREAT_SPEED_M_S, at_once=True)
        self._growing = GrowingForce(self._touch.limits.cycles_to_turn)
        self._enter(Phase.RETREAT)

    def _retreat(self) -> ProbePose:
        touch = self._touch
        if self._growing.grows(self._cycle, touch.force, a_part=math.isinf(touch.force_sigma)):
            grows = f"the force grows on the way back, to {touch.force:.2f} N: the probe was stopped there"
            self.reason = grows if self.reason is None else f"{self.reason}; {grows}"
            self._enter(Phase.DONE)
            return self._commanded
        pose = self._line.at(self._t)
        over = self._t >= self._line.duration + self._lead_s
        if over if self._retrace is None else self._retrace.step(self._dt) is None:
            self._off()
        return pose

    def _off(self) -> None:
        """The probe is off the object."""
        self._enter(Phase.DONE)


def felt_columns(
    phase: Phase, sample: TactileSample, patch: Patch, contact: ContactSample | None
) -> dict[str, float | Floats]:
    """Columns of the log with the data of an image."""
    return {
        "phase": float(phase),
        **sample_columns(sample, patch),
        "contact_mm": contact.p_base * 1e3 if contact is not None else np.full(3, np.nan),
        "normal": contact.n_base if contact is not None else np.full(3, np.nan),
    }
