"""The CiA 402 drive state machine as tables, read by the drive and by its master.

    power on ─0→ NOT_READY ─1→ SWITCH_ON_DISABLED ⇄2,7 READY ⇄3,6 SWITCHED_ON ⇄4,5 OPERATION_ENABLED
    OPERATION_ENABLED ─8→ READY   ─9→ SWITCH_ON_DISABLED   ─11→ QUICK_STOP_ACTIVE ─12→ SWITCH_ON_DISABLED (16: back)
    SWITCHED_ON ─10→ SWITCH_ON_DISABLED      any ─13→ FAULT_REACTION_ACTIVE ─14→ FAULT ─15→ SWITCH_ON_DISABLED

Source: CiA 402-2 (IEC 61800-7-201), finite state automaton, controlword 6040h, statusword 6041h.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto

from canprobe.errors import ProtocolError

# Statusword bit numbers (6041h) outside the state bits 0..3, 5, 6.
VOLTAGE_ENABLED_BIT = 4
REMOTE_BIT = 9
TARGET_REACHED_BIT = 10
INTERNAL_LIMIT_BIT = 11
DRIVE_FOLLOWS_BIT = 12  # CSP, CSV, CST: the drive follows the command value
SETPOINT_ACKNOWLEDGE_BIT = 12  # PP
HOMING_ATTAINED_BIT = 12  # homing
INTERPOLATION_ACTIVE_BIT = 12  # interpolated position
FOLLOWING_ERROR_BIT = 13  # PP, CSP
HOMING_ERROR_BIT = 13  # homing

# Controlword bit numbers (6040h) outside the command bits 0..3.
NEW_SETPOINT_BIT = 4  # PP
HOMING_START_BIT = 4  # homing
ENABLE_INTERPOLATION_BIT = 4  # interpolated position
CHANGE_IMMEDIATELY_BIT = 5  # PP
RELATIVE_BIT = 6  # PP
FAULT_RESET_BIT = 7
HALT_BIT = 8
ENABLE_WORD = 0x000F
"""Controlword that enables the operation, and keeps it."""

# Objects of the first axis, by index.
CONTROLWORD, STATUSWORD, MODE, MODE_DISPLAY = 0x6040, 0x6041, 0x6060, 0x6061
POSITION, VELOCITY, TARGET_POSITION, TARGET_VELOCITY, TARGET_TORQUE = 0x6064, 0x606C, 0x607A, 0x60FF, 0x6071
HOMING_METHOD, INTERPOLATION_DATA, INTERPOLATION_TIME, SUPPORTED_MODES = 0x6098, 0x60C1, 0x60C2, 0x6502


class OperationMode(IntEnum):
    """Modes of operation, 6060h and 6061h, that the drives know."""

    NONE = 0
    PROFILE_POSITION = 1
    HOMING = 6
    INTERPOLATED_POSITION = 7
    CYCLIC_SYNC_POSITION = 8
    CYCLIC_SYNC_VELOCITY = 9
    CYCLIC_SYNC_TORQUE = 10


class DriveState(Enum):
    """States of the drive; the value is its pattern in the statusword's bits 0..3, 5 and 6."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class DriveCommand(Enum):
    """Commands of a controlword; switching on and disabling operation have the same pattern."""

    SHUTDOWN = auto()
    SWITCH_ON = auto()
    DISABLE_OPERATION = SWITCH_ON
    ENABLE_OPERATION = auto()
    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()
    FAULT_RESET = auto()


class Event(Enum):
    """Events in the drive that change the state without a controlword."""

    INITIALISED = auto()
    QUICK_STOP_DONE = auto()
    FAULT_DETECTED = auto()
    FAULT_REACTION_DONE = auto()


_S = DriveState
_C = DriveCommand
INITIAL_STATE = _S.NOT_READY_TO_SWITCH_ON  # transition 0, at power on

# (mask, pattern, command). With bit 7 clear every controlword matches exactly one line.
CONTROLWORD_PATTERNS: tuple[tuple[int, int, DriveCommand], ...] = (
    (0x82, 0x00, _C.DISABLE_VOLTAGE),
    (0x86, 0x02, _C.QUICK_STOP),
    (0x87, 0x06, _C.SHUTDOWN),
    (0x8F, 0x07, _C.SWITCH_ON),
    (0x8F, 0x0F, _C.ENABLE_OPERATION),
)

# (number in the standard, from, cause, to). 3 is there twice: enabling from READY passes through SWITCHED_ON.
NUMBERED_TRANSITIONS: tuple[tuple[int, DriveState, DriveCommand, DriveState], ...] = (
    (2, _S.SWITCH_ON_DISABLED, _C.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    (3, _S.READY_TO_SWITCH_ON, _C.SWITCH_ON, _S.SWITCHED_ON),
    (3, _S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION, _S.SWITCHED_ON),
    (4, _S.SWITCHED_ON, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
    (5, _S.OPERATION_ENABLED, _C.DISABLE_OPERATION, _S.SWITCHED_ON),
    (6, _S.SWITCHED_ON, _C.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    (7, _S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    (7, _S.READY_TO_SWITCH_ON, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    (8, _S.OPERATION_ENABLED, _C.SHUTDOWN, _S.READY_TO_SWITCH_ON),
    (9, _S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    (10, _S.SWITCHED_ON, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    (10, _S.SWITCHED_ON, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    (11, _S.OPERATION_ENABLED, _C.QUICK_STOP, _S.QUICK_STOP_ACTIVE),
    (12, _S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    (15, _S.FAULT, _C.FAULT_RESET, _S.SWITCH_ON_DISABLED),
    (16, _S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
)

TRANSITIONS: dict[tuple[DriveState, DriveCommand], DriveState] = {
    (source, command): target for _, source, command, target in NUMBERED_TRANSITIONS
}
"""Where a command leads. What is not in the table changes nothing. Transition 16 is only for 605Ah = 5..8, and
transition 15 only when no cause of the fault remains: the drive checks both."""

AUTOMATIC_TRANSITIONS: dict[tuple[DriveState, Event], DriveState] = {
    (_S.NOT_READY_TO_SWITCH_ON, Event.INITIALISED): _S.SWITCH_ON_DISABLED,  # 1
    (_S.QUICK_STOP_ACTIVE, Event.QUICK_STOP_DONE): _S.SWITCH_ON_DISABLED,  # 12, with 605Ah = 0..3
    (_S.FAULT_REACTION_ACTIVE, Event.FAULT_REACTION_DONE): _S.FAULT,  # 14
} | {
    (state, Event.FAULT_DETECTED): _S.FAULT_REACTION_ACTIVE  # 13
    for state in DriveState
    if state not in (_S.FAULT_REACTION_ACTIVE, _S.FAULT)
}

POWERED_STATES = frozenset({_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE})
"""States in which the drive function is on, so that torque may act on the motor."""
UNPOWERED_STATES = frozenset(DriveState) - POWERED_STATES
DISABLED_STATES = frozenset({_S.SWITCH_ON_DISABLED, _S.FAULT, _S.NOT_READY_TO_SWITCH_ON})
"""States of a drive that was disabled."""

_BIT_5_FREE = (_S.NOT_READY_TO_SWITCH_ON, _S.SWITCH_ON_DISABLED, _S.FAULT_REACTION_ACTIVE, _S.FAULT)
_STATES = {state.value: state for state in DriveState} | {state.value | 0x20: state for state in _BIT_5_FREE}
_COMMANDS = {
    word: command for mask, pattern, command in CONTROLWORD_PATTERNS for word in range(0x100) if word & mask == pattern
}


def state_of(statusword: int) -> DriveState:
    """The drive state in a statusword.

    Raises:
        ProtocolError: the bits are the pattern of no state.
    """
    state = known_state(statusword)
    if state is None:
        raise ProtocolError(f"statusword {statusword:#06x} is no CiA 402 state")
    return state


def known_state(statusword: int) -> DriveState | None:
    """The drive state in a statusword; None for a bit pattern that is no state."""
    return _STATES.get(statusword & 0x6F)


def describe_state(statusword: int) -> str:
    """The drive state in words that go on after "the drive is"."""
    state = known_state(statusword)
    return state.name if state is not None else f"in no CiA 402 state (statusword {statusword:#06x})"


def command_of(controlword: int, previous: int = 0) -> DriveCommand | None:
    """The command in a controlword, given the one before it.

    Fault reset is the rising edge of bit 7. While bit 7 stays set nothing else is commanded: None.
    """
    if controlword & ~previous & 1 << FAULT_RESET_BIT:
        return DriveCommand.FAULT_RESET
    return _COMMANDS.get(controlword & 0xFF)


_DISABLING_WORDS = dict.fromkeys(DriveState, 0x0000)
_WORDS_TOWARD: dict[DriveState, dict[DriveState, int]] = {
    _S.SWITCH_ON_DISABLED: _DISABLING_WORDS,
    # whatever is reported: below operation it disables, and a drive in operation after all brakes as the others do
    _S.QUICK_STOP_ACTIVE: dict.fromkeys(DriveState, 0x0002) | {_S.SWITCH_ON_DISABLED: 0x0000},
    _S.OPERATION_ENABLED: _DISABLING_WORDS
    | {
        _S.SWITCH_ON_DISABLED: 0x0006,
        _S.READY_TO_SWITCH_ON: 0x0007,
        _S.SWITCHED_ON: ENABLE_WORD,
        _S.OPERATION_ENABLED: ENABLE_WORD,
        _S.FAULT: 0x0080,
    },
}


def controlword_toward(state: DriveState, goal: DriveState, previous: int = 0) -> int:
    """The controlword that a master sends now, in `state`, to come nearer to `goal`. Call it every cycle.

    On the way to OPERATION_ENABLED a fault is reset (with an edge every second call while `previous` is passed) and
    a quick stop is left through SWITCH_ON_DISABLED. Stopping never resets a fault: a drive in FAULT is already off.

    Args:
        state: the drive's present state.
        goal: OPERATION_ENABLED, SWITCH_ON_DISABLED or QUICK_STOP_ACTIVE (from states below operation: disable).
        previous: the controlword sent before, so that a reset that did not take is tried with a new edge.

    Raises:
        ProtocolError: the goal is none of the three.
    """
    try:
        word = _WORDS_TOWARD[goal][state]
    except KeyError:
        raise ProtocolError(f"no way to {goal.name}: goals are {', '.join(s.name for s in _WORDS_TOWARD)}") from None
    return word & ~(previous & 1 << FAULT_RESET_BIT)
