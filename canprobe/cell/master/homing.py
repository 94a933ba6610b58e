"""Homing: drives without an absolute encoder find their zeros, one joint after the other, and a record keeps track.

Homing goes by SDO, after bring-up: the nodes are operational, there is no SYNC, and one drive at a time is enabled, in
mode 6. The master's heartbeat goes on, so that a drive notices when the master dies. On every way out the drive is
stopped and disabled, and has its mode of the cycle again. Limit switches are beyond the range of a joint, where a run
could not begin: a joint whose home is there goes back inside in profile position (mode 1), where the drive has it.

A drive keeps its zero until its power goes; bring-up therefore resets its communication only. What a drive cannot say
is whether its zero is that of this cell. So a record on the master's disk has, by node: the identity, what homing
wrote, by which settings, and the position at the end of each use. Where a drive answers anything else it counts as not
homed. A drive that was moved by hand, or whose last use ended without a record, is homed once more than necessary.
Source: CiA 402-2, "Homing mode", objects 607Ch, 6098h, 6099h, 609Ah; statusword bits 10, 12 and 13.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.master.led_drive import LedDrive, SdoLink
from canprobe.cell.master.node_bringup import IDENTITY
from canprobe.cell.master.node_record import NodeRecord
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.configuration import HOME_OFFSET, HOMES_HERE
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.errors import CanprobeError, NodeError
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.protocol.cia402 import (
    CHANGE_IMMEDIATELY_BIT,
    HOMING_ATTAINED_BIT,
    HOMING_ERROR_BIT,
    HOMING_START_BIT,
    NEW_SETPOINT_BIT,
    POSITION,
    SETPOINT_ACKNOWLEDGE_BIT,
    TARGET_REACHED_BIT,
    OperationMode,
)
from canprobe.mechanics.robot.model import coupled_joints, drive_position_at
from canprobe.mechanics.types import Floats

TOLERANCE_RAD = math.radians(1.0)
"""Largest difference of a position from the record, and at home from the home offset, rad; of a slide in proportion."""
TARGET, PROFILE_SPEED = 0x607A, 0x6081
_ENABLE = 0x0F
_MOVES = {
    **{1: (-1, "the index pulse at the negative limit switch"), 2: (1, "the index pulse at the positive limit switch")},
    **{17: (-1, "the negative limit switch"), 18: (1, "the positive limit switch")},
    **{33: (-1, "the next index pulse"), 34: (1, "the next index pulse")},
}
"""Direction in which a drive counts, and what it looks for, of the common methods."""


class UnhomedError(NodeError):
    """A drive has to be homed before it may be enabled."""


class Homing:
    """Homes the drives of a cell that have no absolute encoder, and knows which of them have their zeros.

    Args:
        plan: plan of a cell with an arm.
        setups: configurations of its nodes.
        network: pumped; the nodes are operational.
        watch: what the nodes report of themselves.
        supervise: called meanwhile; it raises the error of whatever else goes wrong.
        record: file of the zeros; None: no record is kept.
        say: called with each step.

    Attributes:
        link: SDO channel of the drives; its `keep_alive` lets time pass before a joint is homed.
        order: joints that are homed, from 0, in their order.
        known: joints whose zeros are known, from 0: those with absolute encoders and those that canprobe emulates, too.
    """

    def __init__(
        self,
        plan: Plan,
        setups: tuple[NodeConfiguration, ...],
        network: PumpedNetwork,
        watch: NodeWatch,
        supervise: Callable[[], None],
        *,
        record: Path | None,
        say: Callable[[str], None],
    ) -> None:
        arm = plan.setup.needed_arm()
        self._command_line = plan.setup.line_to_type("home")
        self._model = arm.model
        self.link = SdoLink(network, watch, plan.setup.bring_up, supervise)
        by_id = {setup.node_id: setup for setup in setups}
        self._drives = [LedDrive(by_id[node_id], self.link, say) for node_id in arm.node_ids]
        self._record = NodeRecord(record, "home the drives again")
        guard = JointGuard(plan)
        inside = TOLERANCE_RAD * self._model.radian
        self._low, self._high = guard.low + inside, guard.high - inside
        self._zeros = {axis: drive.zero for axis, drive in enumerate(arm.drives) if drive.zero is not None}
        self.order = tuple(sorted(self._zeros, key=lambda axis: (self._zeros[axis].order, axis)))
        self._recorded = tuple(axis for axis in self.order if not arm.drives[axis].emulated)
        self.known = set(range(self._model.n)) - set(self._recorded)

    # which drives have their zeros

    def look(self) -> None:
        """Compare the drives with the record; a zero is known where all agrees."""
        for axis in self._recorded:
            now, before = self._evidence(axis), self._record.entry(self._drives[axis].setup.node_id)
            there, then = now.pop("position"), before.get("position")
            same = now == {key: value for key, value in before.items() if key != "position"}
            if same and isinstance(then, int) and abs(there - then) <= self._tolerance(axis):
                self.known.add(axis)

    def doubt(self, node_ids: Collection[int]) -> None:
        """Take the zeros of drives as lost that may have been without power, whatever they report.

        Raises:
            CanprobeError: the record cannot be written.
        """
        for axis in self.order:
            if self._drives[axis].setup.node_id in node_ids:
                self.known.discard(axis)
                if axis in self._recorded:
                    self._record.put(self._drives[axis].setup.node_id, None)

    def refuse_unhomed(self) -> None:
        """Refuse to go on where a zero is not known.

        Raises:
            UnhomedError: a drive has to be homed; with the command to type.
        """
        lacking = [self._drives[axis].setup for axis in self.order if axis not in self.known]
        if lacking:
            first, *rest = lacking
            others = ", ".join(f"{setup.node_id} ({setup.name})" for setup in rest)
            too = f"; nor are {others}" if others else ""
            why = f"is not homed, or was switched off or moved since{too}; type: {self._command_line}"
            raise UnhomedError(first.node_id, f"({first.name}) {why}")

    def keep(self) -> None:
        """Record the positions in which the drives are left, as far as their zeros are known.

        Raises:
            CanprobeError: a drive does not answer; the others are written down all the same.
        """
        self.link.beats, failures = True, list[CanprobeError]()
        for axis in self._recorded:
            if axis in self.known:
                try:
                    self._record.put(self._drives[axis].setup.node_id, self._evidence(axis))
                except CanprobeError as error:
                    failures.append(error)
        if failures:
            raise failures[0]

    def _evidence(self, axis: int) -> dict[str, Any]:
        """The answers of a drive now, and the settings with which its zero is valid, as JSON gives them back."""
        drive, zero, model = self._drives[axis], self._zeros[axis], self._model
        described = Description(drive.setup.dictionary)
        there = [sub for sub in range(1, 5) if described.entry(IDENTITY, sub) is not None]
        return {
            "identity": [drive.read(IDENTITY, sub) for sub in there],
            "settings": [zero.method, zero.home, *model.units_per_q[axis].tolist(), model.zero_units[axis]],
            "objects": {write.place: drive.read(write.index, write.subindex) for write in drive.setup.homing},
            "position": drive.read(POSITION),
        }

    def _tolerance(self, axis: int) -> float:
        """Tolerance of the position of a joint, drive units."""
        return abs(float(self._model.units_per_q[axis, axis] * self._model.radian[axis])) * TOLERANCE_RAD

    # homing

    def question(self, axis: int) -> str:
        """The question to an operator before a joint is homed: method, direction and speeds."""
        joint, zero, setup = self._model.joints[axis], self._zeros[axis], self._drives[axis].setup
        up = 1 if self._model.units_per_q[axis, axis] > 0.0 else -1
        speeds = f"{joint.shown(zero.speed):g} and {joint.shown(zero.zero_speed):g} {joint.unit}/s"
        if zero.method in HOMES_HERE:
            way = f"take the place where it stands for {joint.text(zero.home, '.2f')}"
        elif zero.method in _MOVES:
            direction, goal = _MOVES[zero.method]
            way = f"move in {'positive' if direction * up > 0 else 'negative'} direction to {goal}, at {speeds}"
        else:
            way = f"move as its maker says, at {speeds}"
        return f"{setup.name} ({joint.name}, node {setup.node_id}): home it by method {zero.method}: {way}?"

    def home(self, axis: int) -> str:
        """Home one joint.

        Returns:
            A line for the operator: where the joint stands.

        Raises:
            NodeError: the drive reports an error, is lost, or does not find its home position in time.
        """
        drive, zero, joint = self._drives[axis], self._zeros[axis], self._model.joints[axis]
        setup = drive.setup
        self.link.beats = True
        units = self._positions(axis)
        home = round(drive_position_at(self._model, axis, zero.home, units))
        self.known.discard(axis)
        if axis in self._recorded:
            self._record.put(setup.node_id, None)
        with drive.left_disabled():
            for write in setup.homing:
                drive.write(replace(write, value=-home) if write.index == HOME_OFFSET else write)
            drive.enable(OperationMode.HOMING)
            drive.command(_ENABLE | 1 << HOMING_START_BIT)
            what = f"find its home position by method {zero.method}"
            late = f"did not {what} in {zero.timeout_s:g} s (homing_timeout_s)"
            found_bits = HOMING_ATTAINED_BIT, TARGET_REACHED_BIT
            drive.wait_for_bits(found_bits, zero.timeout_s, what, late, error=HOMING_ERROR_BIT)
        found, braking = drive.read(POSITION), zero.zero_speed**2 / (2.0 * zero.acceleration)
        per_q = abs(float(self._model.units_per_q[axis, axis]))
        if abs(found - home) > self._tolerance(axis) + braking * per_q:
            why = "it has no home offset (607Ch)"
            if any(write.index == HOME_OFFSET for write in setup.homing):
                why = f"with 607Ch = {-home}: the drive may count the home offset the other way round"
            raise drive.error(f"homed, but is at {found} (6064h) where {home} was expected, {why}")
        inside, stands = float(np.clip(zero.home, self._low[axis], self._high[axis])), "it stands there"
        if inside != zero.home and _has_profile_position(setup):
            target = round(drive_position_at(self._model, axis, inside, units))
            speed = max(1, round(zero.speed * per_q / setup.speed_unit))
            with drive.left_disabled():
                self._move(drive, target, speed, zero.timeout_s, self._tolerance(axis))
            stands = f"it stands at {joint.text(inside, '.2f')}, inside its range"
        elif inside != zero.home:
            stands = "it stands there, outside its range: move it inside by hand before a run"
        self.known.add(axis)
        if axis in self._recorded:
            self._record.put(setup.node_id, self._evidence(axis))
        return f"{setup.name} ({joint.name}) is homed: home is at {joint.text(zero.home, '.2f')}; {stands}"

    def _positions(self, axis: int) -> Floats:
        """(n,) positions of the drives on which the zero of one depends, drive units."""
        units = np.zeros(self._model.n)
        for other in sorted(coupled_joints(self._model, axis)):
            if other not in self.known:
                setup, its = self._drives[axis].setup, self._drives[other].setup.name
                raise setup.error(f"cannot be homed: its zero depends on {its}: home it first")
            units[other] = self._drives[other].read(POSITION)
        return units

    def _move(self, drive: LedDrive, target: int, speed: int, timeout_s: float, tolerance: float) -> None:
        """Move a drive to a target in profile position."""
        drive.write(Write(PROFILE_SPEED, 0, speed, "profile velocity"))
        drive.enable(OperationMode.PROFILE_POSITION)
        drive.write(Write(TARGET, 0, target, "target position"))
        drive.command(_ENABLE | 1 << NEW_SETPOINT_BIT | 1 << CHANGE_IMMEDIATELY_BIT)
        what, late = "move back into its range", f"is homed, but did not reach {target} (607Ah), inside its range"
        drive.wait_for_bits((SETPOINT_ACKNOWLEDGE_BIT,), self.link.times.enable_s, what, late)
        drive.command(_ENABLE)
        drive.wait_for_bits((TARGET_REACHED_BIT,), timeout_s, what, late)
        # Bit 10 may still be that of the homing, or of a drive whose position window (6067h) is switched off.
        drive.wait_until(lambda: abs(drive.read(POSITION) - target) <= tolerance, timeout_s, lambda: late)


def _has_profile_position(setup: NodeConfiguration) -> bool:
    drive = Description(setup.dictionary)
    listed = drive.modes is None or OperationMode.PROFILE_POSITION in drive.modes
    return listed and drive.entry(TARGET) is not None and drive.entry(PROFILE_SPEED) is not None
