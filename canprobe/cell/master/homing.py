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

import contextlib
import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.master.bringup import IDENTITY, MODE_DISPLAY, read_entry, write_entry
from canprobe.cell.master.node_record import NodeRecord
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.configuration import HOME_OFFSET, HOMES_HERE, MODE, NodeSetup, Write
from canprobe.cell.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Plan
from canprobe.cell.scene.setup import HomingParameters
from canprobe.errors import CanprobeError, NodeError
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import Dialogue, Dialogues
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.protocol.cia402 import (
    CHANGE_IMMEDIATELY_BIT,
    HOMING_ATTAINED_BIT,
    HOMING_ERROR_BIT,
    HOMING_START_BIT,
    NEW_SETPOINT_BIT,
    POWERED_STATES,
    SETPOINT_ACKNOWLEDGE_BIT,
    TARGET_REACHED_BIT,
    DriveState,
    OperationMode,
    controlword_toward,
    describe_state,
    known_state,
)
from canprobe.fieldbus.protocol.frames import NmtState, pack_heartbeat
from canprobe.mechanics.robot.model import coupled_joints, drive_position_at
from canprobe.mechanics.types import Floats

POLL_S = 0.01
TOLERANCE_RAD = math.radians(1.0)
"""Largest difference of a position from the record, and at home from the home offset, rad; of a slide in proportion."""
CONTROLWORD, STATUSWORD, POSITION = 0x6040, 0x6041, 0x6064
TARGET, PROFILE_SPEED = 0x607A, 0x6081
_ENABLE = 0x0F
_OFF = frozenset(DriveState) - POWERED_STATES
_DISABLED = frozenset({DriveState.SWITCH_ON_DISABLED, DriveState.FAULT, DriveState.NOT_READY_TO_SWITCH_ON})
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
        order: joints that are homed, from 0, in their order.
        known: joints whose zeros are known, from 0: those with absolute encoders and those that canprobe emulates, too.
    """

    def __init__(
        self,
        plan: Plan,
        setups: tuple[NodeSetup, ...],
        network: PumpedNetwork,
        watch: NodeWatch,
        *,
        supervise: Callable[[], None],
        record: Path | None,
        say: Callable[[str], None],
    ) -> None:
        assert plan.setup.arm is not None
        self._arm, self._times = plan.setup.arm, plan.setup.bring_up
        self._command_line = plan.setup.line_to_type("home")
        self._model, self._drives = self._arm.model, self._arm.drives
        by_id = {setup.node_id: setup for setup in setups}
        self._setups = [by_id[drive.node_id] for drive in self._drives]
        self._network, self._watch, self._supervise = network, watch, supervise
        self._record, self._say = NodeRecord(record, "home the drives again"), say
        guard = JointGuard(plan)
        self._low, self._high = (
            guard.low + TOLERANCE_RAD * self._model.radian,
            guard.high - TOLERANCE_RAD * self._model.radian,
        )
        self._beats, self._heartbeat_ns = False, 0
        zeros = {axis: drive.zero for axis, drive in enumerate(self._drives) if drive.zero is not None}
        self.order = tuple(sorted(zeros, key=lambda axis: (zeros[axis].order, axis)))
        self._recorded = tuple(axis for axis in self.order if not self._drives[axis].emulated)
        self.known = set(range(self._model.n)) - set(self._recorded)

    # which drives have their zeros

    def look(self) -> None:
        """Compare the drives with the record; a zero is known where all agrees."""
        for axis in self._recorded:
            now, before = self._evidence(axis), self._record.entry(self._drives[axis].node_id)
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
            if self._drives[axis].node_id in node_ids:
                self.known.discard(axis)
                if axis in self._recorded:
                    self._record.put(self._drives[axis].node_id, None)

    def refuse_unhomed(self) -> None:
        """Refuse to go on where a zero is not known.

        Raises:
            UnhomedError: a drive has to be homed; with the command to type.
        """
        lacking = [axis for axis in self.order if axis not in self.known]
        if lacking:
            others = ", ".join(f"{self._drives[axis].node_id} ({self._setups[axis].name})" for axis in lacking[1:])
            too = f"; nor are {others}" if others else ""
            raise UnhomedError(
                self._drives[lacking[0]].node_id,
                f"({self._setups[lacking[0]].name}) is not homed, or was switched off or moved since{too}; type:"
                f" {self._command_line}",
            )

    def keep(self) -> None:
        """Record the positions in which the drives are left, as far as their zeros are known.

        Raises:
            CanprobeError: a drive does not answer; the others are written down all the same.
        """
        self._beats, failures = True, list[CanprobeError]()
        for axis in self._recorded:
            if axis in self.known:
                try:
                    self._record.put(self._drives[axis].node_id, self._evidence(axis))
                except CanprobeError as error:
                    failures.append(error)
        if failures:
            raise failures[0]

    def _evidence(self, axis: int) -> dict[str, Any]:
        """The answers of a drive now, and the settings with which its zero is valid, as JSON gives them back."""
        setup, drive, model = self._setups[axis], self._drives[axis], self._model
        assert drive.zero is not None
        there = [sub for sub in range(1, 5) if Description(setup.dictionary).entry(IDENTITY, sub) is not None]
        entries = {write.place: (write.index, write.subindex) for write in setup.homing}
        return {
            "identity": [self._read(setup, IDENTITY, sub) for sub in there],
            "settings": [drive.zero.method, drive.zero.home, *model.units_per_q[axis].tolist(), model.zero_units[axis]],
            "objects": {place: self._read(setup, *entry) for place, entry in entries.items()},
            "position": self._read(setup, POSITION, 0),
        }

    def _tolerance(self, axis: int) -> float:
        """Tolerance of the position of a joint, drive units."""
        return abs(float(self._model.units_per_q[axis, axis] * self._model.radian[axis])) * TOLERANCE_RAD

    # homing

    def question(self, axis: int) -> str:
        """The question to an operator before a joint is homed: method, direction and speeds."""
        joint, zero, setup = self._model.joints[axis], self._zero(axis), self._setups[axis]
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
        setup, zero = self._setups[axis], self._zero(axis)
        self._beats = True
        units = self._positions(axis)
        home = round(drive_position_at(self._model, axis, zero.home, units))
        self.known.discard(axis)
        if axis in self._recorded:
            self._record.put(setup.node_id, None)
        with self._left_disabled(setup):
            self._find_home(setup, zero, home)
        found, braking = self._read(setup, POSITION, 0), zero.zero_speed**2 / (2.0 * zero.acceleration)
        per_q = abs(float(self._model.units_per_q[axis, axis]))
        if abs(found - home) > self._tolerance(axis) + braking * per_q:
            why = "it has no home offset (607Ch)"
            if any(write.index == HOME_OFFSET for write in setup.homing):
                why = f"with 607Ch = {-home}: the drive may count the home offset the other way round"
            raise self._error(setup, f"homed, but is at {found} (6064h) where {home} was expected, {why}")
        inside = float(np.clip(zero.home, self._low[axis], self._high[axis]))
        joint, stands = self._model.joints[axis], "it stands there"
        if inside != zero.home and _has_profile_position(setup):
            with self._left_disabled(setup):
                target = round(drive_position_at(self._model, axis, inside, units))
                speed = max(1, round(zero.speed * per_q / setup.speed_unit))
                self._move(setup, zero, target, speed, self._tolerance(axis))
            stands = f"it stands at {joint.text(inside, '.2f')}, inside its range"
        elif inside != zero.home:
            stands = "it stands there, outside its range: move it inside by hand before a run"
        self.known.add(axis)
        if axis in self._recorded:
            self._record.put(setup.node_id, self._evidence(axis))
        return f"{setup.name} ({joint.name}) is homed: home is at {joint.text(zero.home, '.2f')}; {stands}"

    def keep_alive(self) -> None:
        """Let a little time pass with heartbeats, such as while an operator thinks.

        Raises:
            CanprobeError: a node was lost or reports an error, or the bus fails.
        """
        self._pump(lambda: False, POLL_S)
        self._supervise()

    def _zero(self, axis: int) -> HomingParameters:
        zero = self._drives[axis].zero
        assert zero is not None
        return zero

    def _positions(self, axis: int) -> Floats:
        """(n,) positions of the drives on which the zero of one depends, drive units."""
        units = np.zeros(self._model.n)
        for other in sorted(coupled_joints(self._model, axis)):
            if other not in self.known:
                setup, its = self._setups[axis], self._setups[other].name
                raise NodeError(
                    setup.node_id, f"({setup.name}) cannot be homed: its zero depends on {its}: home it first"
                )
            units[other] = self._read(self._setups[other], POSITION, 0)
        return units

    def _find_home(self, setup: NodeSetup, zero: HomingParameters, home: int) -> None:
        for write in setup.homing:
            self._write(setup, replace(write, value=-home) if write.index == HOME_OFFSET else write)
        self._enable(setup, OperationMode.HOMING)
        self._command(setup, _ENABLE | 1 << HOMING_START_BIT)
        what = f"find its home position by method {zero.method}"
        late = f"did not {what} in {zero.timeout_s:g} s (homing_timeout_s)"
        self._await_bits(
            setup, (HOMING_ATTAINED_BIT, TARGET_REACHED_BIT), zero.timeout_s, what, late, error=HOMING_ERROR_BIT
        )

    def _move(self, setup: NodeSetup, zero: HomingParameters, target: int, speed: int, tolerance: float) -> None:
        """Move a drive to a target in profile position."""
        self._write(setup, Write(PROFILE_SPEED, 0, speed, "profile velocity"))
        self._enable(setup, OperationMode.PROFILE_POSITION)
        self._write(setup, Write(TARGET, 0, target, "target position"))
        self._command(setup, _ENABLE | 1 << NEW_SETPOINT_BIT | 1 << CHANGE_IMMEDIATELY_BIT)
        what, late = "move back into its range", f"is homed, but did not reach {target} (607Ah), inside its range"
        self._await_bits(setup, (SETPOINT_ACKNOWLEDGE_BIT,), self._times.enable_s, what, late)
        self._command(setup, _ENABLE)
        self._await_bits(setup, (TARGET_REACHED_BIT,), zero.timeout_s, what, late)
        # Bit 10 may still be that of the homing, or of a drive whose position window (6067h) is switched off.
        self._await(
            lambda: abs(self._read(setup, POSITION, 0) - target) <= tolerance,
            zero.timeout_s,
            lambda: self._error(setup, late),
        )

    def _enable(self, setup: NodeSetup, mode: OperationMode) -> None:
        self._write(setup, Write(MODE, 0, mode, "mode of operation"))
        self._await(
            lambda: self._read(setup, MODE_DISPLAY, 0) == mode,
            self._times.enable_s,
            lambda: self._error(setup, f"is not in mode {mode} (6061h) after it was written to 6060h"),
        )
        self._lead(setup, DriveState.OPERATION_ENABLED, frozenset({DriveState.OPERATION_ENABLED}), self._times.enable_s)

    def _await_bits(
        self,
        setup: NodeSetup,
        bits: tuple[int, ...],
        timeout_s: float,
        what: str,
        late: str,
        *,
        error: int | None = None,
    ) -> None:
        """Wait until the statusword has these bits; a time-out, the error bit or a drive that is off is an error."""
        wanted = sum(1 << bit for bit in bits)

        def reached() -> bool:
            word = self._read(setup, STATUSWORD, 0)
            if error is not None and word >> error & 1:
                raise self._error(setup, f"could not {what}: its statusword (6041h) has bit {error}")
            if known_state(word) is not DriveState.OPERATION_ENABLED:
                raise self._error(setup, f"could not {what}: it is {describe_state(word)}")
            return word & wanted == wanted

        self._await(reached, timeout_s, lambda: self._error(setup, late))

    @contextlib.contextmanager
    def _left_disabled(self, setup: NodeSetup) -> Iterator[None]:
        """A context on every way out of which the drive is stopped, disabled, and in its mode of the cycle."""
        try:
            yield
        except BaseException:
            failure = self._stop(setup)
            done = "is stopped and disabled" if failure is None else f"could not be stopped ({failure})"
            self._say(f"{setup.name} {done}; it is not homed")
            raise
        if failure := self._stop(setup):
            raise failure

    def _stop(self, setup: NodeSetup) -> CanprobeError | None:
        """Stop, disable, and leave homing; an interrupt repeats it once. A failure is returned."""
        for _ in range(2):
            try:
                stop_s = self._times.stop_s
                with contextlib.suppress(NodeError):  # by 605Ah it may stay in quick stop
                    self._lead(setup, DriveState.QUICK_STOP_ACTIVE, _OFF, stop_s, supervised=False)
                self._lead(setup, DriveState.SWITCH_ON_DISABLED, _DISABLED, stop_s, supervised=False)
                if setup.mode is not None:
                    self._write(setup, Write(MODE, 0, setup.mode, "mode of operation"))
            except KeyboardInterrupt:
                continue
            except CanprobeError as error:
                return error
            return None
        return None

    # parts

    def _lead(
        self,
        setup: NodeSetup,
        goal: DriveState,
        states: frozenset[DriveState],
        timeout_s: float,
        *,
        supervised: bool = True,
    ) -> None:
        """Bring a drive into one of some states."""
        word = previous = 0

        def arrived() -> bool:
            nonlocal word, previous
            word = self._read(setup, STATUSWORD, 0)
            state = known_state(word)
            if state in states:
                return True
            previous = 0 if state is None else controlword_toward(state, goal, previous)
            self._command(setup, previous)
            return False

        def late() -> NodeError:
            return self._error(setup, f"is {describe_state(word)} {timeout_s:g} s after the command for {goal.name}")

        self._await(arrived, timeout_s, late, supervised=supervised)

    def _await(
        self, reached: Callable[[], bool], timeout_s: float, late: Callable[[], NodeError], *, supervised: bool = True
    ) -> None:
        clock = self._network.port.clock
        until_ns = clock.now_ns() + round(timeout_s * 1e9)
        while not reached():
            if clock.now_ns() >= until_ns:
                raise late()
            if supervised:
                self.keep_alive()
            else:
                self._pump(lambda: False, POLL_S)

    def _error(self, setup: NodeSetup, what: str) -> NodeError:
        return NodeError(setup.node_id, f"({setup.name}) {what}{self._watch.last_words(setup.node_id)}")

    def _command(self, setup: NodeSetup, word: int) -> None:
        self._write(setup, Write(CONTROLWORD, 0, word, "controlword", read_back=False))

    def _read(self, setup: NodeSetup, index: int, subindex: int) -> int:
        return int(self._talk(setup, read_entry(setup, index, subindex)))

    def _write(self, setup: NodeSetup, write: Write) -> None:
        self._talk(setup, write_entry(setup, write))

    def _talk(self, setup: NodeSetup, dialogue: Dialogue) -> Any:
        """Hold a dialogue, with heartbeats meanwhile, and return its result."""
        results: list[Any] = []

        def held() -> Dialogue:
            results.append((yield from dialogue))

        times = self._times
        with Dialogues(
            self._network, {setup.node_id: held()}, timeout_s=times.sdo_s, retries=times.retries
        ) as dialogues:
            while waiting := dialogues.waiting:
                self._pump(lambda: bool(waiting[0].inbox), POLL_S)
                dialogues.serve()
        return results[0]

    def _pump(self, done: Callable[[], bool], timeout_s: float) -> None:
        port = self._network.port
        if self._beats and (now_ns := port.clock.now_ns()) >= self._heartbeat_ns:  # nodes that heard one expect more
            self._heartbeat_ns = now_ns + HEARTBEAT_PRODUCED_MS * 1_000_000
            port.send_batch([pack_heartbeat(MASTER_NODE_ID, NmtState.OPERATIONAL)])
        self._network.pump_until(done, timeout_s)


def _has_profile_position(setup: NodeSetup) -> bool:
    drive = Description(setup.dictionary)
    listed = drive.modes is None or OperationMode.PROFILE_POSITION in drive.modes
    return listed and drive.entry(TARGET) is not None and drive.entry(PROFILE_SPEED) is not None
