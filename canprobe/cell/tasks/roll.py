"""Press the probe on a known plane or ball at places of its pad, roll to and fro there, and keep the images."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.calibrate import PRESS_SPEED
from canprobe.cell.tasks.probing import Phase, ProbingTask
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.mechanics.touch import ContactSample, Patch
from canprobe.mechanics.touch.probe_motion import LineMotion
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.types import Floats

TOUCH_TO_TOUCH_SPEED = 30e-3
"""Speed from touch to touch, m/s."""
FORCE_HZ = 0.5
"""Bandwidth with which the force is held; slower than a roll, so that its images have one depth."""
MAX_PRESS_WAY = 3e-3
"""Way beyond the first touch, m, after which the object counts as one that gives way."""
ROLL_SAMPLES = 24
"""Poses of a roll whose reach is checked."""


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


class RollTask(ProbingTask):
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
        super().__init__(plan, task.lag_s, sensing)
        self._phases |= {Phase.APPROACH: self._approach, Phase.SETTLE: self._settle, Phase.SCAN: self._scan}
        self._follows_depth = False  # what is calibrated here is the very force that a depth would contradict
        self.pressed: list[RollRecord] = []
        self.unloaded: list[NDArray[np.uint8]] = []
        self._approach_of = task.approach
        self.presses, self._radius, self._rest_s = presses, radius, rest_s
        self._number = 0
        self._gone = self._touched_at = 0.0
        self._axes = np.eye(3)
        sensing.set_kappa(np.full(2, 0.0 if math.isinf(radius) else 1.0 / radius))

    def stop(self) -> None:
        self._number = len(self.presses)
        super().stop()

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        self._touch.update_force(patch, sample.t_sample_ns)
        pose = self.sensing.probe_at(sample.t_sample_ns)
        if self.phase is Phase.MOVE and not self._number and self._t < self._rest_s:
            self.unloaded.append(sample.frame.taxels)
        if self.phase is Phase.SCAN and pose is not None:
            self.taxels = sample.frame.taxels
            mine = self.pressed[-1]
            mine.t_s.append(sample.t_sample_ns * 1e-9)
            mine.images.append(sample.frame.taxels)
            mine.windows.append(sample.frame.window)
            mine.T_base_probe.append(pose)
            mine.cycles.append(sample.cycle)
        contact = self.sensing.contact(sample, patch) if patch.force > TOUCH_FORCE / 2 else None
        self._columns = self._felt_columns(sample, patch, contact) | {"touch": float(self._number + 1)}
        return contact

    # where the probe is

    def poses(self, x: Floats) -> Iterator[ProbePose]:
        """Poses above each touch and round its roll, for a probe that begins with its x axis along `x` (3,)."""
        self._set_axes(x)
        for number, press in enumerate(self.presses):
            self._number = number
            yield self._pose((0.0, 0.0), -self._approach_of.clearance)
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

    # phases: each returns the pose for this cycle

    def _begin(self, pose: ProbePose) -> None:
        """Go to the next touch, or end."""
        if self._number == 0:
            self._set_axes(self._motion.pose_matrix[:3, 0])
        if self.reason is not None or self._number >= len(self.presses):
            return self._enter(Phase.DONE)
        self.depth.restart()
        self._line = LineMotion(pose, self._pose((0.0, 0.0), -self._approach_of.clearance), TOUCH_TO_TOUCH_SPEED)
        self._enter(Phase.MOVE)

    def _off(self) -> None:
        self._begin(self._motion.pose)

    def _move(self) -> ProbePose:
        if self._number == 0 and self._t < self._rest_s:
            return self._line.at(0.0)
        if self._number == 0 and self._rest_s > 0.0:
            self._rest_s, self._t = 0.0, 0.0
        return super()._move()

    def _approach(self) -> ProbePose:
        self._gone = self._approach_of.speed * self._t - self._approach_of.clearance
        if self._touch.force > TOUCH_FORCE + self._floor:
            self._touched_at = self._gone
            self._enter(Phase.SETTLE)
        elif self._gone > (way := self._search_way(self._approach_of)):
            nothing = self._found_nothing(f"touch {self._number + 1}: no object found", way)
            self.retreat(f"{nothing}; or move the object there, or correct its place")
        return self._pose((0.0, 0.0), self._gone)

    def _settle(self) -> ProbePose:
        """Press on slowly until the force is reached."""
        press = self.presses[self._number]
        if self._touch.force >= press.force:
            self.pressed.append(RollRecord(press))
            self._enter(Phase.SCAN)
        elif self._gone > self._touched_at + MAX_PRESS_WAY:
            self.retreat(
                f"touch {self._number + 1}: expected {press.force:g} N within {MAX_PRESS_WAY * 1e3:g} mm of the first"
                f" touch, got {self._touch.force:.2f} N: fix the object in its place"
            )
        else:
            self._gone += PRESS_SPEED * self._dt
        return self._pose((0.0, 0.0), self._gone)

    def _scan(self) -> ProbePose:
        press = self.presses[self._number]
        depth = self.sensing.depth(press.force)
        error = depth * (1.0 - math.sqrt(max(self._touch.force, 0.0) / press.force))
        self._gone += 2.0 * math.pi * FORCE_HZ * self._dt * error
        if self._t >= press.seconds:
            self._number += 1
            self._let_go()
            return self._retreat()
        return self._pose(press.way(self._t), self._gone)

    def _let_go(self) -> None:
        self._draw_back(-self._axes[2] * (self._approach_of.clearance + 2e-3))
