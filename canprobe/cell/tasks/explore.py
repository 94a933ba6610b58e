"""Exploration: a scan whose path goes where the map of the surface is not sure enough.

The servo, the supervision and all that a scan does are those of `TouchTask`. Here a stretch is chosen behind the
commands of each cycle, and the scan ends where the map is sure enough. At an edge, in a hollow as tight as the probe,
before a joint's limit, and before it runs off the array, the contact brakes and goes back on the path that it
came; the ground ahead is closed. A contact that is lost there is found again on that path, to which the probe returns
in the air.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any

import numpy as np

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.contact import edge_margin
from canprobe.cell.tasks.task import Phase, TaskRecord
from canprobe.cell.tasks.touch import SEARCH_SPEED, Search, TouchTask
from canprobe.mechanics.touch import ContactSample, Patch
from canprobe.mechanics.touch.explore.explorer import BACK_M, Explorer
from canprobe.mechanics.touch.explore.ground import UNKNOWN_M, GroundCells
from canprobe.mechanics.touch.explore.lanes import LaneForecast
from canprobe.mechanics.touch.explore.stretches import STEP_M
from canprobe.mechanics.touch.map.cells import STATED_STIFFNESS_SIGMA
from canprobe.mechanics.touch.map.stiffness import SOURCE_SIGMA
from canprobe.mechanics.touch.probe_motion import RETREAT_SPEED_M_S
from canprobe.mechanics.touch.servo import RAMP_S, ProbePose
from canprobe.mechanics.touch.strategies import Rectangle, turn_radius
from canprobe.mechanics.types import Floats

SHARES_AHEAD = 40
"""Cycles before the end of a stretch from which on the next one is looked for: a path is judged in each."""
AHEAD = 8
"""Number of points of the path ahead that are logged."""
SAMPLE_AGE_CYCLES = 4
"""Usual age of a contact when it is taken, in cycles: the array's latency and its transfer."""
LIMIT_S = 0.2
"""Time before a joint would come to its limit at which the contact turns back: four times that of braking."""
RIM_M = 1.5e-3
"""Distance on the array, m, before the place from which on it has lost a part of the force: there the contact turns."""
LIFT_M = 1.5e-3
"""Distance off the surface at which the probe returns to where it had contact, m."""


class ExploreTask(TouchTask):
    """Approach an object, touch it, and explore a rectangle round the first contact; arguments as for `TouchTask`.

    Attributes:
        explorer: what leads the contact; None before the touch.
    """

    explorer: Explorer  # from the first touch on
    _brake_from: float | None = None
    _near_rim = False
    _ends = False

    def _leader(self, contact: ContactSample) -> tuple[Explorer, Floats]:
        """Its origin is the end of the approach: an inclined surface is touched beside it, and the rectangle stays."""
        scan = self._task.scan
        assert scan is not None and isinstance(scan.strategy, Rectangle)
        surface_map = self.shape.surface_map if self.shape is not None else None
        assert surface_map is not None
        area = scan.strategy
        shown = self.sensing.slope is not None or self._task.array.mode != "features"
        ground = GroundCells(
            surface_map,
            self._task.approach.start,
            self._task.approach.axes,
            area,
            stiffness_sigma=SOURCE_SIGMA if shown else STATED_STIFFNESS_SIGMA,
        )
        forecast = LaneForecast(self.sensing.radius, self._target_depth(), surface_map.noise)
        radius = turn_radius(scan.speed, self._task.gains.tilt_hz)
        self.explorer = Explorer(
            ground,
            forecast,
            (area.length, area.width),
            start=ground.in_plane(contact.p_base),
            radius=radius,
            ahead=SHARES_AHEAD * self._period_s * scan.speed,
            lag=(self._lead_s + SAMPLE_AGE_CYCLES * self._period_s) * scan.speed,
        )
        reach = self._task.array.pad.reach_m  # of an array that is as small as the patch, no place is near its edge
        self._rim = rim if (rim := edge_margin(self._task) + RIM_M) < reach else 0.0
        self._gone: deque[ProbePose] = deque(maxlen=round(BACK_M / STEP_M))
        return self.explorer, self._task.approach.start

    def record(self) -> TaskRecord:
        explored = end_of(self.explorer, self._scan_t, over=not self._ends) if self._touched else None
        return replace(super().record(), explored=explored)

    def update(self) -> None:
        """The work of estimator and map, and one share of the exploration's."""
        due = not self._updated
        super().update()
        if due and self.phase is Phase.SCAN:
            self.explorer.work()

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        contact = super()._feel(sample, patch)
        if self.phase is Phase.SCAN and contact is not None:
            from_edge = self._task.array.pad.reach_m - max(abs(patch.u), abs(patch.v))
            self._near_rim = from_edge < self._rim
            # an edge shows in contact and force together: by the contact alone a fillet of 22 mm would pass for one
            self.explorer.walk(contact.p_base, contact.n_base, contact.force_n / self.targets["target_force_n"])
            places = self.explorer.ground.in_base(self.explorer.ahead(AHEAD)).tolist()
            ahead = [self._servo.surface.foot(place)[0] for place in places]
            self._columns = self._columns | {
                "explored_mm": 1e3 * self.explorer.path,
                "explored_sigma_um": 1e6 * self.explorer.ground.largest,
                "explored_within": float(np.mean(self.explorer.ground.sigma <= self.explorer.ground.target)),
                "explored_ahead_mm": 1e3 * np.array(ahead),
            }
        return contact

    def _watch(self) -> None:
        if self.phase is Phase.SCAN:
            if self.explorer.astray and self._touch.limits.regain > 0.0:
                self._look_for_contact()
            elif self.explorer.at_edge or self._near_rim or self._motion.near_limit(LIMIT_S):
                self._brake()  # the probe turns round an edge, or the array or a joint ends
        super()._watch()

    def _at_hollow(self, radius: float) -> None:
        self._brake()

    def _brake(self) -> None:
        """Begin to turn back, unless the contact goes back already."""
        if self._brake_from is None and not self.explorer.going_back:
            self._brake_from = self._scan_t

    def _pace(self, left: float) -> float:
        if not self._ends and not self.explorer.ground.wanting.any():
            self._ends = True
            self._task = replace(self._task, duration_s=self._scan_t + RAMP_S)
        pace = super()._pace(left)
        if self._brake_from is None:
            return pace
        slower = 1.0 - (self._scan_t - self._brake_from) / RAMP_S
        if slower > 0.0:
            return min(pace, slower)
        self._brake_from, self._t = None, 0.0
        self.explorer.turn_back()
        return 0.0

    def _scan(self) -> ProbePose:
        pose = super()._scan()
        if not self._gone or np.linalg.norm(pose.centre - self._gone[-1].centre) > STEP_M:
            self._gone.append(pose)
        return pose

    def _look_for_contact(self) -> None:
        """Return to where the contact was, in the air over the path."""
        super()._look_for_contact()
        self._brake_from = None
        self.explorer.turn_back(without=BACK_M)
        self._search = Return([self._motion.pose, *reversed(self._gone)])
        self._gone.clear()


class Return(Search):
    """Off the object, back in the air over poses that had contact, and down again at the last of them.

    Args:
        poses: poses of the probe, that where the contact was lost first.
    """

    def __init__(self, poses: list[ProbePose]) -> None:
        raised = [ProbePose(pose.centre - LIFT_M * pose.pole, pose.pole) for pose in poses]
        self._poses = [poses[0], *raised]
        steps = [float(np.linalg.norm(b.centre - a.centre)) for a, b in zip(self._poses, self._poses[1:], strict=False)]
        self._times = np.concatenate([[0.0], np.cumsum(steps)]) / RETREAT_SPEED_M_S

    def pose(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the loss."""
        centre, pole = (
            np.array([np.interp(t, self._times, column) for column in zip(*values, strict=True)])
            for values in ([pose.centre for pose in self._poses], [pose.pole for pose in self._poses])
        )
        pole /= np.linalg.norm(pole)
        return ProbePose(centre + SEARCH_SPEED * max(0.0, t - self._times[-1]) * pole, pole)

    def searched(self, t: float) -> float:
        """Distance beyond the known surface that was searched by then, m."""
        return max(0.0, SEARCH_SPEED * (t - float(self._times[-1])) - LIFT_M)


def end_of(explorer: Explorer, seconds: float, *, over: bool) -> dict[str, Any]:
    """The section ``explore`` of ``summary.json``.

    Args:
        explorer: at the end of its way.
        seconds: time of the scan, s.
        over: its time was over; else it had nothing more to gain.

    Returns:
        The largest stated deviation is None where a cell was not touched. The shares of the rectangle are those within
        the target, beyond where the contact turned back, and where contacts contradict every smooth surface.
    """
    ground = explorer.ground
    target, sigma, is_open = ground.target, ground.sigma, ~ground.closed
    within = is_open & (sigma <= target)
    scatter2 = ground.floor**2 - ground.common**2
    # the scatter has to be the larger part: 2 µm beside 8 µm in common made 48 % of a smooth ellipsoid rough
    rough = is_open & (ground.floor > target) & (scatter2 > ground.common**2)
    causes = []
    if ground.common > target:
        causes.append(
            f"{1e6 * ground.common:.0f} µm of the deviation, from the stiffness of the layer, are common to the scan"
        )
    if ground.closed.any():
        causes.append(
            f"{100 * ground.closed.mean():.0f} % of the rectangle lie beyond an edge, in a hollow, or where a joint or"
            " the array ends"
        )
    if rough.any():
        causes.append(
            f"on {100 * rough.mean():.0f} % the contacts contradict a smooth surface: its curvature changes within a"
            " contact patch, or the probe is too blunt to touch all of that ground"
        )
    if over and ground.wanting.any():
        causes.append(f"the time was over with {100 * ground.wanting.mean():.0f} % still above what can be reached")
    reached = bool(within.all())
    why = None if reached else "; ".join(causes) or "the last cells are within a tenth of what can be reached"
    return {
        "target_sigma_um": 1e6 * target,
        "sigma_max_um": 1e6 * ground.largest if ground.largest < UNKNOWN_M else None,
        "reached": reached,
        "why_not": why,
        "path_mm": 1e3 * explorer.path,
        "time_s": seconds,
        "done_fraction": float(within.mean()),
        "closed_fraction": float(ground.closed.mean()),
        "rough_fraction": float(rough.mean()),
        "common_sigma_um": 1e6 * ground.common,
    }
