"""Taking the probe off the object without its task: with the drives that still obey, a short way back.

Where all of them obey and the way that the probe has come is known to be free, it goes back on that (`trail`).
Otherwise the way is computed: along the pole.

A lost drive stands still, by its own quick stop or because it gets no targets, and its position is known. The others
carry the tool's point away from the object on a straight line, its orientation left open. A drive that reports a
position it cannot have reached may be moving: then nothing is moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain, repeat

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import Command
from canprobe.cell.master.drives import DriveGroup
from canprobe.cell.master.supervised_cycle import SupervisedCycle
from canprobe.cell.master.supervisor import Supervisor
from canprobe.cell.master.trail import ARRIVAL_S, WAY_BACK, WAY_BACK_SPEED, GrowingForce, Retrace, TakenWay, way_gone
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import Plan
from canprobe.errors import ArmError, CanprobeError, NodeError
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.mechanics.robot.chain import forward_jacobian
from canprobe.mechanics.robot.inverse import lifting_step
from canprobe.mechanics.robot.model import ArmModel, joints_to_units, units_per_motor, units_to_joints
from canprobe.mechanics.types import Floats

REST_S = 0.05
"""Time in which drives come to rest at their last targets before a quick stop, s: the longest usual lag."""
LEAP_RAD = 10e-3
"""Distance of a joint from its target, rad, beyond which it does not lag: at 25 mm/s the joints lag by 7 mrad."""


class WayBack:
    """The way of the tool's point off the object, cycle by cycle, from given targets of the motors on.

    In a motion the last targets lie ahead of the arm. A way from where the arm is would begin with a jump against the
    motion, behind which each joint overshoots in its own way (7 N at 25 mm/s, instead of 2). A motor that is further
    from its target than it lags in a motion begins where it is.

    Args:
        model: the arm's geometry.
        flange_point: transform (4, 4) from that point, z = pole, to the flange.
        period_s: period of the cycle.
        free: drives (n,) that may move.
    """

    def __init__(self, model: ArmModel, flange_point: Floats, period_s: float, free: NDArray[np.bool_]) -> None:
        self._model, self._flange_point, self._period_s, self._free = model, flange_point, period_s, free
        self._leap = np.abs(units_per_motor(model)) * model.radian * LEAP_RAD
        self._targets: Floats | None = None
        self._away: Floats | None = None
        self._t = 0.0

    def step(self, measured: Floats, targets: Floats) -> Floats | None:
        """Joint targets (n,), rad or m, of this cycle; None at the end of the way, or where it cannot go on.

        Args:
            measured: joint positions (n,), rad or m.
            targets: targets (n,) of the motors, counts, at which the way begins.
        """
        T, J = forward_jacobian(self._model.chain, measured, self._flange_point)
        if self._away is None or self._targets is None:
            here, far = joints_to_units(self._model, measured), self._leap
            self._away, self._targets = -T[:3, 2], np.where(np.abs(targets - here) <= far, targets, here)
        before, self._t = way_gone(self._t), self._t + self._period_s
        if self._t > WAY_BACK / WAY_BACK_SPEED + ARRIVAL_S:
            return None
        move = self._away * (way_gone(self._t) - before)
        if move.any():
            units = lifting_step(self._model, J[:3], move, self._free)
            if units is None:
                return None
            self._targets = self._targets + units
        return units_to_joints(self._model, self._targets)


class LiftOff:
    """A way back of the probe, cycle by cycle.

    Args:
        plan: plan of a cell with an arm.
        drives: drives of the arm; those that do not obey are stopped from now on.
        watch: what the nodes report of themselves.
        error: why the cell is stopped; the node that it names does not obey.
        trail: the way that the probe has come, where it is free; None: it goes back along its pole.
    """

    def __init__(
        self, plan: Plan, drives: DriveGroup, watch: NodeWatch, error: BaseException, trail: TakenWay | None = None
    ) -> None:
        model, self._period_s = plan.setup.needed_arm().model, plan.sync.period_ns * 1e-9
        self._model = model
        self._drives = drives
        ages = drives.ages()
        heard = zip(drives.axes, ages, drives.enabled_ones(), strict=True)
        self._free = np.array([age == 0 and on and _obeys(watch, axis.node_id, error) for axis, age, on in heard])
        self._way = WayBack(model, plan.setup.probe.T_flange_point, self._period_s, self._free)
        self._trail = trail if self._free.all() else None  # with a drive at rest the others do not go where they were
        self._step_max: Floats = model.qd_max * plan.setup.limits.speed_share * self._period_s
        self._retrace: Retrace | None = None
        self._growing: GrowingForce | None = None  # until the way begins
        booted = any(watch.states.get(axis.node_id) is NmtState.INITIALISING for axis in drives.axes)
        self._all_there = not booted and not any(ages)

    @property
    def possible(self) -> bool:
        """Some drives obey, and none reports a position that it cannot have reached."""
        return bool(self._free.any()) and not self._drives.disbelieved

    def begin(self) -> None:
        """Stop the drives that do not obey.

        One that moves, but not as it was told, keeps its last target, or its place where that is far: that brakes it,
        and with the others. Its quick stop has a ramp, on which it would go millimetres into the object without them.
        """
        axes = zip(self._drives.axes, self._free, self._drives.brakeable, strict=True)
        self._drives.targets.stopped = frozenset(axis.node_id for axis, free, brakes in axes if not (free or brakes))

    def command(self, supervisor: Supervisor) -> Command | None:
        """The command of this cycle; None at the end, and where the array shows that the force grows."""
        seen, measurement = supervisor.seen, supervisor.seen.measurement
        if measurement.q is None or self._drives.disbelieved or not self._still_obeyed():
            return None
        if self._growing is None:
            self._growing = GrowingForce(seen.limits.cycles_to_turn)
            self._retrace = self._trail.back(measurement.q, self._step_max) if self._trail is not None else None
        retrace = self._retrace
        # a drive that is silent or has booted stands where it lost its power: the others do not go on without it
        targets = self._drives.targets.aimed if self._all_there else joints_to_units(self._model, measurement.q)
        q = self._way.step(measurement.q, targets) if retrace is None else retrace.step(self._period_s)
        if q is None:
            return None
        command, finding = supervisor.guard_target(Command(q))
        grows = self._growing.grows(measurement.cycle, seen.force, a_part=seen.shows_a_part)
        return None if finding is not None or supervisor.must_stop() or grows else command

    def _still_obeyed(self) -> bool:
        """A TPDO may be missing now and then; a drive that has left operation or stands does not come back."""
        enabled = np.array(self._drives.enabled_ones())
        late = np.array(self._drives.ages()) >= 3
        beyond = self._drives.targets.beyond_lag()
        return not bool((self._free & (~enabled | late)).any()) and not any(self._free[i] for i in beyond)


def lift_off(plan: Plan, cycles: SupervisedCycle, error: BaseException) -> None:
    """Lift the probe off before the cell is stopped for an error; where that is not possible, let it rest."""
    supervisor = cycles.supervisor
    seen = supervisor.seen
    if seen.drives is None or seen.tactile is None or not supervisor.pressing() or supervisor.must_stop():
        return
    lift = LiftOff(plan, seen.drives, seen.watch, error, cycles.controller.trail)
    t_s = cycles.run_s(seen.measurement)
    commands: Iterator[Command] = iter(())
    if lift.possible:
        cycles.say("lift off with the drives that obey")
        cycles.notes.add("lift off", t_s=t_s)
        lift.begin()
        commands = iter(lambda: lift.command(supervisor), None)
    else:
        cycles.notes.add("no lift-off: a drive may be moving, or none obeys", t_s=t_s)
    # In a quick stop each drive brakes on a ramp of its own, from the speed of its targets: off the path, and after
    # a step of the target the wrong way (45 N at 25 mm/s). So all come to rest at their last targets before.
    rest = repeat(Command(), round(REST_S * 1e9 / plan.sync.period_ns))
    try:
        if not cycles.cycle.begun:  # the controller's update failed: the commands of this cycle are out
            cycles.begin()
        for command in chain(commands, rest):
            cycles.cycle.end(command)
            cycles.record(seen.measurement, command)
            cycles.begin()
            if supervisor.must_stop():
                break
    except CanprobeError as failure:
        cycles.notes.add(f"while lifting off: {failure}")


def _obeys(watch: NodeWatch, node_id: int, error: BaseException) -> bool:
    """Whether a node obeys by NMT and EMCY, or an external arm: not the one that the cell is stopped for."""
    if not node_id:
        return not isinstance(error, ArmError)
    if isinstance(error, NodeError) and error.node_id == node_id:
        return False
    return watch.states.get(node_id) is NmtState.OPERATIONAL and node_id not in watch.alarmed
