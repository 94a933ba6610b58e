"""Tasks that touch a known object again and again: to find the probe's centre on the flange, to calibrate an array."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Calibrate, Touch
from canprobe.cell.tasks.probing import ProbingTask, felt_columns
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.cell.tasks.task import Phase, TaskRecord
from canprobe.mechanics.robot.tool_calibration import BallModel, BallTouch, ToolEstimate, calibrate_tool
from canprobe.mechanics.touch import ContactSample, Patch
from canprobe.mechanics.touch.layer_stiffness import PushFit
from canprobe.mechanics.touch.probe_motion import EXTRA_CLEARANCE_M, ROUND_SPEED_M_S, ArcMotion, LineMotion
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
TOUCH_TO_TOUCH_SPEED = 30e-3
"""Speed from touch to touch of a roll, m/s."""
FORCE_HZ = 0.5
"""Bandwidth with which the force of a roll is held; slower than the roll, so that its images have one depth."""
MAX_PRESS_WAY = 3e-3
"""Way beyond the first touch, m, after which the object of a roll counts as one that gives way."""
ROLL_SAMPLES = 24
"""Poses of a roll whose reach is checked."""


class TouchSeries(ProbingTask):
    """Base of the two: go to the next touch, approach, press on, and let go.

    Args:
        plan: plan of the cell.
        task: settings of the task.
        sensing: contacts from measurements.
        count: how many touches.
        radius: radius of the object, m; infinite for one without a curve.
        holds: each touch stays in one place.
    """

    def __init__(
        self, plan: Plan, task: Calibrate | Touch, sensing: ContactSensing, count: int, radius: float, *, holds: bool
    ) -> None:
        super().__init__(plan, task.lag_s, sensing, holds=holds)
        self._approach_of, self._count = task.approach, count
        self._number = 0
        self._gone = self._touched_at = 0.0
        sensing.set_kappa(np.full(2, 1.0 / radius))

    def stop(self) -> None:
        """Let go, and do without the touches that are left."""
        self._number = self._count
        super().stop()

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        self._touch.update_force(patch, sample.t_sample_ns)
        if self.phase is Phase.SCAN:
            self.taxels = sample.frame.taxels
        contact = self.sensing.contact(sample, patch) if patch.force > TOUCH_FORCE / 2 else None
        self._columns = felt_columns(self.phase, sample, patch, contact) | {"touch": float(self._number + 1)}
        return contact

    # phases: each returns the pose for this cycle

    def _at(self, gone: float) -> ProbePose:
        """Probe at this touch, its surface a way beyond the object's, m, both as they are expected."""
        raise NotImplementedError

    def _begin(self, pose: ProbePose) -> None:
        """Go to the next touch, or end."""
        if self.reason is not None or self._number >= self._count:
            return self._enter(Phase.DONE)
        self.depth.restart()
        self._line = self._way(pose, self._at(-self._approach_of.clearance))
        self._enter(Phase.MOVE)

    def _way(self, here: ProbePose, there: ProbePose) -> LineMotion | ArcMotion:
        """Way to a touch."""
        return LineMotion(here, there, TOUCH_TO_TOUCH_SPEED)

    def _off(self) -> None:
        self._begin(self._motion.pose)

    def _come(self, least_force: float, what: str, remedy: str) -> ProbePose:
        """Come nearer until a force is felt, N; with words for what is not there, and what helps."""
        self._gone = self._approach_of.speed * self._t - self._approach_of.clearance
        if self._touch.force > least_force:
            self._touched_at = self._gone
            self._enter(Phase.SETTLE)
        elif self._gone > (way := self._search_way(self._approach_of)):
            self.retreat(f"{self._found_nothing(f'touch {self._number + 1}: no {what} found', way)}; or {remedy}")
        return self._at(self._gone)

    def _press_on(self, force: float, longest: float, where: str, remedy: str) -> bool:
        """Press on slowly until a force is reached, N; whether it is. Words for one that is not, a way beyond, m."""
        if self._touch.force >= force:
            self._enter(Phase.SCAN)
            return True
        if self._gone > longest:
            got = f"got {self._touch.force:.2f} N{remedy}"
            self.retreat(f"touch {self._number + 1}: expected {force:g} N {where}, {got}")
        else:
            self._gone += PRESS_SPEED * self._dt
        return False


class CalibrateTask(TouchSeries):
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
        super().__init__(plan, task, sensing, len(task.approaches), task.ball_radius, holds=True)
        self._phases |= {Phase.APPROACH: self._approach, Phase.SETTLE: self._settle, Phase.SCAN: self._scan}
        radii = sensing.radius + task.ball_radius
        self._ball = BallModel(sensing.flange_probe[:3, 3], task.ball_centre, radii, sigma_c=task.ball_sigma)
        self.touches: list[BallTouch] = []
        self.estimate: ToolEstimate | None = None
        self._task = task
        self._felt: list[ContactSample] = []
        self._push = PushFit()
        self._depths: list[tuple[float, float]] = []

    def record(self) -> TaskRecord:
        return replace(super().record(), tool=self.estimate)

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        contact = super()._feel(sample, patch)
        if contact is not None and self.phase in (Phase.APPROACH, Phase.SETTLE):
            self._push.add(self._pushed(contact.T_base_probe[:3, 3]), contact.force_n)
        if contact is not None and self.phase is Phase.SCAN and self._t > SETTLE_S:
            self._felt.append(contact)
        return contact

    def _at(self, gone: float) -> ProbePose:
        touch = self._task.approaches[self._number]
        return ProbePose(self._ball.c_base + (self._ball.radii - gone) * touch.n_base, touch.pole_base)

    def _begin(self, pose: ProbePose) -> None:
        """Go to the next touch, or estimate in the end; after a stop from the touches so far."""
        if self.reason is None and self._number >= self._count and len(self.touches) >= 2:
            self.estimate = calibrate_tool(self._corrected(), self._ball)
        self._push = PushFit()
        super()._begin(pose)

    def _way(self, here: ProbePose, there: ProbePose) -> LineMotion | ArcMotion:
        return ArcMotion(self._ball.c_base, here, there, ROUND_SPEED_M_S)

    def _approach(self) -> ProbePose:
        remedy = "correct task.start_mm and task.ball_radius_mm, or raise task.search_mm"
        return self._come(TOUCH_FORCE, "ball", remedy)

    def _settle(self) -> ProbePose:
        way = self._approach_of.search
        remedy = f" {way * 1e3:g} mm beyond: fix the ball in its place, or correct task.start_mm"
        if self._press_on(self._task.force, way, "at the ball", remedy):
            self._felt = []
        return self._at(self._gone)

    def _scan(self) -> ProbePose:
        if self._t >= SETTLE_S + LISTEN_S:
            if self._felt:
                self.touches.append(self._ball_touch(self._felt))
                self._number += 1
                self._let_go()
            else:
                self.retreat(f"touch {self._number + 1}: no tactile sample while the probe rested: check the array")
        return self._at(self._gone) if self.phase is Phase.SCAN else self._retreat()

    def _ball_touch(self, felt: Sequence[ContactSample]) -> BallTouch:
        """Mean of the samples of a touch at rest."""
        n = np.mean([contact.n_base for contact in felt], axis=0)
        # at rest any orientation will do, and a mean of rotation matrices is none
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
        self._draw_back(n / np.linalg.norm(n) * (self._approach_of.clearance + EXTRA_CLEARANCE_M))


@dataclass(frozen=True, slots=True)
class Press:
    """A touch of the object, with its roll.

    Attributes:
        force: force of the touch, N.
        at: place on the pad where it begins, m.
        roll: half-widths of the roll over the pad along and across its heading, m; both: it is an eight.
        heading: heading of the roll on the pad, rad.
        hz: rates of the roll, one after the other, in equal parts of the time.
        seconds: duration of the roll, s.
    """

    force: float
    at: tuple[float, float] = (0.0, 0.0)
    roll: tuple[float, float] = (1.5e-3, 0.6e-3)
    heading: float = 0.0
    hz: tuple[float, ...] = (0.35,)
    seconds: float = 3.0

    def way(self, t: float) -> tuple[float, float]:
        """Way over the pad from the place where it begins, m, after so many seconds of roll."""
        part = self.seconds / len(self.hz)
        full = min(int(t / part), len(self.hz) - 1)
        # the phase of the parts before goes on: by 2π hz t the probe would jump where the rate changes
        phase = 2.0 * math.pi * (part * sum(self.hz[:full]) + (t - full * part) * self.hz[full])
        x, y = self.roll[0] * math.sin(phase), self.roll[1] * math.sin(2.0 * phase)
        c, s = math.cos(self.heading), math.sin(self.heading)
        return c * x - s * y, s * x + c * y


@dataclass(frozen=True, slots=True, eq=False)
class RollRecord:
    """The record of a touch, image by image, from the moment in which the force was reached.

    Attributes:
        press: the touch as it was planned.
        t_s: times of the images, s.
        images, windows: counts (16, 16), and first row, first column, rows, columns of what was sent.
        T_base_probe: (4, 4) each, of the probe at these times.
        cycles: cycles whose SYNCs triggered them.
    """

    press: Press
    t_s: list[float] = field(default_factory=list)
    images: list[NDArray[np.uint8]] = field(default_factory=list)
    windows: list[tuple[int, int, int, int] | None] = field(default_factory=list)
    T_base_probe: list[Floats] = field(default_factory=list)
    cycles: list[int] = field(default_factory=list)


class RollTask(TouchSeries):
    """Touches an object of known shape again and again, and rolls on it.

    The probe rolls without slipping: the contact goes as far over the object as over the pad. Its centre follows the
    object that is known; only slowly does the depth follow the force.

    Args:
        plan: plan of the cell.
        task: settings with the place that is touched first.
        sensing: contacts from measurements; its force is not trusted, only held.
        presses: the touches.
        radius: radius of the ball, m; infinite for a plane, and for a rod that is rolled along its axis.
        rest_s: time for which images without load are kept before the first touch.

    Attributes:
        presses: the touches, as given.
        pressed: the records, touch by touch.
        unloaded: images before the first touch.
    """

    def __init__(  # noqa: PLR0917
        self, plan: Plan, task: Touch, sensing: ContactSensing, presses: Sequence[Press], radius: float, rest_s: float
    ) -> None:
        super().__init__(plan, task, sensing, len(presses), radius, holds=False)
        self._phases |= {Phase.APPROACH: self._approach, Phase.SETTLE: self._settle, Phase.SCAN: self._scan}
        self._follows_depth = False  # what is calibrated here is the very force that a depth would contradict
        self.pressed: list[RollRecord] = []
        self.unloaded: list[NDArray[np.uint8]] = []
        self.presses, self._radius, self._rest_s = presses, radius, rest_s
        self._axes = np.eye(3)

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        contact = super()._feel(sample, patch)
        pose = self.sensing.probe_at(sample.t_sample_ns)
        if self.phase is Phase.MOVE and not self._number and self._t < self._rest_s:
            self.unloaded.append(sample.frame.taxels)
        if self.phase is Phase.SCAN and pose is not None:
            mine = self.pressed[-1]
            mine.t_s.append(sample.t_sample_ns * 1e-9)
            mine.images.append(sample.frame.taxels)
            mine.windows.append(sample.frame.window)
            mine.T_base_probe.append(pose)
            mine.cycles.append(sample.cycle)
        return contact

    # where the probe is

    def poses(self, x: Floats) -> Iterator[ProbePose]:
        """Poses above each touch and round its roll, for a probe that begins with its x axis along `x` (3,)."""
        self._set_axes(x)
        for number, press in enumerate(self.presses):
            self._number = number
            yield self._at(-self._approach_of.clearance)
            for t in np.linspace(0.0, press.seconds, ROLL_SAMPLES):
                yield self._pose(press.way(float(t)), 0.0)
        self._number = 0

    def _set_axes(self, x: Floats) -> None:
        inward = -self._approach_of.normal
        x = x - inward * float(inward @ x)
        x = x / np.linalg.norm(x)
        self._axes = np.array([x, np.cross(inward, x), inward])

    def _pose(self, way: tuple[float, float], gone: float) -> ProbePose:
        """Rolled by a way over the pad (m), its surface a way beyond the object's, both as they are expected."""
        press = self.presses[min(self._number, len(self.presses) - 1)]
        x_axis, y_axis, inward = self._axes
        along = way[0] * x_axis + way[1] * y_axis
        arc = float(np.linalg.norm(along))
        foot, normal = self._approach_of.start, -inward
        if math.isinf(self._radius):
            foot = foot + along
        elif arc > 0.0:
            angle = arc / self._radius
            turned = math.cos(angle) * normal + math.sin(angle) * along / arc
            foot, normal = foot + self._radius * (turned - normal), turned
        u, v = press.at[0] + way[0], press.at[1] + way[1]
        off = math.hypot(u, v) / self.sensing.radius
        aside = (u * x_axis + v * y_axis) / max(math.hypot(u, v), 1e-12)
        aside = aside + normal * float(inward @ aside)
        aside = aside - normal * float(normal @ aside)
        pole = -math.cos(off) * normal - math.sin(off) * aside / max(float(np.linalg.norm(aside)), 1e-12)
        return ProbePose(foot + normal * (self.sensing.radius - gone), pole)

    def _at(self, gone: float) -> ProbePose:
        return self._pose((0.0, 0.0), gone)

    def _begin(self, pose: ProbePose) -> None:
        if self._number == 0:
            self._set_axes(self._motion.pose_matrix[:3, 0])
        super()._begin(pose)

    def _move(self) -> ProbePose:
        if self._number == 0 and self._t < self._rest_s:
            return self._line.at(0.0)
        if self._number == 0 and self._rest_s > 0.0:
            self._rest_s, self._t = 0.0, 0.0
        return super()._move()

    def _approach(self) -> ProbePose:
        return self._come(TOUCH_FORCE + self._floor, "object", "move the object there, or correct its place")

    def _settle(self) -> ProbePose:
        press, where = self.presses[self._number], f"within {MAX_PRESS_WAY * 1e3:g} mm of the first touch"
        remedy = ": fix the object in its place"
        if self._press_on(press.force, self._touched_at + MAX_PRESS_WAY, where, remedy):
            self.pressed.append(RollRecord(press))
        return self._at(self._gone)

    def _scan(self) -> ProbePose:
        press = self.presses[self._number]
        depth = self.sensing.depth(press.force)
        error = depth * (1.0 - math.sqrt(max(self._touch.force, 0.0) / press.force))  # force goes with depth squared
        self._gone += 2.0 * math.pi * FORCE_HZ * self._dt * error
        if self._t >= press.seconds:
            self._number += 1
            self._let_go()
            return self._retreat()
        return self._pose(press.way(self._t), self._gone)

    def _let_go(self) -> None:
        self._draw_back(-self._axes[2] * (self._approach_of.clearance + 2e-3))
