"""Rules on switching a drive on and off, and on homing: the controlword, and what the targets are meanwhile."""

from __future__ import annotations

from collections import deque

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import TRANSITIONS, DriveCommand, DriveState, OperationMode, command_of
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.fieldbus.tools.judge import events
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.rule import Case, Watch, rule
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
_LONGEST_RESET_NS = 500_000_000
"""Longest time for which bit 7 may stay set."""
_RESETS_WINDOW_NS = 10_000_000_000
"""Time within which a fourth fault reset is one too many."""
_STOP_SEEN_NS = 50_000_000
"""Time from a quick stop of the drive's own to the answer of its master."""
_LONGEST_HALT_NS = 1_000_000_000
"""Longest time for which targets may change under halt."""
_LONGEST_START_NS = 500_000_000
"""Longest time for which bit 4 may be set in the homing mode without an edge."""


def enables(event: events.ControlSeen) -> bool:
    """Whether a controlword is the first to enable a drive that is not enabled yet."""
    enable = DriveCommand.ENABLE_OPERATION
    enabled_before = event.before is not None and command_of(event.before) is enable
    return command_of(event.word, event.before or 0) is enable and not enabled_before and not event.node.enabled


@rule(1)
def target_at_enable(case: Case, node: SeenNode) -> Watch[events.ControlSeen | events.TargetSeen | events.StatusSeen]:
    """The target position is elsewhere than the axis when the drive is enabled."""
    armed: BusFrame | None = None
    while event := (yield):
        if isinstance(event, events.ControlSeen):
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
        allowed = node.tolerance(case.bus.period_ns)
        where = f"target {target.value} while the axis is at {position.value}"
        case.expect(node, off <= allowed, f"{where}: {off} off, {allowed:.0f} allowed", position, target, command)


@rule(2)
def speed_at_enable(case: Case, node: SeenNode) -> Watch[events.ControlSeen]:
    """A velocity or torque is set when the drive is enabled."""
    while event := (yield):
        mode = node.mode
        if mode is None or TARGET_OF_MODE.get(mode) not in _AMOUNTS or not enables(event):
            continue
        case.looked += 1
        target = node.target(mode)
        if target is not None and target.value != 0:
            what = f"{TARGET_OF_MODE[mode]:04X}h is {target.value} when the drive is enabled in mode {mode}"
            case.blame(node, what, target, event)


@rule(3)
def setpoint_too_early(case: Case, node: SeenNode) -> Watch[events.ControlSeen | events.TargetSeen]:
    """In profile position bit 4 rises before the new target is there."""
    edge: BusFrame | None = None
    fresh = False
    while event := (yield):
        if node.mode != OperationMode.PROFILE_POSITION or not node.enabled:
            continue
        if isinstance(event, events.ControlSeen):
            if event.word & 0x10 and not (event.before or 0) & 0x10:
                case.looked += 1
                edge, fresh = None if fresh else event.frame, False
            elif not event.word & 0x10:
                edge = None
        elif event.value != event.before:  # too late while bit 4 of an old target is set
            if edge is not None and edge.t_ns != event.frame.t_ns:
                early_ms = (event.frame.t_ns - edge.t_ns) * 1e-6
                case.blame(node, f"bit 4 rose {early_ms:.1f} ms before target {event.value} came", edge, event)
                edge = None
            else:
                fresh = True


@rule(4, answers=True)
def mode_not_confirmed(case: Case, node: SeenNode) -> Watch[events.ControlSeen | events.TargetSeen]:
    """The drive is enabled, or gets targets, before it has confirmed its mode."""
    while event := (yield):
        asked = node.known(cia402.MODE)
        if asked is None:
            continue
        if isinstance(event, events.ControlSeen):
            begins, does = enables(event), "enables"
        else:
            of_mode = TARGET_OF_MODE.get(asked.value) == event.index
            begins, does = node.enabled and event.value != event.before and of_mode, "sends targets"
        if not begins:
            continue
        shown = node.known(cia402.MODE_DISPLAY)
        display = f"6061h was {shown.value}" if shown is not None else "6061h was not read"
        case.expect(node, node.mode_confirmed, f"{does} in mode {asked.value}; {display}", asked, shown, event)


@rule(8)
def stepped_blind(case: Case, node: SeenNode) -> Watch[events.ControlSeen]:
    """The next step of the state machine comes before the drive has shown the last one."""
    while event := (yield):
        before = command_of(event.before) if event.before is not None else None
        command = command_of(event.word, event.before or 0)
        if command is None or (before, command) not in _STEPS_UP:
            continue
        status, wanted = node.known(cia402.STATUSWORD), _STATES_FOR[command]
        if before is DriveCommand.SWITCH_ON:
            wanted = wanted - {DriveState.READY_TO_SWITCH_ON}  # switch on has left that
        seen = f"6041h was {status.value:04X}h" if status is not None else "6041h was not seen"
        what = f"6040h = {event.word:04X}h after {event.before or 0:04X}h; {seen}"
        case.expect(node, node.state in wanted, what, status, event)


@rule(9, answers=True)
def reset_held(case: Case, node: SeenNode) -> Watch[events.ControlSeen]:
    """Bit 7 stays set, so that there is no edge and no other command."""
    first: BusFrame | None = None
    while event := (yield):
        if not event.word >> cia402.FAULT_RESET_BIT & 1:
            first = None
            continue
        first = first or event.frame
        held_ns = event.frame.t_ns - first.t_ns
        if case.in_a_row(node, held_ns > _LONGEST_RESET_NS):
            case.blame(node, f"bit 7 of 6040h has been set for {held_ns * 1e-9:.2f} s without an edge", first, event)


@rule(10, answers=True)
def resets_again(case: Case, node: SeenNode) -> Watch[events.ControlSeen]:
    """Faults are reset again and again."""
    resets: deque[BusFrame] = deque(maxlen=4)
    while event := (yield):
        edge = command_of(event.word, event.before or 0) is DriveCommand.FAULT_RESET
        if not edge or node.state is not DriveState.FAULT:
            continue
        case.looked += 1
        resets.append(event.frame)
        took_ns = event.frame.t_ns - resets[0].t_ns
        if len(resets) == 4 and took_ns < _RESETS_WINDOW_NS:
            case.blame(node, f"four fault resets in {took_ns * 1e-9:.1f} s", *resets)
            resets.clear()


@rule(11, answers=True)
def leaves_quick_stop(case: Case, node: SeenNode) -> Watch[events.ControlSeen | events.StatusSeen]:
    """The master enables a drive that has stopped by itself."""
    first: BusFrame | None = None  # that shows a quick stop which the master has not commanded
    while event := (yield):
        if isinstance(event, events.StatusSeen):
            word = node.number(cia402.CONTROLWORD)
            by_itself = word is not None and command_of(word) is DriveCommand.ENABLE_OPERATION
            if node.state is not DriveState.QUICK_STOP_ACTIVE:
                first = None
            elif by_itself:
                first = first or event.frame
        elif first is not None:
            late = event.frame.t_ns - first.t_ns > max(_STOP_SEEN_NS, 3 * case.bus.period_ns)
            if command_of(event.word) is not DriveCommand.ENABLE_OPERATION:
                first = None
            elif case.in_a_row(node, late):
                case.blame(node, "enable operation to a drive in quick stop active", first, event)


@rule(41)
def halt_kept(case: Case, node: SeenNode) -> Watch[events.TargetSeen | events.ModeSeen]:
    """Targets are sent while halt is set, or the mode is changed under it."""
    first: BusFrame | None = None
    while event := (yield):
        word = node.known(cia402.CONTROLWORD)
        if word is None or not word.value >> cia402.HALT_BIT & 1 or not node.enabled:
            first = None
            continue
        case.looked += 1
        if isinstance(event, events.ModeSeen):
            if event.mode != event.before and event.before is not None:
                case.blame(node, f"mode {event.mode} is asked for while halt is set", word, event)
        elif event.value != event.before:
            first = first or event.frame
            held_ns = event.frame.t_ns - first.t_ns
            if case.in_a_row(node, held_ns > _LONGEST_HALT_NS):
                case.blame(node, f"targets have changed under halt for {held_ns * 1e-9:.1f} s", word, first, event)


@rule(13)
def homes_again(case: Case, node: SeenNode) -> Watch[events.StatusSeen | events.ControlSeen | events.HeartbeatSeen]:
    """An axis is homed although it has its reference."""
    referenced: BusFrame | None = None
    while event := (yield):
        if isinstance(event, events.HeartbeatSeen):
            referenced = None if event.state is NmtState.INITIALISING else referenced
        elif node.number(cia402.MODE_DISPLAY) != OperationMode.HOMING:
            continue
        elif isinstance(event, events.StatusSeen):
            done, failed = event.word >> cia402.HOMING_ATTAINED_BIT & 1, event.word >> cia402.HOMING_ERROR_BIT & 1
            referenced = (referenced or event.frame) if done and not failed else None
        elif event.word & ~(event.before or 0) & 1 << cia402.HOMING_START_BIT and node.enabled:
            what = "homing is started on an axis that has its reference"
            case.expect(node, referenced is None, what, referenced, event)


@rule(14)
def homing_start(case: Case, node: SeenNode) -> Watch[events.ControlSeen]:
    """Homing is started in another mode, or without an edge."""
    first: BusFrame | None = None  # with bit 4
    while event := (yield):
        if not event.word >> cia402.HOMING_START_BIT & 1:
            first = None
            continue
        first, asked = first or event.frame, node.known(cia402.MODE)
        if asked is None or asked.value != OperationMode.HOMING:
            continue
        waited_ns = event.frame.t_ns - asked.t_ns
        if first is event.frame:
            shown = node.known(cia402.MODE_DISPLAY)
            what = f"bit 4 rises while 6061h is {shown.value if shown is not None else 'not read'}"
            case.expect(node, node.mode_confirmed, what, asked, shown, event)
        elif case.in_a_row(node, first.t_ns < asked.t_ns and waited_ns > _LONGEST_START_NS and node.enabled):
            case.blame(node, "bit 4 was set before mode 6, and has no edge", first, asked, event)
