"""Taking the probe off the object without its task: with the drives that still obey, a short way back along the pole.

A lost drive stands still, by its own quick stop or because it gets no targets, and its position is known. The others
carry the tool's point away from the object on a straight line, its orientation left open. A drive that reports a
position it cannot have reached may be moving: then nothing is moved.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import Command
from canprobe.cell.master.drives import DriveGroup
from canprobe.cell.master.supervisor import Supervisor
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import Plan
from canprobe.errors import NodeError
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.mechanics.robot.chain import forward_jacobian
from canprobe.mechanics.robot.model import ArmModel, joints_to_units, units_to_joints
from canprobe.mechanics.robot.remaining_drives import lifting_step
from canprobe.mechanics.types import Floats

LIFT_WAY = 6e-3
"""Length of the way back, m: as far as a touch retreats, and further than the softest pad is pressed in."""
LIFT_SPEED = 20e-3
"""Mean speed of the way back, m/s; it begins with twice as much, which then falls to zero."""
ARRIVAL_S = 0.02
"""Time for the drives to make up their lag at the end."""


class WayBack:
    """The way of the tool's point off the object, cycle by cycle: targets of the motors from the measured joints.

    It begins where the arm stands, not at its last targets. In a motion those lie ahead of it: where one joint has
    stopped, the others would go on to them without it, and into the object.

    Args:
        model: the arm's geometry.
        flange_probe: transform (4, 4) from the probe's centre frame to the flange.
        period_s: period of the cycle.
        free: drives (n,) that may move.
    """

    def __init__(self, model: ArmModel, flange_probe: Floats, period_s: float, free: NDArray[np.bool_]) -> None:
        self._model, self._flange_probe, self._period_s, self._free = model, flange_probe, period_s, free
        self._targets: Floats | None = None
        self._away: Floats | None = None
        self._t = 0.0

    def step(self, measured: Floats) -> Floats | None:
        """Joint targets (n,), rad or m, of this cycle; None at the end of the way, or where it cannot go on.

        Args:
            measured: joint positions (n,), rad or m.
        """
        T, J = forward_jacobian(self._model.chain, measured, self._flange_probe)
        if self._away is None or self._targets is None:
            self._away, self._targets = -T[:3, 2], joints_to_units(self._model, measured)
        before, self._t = self._gone(self._t), self._t + self._period_s
        if self._t > LIFT_WAY / LIFT_SPEED + ARRIVAL_S:
            return None
        move = self._away * (self._gone(self._t) - before)
        if move.any():
            units = lifting_step(self._model, J[:3], move, self._free)
            if units is None:
                return None
            self._targets = self._targets + units
        return units_to_joints(self._model, self._targets)

    @staticmethod
    def _gone(t: float) -> float:
        """Way after ``t`` seconds, m."""
        return LIFT_WAY * (1.0 - max(1.0 - t * LIFT_SPEED / LIFT_WAY, 0.0) ** 2)


class LiftOff:
    """A way back of the probe, cycle by cycle.

    Args:
        plan: plan of a cell with an arm.
        drives: drives of the arm; those that do not obey are stopped from now on.
        watch: what the nodes report of themselves.
        error: why the cell is stopped; the node that it names does not obey.
    """

    def __init__(self, plan: Plan, drives: DriveGroup, watch: NodeWatch, error: BaseException) -> None:
        assert plan.setup.arm is not None
        self._drives = drives
        heard = zip(drives.axes, drives.ages(), drives.enabled_ones(), strict=True)
        self._free = np.array([age == 0 and on and _obeys(watch, axis.node_id, error) for axis, age, on in heard])
        self._way = WayBack(
            plan.setup.arm.model,
            plan.setup.probe.T_flange_probe,
            plan.sync.period_ns * 1e-9,
            self._free,
        )
        self._force_known_from: int | None = None
        self._highest = 0.0

    @property
    def possible(self) -> bool:
        """Some drives obey, and none reports a position that it cannot have reached."""
        return bool(self._free.any()) and not self._drives.disbelieved

    def begin(self) -> None:
        """Stop the drives that do not obey."""
        axes = zip(self._drives.axes, self._free, strict=True)
        self._drives.stopped = frozenset(axis.node_id for axis, free in axes if not free)

    def command(self, supervisor: Supervisor) -> Command | None:
        """The command of this cycle; None at the end, and where the force grows on the way back."""
        measurement, force = supervisor.seen.measurement, supervisor.felt()
        if measurement.q is None or self._drives.disbelieved or not self._still_obeyed():
            return None
        q = self._way.step(measurement.q)
        if q is None:
            return None
        command, finding = supervisor.guard_target(Command(q))
        if self._force_known_from is None:
            self._force_known_from = measurement.cycle + supervisor.seen.limits.cycles_to_feel
        if measurement.cycle < self._force_known_from:  # what is felt is from before the way back
            self._highest = max(self._highest, force)
        return None if finding is not None or supervisor.must_stop() or force > self._highest else command

    def _still_obeyed(self) -> bool:
        """A TPDO may be missing now and then; a drive that has left operation does not come back."""
        enabled = np.array(self._drives.enabled_ones())
        late = np.array(self._drives.ages()) >= 3
        return not bool((self._free & (~enabled | late)).any())


def _obeys(watch: NodeWatch, node_id: int, error: BaseException) -> bool:
    """Whether a node obeys by NMT and EMCY: not the one that the cell is stopped for."""
    if isinstance(error, NodeError) and error.node_id == node_id:
        return False
    return watch.states.get(node_id) is NmtState.OPERATIONAL and node_id not in watch.alarmed
