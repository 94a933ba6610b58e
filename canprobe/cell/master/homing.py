"""Homing: drives without an absolute encoder find their zeros, one joint after the other, and a record keeps track.

Homing goes by SDO, after bring-up: the nodes are operational, there is no SYNC, and one drive at a time is enabled, in
mode 6. The master's heartbeat goes on, so that a drive notices when the master dies. On every way out the drive is
stopped and disabled, and has its mode of the cycle again. Limit switches are beyond the range of a joint, where a run
could not begin: a joint whose home is there goes back inside in profile position (mode 1), where the drive has it.

A drive keeps its zero until its power goes; bring-up therefore resets its communication only. What a drive cannot say
is whether its zero is that of this cell. So a record on the master's disk has, by node: the identity, what homing
wrote, by which settings, and the position at the end of each use. Where a drive answers anything else it counts as not
homed. A drive that was moved by hand, or whose last use ended without a record, is homed once more than necessary.
Source: CiA 402-2, "Homing mode", objects 607Ch, 6098h, 6099h, 609Ah; controlword; statusword bits 10, 12 and 13.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.master.bringup import NodeAccess
from canprobe.cell.master.node_bringup import IDENTITY, read_entry, write_entry
from canprobe.cell.master.node_record import NodeRecord
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.configuration import HOME_OFFSET, HOMES_HERE
from canprobe.cell.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.cell.planning.units import PROFILE_SPEED
from canprobe.errors import CanprobeError, NodeError
from canprobe.fieldbus.bus.port import nothing
from canprobe.fieldbus.bus.sdo import Dialogue
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveState, OperationMode
from canprobe.fieldbus.protocol.frames import NmtState, pack_heartbeat
from canprobe.mechanics.robot.model import coupled_joints, drive_position_at
from canprobe.mechanics.types import Floats

POLL_S = 0.01


class SdoLink:
    """Dialogues with one node after the other, and the master's heartbeats meanwhile.

    Args:
        access: the nodes, which are operational.
        supervise: called while time passes; it raises the error of whatever goes wrong.

    Attributes:
        beats: whether heartbeats are sent: nodes that have heard one expect more.
        attend: called as `supervise`, by whoever looks after the drive.
    """

    def __init__(self, access: NodeAccess, supervise: Callable[[], None]) -> None:
        self.watch, self.times, self.clock = access.watch, access.settings, access.network.port.clock
        self.beats, self._heartbeat_ns = False, 0
        self._access, self._supervise = access, supervise
        self.attend: Callable[[], None] = nothing

    def hold(self, node_id: int, dialogue: Dialogue) -> Any:
        """Hold a dialogue, and return its result."""
        results: list[Any] = []

        def held() -> Dialogue:
            results.append((yield from dialogue))

        with self._access.dialogues({node_id: held()}) as dialogues:
            while waiting := dialogues.waiting:
                self.pump(lambda: bool(waiting[0].inbox), POLL_S)
                dialogues.serve()
        return results[0]

    def keep_alive(self) -> None:
        """Let a little time pass, such as while an operator thinks.

        Raises:
            CanprobeError: a node was lost or reports an error, or the bus fails.
        """
        self.pump(lambda: False, POLL_S)
        self._supervise()
        self.attend()

    def pump(self, done: Callable[[], bool], timeout_s: float) -> None:
        """Wait until `done`, with a heartbeat where one is due."""
        port = self._access.network.port
        if self.beats and (now_ns := port.clock.now_ns()) >= self._heartbeat_ns:
            self._heartbeat_ns = now_ns + HEARTBEAT_PRODUCED_MS * 1_000_000
            port.send_batch([pack_heartbeat(MASTER_NODE_ID, NmtState.OPERATIONAL)])
        self._access.network.pump_until(done, timeout_s)


class LedDrive:
    """A drive that is led by SDO.

    Args:
        setup: configuration of the drive.
        link: its SDO channel.
        say: called where the drive was stopped by an error.
    """

    def __init__(self, setup: NodeConfiguration, link: SdoLink, say: Callable[[str], None]) -> None:
        self.setup = setup
        self._link, self._say = link, say

    def read(self, index: int, subindex: int = 0) -> int:
        """The value of an entry."""
        return int(self._link.hold(self.setup.node_id, read_entry(self.setup, index, subindex)))

    def write(self, write: Write) -> None:
        """Write an entry, and read it back."""
        self._link.hold(self.setup.node_id, write_entry(self.setup, write))

    def command(self, word: int) -> None:
        """Write the controlword."""
        self.write(Write(cia402.CONTROLWORD, 0, word, "controlword", read_back=False))

    def error(self, what: str) -> NodeError:
        """The error of this drive, with its last EMCY."""
        return self.setup.error(f"{what}{self._link.watch.last_words(self.setup.node_id)}")

    def enable(self, mode: OperationMode) -> None:
        """Enable the drive in a mode."""
        self.write(Write(cia402.MODE, 0, mode, "mode of operation"))
        timeout_s, late = self._link.times.enable_s, f"is not in mode {mode} (6061h) after it was written to 6060h"
        self.wait_for(cia402.MODE_DISPLAY, lambda held: held == mode, timeout_s, late)
        enabled = DriveState.OPERATION_ENABLED
        self._lead(enabled, frozenset({enabled}), timeout_s)

    def wait_for_bits(
        self, bits: tuple[int, ...], timeout_s: float, what: str, late: str, *, error: int | None = None
    ) -> None:
        """Wait until the statusword has these bits; a time-out, the error bit or a drive that is off is an error."""
        wanted = sum(1 << bit for bit in bits)
        for _ in self._looks(timeout_s):
            word = self.read(cia402.STATUSWORD)
            if error is not None and word >> error & 1:
                raise self.error(f"could not {what}: its statusword (6041h) has bit {error}")
            if cia402.known_state(word) is not DriveState.OPERATION_ENABLED:
                raise self.error(f"could not {what}: it is {cia402.describe_state(word)}")
            if word & wanted == wanted:
                return
        raise self.error(late)

    def wait_for(self, index: int, fits: Callable[[int], bool], timeout_s: float, late: str) -> None:
        """Wait until the value of an entry fits; a time-out is an error."""
        for _ in self._looks(timeout_s):
            if fits(self.read(index)):
                return
        raise self.error(late)

    def _looks(self, timeout_s: float, *, supervised: bool = True) -> Iterator[None]:
        """Looks at the drive until the time-out; between two time passes, supervised or with heartbeats alone."""
        until_ns = self._link.clock.now_ns() + round(timeout_s * 1e9)
        while True:
            yield
            if self._link.clock.now_ns() >= until_ns:
                return
            if supervised:
                self._link.keep_alive()
            else:
                self._link.pump(lambda: False, POLL_S)

    @contextlib.contextmanager
    def left_disabled(self) -> Iterator[None]:
        """A context on every way out of which the drive is stopped, disabled, and in its mode of the cycle."""
        try:
            yield
        except BaseException:
            failure = self._stop()
            done = "is stopped and disabled" if failure is None else f"could not be stopped ({failure})"
            self._say(f"{self.setup.name} {done}; it is not homed")
            raise
        if failure := self._stop():
            raise failure

    def _stop(self) -> CanprobeError | None:
        """Stop, disable, and leave homing; an interrupt repeats it once. A failure is returned."""
        for _ in range(2):
            try:
                stop_s = self._link.times.stop_s
                with contextlib.suppress(NodeError):  # by 605Ah it may stay in quick stop
                    self._lead(DriveState.QUICK_STOP_ACTIVE, cia402.UNPOWERED_STATES, stop_s, supervised=False)
                self._lead(DriveState.SWITCH_ON_DISABLED, cia402.DISABLED_STATES, stop_s, supervised=False)
                if self.setup.mode is not None:
                    self.write(Write(cia402.MODE, 0, self.setup.mode, "mode of operation"))
            except KeyboardInterrupt:
                continue
            except CanprobeError as error:
                return error
            return None
        return None

    def _lead(
        self, goal: DriveState, states: frozenset[DriveState], timeout_s: float, *, supervised: bool = True
    ) -> None:
        """Bring the drive into one of some states."""
        word = previous = 0
        for _ in self._looks(timeout_s, supervised=supervised):
            word = self.read(cia402.STATUSWORD)
            state = cia402.known_state(word)
            if state in states:
                return
            previous = 0 if state is None else cia402.controlword_toward(state, goal, previous)
            self.command(previous)
        raise self.error(f"is {cia402.describe_state(word)} {timeout_s:g} s after the command for {goal.name}")


TOLERANCE_RAD = math.radians(1.0)
"""Largest difference of a position from the record, and at home from the home offset, rad; of a slide in proportion."""
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
        access: its nodes, which are operational.
        supervise: called meanwhile; it raises the error of whatever else goes wrong.
        record: file of the zeros; None: no record is kept.

    Attributes:
        link: SDO channel of the drives; its `keep_alive` lets time pass before a joint is homed.
        order: joints that are homed, from 0, in their order.
        known: joints whose zeros are known, from 0: those with absolute encoders and those that canprobe emulates, too.
    """

    def __init__(self, plan: Plan, access: NodeAccess, supervise: Callable[[], None], record: Path | None) -> None:
        arm = plan.setup.needed_arm()
        self._command_line = plan.setup.line_to_type("home")
        self._model = arm.model
        self.link = SdoLink(access, supervise)
        by_id = {setup.node_id: setup for setup in access.setups}
        self._drives = [LedDrive(by_id[node_id], self.link, access.say) for node_id in arm.node_ids]
        self._record = NodeRecord(record, "home the drives again")
        guard = JointGuard(plan)
        inside = TOLERANCE_RAD * self._model.radian
        # a joint that comes to stand a tolerance short of its place is in its range all the same
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
                self._set_known(axis, False)

    def _set_known(self, axis: int, known: bool) -> None:
        """Note whether a zero is known, in the record as well."""
        (self.known.add if known else self.known.discard)(axis)
        if axis in self._recorded:
            self._record.put(self._drives[axis].setup.node_id, self._evidence(axis) if known else None)

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
            "position": drive.read(cia402.POSITION),
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
        # first: whatever ends a homing half-way leaves a drive that may have another zero
        self._set_known(axis, False)
        with drive.left_disabled():
            for write in setup.homing:
                # zero is the home position plus 607Ch (CiA 402-2), so that at home 6064h is -607Ch
                drive.write(replace(write, value=-home) if write.index == HOME_OFFSET else write)
            drive.enable(OperationMode.HOMING)
            drive.command(cia402.ENABLE_WORD | 1 << cia402.HOMING_START_BIT)
            what = f"find its home position by method {zero.method}"
            late = f"did not {what} in {zero.timeout_s:g} s (homing_timeout_s)"
            found_bits = cia402.HOMING_ATTAINED_BIT, cia402.TARGET_REACHED_BIT
            drive.wait_for_bits(found_bits, zero.timeout_s, what, late, error=cia402.HOMING_ERROR_BIT)
        # not every drive goes back to the pulse or edge: it may stand behind it by the way on which it has braked
        found, braking = drive.read(cia402.POSITION), zero.zero_speed**2 / (2.0 * zero.acceleration)
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
            for write in (write for write in setup.writes if write.index == PROFILE_SPEED):  # the cycle needs it, too
                drive.write(write)
            stands = f"it stands at {joint.text(inside, '.2f')}, inside its range"
        elif inside != zero.home:
            stands = "it stands there, outside its range: move it inside by hand before a run"
        self._set_known(axis, True)
        return f"{setup.name} ({joint.name}) is homed: home is at {joint.text(zero.home, '.2f')}; {stands}"

    def _positions(self, axis: int) -> Floats:
        """(n,) positions of the drives on which the zero of one depends, drive units."""
        units = np.zeros(self._model.n)
        for other in sorted(coupled_joints(self._model, axis)):
            if other not in self.known:
                setup, its = self._drives[axis].setup, self._drives[other].setup.name
                raise setup.error(f"cannot be homed: its zero depends on {its}: home it first")
            units[other] = self._drives[other].read(cia402.POSITION)
        return units

    def _move(self, drive: LedDrive, target: int, speed: int, timeout_s: float, tolerance: float) -> None:
        """Move a drive to a target in profile position."""
        drive.write(Write(PROFILE_SPEED, 0, speed, "profile velocity"))
        drive.enable(OperationMode.PROFILE_POSITION)
        drive.write(Write(cia402.TARGET_POSITION, 0, target, "target position"))
        drive.command(cia402.ENABLE_WORD | 1 << cia402.NEW_SETPOINT_BIT | 1 << cia402.CHANGE_IMMEDIATELY_BIT)
        what, late = "move back into its range", f"is homed, but did not reach {target} (607Ah), inside its range"
        drive.wait_for_bits((cia402.SETPOINT_ACKNOWLEDGE_BIT,), self.link.times.enable_s, what, late)
        drive.command(cia402.ENABLE_WORD)
        drive.wait_for_bits((cia402.TARGET_REACHED_BIT,), timeout_s, what, late)
        # Bit 10 may still be that of the homing, or of a drive whose position window (6067h) is switched off.
        drive.wait_for(cia402.POSITION, lambda there: abs(there - target) <= tolerance, timeout_s, late)


def _has_profile_position(setup: NodeConfiguration) -> bool:
    drive = Description(setup.dictionary)
    listed = drive.modes is None or OperationMode.PROFILE_POSITION in drive.modes
    return listed and drive.entry(cia402.TARGET_POSITION) is not None and drive.entry(PROFILE_SPEED) is not None
