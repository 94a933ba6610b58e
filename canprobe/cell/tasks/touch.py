"""The touch tasks: approach, settle, scan or hold, regain a lost contact, retreat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.master.conditions import touch_finding
from canprobe.cell.master.controller import Command, Measurement, TactileSample
from canprobe.cell.master.supervision import Reaction
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.probing import Phase, ProbingTask
from canprobe.cell.tasks.regain import REST_S, Search
from canprobe.cell.tasks.sensing import ContactSensing, is_too_hollow
from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.cell.tasks.task import Loss, TaskRecord
from canprobe.mechanics.touch import CalibrationCheck, ContactSample, Patch, Slope
from canprobe.mechanics.touch.layer_stiffness import PushFit
from canprobe.mechanics.touch.probe_motion import MOVE_SPEED_M_S, SETTLE_S, LineMotion, smooth_step
from canprobe.mechanics.touch.servo import LocalSurface, ProbePose, TactileServo
from canprobe.mechanics.touch.stops import TOUCH_FORCE, AtRest
from canprobe.mechanics.touch.strategies import PathFollower, Rectangle
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch import SurfaceEstimate


MAX_SLOPE_SIGMA_SHARE = 0.12
"""Share of itself to which the slope of √F over the push must be known (1σ) before it is used."""
LONGEST_GAP_S = 0.02
"""Longest gap between two contacts for the servo's surface: after a longer gap it does not rest on one sample alone."""
REST_SHARE = 0.7
"""Share of the settling time after which force and depth are constant."""
LOST_FORCE_SHARE = 0.1
"""Share of the wanted force below which a scan or a hold has lost its contact: the hysteresis of the array."""
RETREAT_WAY = 6e-3
"""Way off the object, m."""
RAMP_S = 0.05
"""Time to reach the scan's speed, at its begin and where its path has turned back."""
CALIBRATE = "type `canprobe calibrate array CELL` and name its file as sensor.calibration"
_LEAVING = (Phase.RETREAT, Phase.DONE)


class TouchTask(ProbingTask):
    """Approach an object, touch it with a given force, follow a strategy over it or hold still, and let go.

    Args:
        plan: plan of the cell.
        task: settings of the touch.
        sensing: contacts from measurements.
        shape: the estimator in the loop; None where no shape is asked for.
        check: compares the array with its calibration; None where nothing can be compared.
    """

    def __init__(
        self,
        plan: Plan,
        task: Touch,
        sensing: ContactSensing,
        shape: ShapeTracker | None,
        check: CalibrationCheck | None = None,
    ) -> None:
        super().__init__(plan, task.lag_s, sensing, holds=task.scan is None)
        self.shape = shape
        self._check = check
        self._remarks: list[str] = []
        self._scan_start: int | None = None
        self._scan_end: int | None = None
        self._task = task
        self._target_force = task.force
        self._speed = task.scan.speed if task.scan is not None else 0.0
        self._servo: TactileServo | None = None
        self._sample_t: float | None = None
        self.losses: list[Loss] = []
        self._search: Search | None = None
        self._asked: ProbePose | None = None
        self._velocity: Floats = np.zeros(3)
        self._scan_t = self._searched_before = 0.0
        self._contact: ContactSample | None = None
        self._depth0 = 0.0
        self._push = PushFit()
        self._push_from: tuple[Floats, Floats] | None = None
        self._at_rest = AtRest()
        self._pole0: Floats = np.zeros(3)
        self._shape_columns: dict[str, float | Floats] = {}
        self._updated = True

    @property
    def restarts(self) -> int:
        """How often its estimator diverged and started afresh."""
        return self.shape.restarts if self.shape is not None else 0

    @property
    def remarks(self) -> Sequence[str]:
        """That the calibration is another array's, once."""
        return self._remarks

    def record(self) -> TaskRecord:
        return replace(super().record(), shape=self.shape, losses=self.losses, scan_cycles=self.scan_cycles)

    @property
    def scan_cycles(self) -> tuple[int, int] | None:
        """First cycle of the scan and the one after its last, so far; None before."""
        if self._scan_start is None:
            return None
        return self._scan_start, self._cycle if self._scan_end is None else self._scan_end

    @property
    def targets(self) -> dict[str, float]:
        """What the servo aims at: `target_force_n` and `speed_m_s`."""
        return {"target_force_n": self._target_force, "speed_m_s": self._speed}

    def set_target(self, kind: str, value: float) -> None:
        """Change one of `targets`, by a small step: the servo follows at once."""
        if kind == "target_force_n":
            self._target_force = value
        else:
            self._speed = value

    def stop(self) -> None:
        """Let go and be done, from whatever phase."""
        if self._motion is not None and self.phase not in _LEAVING:
            self._leave(None)

    def step(self, measurement: Measurement) -> Command:
        self.update()
        self._updated = False
        self._estimate = self.shape.answer(measurement.t_ns * 1e-9) if self.shape is not None else None
        command = super().step(measurement)
        if self.phase in (Phase.SCAN, Phase.REGAIN):
            self._scan_t += self._dt
        return command

    def update(self) -> None:
        """The estimator's work after a step, once: when the commands are out, or else before the next step."""
        if not self._updated and self.shape is not None and (estimate := self.shape.work()) is not None:
            self._follow(estimate)
        if not self._updated and self._check is not None:
            self._doubt(self._check)
        self._updated = True

    def _doubt(self, check: CalibrationCheck) -> None:
        """Answer with less certainty where the array is not as its calibration says."""
        if not check.work() or (finding := check.finding) is None:
            return
        self.sensing.reader.widen(check.force_spread)
        if self.shape is not None:
            self.shape.doubted = check.image_model_off
        if check.contradicted:
            self.sensing.leave_out_moments()
        if not self._remarks:
            wider = "forces and regions" if check.image_model_off else "forces"
            self._remarks.append(f"{finding}: {wider} are stated wider from here on; {CALIBRATE}")

    # sensing and supervision

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        self._touch.feel(patch, sample.t_sample_ns, known=patch.saturated and self._push.certain(MAX_SLOPE_SIGMA_SHARE))
        if self.phase is Phase.SCAN:
            self.taxels = sample.frame.taxels
        depth_at_1n_mm = self.sensing.depth(1.0) * 1e3
        contact = self.sensing.contact(sample, patch) if patch.force > TOUCH_FORCE / 2 else None
        if contact is not None and self._sample_t is not None and contact.t_s <= self._sample_t:
            self.sensing.dropped += 1  # it says that it is older than the one before
            contact = None
        self._contact = contact
        if contact is not None and self._servo is not None:
            elapsed = contact.t_s - self._sample_t if self._sample_t is not None else 2 * self._period_s
            self._servo.surface.correct(contact.p_base, contact.n_base, min(elapsed, LONGEST_GAP_S))
            self._sample_t = contact.t_s
            if self.phase is Phase.SETTLE:
                self._feel_stiffness(contact)
                if self._t > REST_SHARE * SETTLE_S:
                    self._at_rest.add(contact.force_n, patch.saturated)
            if self.phase is Phase.SCAN and self.shape is not None:
                self.shape.add(contact)
            if self.phase is Phase.SCAN and self._check is not None:
                self._check.see(contact.t_s, self.sensing.reader.image, sample.frame.window, patch)
        felt_columns = self._felt_columns(sample, patch, contact)
        self._columns = felt_columns | self._shape_columns | {"depth_at_1n_mm": depth_at_1n_mm}
        return contact

    def _feel_stiffness(self, contact: ContactSample) -> None:
        """Learn from the growing force how stiff this touch is; what was measured so far moves with it, no bump."""
        assert self._servo is not None
        centre = contact.p_base + contact.n_base * (self.sensing.radius - self.sensing.depth(contact.force_n))
        if self._push_from is None:
            self._push_from = centre, contact.n_base
            self._push = PushFit(self.sensing.position_sigma(contact.n_base))
        first, normal = self._push_from
        self._push.add(float(normal @ (first - centre)), contact.force_n)
        if self._push.certain(MAX_SLOPE_SIGMA_SHARE):
            before = self.sensing.depth(contact.force_n)
            self.sensing.set_slope(Slope(self._push.slope, self._push.sigma))
            rise = self.sensing.depth(contact.force_n) - before
            self._servo.surface.raise_by(rise)
            self._depth0 += rise

    def _follow(self, estimate: SurfaceEstimate) -> None:
        """Go by an estimate from now on."""
        if self._check is not None:
            self._check.take(estimate, self.sensing.slope)
        contact = self._contact
        if contact is None or self._servo is None:
            return
        self._shape_columns = {
            "kappa_per_m": np.where(estimate.observed, estimate.kappa, np.nan),
            "T_base_contact_m": estimate.T_frame_contact,
            "K_per_m": estimate.K,
            "K_covariance_per_m2": estimate.covariance,
        }
        self._columns = self._columns | self._shape_columns
        if bool(np.all(estimate.observed)):
            self._servo.surface.set_curvature(estimate.curvature_tensor_base())
            before = self.sensing.depth(contact.force_n)
            self.sensing.set_kappa(np.asarray(estimate.kappa), estimate.stiffness)
            # the depth that is aimed at has changed as much: without this the force would jump with the first answer
            self._servo.surface.raise_by(self.sensing.depth(contact.force_n) - before)
            if self.phase not in _LEAVING and is_too_hollow(estimate, self.sensing.radius):
                self._at_hollow(-1.0 / float(estimate.kappa[1]))

    def _at_hollow(self, radius: float) -> None:
        """Let go: the object is as hollow as the probe, with a radius, m."""
        self._leave(f"a hollow of radius {1e3 * radius:.0f} mm: as tight as the probe, no contact in one place")

    def _watch(self) -> None:
        if self.phase in _LEAVING:
            return
        touch = self._touch
        touch.lost_s = touch.lost_s + self._dt if touch.force < self._least_force() else 0.0
        touch.path = self._speed > 0 and self._scan_start is not None
        touch.searched = self.losses[-1].searched if self._search is not None else 0.0
        finding = touch_finding(touch)
        if finding is None:
            return
        if finding.condition.reaction is Reaction.SEARCH:
            self._look_for_contact()
        else:
            self._doubt_array(finding)
            self._leave(str(finding.error))

    def _least_force(self) -> float:
        """The force below which the contact is lost, N; an array that has let go shows a tenth of it for a while."""
        if self.phase is Phase.SCAN:
            return max(TOUCH_FORCE / 2, LOST_FORCE_SHARE * self._target_force)
        resting = self.phase is Phase.SETTLE or (self.phase is Phase.REGAIN and self._search is None)
        return TOUCH_FORCE / 2 if resting else 0.0

    def retreat(self, reason: str) -> None:
        """Let go for a reason that the cell has; nothing changes where the task is letting go already."""
        if self.phase not in _LEAVING and self._motion is not None:
            self._leave(reason)

    def _leave(self, reason: str | None) -> None:
        """Go to the retreat, for ``reason`` or because the work is done."""
        assert self._motion is not None
        if self.phase in (Phase.SCAN, Phase.REGAIN):
            self._scan_end = self._cycle
        self.reason = reason
        self._draw_back(-RETREAT_WAY * self._motion.pose.pole)

    # phases: each returns the pose for this cycle

    def _above(self, distance: float) -> ProbePose:
        up = self._task.approach.axes[2]
        return ProbePose(self._task.approach.start + up * (self.sensing.radius + distance), -up)

    def _begin(self, pose: ProbePose) -> None:
        self._line = LineMotion(pose, self._above(self._task.approach.clearance), MOVE_SPEED_M_S)

    def _approach(self) -> ProbePose:
        distance = self._task.approach.clearance - self._task.approach.speed * self._t
        pose = self._above(distance)
        if self._contact is not None and self._touch.force > TOUCH_FORCE + self._floor:
            self._touch_down(self._contact, pose)
        elif distance < -(way := self._search_way(self._task.approach)):
            self._leave(self._found_nothing("no object found", way))
        return pose

    def _touch_down(self, contact: ContactSample, pose: ProbePose) -> None:
        scan = self._task.scan
        surface = LocalSurface(contact.p_base, contact.n_base, self._task.gains)
        self._servo = TactileServo(
            surface,
            self._follower(),
            axes=self._task.approach.axes,
            origin=self._middle_of_path(contact),
            probe_radius=self.sensing.radius,
            rolling_share=scan.rolling_share if scan is not None else 0.0,
        )
        self.depth.restart()
        self._sink_from(contact, pose)
        self._enter(Phase.SETTLE)

    def _middle_of_path(self, contact: ContactSample) -> Floats:
        """Place (3,), m, over which the curve's origin lies: the first contact."""
        return contact.p_base

    def _follower(self) -> PathFollower | None:
        """What leads the contact over the surface; None holds it where it is."""
        scan = self._task.scan
        if scan is None or isinstance(scan.strategy, Rectangle):  # `ExploreTask` has a leader of its own
            return None
        return PathFollower(scan.strategy, scan.speed * RAMP_S / 2)

    def _sink_from(self, contact: ContactSample, pose: ProbePose) -> None:
        """Remember how deep and with which pole the probe touches, to go on from there without a bump."""
        self._depth0 = self.sensing.radius - float(contact.n_base @ (pose.centre - contact.p_base))
        self._pole0 = pose.pole

    def _sink(self, share: float) -> ProbePose:
        """At rest on the surface, with a share of the way from the first touch to the wanted force gone."""
        assert self._servo is not None
        depth = self._depth0 + share * (self._target_depth() - self._depth0)
        pose = self._servo.step(0.0, depth, self._dt)
        pole = self._pole0 + share * (pose.pole - self._pole0)
        return ProbePose(pose.centre, pole / np.linalg.norm(pole))

    def _settled_share(self) -> float:
        """Share of the way to the wanted depth; out of a touch that went too deep as fast as it went in."""
        too_deep = self._depth0 - self._target_depth()
        if too_deep <= 0.0:
            return smooth_step(self._t / (0.6 * SETTLE_S))
        return min(1.0, self._t * self._task.approach.speed / too_deep)

    def _target_depth(self) -> float:
        return self.sensing.depth(self._target_force)

    def _settle(self) -> ProbePose:
        pose = self._sink(self._settled_share())
        if self._t >= SETTLE_S:
            self._enter(Phase.SCAN)
            self._scan_start = self._cycle
            doubt = self._at_rest.doubt(self._target_force, self._push.certain(MAX_SLOPE_SIGMA_SHARE))
            if doubt is not None:
                self._leave(doubt)
        return pose

    def _scan(self) -> ProbePose:
        assert self._servo is not None
        left = self._task.duration_s - self._scan_t
        pose = self._servo.step(self._speed * self._pace(left), self._target_depth(), self._dt)
        if self._asked is not None:
            self._velocity = (pose.centre - self._asked.centre) / self._dt
        self._asked = pose
        if left <= 0:
            self._leave(None)
        return pose

    def _pace(self, left: float) -> float:
        """Share of the speed: it grows and falls at the ends of the scan, of which some time is left, s."""
        return min(1.0, self._t / RAMP_S, max(left, 0.0) / RAMP_S)

    def _look_for_contact(self) -> None:
        """Leave the path for where the object should be."""
        assert self._motion is not None
        if self.phase is Phase.SCAN:
            self.losses.append(Loss(self._cycle))
        self._search = self._search_from(self._motion.pose)
        self._floor = self._touch.force
        self._asked, self._velocity = None, np.zeros(3)
        self._searched_before = self.losses[-1].searched
        self._touch.lost_s = 0.0
        self._enter(Phase.REGAIN)

    def _search_from(self, pose: ProbePose) -> Search:
        """The search for a contact that was lost at a pose."""
        return Search(pose, self._velocity)

    def _regain(self) -> ProbePose:
        assert self._servo is not None
        if self._scan_t >= self._task.duration_s:
            self._leave(None)
        if self._search is None:
            if self._t >= REST_S:
                self._enter(Phase.SCAN)
            return self._sink(smooth_step(self._t / (0.6 * REST_S)))
        pose, loss = self._search.pose(self._t), self.losses[-1]
        loss.searched = self._searched_before + self._search.searched(self._t)
        if self._contact is not None and self._touch.force > TOUCH_FORCE + self._floor:
            loss.regained_s = (self._cycle - loss.cycle) * self._period_s
            self._servo.rest_on(self._contact.p_base, self._contact.n_base)
            self.depth.restart()
            self._sink_from(self._contact, pose)
            self._search = None
            self._enter(Phase.REGAIN)
        return pose
