"""A touch task whose path and force are set from outside, with the usual servo and supervision."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.from_plan import make_sensing, make_shape_tracker
from canprobe.cell.tasks.task import Phase
from canprobe.cell.tasks.touch import TouchTask
from canprobe.mechanics.touch import ContactSample, Patch, SurfaceEstimate
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.touch.strategies import PathFollower
from canprobe.mechanics.types import Floats


class _Heading(PathFollower):
    """A follower without a curve: it moves at the velocity that the agent sets."""

    def __init__(self) -> None:
        self.direction = (1.0, 0.0)

    @property
    def heading(self) -> tuple[float, float]:
        return self.direction

    def step(self, x: float, y: float, distance_m: float) -> tuple[float, float]:
        return self.direction


class LedTask(TouchTask):
    """Approaches and touches as a scan does; then follows `lead`, until the cell is closed or the probe lets go.

    The contact frame is on the surface model of the servo: z is the outward normal, x the heading of the scan
    laid into the tangent plane, y = z × x.

    Args:
        plan: plan of a scan.

    Attributes:
        axes: rows of the scan plane (3, 3): heading, across, approach normal; base frame.
        wanted_force: contact force that the scene asks for, N.
        top_speed: speed of the scene's scan, m/s.
        velocity: present velocity of the contact (2,), in the contact frame, m/s.
    """

    def __init__(self, plan: Plan) -> None:
        task = plan.setup.task
        assert isinstance(task, Touch) and task.scan is not None
        super().__init__(
            plan, replace(task, duration_s=math.inf), make_sensing(task), make_shape_tracker(plan.setup, with_map=False)
        )
        self.axes = task.approach.axes
        self.wanted_force = task.force
        self.top_speed = task.scan.speed
        self.velocity = 0.0, 0.0
        self._heading = _Heading()
        self._change = 0.0, 0.0, 0.0
        self._left = 0
        self.tables.clear()
        self.targets["speed_m_s"] = 0.0
        self._newest: ContactSample | None = None

    @property
    def touching(self) -> bool:
        """Whether the probe is in contact and can be led."""
        return self.phase is Phase.SCAN

    @property
    def ended(self) -> bool:
        """Whether the probe lets go, or has let go."""
        return self.phase in (Phase.RETREAT, Phase.DONE)

    @property
    def last_contact(self) -> ContactSample:
        """The newest contact; there is one from the touch-down on."""
        assert self._newest is not None
        return self._newest

    @property
    def estimate(self) -> SurfaceEstimate | None:
        """The newest answer of the estimator; None before the first, or without one."""
        return self.shape.records[-1].estimate if self.shape is not None and self.shape.records else None

    @property
    def force(self) -> float:
        """Last measured force, N."""
        return self._touch.force

    def frame(self, normal: Floats) -> Floats:
        """Rows x, y, z (3, 3) of the contact frame in base, for an outward unit normal (3,)."""
        x = self.axes[0] - (normal @ self.axes[0]) * normal
        x /= np.linalg.norm(x)
        return np.array((x, np.cross(normal, x), normal))

    def lead(self, velocity: Floats, force: float, cycles: int) -> None:
        """Change to a velocity of the contact (2,), m/s, and a force, N, evenly within a number of cycles."""
        vx, vy = self.velocity
        dx, dy, more = float(velocity[0]) - vx, float(velocity[1]) - vy, force - self.targets["target_force_n"]
        self._change, self._left = (dx / cycles, dy / cycles, more / cycles), cycles

    def _feel(self, sample: TactileSample, patch: Patch) -> ContactSample | None:
        contact = super()._feel(sample, patch)
        self._newest = self._contact or self._newest
        return contact

    def _leader(self, contact: ContactSample) -> tuple[PathFollower, Floats]:
        return self._heading, contact.p_base

    def _scan(self) -> ProbePose:
        assert self._servo is not None
        vx, vy = self.velocity
        if self._left:
            self._left -= 1
            dx, dy, more = self._change
            self.velocity = vx, vy = vx + dx, vy + dy
            self.targets["target_force_n"] += more
        self.targets["speed_m_s"] = speed = math.hypot(vx, vy)
        if speed > 0.0:
            # x = (h − (n·h) n)/s with s its length and y = n × x, seen from above the scan plane of h, c = u × h and u
            nh, nc, nu = (self.axes @ self._servo.surface.normal).tolist()
            s = math.sqrt(1.0 - nh * nh)
            along, across = vx * s, (vy * nu - vx * nh * nc) / s
            in_plane = math.hypot(along, across)
            self._heading.direction = (along / in_plane, across / in_plane)
        return super()._scan()
