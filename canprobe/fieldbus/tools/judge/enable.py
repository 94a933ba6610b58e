"""Rules on switching a drive on and off: the controlword, and what the targets are meanwhile."""

from __future__ import annotations

from collections import deque

from canprobe.fieldbus.protocol.cia402 import (
    FAULT_RESET_BIT,
    HALT_BIT,
    DriveCommand,
    DriveState,
    OperationMode,
    command_of,
)
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import BusEvent, ControlSeen, ModeSeen, StatusSeen, TargetSeen
from canprobe.fieldbus.tools.judge.rule import Rule, Severity
from canprobe.fieldbus.tools.judge.seen_node import (
    CONTROLWORD,
    MODE,
    MODE_DISPLAY,
    POSITION,
    STATUSWORD,
    TARGET_OF_MODE,
    TARGET_TORQUE,
    TARGET_VELOCITY,
    Known,
)

_AT_ONCE = (OperationMode.CYCLIC_SYNC_POSITION, OperationMode.INTERPOLATED_POSITION)
"""Modes in which a drive follows its target position as soon as it is enabled."""


_STATES_FOR = {
    DriveCommand.SWITCH_ON: frozenset(
        {DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON, DriveState.OPERATION_ENABLED}
    ),
    DriveCommand.ENABLE_OPERATION: frozenset(
        {
            DriveState.READY_TO_SWITCH_ON,  # the drive passes through switched on by itself
            DriveState.SWITCHED_ON,
            DriveState.OPERATION_ENABLED,
            DriveState.QUICK_STOP_ACTIVE,
        }
    ),
}
"""States in which a step up may be commanded."""


def frame_of(known: Known | None) -> BusFrame | None:
    """Frame of a value."""
    return known.frame if known is not None else None


def enables(event: ControlSeen) -> bool:
    """Whether a controlword is the first to enable a drive that is not enabled yet."""
    was = command_of(event.before) if event.before is not None else None
    is_first = was is not DriveCommand.ENABLE_OPERATION
    return command_of(event.word, event.before or 0) is DriveCommand.ENABLE_OPERATION and (
        is_first and not event.node.enabled
    )


class TargetAtEnable(Rule):
    """The target position is elsewhere than the axis when the drive is enabled."""

    number, name, group, severity = 1, "target at enable", "enable", Severity.UNSAFE
    source = "ethercat_driver_ros2#125, #158; openarm_ros2#66"
    expected = "607Ah within the way of one period of 6064h when operation is enabled, in CSP and interpolated position"
    hint = "read 6064h, send it as 607Ah, and enable after that"
    hears = (ControlSeen, TargetSeen, StatusSeen)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._armed: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Judge once for each enabling, as soon as target and position are known."""
        assert isinstance(event, ControlSeen | TargetSeen | StatusSeen)
        node = event.node
        if isinstance(event, ControlSeen):
            if enables(event):
                self._armed[node.node_id] = event.frame
            elif command_of(event.word) is not DriveCommand.ENABLE_OPERATION:
                self._armed.pop(node.node_id, None)
        if node.node_id not in self._armed or node.mode not in _AT_ONCE:
            return
        target, position = node.target(node.mode), node.known(POSITION)
        if target is None or position is None:
            return
        self.looked += 1
        command, off = self._armed.pop(node.node_id), target.value - position.value
        if abs(off) > (allowed := node.tolerance(self.bus.period_ns)):
            what = f"target {target.value} while the axis is at {position.value}: {abs(off)} off, {allowed:.0f} allowed"
            self.blame(what, position.frame, target.frame, command, node_id=node.node_id)


class SpeedAtEnable(Rule):
    """A velocity or torque is set when the drive is enabled."""

    number, name, group, severity = 2, "speed or torque at enable", "enable", Severity.UNSAFE
    source = "ros_canopen#111"
    expected = "60FFh = 0 and 6071h = 0 when operation is enabled in a mode of velocity or torque"
    hint = "write 0 to the target before enabling"
    hears = (ControlSeen,)

    def see(self, event: BusEvent) -> None:
        """Look at the target of the mode."""
        assert isinstance(event, ControlSeen)
        node, mode = event.node, event.node.mode
        if mode is None or TARGET_OF_MODE.get(mode) not in (TARGET_VELOCITY, TARGET_TORQUE) or not enables(event):
            return
        self.looked += 1
        target = node.target(mode)
        if target is not None and target.value != 0:
            what = f"{TARGET_OF_MODE[mode]:04X}h is {target.value} when the drive is enabled in mode {mode}"
            self.blame(what, target.frame, event.frame, node_id=node.node_id)


class SetpointTooEarly(Rule):
    """In profile position bit 4 rises before the new target is there."""

    number, name, group, severity = 3, "set-point before its target", "enable", Severity.WRONG
    source = "ros_canopen#373"
    expected = "the new 607Ah, then the rising edge of bit 4 in 6040h"
    hint = "write 607Ah first, or put both into one RPDO"
    hears = (ControlSeen, TargetSeen)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._edges: dict[int, BusFrame | None] = {}
        self._fresh: set[int] = set()

    def see(self, event: BusEvent) -> None:
        """A target that changes while bit 4 of an old one is set came too late."""
        assert isinstance(event, ControlSeen | TargetSeen)
        node = event.node
        if node.mode != OperationMode.PROFILE_POSITION or not node.enabled:
            return
        if isinstance(event, ControlSeen):
            rises = event.word & 0x10 and not (event.before or 0) & 0x10
            if rises:
                self.looked += 1
                self._edges[node.node_id] = event.frame if node.node_id not in self._fresh else None
                self._fresh.discard(node.node_id)
            elif not event.word & 0x10:
                self._edges.pop(node.node_id, None)
            return
        if event.value != event.before:
            edge = self._edges.get(node.node_id)
            if edge is not None and edge.t_ns != event.frame.t_ns:
                what = f"bit 4 rose {(event.frame.t_ns - edge.t_ns) * 1e-6:.1f} ms before target {event.value} came"
                self.blame(what, edge, event.frame, node_id=node.node_id)
                self._edges[node.node_id] = None
            else:
                self._fresh.add(node.node_id)


class ModeNotConfirmed(Rule):
    """The drive is enabled, or gets targets, before it has confirmed its mode."""

    number, name, group, severity = 4, "mode not confirmed", "enable", Severity.UNSAFE
    source = "ethercat_driver_ros2#87, #158"
    expected = "6061h = 6060h seen before operation is enabled and before targets of the mode change"
    hint = "read 6061h until it has the mode; stop where it does not come"
    hears = (ControlSeen, TargetSeen)
    answers = True

    def see(self, event: BusEvent) -> None:
        """Compare 6061h with 6060h."""
        assert isinstance(event, ControlSeen | TargetSeen)
        node = event.node
        asked = node.known(MODE)
        if asked is None:
            return
        if isinstance(event, ControlSeen):
            begins = enables(event)
        else:
            begins = node.enabled and event.value != event.before and TARGET_OF_MODE.get(asked.value) == event.index
        if not begins:
            return
        self.looked += 1
        if not node.mode_confirmed:
            shown = node.known(MODE_DISPLAY)
            display = f"6061h was {shown.value}" if shown is not None else "6061h was not read"
            does = "enables" if isinstance(event, ControlSeen) else "sends targets"
            self.blame(f"{does} in mode {asked.value}; {display}", asked.frame, frame_of(shown), event.frame,
                       node_id=node.node_id)  # fmt: skip


class SteppedBlind(Rule):
    """The next step of the state machine comes before the drive has shown the last one."""

    number, name, group, severity = 8, "next step unseen", "enable", Severity.WRONG
    expected = "between two steps of 6040h a 6041h in the state that the first one leads to"
    hint = "wait for ready to switch on after 0006h, and for switched on after 0007h"
    hears = (ControlSeen,)

    def see(self, event: BusEvent) -> None:
        """A step up needs a state that was seen after the command before it."""
        assert isinstance(event, ControlSeen)
        before = command_of(event.before) if event.before is not None else None
        command = command_of(event.word, event.before or 0)
        steps_up = (before, command) in (
            (DriveCommand.SHUTDOWN, DriveCommand.SWITCH_ON),
            (DriveCommand.SHUTDOWN, DriveCommand.ENABLE_OPERATION),
            (DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION),
        )
        if not steps_up or command is None:
            return
        self.looked += 1
        node, status = event.node, event.node.known(STATUSWORD)
        wanted = _STATES_FOR[command]
        if before is DriveCommand.SWITCH_ON:
            wanted = wanted - {DriveState.READY_TO_SWITCH_ON}
        if status is None or node.state not in wanted:
            seen = f"6041h was {status.value:04X}h" if status is not None else "6041h was not seen"
            what = f"6040h = {event.word:04X}h after {event.before or 0:04X}h; {seen}"
            self.blame(what, frame_of(status), event.frame, node_id=node.node_id)


class ResetHeld(Rule):
    """Bit 7 stays set, so that there is no edge and no other command."""

    number, name, group, severity = 9, "fault reset held", "enable", Severity.WRONG
    source = "ros_canopen PR 138; canopen#261"
    expected = "a rising edge of bit 7, then 6040h without it"
    hint = "send 0000h, 0080h, 0000h"
    hears = (ControlSeen,)
    answers = True
    _LONGEST_NS = 500_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._since: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Measure how long bit 7 stays set."""
        assert isinstance(event, ControlSeen)
        node_id = event.node.node_id
        if not event.word >> FAULT_RESET_BIT & 1:
            self._since.pop(node_id, None)
            return
        first = self._since.setdefault(node_id, event.frame)
        held_ns = event.frame.t_ns - first.t_ns
        if self.in_a_row(node_id, held_ns > self._LONGEST_NS):
            what = f"bit 7 of 6040h has been set for {held_ns * 1e-9:.2f} s without an edge"
            self.blame(what, first, event.frame, node_id=node_id)


class ResetsAgain(Rule):
    """Faults are reset again and again."""

    number, name, group, severity = 10, "fault reset repeated", "enable", Severity.UNSAFE
    source = "ethercat_driver_ros2, auto_fault_reset"
    expected = "at most three fault resets in 10 s, and then a stop"
    hint = "leave the reset to a person, or stop after the third"
    hears = (ControlSeen,)
    answers = True
    _WINDOW_NS = 10_000_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._resets: dict[int, deque[BusFrame]] = {}

    def see(self, event: BusEvent) -> None:
        """Count the edges in the state fault."""
        assert isinstance(event, ControlSeen)
        edge = command_of(event.word, event.before or 0) is DriveCommand.FAULT_RESET
        if not edge or event.node.state is not DriveState.FAULT:
            return
        self.looked += 1
        resets = self._resets.setdefault(event.node.node_id, deque(maxlen=4))
        resets.append(event.frame)
        if len(resets) == 4 and event.frame.t_ns - resets[0].t_ns < self._WINDOW_NS:
            took = (event.frame.t_ns - resets[0].t_ns) * 1e-9
            self.blame(f"four fault resets in {took:.1f} s", *resets, node_id=event.node.node_id)
            resets.clear()


class LeavesQuickStop(Rule):
    """The master enables a drive that has stopped by itself."""

    number, name, group, severity = 11, "leaves quick stop", "enable", Severity.UNSAFE
    source = "ethercat_driver_ros2, generic_ec_cia402_drive.cpp"
    expected = "a drive that came into quick stop by itself is disabled, and enabled again on request only"
    hint = "answer quick stop active with 0000h"
    hears = (StatusSeen, ControlSeen)
    answers = True
    _PATIENCE_NS = 50_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._since: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Look for enabling words in a quick stop that the master has not commanded."""
        assert isinstance(event, ControlSeen | StatusSeen)
        node, node_id = event.node, event.node.node_id
        if isinstance(event, StatusSeen):
            word = node.number(CONTROLWORD)
            by_itself = word is not None and command_of(word) is DriveCommand.ENABLE_OPERATION
            if node.state is not DriveState.QUICK_STOP_ACTIVE:
                self._since.pop(node_id, None)
            elif by_itself:
                self._since.setdefault(node_id, event.frame)
            return
        first = self._since.get(node_id)
        if first is None:
            return
        late = event.frame.t_ns - first.t_ns > max(self._PATIENCE_NS, 3 * self.bus.period_ns)
        if command_of(event.word) is not DriveCommand.ENABLE_OPERATION:
            del self._since[node_id]
        elif self.in_a_row(node_id, late):
            self.blame("enable operation to a drive in quick stop active", first, event.frame, node_id=node_id)


class HaltKept(Rule):
    """Targets are sent while halt is set, or the mode is changed under it."""

    number, name, group, severity = 41, "halt kept", "enable", Severity.REFUSED
    source = "ros2_canopen#234; ros_canopen#328"
    expected = "bit 8 of 6040h is cleared before targets are sent; the mode is changed without it"
    hint = "clear bit 8 once a target is there"
    hears = (TargetSeen, ModeSeen)
    _LONGEST_NS = 1_000_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._since: dict[int, BusFrame] = {}

    def see(self, event: BusEvent) -> None:
        """Measure for how long targets change under halt."""
        assert isinstance(event, TargetSeen | ModeSeen)
        node, word = event.node, event.node.known(CONTROLWORD)
        if word is None or not word.value >> HALT_BIT & 1 or not node.enabled:
            self._since.pop(node.node_id, None)
            return
        self.looked += 1
        if isinstance(event, ModeSeen):
            if event.mode != event.before and event.before is not None:
                what = f"mode {event.mode} is asked for while halt is set"
                self.blame(what, word.frame, event.frame, node_id=node.node_id)
        elif event.value != event.before:
            first = self._since.setdefault(node.node_id, event.frame)
            if self.in_a_row(node.node_id, event.frame.t_ns - first.t_ns > self._LONGEST_NS):
                what = f"targets have changed under halt for {(event.frame.t_ns - first.t_ns) * 1e-9:.1f} s"
                self.blame(what, word.frame, first, event.frame, node_id=node.node_id)


ENABLE_RULES: tuple[type[Rule], ...] = (
    TargetAtEnable,
    SpeedAtEnable,
    SetpointTooEarly,
    ModeNotConfirmed,
    SteppedBlind,
    ResetHeld,
    ResetsAgain,
    LeavesQuickStop,
    HaltKept,
)
