"""Rules on switching a drive on and off: the controlword, and what the targets are meanwhile."""

from __future__ import annotations

from collections import deque

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import TRANSITIONS, DriveCommand, DriveState, OperationMode, command_of
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.events import ControlSeen, ModeSeen, StatusSeen, TargetSeen
from canprobe.fieldbus.tools.judge.rule import Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import TARGET_OF_MODE, SeenNode

_AT_ONCE = (OperationMode.CYCLIC_SYNC_POSITION, OperationMode.INTERPOLATED_POSITION)
"""Modes in which a drive follows its target position as soon as it is enabled."""
_AMOUNTS = (cia402.TARGET_VELOCITY, cia402.TARGET_TORQUE)
"""Targets of which any but 0 moves the axis."""
_STEPS_UP = (
    (DriveCommand.SHUTDOWN, DriveCommand.SWITCH_ON),
    (DriveCommand.SHUTDOWN, DriveCommand.ENABLE_OPERATION),
    (DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION),
)
_STATES_FOR = {
    step: {state for (source, command), goal in TRANSITIONS.items() if command is step for state in (source, goal)}
    for step in (DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION)
}
"""States in which a step up may be commanded: it leads on from them, or they are its goal."""


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

    def watch(self, node: SeenNode) -> Watch[ControlSeen | TargetSeen | StatusSeen]:
        armed: BusFrame | None = None
        while event := (yield):
            if isinstance(event, ControlSeen):
                if enables(event):
                    armed = event.frame
                elif command_of(event.word) is not DriveCommand.ENABLE_OPERATION:
                    armed = None
            if armed is None or node.mode not in _AT_ONCE:
                continue
            target, position = node.target(node.mode), node.known(cia402.POSITION)
            if target is None or position is None:
                continue
            command, armed, off = armed, None, abs(target.value - position.value)
            allowed, where = (
                node.tolerance(self.bus.period_ns),
                f"target {target.value} while the axis is at {position.value}",
            )
            self.expect(node, off <= allowed, f"{where}: {off} off, {allowed:.0f} allowed", position, target, command)


class SpeedAtEnable(Rule):
    """A velocity or torque is set when the drive is enabled."""

    number, name, group, severity = 2, "speed or torque at enable", "enable", Severity.UNSAFE
    source = "ros_canopen#111"
    expected = "60FFh = 0 and 6071h = 0 when operation is enabled in a mode of velocity or torque"
    hint = "write 0 to the target before enabling"

    def watch(self, node: SeenNode) -> Watch[ControlSeen]:
        while event := (yield):
            mode = node.mode
            if mode is None or TARGET_OF_MODE.get(mode) not in _AMOUNTS or not enables(event):
                continue
            self.looked += 1
            target = node.target(mode)
            if target is not None and target.value != 0:
                what = f"{TARGET_OF_MODE[mode]:04X}h is {target.value} when the drive is enabled in mode {mode}"
                self.blame(node, what, target, event)


class SetpointTooEarly(Rule):
    """In profile position bit 4 rises before the new target is there."""

    number, name, group, severity = 3, "set-point before its target", "enable", Severity.WRONG
    source = "ros_canopen#373"
    expected = "the new 607Ah, then the rising edge of bit 4 in 6040h"
    hint = "write 607Ah first, or put both into one RPDO"

    def watch(self, node: SeenNode) -> Watch[ControlSeen | TargetSeen]:
        edge: BusFrame | None = None
        fresh = False
        while event := (yield):
            if node.mode != OperationMode.PROFILE_POSITION or not node.enabled:
                continue
            if isinstance(event, ControlSeen):
                if event.word & 0x10 and not (event.before or 0) & 0x10:
                    self.looked += 1
                    edge, fresh = None if fresh else event.frame, False
                elif not event.word & 0x10:
                    edge = None
            elif event.value != event.before:  # too late while bit 4 of an old target is set
                if edge is not None and edge.t_ns != event.frame.t_ns:
                    early_ms = (event.frame.t_ns - edge.t_ns) * 1e-6
                    self.blame(node, f"bit 4 rose {early_ms:.1f} ms before target {event.value} came", edge, event)
                    edge = None
                else:
                    fresh = True


class ModeNotConfirmed(Rule):
    """The drive is enabled, or gets targets, before it has confirmed its mode."""

    number, name, group, severity = 4, "mode not confirmed", "enable", Severity.UNSAFE
    source = "ethercat_driver_ros2#87, #158"
    expected = "6061h = 6060h seen before operation is enabled and before targets of the mode change"
    hint = "read 6061h until it has the mode; stop where it does not come"
    answers = True

    def watch(self, node: SeenNode) -> Watch[ControlSeen | TargetSeen]:
        while event := (yield):
            asked = node.known(cia402.MODE)
            if asked is None:
                continue
            if isinstance(event, ControlSeen):
                begins, does = enables(event), "enables"
            else:
                of_mode = TARGET_OF_MODE.get(asked.value) == event.index
                begins, does = node.enabled and event.value != event.before and of_mode, "sends targets"
            if not begins:
                continue
            shown = node.known(cia402.MODE_DISPLAY)
            display = f"6061h was {shown.value}" if shown is not None else "6061h was not read"
            self.expect(node, node.mode_confirmed, f"{does} in mode {asked.value}; {display}", asked, shown, event)


class SteppedBlind(Rule):
    """The next step of the state machine comes before the drive has shown the last one."""

    number, name, group, severity = 8, "next step unseen", "enable", Severity.WRONG
    expected = "between two steps of 6040h a 6041h in the state that the first one leads to"
    hint = "wait for ready to switch on after 0006h, and for switched on after 0007h"

    def watch(self, node: SeenNode) -> Watch[ControlSeen]:
        while event := (yield):
            before = command_of(event.before) if event.before is not None else None
            command = command_of(event.word, event.before or 0)
            if command is None or (before, command) not in _STEPS_UP:
                continue
            status, wanted = node.known(cia402.STATUSWORD), _STATES_FOR[command]
            if before is DriveCommand.SWITCH_ON:
                wanted = wanted - {DriveState.READY_TO_SWITCH_ON}
            seen = f"6041h was {status.value:04X}h" if status is not None else "6041h was not seen"
            what = f"6040h = {event.word:04X}h after {event.before or 0:04X}h; {seen}"
            self.expect(node, node.state in wanted, what, status, event)


class ResetHeld(Rule):
    """Bit 7 stays set, so that there is no edge and no other command."""

    number, name, group, severity = 9, "fault reset held", "enable", Severity.WRONG
    source = "ros_canopen PR 138; canopen#261"
    expected = "a rising edge of bit 7, then 6040h without it"
    hint = "send 0000h, 0080h, 0000h"
    answers = True
    _LONGEST_NS = 500_000_000

    def watch(self, node: SeenNode) -> Watch[ControlSeen]:
        first: BusFrame | None = None
        while event := (yield):
            if not event.word >> cia402.FAULT_RESET_BIT & 1:
                first = None
                continue
            first = first or event.frame
            held_ns = event.frame.t_ns - first.t_ns
            if self.in_a_row(node, held_ns > self._LONGEST_NS):
                what = f"bit 7 of 6040h has been set for {held_ns * 1e-9:.2f} s without an edge"
                self.blame(node, what, first, event)


class ResetsAgain(Rule):
    """Faults are reset again and again."""

    number, name, group, severity = 10, "fault reset repeated", "enable", Severity.UNSAFE
    source = "ethercat_driver_ros2, auto_fault_reset"
    expected = "at most three fault resets in 10 s, and then a stop"
    hint = "leave the reset to a person, or stop after the third"
    answers = True
    _WINDOW_NS = 10_000_000_000

    def watch(self, node: SeenNode) -> Watch[ControlSeen]:
        resets: deque[BusFrame] = deque(maxlen=4)
        while event := (yield):
            edge = command_of(event.word, event.before or 0) is DriveCommand.FAULT_RESET
            if not edge or node.state is not DriveState.FAULT:
                continue
            self.looked += 1
            resets.append(event.frame)
            took_ns = event.frame.t_ns - resets[0].t_ns
            if len(resets) == 4 and took_ns < self._WINDOW_NS:
                self.blame(node, f"four fault resets in {took_ns * 1e-9:.1f} s", *resets)
                resets.clear()


class LeavesQuickStop(Rule):
    """The master enables a drive that has stopped by itself."""

    number, name, group, severity = 11, "leaves quick stop", "enable", Severity.UNSAFE
    source = "ethercat_driver_ros2, generic_ec_cia402_drive.cpp"
    expected = "a drive that came into quick stop by itself is disabled, and enabled again on request only"
    hint = "answer quick stop active with 0000h"
    answers = True
    _PATIENCE_NS = 50_000_000

    def watch(self, node: SeenNode) -> Watch[ControlSeen | StatusSeen]:
        first: BusFrame | None = None  # that shows a quick stop which the master has not commanded
        while event := (yield):
            if isinstance(event, StatusSeen):
                word = node.number(cia402.CONTROLWORD)
                by_itself = word is not None and command_of(word) is DriveCommand.ENABLE_OPERATION
                if node.state is not DriveState.QUICK_STOP_ACTIVE:
                    first = None
                elif by_itself:
                    first = first or event.frame
            elif first is not None:
                late = event.frame.t_ns - first.t_ns > max(self._PATIENCE_NS, 3 * self.bus.period_ns)
                if command_of(event.word) is not DriveCommand.ENABLE_OPERATION:
                    first = None
                elif self.in_a_row(node, late):
                    self.blame(node, "enable operation to a drive in quick stop active", first, event)


class HaltKept(Rule):
    """Targets are sent while halt is set, or the mode is changed under it."""

    number, name, group, severity = 41, "halt kept", "enable", Severity.REFUSED
    source = "ros2_canopen#234; ros_canopen#328"
    expected = "bit 8 of 6040h is cleared before targets are sent; the mode is changed without it"
    hint = "clear bit 8 once a target is there"
    _LONGEST_NS = 1_000_000_000

    def watch(self, node: SeenNode) -> Watch[TargetSeen | ModeSeen]:
        first: BusFrame | None = None
        while event := (yield):
            word = node.known(cia402.CONTROLWORD)
            if word is None or not word.value >> cia402.HALT_BIT & 1 or not node.enabled:
                first = None
                continue
            self.looked += 1
            if isinstance(event, ModeSeen):
                if event.mode != event.before and event.before is not None:
                    self.blame(node, f"mode {event.mode} is asked for while halt is set", word, event)
            elif event.value != event.before:
                first = first or event.frame
                held_ns = event.frame.t_ns - first.t_ns
                if self.in_a_row(node, held_ns > self._LONGEST_NS):
                    what = f"targets have changed under halt for {held_ns * 1e-9:.1f} s"
                    self.blame(node, what, word, first, event)
