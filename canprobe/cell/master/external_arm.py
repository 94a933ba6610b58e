"""An arm that is not on the bus: poses of its flange in, poses of its flange out.

`FlangeGroup` stands where the drives of another arm stand. Its joints are the coordinates of the flange, which are
measured when the arm says so, on its own clock, and carried on to the SYNC of the cycle.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

import numpy as np

from canprobe.cell.master.drives import UNSTATED_LAG_S, DriveAxis, DriveCommand, DriveGroup, DriveTargets
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.units import lag_s
from canprobe.errors import ArmError, CanprobeError
from canprobe.fieldbus.protocol.cia402 import DriveState
from canprobe.mechanics.robot.flange import flange_joints, flange_pose
from canprobe.mechanics.robot.model import joints_to_units, units_to_joints
from canprobe.mechanics.types import Floats

FRESH_PERIODS = 1.5
"""Age of a pose, periods, up to which it is of this cycle: the arm's period and the cycle's go past each other."""
DRIFT = 5000
"""Inverse of the drift between the clocks that the offset follows: 200 ppm."""
RIGID = 1e-4
"""Largest error of a pose's rotation: five digits on a wire."""


class ExternalArm(Protocol):
    """An arm behind an interface of its own, for a cell with `arm.kind = "external"`.

    The cell calls the methods from one thread: `read` once at the beginning of each cycle, then `command` once in it.
    None of them may wait longer than a small part of a cycle. What they raise ends the run, and `stop` is called.
    """

    def read(self) -> tuple[Floats, int]:
        """The newest pose of the flange.

        Returns:
            T_base_flange (4, 4), float64, m, in the base frame of the arm; and the time at which the flange was there,
            ns on the clock of the arm, whose zero may be anywhere. The cell finds its offset from the clock of the bus.
        """
        ...

    def command(self, T_base_flange: Floats) -> None:
        """Send the flange to a pose (4, 4), m, in the base frame of the arm, within a cycle or as soon as it can.

        The arm takes each pose in the place of the one before. It stops by itself where none comes for
        `arm.stop_after_ms`. The first pose after `stop` is where the arm stands.
        """
        ...

    def stop(self) -> None:
        """Stop the arm at once and let it hold its place; called on every way out, more than once."""
        ...


@contextmanager
def naming_arm(method: str) -> Iterator[None]:
    """Call a method of an external arm: what it raises becomes an `ArmError`."""
    try:
        yield
    except CanprobeError:
        raise
    except Exception as error:
        raise ArmError(f"{method}: {type(error).__name__}: {error}") from error


@contextmanager
def stopping(arm: ExternalArm) -> Iterator[ExternalArm]:
    """Stop an arm on the way out, whatever has been stopped before."""
    try:
        yield arm
    finally:
        with suppress(ArmError), naming_arm("stop"):
            arm.stop()


class FlangeGroup(DriveGroup):
    """The coordinates of the flange of an external arm, in the place of drives; none of them has a statusword.

    The offset of the arm's clock from that of the bus is known by the least delay of its poses: that delay itself
    counts as none. What is later than it is the age of a pose.

    Args:
        plan: plan of a cell with an external arm.
        arm: the arm.
    """

    def __init__(self, plan: Plan, arm: ExternalArm) -> None:
        model = plan.setup.needed_arm().model
        super().__init__(tuple(DriveAxis(0, (), ()) for _ in model.joints), model, period_ns=plan.sync.period_ns)
        self.targets: FlangeTargets = FlangeTargets(self, arm, lag_s(plan.setup, UNSTATED_LAG_S))
        self.statuswords = []
        self._arm, self._arm_ns, self._offset_ns = arm, 0, 0  # of the newest pose, on the arm's clock
        self._pose_ns = self._age_ns = self._jitter_ns = self._oldest_ns = 0
        self._disbelieved = False

    def begin(self, cycle: int, t_ns: int = 0, deadline_ns: int | None = None) -> None:
        super().begin(cycle, t_ns, deadline_ns)
        with naming_arm("read"):
            pose, arm_ns = self._arm.read()
            T, arm_ns = np.asarray(pose, dtype=np.float64), int(arm_ns)
        R = T[:3, :3] if T.shape == (4, 4) else np.zeros((3, 3))
        if not (np.isfinite(T).all() and np.abs(R @ R.T - np.eye(3)).max() < RIGID and np.linalg.det(R) > 0.0):
            raise ArmError(f"read: expected a pose (4, 4) with a rotation, got {T.tolist()}")
        # an arm that is slower than the cycle gives its last pose again, which is no report
        if arm_ns > self._arm_ns or not self._all_heard:
            # the least delay may rise by the drift: held for ever, it would make the poses of a slower clock ever older
            offset_ns = self._offset_ns + (arm_ns - self._arm_ns) // DRIFT
            self._offset_ns = min(offset_ns, t_ns - arm_ns) if self._all_heard else t_ns - arm_ns
            self._arm_ns = arm_ns
            self._take(joints_to_units(self.model, flange_joints(self.model, T)), t_ns - arm_ns - self._offset_ns)
        self._age_ns = self.deadline_ns - self._pose_ns
        self._oldest_ns = max(self._oldest_ns, self._age_ns)

    def _take(self, counts: Floats, age_ns: int) -> None:
        """Take a pose of an age; where a coordinate cannot have come there, it is not believed."""
        pose_ns, guarded = self.deadline_ns - age_ns, self.enabled and self.targets.sent is not None
        self._jitter_ns = max(self._jitter_ns, age_ns)
        tracks = zip(self.tracks, counts.tolist(), strict=True)
        taken = [track.take(round(one), self.cycle, pose_ns, guarded=guarded) for track, one in tracks]
        self._disbelieved = not all(taken)
        if self._disbelieved:
            self.implausible += 1
        else:
            self._pose_ns, self._all_heard = pose_ns, True

    def figures(self) -> dict[str, float]:
        """Offset of the arm's clock from that of the bus and its jitter, and the age of the oldest pose in use, ms."""
        times = {"clock_offset": self._offset_ns, "jitter": self._jitter_ns, "age_max": self._oldest_ns}
        return {f"{name}_ms": 1e-6 * ns for name, ns in times.items()}

    def ages(self) -> tuple[int, ...]:
        overdue = -(-(self._age_ns - round(FRESH_PERIODS * self.period_ns)) // self.period_ns)
        return (max(overdue, int(self._disbelieved)),) * len(self.tracks)

    def joints(self) -> Floats:
        # + 1, as if no report had come: a pose that was read in this cycle is older than its SYNC, and is carried on
        q = units_to_joints(self.model, [track.position(self.cycle + 1, self.deadline_ns) for track in self.tracks])
        q.flags.writeable = False
        return q

    @property
    def states(self) -> tuple[DriveState | None, ...]:
        """The state that the arm is led into, by its poses: it is left once the arm rests."""
        stopped = DriveState.SWITCH_ON_DISABLED if all(self.rests) else DriveState.QUICK_STOP_ACTIVE
        return tuple([DriveState.OPERATION_ENABLED if on else stopped for on in self.enabled_ones()])

    def enabled_ones(self) -> tuple[bool, ...]:
        return (self.targets.goal is DriveState.OPERATION_ENABLED,) * len(self.tracks)

    @property
    def jitter_ns(self) -> int:
        return self._age_ns


class FlangeTargets(DriveTargets):
    """Where the flange is sent.

    Args:
        drives: the poses that the arm reports.
        arm: the arm.
        lag_s: lag of the arm behind a ramp, with its dead time.
    """

    def __init__(self, drives: FlangeGroup, arm: ExternalArm, lag_s: float) -> None:
        self._arm = arm
        self._goal = DriveState.SWITCH_ON_DISABLED  # before the base, which sets `goal`
        super().__init__(drives, 1, lag_s)

    @property
    def goal(self) -> DriveState:
        """State that the arm is led into; leaving operation enabled stops it at once."""
        return self._goal

    @goal.setter
    def goal(self, goal: DriveState) -> None:
        before, self._goal = self._goal, goal
        if before is DriveState.OPERATION_ENABLED is not goal:
            with naming_arm("stop"):
                self._arm.stop()

    def commands(self) -> list[DriveCommand]:
        """Command the arm; no RPDO goes to it."""
        drives = self._drives
        self.aim(drives.counts if self._counts is None else self._counts)
        if drives.enabled and self.sent is not None:
            with naming_arm("command"):
                self._arm.command(flange_pose(drives.model, units_to_joints(drives.model, self.sent)))
        return []
