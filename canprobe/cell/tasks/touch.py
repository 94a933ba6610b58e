"""The touch tasks: approach, settle, scan or hold, regain a lost contact, retreat.

The depth that belongs to a force follows from the layer's stiffness and the surface's curvature. Where either becomes
better known, the depth changes; the servo's surface rises as much, so that the force does not jump.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from canprobe.cell.master.conditions import touch_finding
from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.supervision import Reaction
from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Approach, Touch
from canprobe.cell.tasks.probing import LEAVING, ProbingTask, felt_columns
from canprobe.cell.tasks.sensing import ContactSensing, is_too_hollow
from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.cell.tasks.task import Loss, Phase, TaskRecord
from canprobe.mechanics.robot.motion_profile import smooth_step
from canprobe.mechanics.touch import CalibrationCheck, ContactSample, Patch, Slope, SurfaceEstimate
from canprobe.mechanics.touch.layer_stiffness import PushFit
from canprobe.mechanics.touch.probe_motion import MOVE_SPEED_M_S, LineMotion
from canprobe.mechanics.touch.servo import (
    RAMP_S,
    SETTLE_S,
    TARGET_RATES,
    LocalSurface,
    ProbePose,
    Sinking,
    TactileServo,
)
from canprobe.mechanics.touch.stops import TOUCH_FORCE, AtRest
from canprobe.mechanics.touch.strategies import PathFollower, Rectangle
from canprobe.mechanics.types import Floats

MAX_SLOPE_SIGMA_SHARE = 0.12
"""Share of itself to which the slope of √F over the push must be known (1σ) before it is used."""
CALIBRATE = "type `canprobe calibrate array CELL` and name its file as sensor.calibration"
REST_SHARE = 0.7
"""Share of the settling time after which force and depth are constant."""
LOST_FORCE_SHARE = 0.1
"""Share of the wanted force below which a scan or a hold has lost its contact: the hysteresis of the array."""
RETREAT_WAY = 6e-3
"""Way off the object, m."""
SEARCH_SPEED = 2e-3
"""Speed of the search, m/s: until the first sample of the new touch takes effect, 27 ms, the layer sinks in 0.05 mm."""
BRAKE_S = 0.02
"""Time constant with which the motion along the path ends: 0.5 mm at 25 mm/s."""
REST_S = 0.25
"""Time at rest on the surface that was found, until the wanted force is reached and the scan goes on."""

CHANGE_M = 5e-3
"""Path over which a curvature is compared with those before, m: on a cylinder answers differ by less than σ."""


def towards(wanted: float, now: float, step: float) -> float:
    """A target that is one step, at most, nearer to the wanted one."""
    return now + min(max(wanted - now, -step), step)


def target_column(target: str) -> str:
    """Column of the log with one of `TouchTask.targets`."""
    return f"target_{target.removeprefix('target_')}"


class ContactLearning:
    """Learns of a contact from the growing force, from the estimator, and from images that contradict the calibration.

    Args:
        sensing: contacts from measurements, which go by what is learned.
        shape: the estimator in the loop; None where no shape is asked for.
        check: compares the array with its calibration; None where nothing can be compared.

    Attributes:
        sensing: as above.
        remarks: that the calibration is another array's, once.
        columns: columns of the log with the newest estimate.
    """

    def __init__(self, sensing: ContactSensing, shape: ShapeTracker | None, check: CalibrationCheck | None) -> None:
        self.remarks: list[str] = []
        self.columns: dict[str, float | Floats] = {}
        self.check = check
        self.sensing, self._shape = sensing, shape
        self._push = PushFit()
        self._push_from: tuple[Floats, Floats] | None = None

    @property
    def stiffness_known(self) -> bool:
        """Whether the growing force has shown how stiff this touch is."""
        return self._push.certain(MAX_SLOPE_SIGMA_SHARE)

    def push(self, contact: ContactSample, surface: LocalSurface) -> float:
        """Learn from the growing force how stiff this touch is; the way by which the surface rises with it, m."""
        sensing = self.sensing
        centre = contact.p_base + contact.n_base * (sensing.radius - sensing.depth(contact.force_n))
        if self._push_from is None:
            self._push_from = centre, contact.n_base
            self._push = PushFit(sensing.position_sigma(contact.n_base))
        first, normal = self._push_from
        self._push.add(float(normal @ (first - centre)), contact.force_n)
        if not self.stiffness_known:
            return 0.0
        before = sensing.depth(contact.force_n)
        sensing.set_slope(Slope(self._push.slope, self._push.sigma))
        rise = sensing.depth(contact.force_n) - before
        surface.raise_by(rise)
        return rise

    def follow(self, estimate: SurfaceEstimate, contact: ContactSample, surface: LocalSurface) -> bool:
        """Use an estimate for the next targets, where it has observed all curvature; whether it has."""
        self.columns = {
            "kappa_per_m": np.where(estimate.observed, estimate.kappa, np.nan),
            "T_base_contact_m": estimate.T_frame_contact,
            "K_per_m": estimate.K,
            "K_covariance_per_m2": estimate.covariance,
        }
        if not bool(np.all(estimate.observed)):
            return False
        surface.set_curvature(estimate.curvature_tensor_base())
        before = self.sensing.depth(contact.force_n)
        self.sensing.set_kappa(np.asarray(estimate.kappa), estimate.stiffness)
        surface.raise_by(self.sensing.depth(contact.force_n) - before)
        return True

    def doubt(self) -> bool:
        """Answer with less certainty where the array is not as its calibration says; whether there was work to do."""
        check = self.check
        if check is None or not check.work():
            return False
        if (finding := check.finding) is None:
            return True
        self.sensing.reader.widen(check.force_spread)
        if self._shape is not None:
            self._shape.doubted = check.image_model_off
        if check.contradicted:
            self.sensing.leave_out_moments()
        if not self.remarks:
            wider = "forces and regions" if check.image_model_off else "forces"
            self.remarks.append(f"{finding}: {wider} are stated wider from here on; {CALIBRATE}")
        return True


class Search:
    """The probe's motion from a lost contact to the object, along its pole.

    Args:
        pose: pose of the probe where the contact was lost.
        velocity: velocity of its centre then (3,), m/s; its part along the path fades out.
    """

    def __init__(self, pose: ProbePose, velocity: Floats) -> None:
        self._start = pose
        self._sideways = velocity - pose.pole * float(velocity @ pose.pole)

    def pose(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the loss."""
        sideways = self._sideways * (BRAKE_S * (1.0 - math.exp(-t / BRAKE_S)))
        return ProbePose(self._start.centre + sideways + self._start.pole * (SEARCH_SPEED * t), self._start.pole)

    def searched(self, t: float) -> float:
        """Distance towards the object that was searched by then, m."""
        return SEARCH_SPEED * t


def above(approach: Approach, distance: float) -> ProbePose:
    """Pose of a probe whose centre is at a distance, m, above the place that an approach leads to."""
    up = approach.axes[2]
    return ProbePose(approach.start + up * distance, -up)


class TouchTask(ProbingTask):
    """Approach an object, touch it with a given force, follow a strategy over it or hold still, and let go.

    Args:
        plan: plan of the cell.
        task: settings of the touch.
        sensing: contacts from measurements.
        shape: the estimator in the loop; None where no shape is asked for.
        check: compares the array with its calibration; None where nothing can be compared.

    Attributes:
        targets: what the servo aims at, `target_force_n` and `speed_m_s`; it follows a small step at once.
        tables: tables over path or time that these follow, by the same names; each has a column of the log.
        learned: what the contact has taught, by the same sensing.
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
        self._phases |= {Phase.APPROACH: self._approach, Phase.SETTLE: self._settle, Phase.SCAN: self._scan}
        self._phases[Phase.REGAIN] = self._regain
        self.shape = shape
        self.learned = ContactLearning(sensing, shape, check)
        self.remarks = self.learned.remarks
        self._scan_start: int | None = None
        self._scan_end: int | None = None
        self._task = task
        self.targets = {"target_force_n": task.force, "speed_m_s": task.scan.speed if task.scan is not None else 0.0}
        self.tables = dict(task.tables)
        self.targets |= {name: table.at(0.0, 0.0) for name, table in self.tables.items()}
        self._shares = dict.fromkeys(self.tables, 1.0)
        self._answered: tuple[Floats, float] = np.zeros(2), -math.inf  # fading mean of κ, and the path up to it
        self._touched = False
        self._servo: TactileServo  # from the first touch on, as the next
        self._sinking: Sinking
        self.losses: list[Loss] = []
        self._search: Search | None = None
        self._asked: ProbePose | None = None
        self._velocity: Floats = np.zeros(3)
        self._now_s = self._scan_t = self._searched_before = 0.0
        self._contact: ContactSample | None = None
        self._at_rest = AtRest()
        self._updated = True
        self._images = [False, False]  # whether the last two cycles have read one

    def record(self) -> TaskRecord:
        scan = None
        if self._scan_start is not None:
            scan = self._scan_start, self._cycle if self._scan_end is None else self._scan_end
        if self.shape is not None:
            self.shape.answer_at_once(self._now_s)
        return replace(super().record(), shape=self.shape, losses=self.losses, scan_cycles=scan)

    def step(self, measurement: Measurement) -> Command:
        self.update()
        self._updated = False
        self._images = [self._images[-1], measurement.tactile is not None]
        self._now_s = measurement.t_ns * 1e-9
        self._estimate = self.shape.answer(self._now_s) if self.shape is not None else None
        command = super().step(measurement)
        if self.phase in (Phase.SCAN, Phase.REGAIN):
            self._scan_t += self._dt
            for name, table in self.tables.items():
                now, wanted = self.targets[name], self._shares[name] * table.at(self._servo.travelled, self._scan_t)
                self._columns[target_column(name)] = now
                self.targets[name] = towards(wanted, now, TARGET_RATES[name] * self._dt)
        return command

    def update(self) -> None:
        """One step of what is learned, once a cycle: when the commands are out, or else before the next step.

        A cycle that reads an image leaves it to the next one, unless that reads one too.
        """
        if self._updated:
            return
        self._updated = True
        learned, contact = self.learned, self._contact
        if self._images == [False, True] or learned.doubt() or self.shape is None:
            return
        estimate = self.shape.work()
        self.restarts = self.shape.restarts
        if estimate is not None:
            if learned.check is not None:
                learned.check.take(estimate, self.sensing.slope)
            if contact is not None and self._touched:
                all_observed = learned.follow(estimate, contact, self._servo.surface)
                self._columns = self._columns | learned.columns
                if all_observed:
                    self._ease(estimate)
                if all_observed and self.phase not in LEAVING and is_too_hollow(estimate, self.sensing.radius):
                    self._at_hollow(-1.0 / float(estimate.kappa[1]))

    def _ease(self, estimate: SurfaceEstimate) -> None:
        """Lower the targets by an answer: the speed where the curvature changes, the force where it is known well."""
        kappa, C, path = np.array(estimate.kappa), estimate.covariance, self._servo.travelled
        # of the norm of K, as `change` is the norm of both curvatures: K12 stands in the tensor twice
        sigma = math.sqrt(max(0.0, C[0, 0] + 2.0 * C[1, 1] + C[2, 2]))
        before, till = self._answered
        mean = kappa + (before - kappa) * math.exp((till - path) / CHANGE_M)
        self._answered, change = (mean, path), max(float(np.linalg.norm(kappa - mean)), 1e-9)
        eased = {"speed_m_s": sigma / change, "target_force_n": sigma / (self._task.sigma_wanted or 1.0)}
        for name, table in self.tables.items():
            self._shares[name] = max(table.least_share, min(1.0, eased[name]))

    # sensing and supervision

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        self._touch.update_force(patch, sample.t_sample_ns, known=patch.saturated and self.learned.stiffness_known)
        if self.phase is Phase.SCAN:
            self.taxels = sample.frame.taxels
        depth_at_1n_mm = self.sensing.depth(1.0) * 1e3
        contact = self.sensing.contact(sample, patch) if patch.force > TOUCH_FORCE / 2 else None
        if contact is not None and self._touched and contact.t_s <= self._servo.taken_s:
            self.sensing.dropped += 1  # it says that it is older than the one before
            contact = None
        self._contact = contact
        if contact is not None and self._touched:
            self._servo.take(contact, 2 * self._period_s)
            if self.phase is Phase.SETTLE:
                self._sinking.depth += self.learned.push(contact, self._servo.surface)
                if self._t > REST_SHARE * SETTLE_S:
                    self._at_rest.add(contact.force_n, patch.saturated)
            if self.phase is Phase.SCAN and self.shape is not None:
                self.shape.add(contact)
            if self.phase is Phase.SCAN and (check := self.learned.check) is not None:
                check.see(contact.t_s, self.sensing.reader.image, sample.frame.window, patch)
        felt = felt_columns(self.phase, sample, patch, contact)
        self._columns = felt | self.learned.columns | {"depth_at_1n_mm": depth_at_1n_mm}
        return contact

    def _at_hollow(self, radius: float) -> None:
        """Let go: the object is as hollow as the probe, with a radius, m."""
        self.retreat(f"a hollow of radius {1e3 * radius:.0f} mm: as tight as the probe, no contact in one place")

    def _watch(self) -> None:
        if self.phase in LEAVING:
            return
        touch = self._touch
        least_force = 0.0  # below it the contact is lost; an array that has let go shows a tenth of it for a while
        if self.phase is Phase.SCAN:
            least_force = max(TOUCH_FORCE / 2, LOST_FORCE_SHARE * self.targets["target_force_n"])
        elif self.phase is Phase.SETTLE or (self.phase is Phase.REGAIN and self._search is None):
            least_force = TOUCH_FORCE / 2
        touch.lost_s = touch.lost_s + self._dt if touch.force < least_force else 0.0
        touch.path = self.targets["speed_m_s"] > 0 and self._scan_start is not None
        touch.searched = self.losses[-1].searched if self._search is not None else 0.0
        finding = touch_finding(touch)
        if finding is None:
            return
        if finding.condition.reaction is Reaction.SEARCH:
            self._look_for_contact()
        else:
            self._doubt_array(finding)
            self.retreat(str(finding.error))

    def retreat(self, reason: str) -> None:
        if self.phase not in LEAVING:  # where the task is letting go already nothing changes
            super().retreat(reason)

    def _let_go(self) -> None:
        if self.phase in (Phase.SCAN, Phase.REGAIN):
            self._scan_end = self._cycle
        self._draw_back(-RETREAT_WAY * self._commanded.pole)

    # phases: each returns the pose for this cycle

    def _begin(self, pose: ProbePose) -> None:
        approach = self._task.approach
        self._line = LineMotion(pose, above(approach, self.sensing.radius + approach.clearance), MOVE_SPEED_M_S)

    def _approach(self) -> ProbePose:
        distance = self._task.approach.clearance - self._task.approach.speed * self._t
        pose = above(self._task.approach, self.sensing.radius + distance)
        if self._contact is not None and self._touch.force > TOUCH_FORCE + self._floor:
            self._touch_down(self._contact, pose)
        elif distance < -(way := self._search_way(self._task.approach)):
            self.retreat(self._found_nothing("no object found", way))
        return pose

    def _touch_down(self, contact: ContactSample, pose: ProbePose) -> None:
        scan = self._task.scan
        follower, origin = self._leader(contact)
        self._servo = TactileServo(
            LocalSurface(contact.p_base, contact.n_base, self._task.gains),
            follower,
            axes=self._task.approach.axes,
            origin=origin,
            probe_radius=self.sensing.radius,
            rolling_share=scan.rolling_share if scan is not None else 0.0,
        )
        self.depth.restart()
        self._sinking = Sinking(contact, pose, self.sensing.radius, self._lever)
        self._touched = True
        self._enter(Phase.SETTLE)

    def _leader(self, contact: ContactSample) -> tuple[PathFollower | None, Floats]:
        """What leads the contact over the surface, None to hold it where it is; and the origin of its curve (3,), m."""
        scan = self._task.scan
        if scan is None or isinstance(scan.strategy, Rectangle):  # `ExploreTask` has a leader of its own
            return None, contact.p_base
        return PathFollower(scan.strategy, scan.speed * RAMP_S / 2), contact.p_base

    def _target_depth(self) -> float:
        return self.sensing.depth(self.targets["target_force_n"])

    def _settle(self) -> ProbePose:
        depth = self._target_depth()
        share = self._sinking.share(self._t, depth, self._task.approach.speed)
        pose = self._sinking.pose(self._servo, share, depth, self._dt)
        if self._t >= SETTLE_S:
            self._enter(Phase.SCAN)
            self._scan_start = self._cycle
            doubt = self._at_rest.doubt(self.targets["target_force_n"], self.learned.stiffness_known)
            if doubt is not None:
                self.retreat(doubt)
        return pose

    def _scan(self) -> ProbePose:
        left = self._task.duration_s - self._scan_t
        pose = self._servo.next_pose(self.targets["speed_m_s"] * self._pace(left), self._target_depth(), self._dt)
        if self._asked is not None:
            self._velocity = (pose.centre - self._asked.centre) / self._dt
        self._asked = pose
        if left <= 0:
            self.stop()
        return pose

    def _pace(self, left: float) -> float:
        """Share of the speed: it grows and falls at the ends of the scan, of which some time is left, s."""
        return min(1.0, self._t / RAMP_S, max(left, 0.0) / RAMP_S)

    def _look_for_contact(self) -> None:
        """Leave the path for where the object should be."""
        if self.phase is Phase.SCAN:
            self.losses.append(Loss(self._cycle))
        self._search = Search(self._commanded, self._velocity)
        self._floor = self._touch.force
        self._asked, self._velocity = None, np.zeros(3)
        self._searched_before = self.losses[-1].searched
        self._touch.lost_s = 0.0
        self._enter(Phase.REGAIN)

    def _regain(self) -> ProbePose:
        if self._scan_t >= self._task.duration_s:
            self.stop()
        if self._search is None:
            if self._t >= REST_S:
                self._enter(Phase.SCAN)
            share = smooth_step(self._t / (0.6 * REST_S))
            return self._sinking.pose(self._servo, share, self._target_depth(), self._dt)
        pose, loss = self._search.pose(self._t), self.losses[-1]
        loss.searched = self._searched_before + self._search.searched(self._t)
        if self._contact is not None and self._touch.force > TOUCH_FORCE + self._floor:
            loss.regained_s = (self._cycle - loss.cycle) * self._period_s
            self._servo.rest_on(self._contact.p_base, self._contact.n_base)
            self.depth.restart()
            self._sinking = Sinking(self._contact, pose, self.sensing.radius, self._lever)
            self._search = None
            self._enter(Phase.REGAIN)
        return pose
