"""The drive state machine against the standard's own tables, written out again as text."""

import pytest

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import (
    DriveCommand,
    DriveState,
    Event,
    command_of,
    controlword_toward,
    state_of,
)

S, C = DriveState, DriveCommand
ALL_LOW_BYTES = [high | low for high in (0x0000, 0xFF00, 0x1200) for low in range(0x100)]

# CiA 402-2, statusword: bits 15..0, x free.
STATUSWORDS = {
    "xxxx xxxx x0xx 0000": S.NOT_READY_TO_SWITCH_ON,
    "xxxx xxxx x1xx 0000": S.SWITCH_ON_DISABLED,
    "xxxx xxxx x01x 0001": S.READY_TO_SWITCH_ON,
    "xxxx xxxx x01x 0011": S.SWITCHED_ON,
    "xxxx xxxx x01x 0111": S.OPERATION_ENABLED,
    "xxxx xxxx x00x 0111": S.QUICK_STOP_ACTIVE,
    "xxxx xxxx x0xx 1111": S.FAULT_REACTION_ACTIVE,
    "xxxx xxxx x0xx 1000": S.FAULT,
}
# CiA 402-2, controlword: bits 7, 3, 2, 1, 0.
CONTROLWORDS = {
    "0x110": C.SHUTDOWN,
    "00111": C.SWITCH_ON,
    "01111": C.ENABLE_OPERATION,
    "0xx0x": C.DISABLE_VOLTAGE,
    "0x01x": C.QUICK_STOP,
}
NO, SOD, RTSO, SO, OE, QSA, FRA, F = S
# CiA 402-2, transitions 2..12, 15, 16: row = state, column = command in the order below.
COMMANDS = (C.SHUTDOWN, C.SWITCH_ON, C.ENABLE_OPERATION, C.DISABLE_VOLTAGE, C.QUICK_STOP, C.FAULT_RESET)
NEXT = {
    NO: (NO, NO, NO, NO, NO, NO),
    SOD: (RTSO, SOD, SOD, SOD, SOD, SOD),
    RTSO: (RTSO, SO, SO, SOD, SOD, RTSO),
    SO: (RTSO, SO, OE, SOD, SOD, SO),
    OE: (RTSO, SO, OE, SOD, QSA, OE),
    QSA: (QSA, QSA, OE, SOD, QSA, QSA),
    FRA: (FRA, FRA, FRA, FRA, FRA, FRA),
    F: (F, F, F, F, F, SOD),
}


def matches(word, pattern):
    digits = pattern.replace(" ", "")
    return all(d in ("x", b) for d, b in zip(digits, format(word, f"0{len(digits)}b"), strict=True))


def test_every_statusword_is_the_state_of_the_standards_table():
    for word in ALL_LOW_BYTES:
        expected = {state for pattern, state in STATUSWORDS.items() if matches(word, pattern)}
        if expected:
            assert {state_of(word)} == expected
        else:
            with pytest.raises(ProtocolError):
                state_of(word)


@pytest.mark.parametrize("state", S)
def test_state_to_statusword_and_back(state):
    assert state_of(state.value) is state
    assert state_of(state.value | 0xFF90) is state  # every bit that does not belong to the state


def test_every_controlword_is_the_command_of_the_standards_table():
    for word in ALL_LOW_BYTES:
        five = (word >> 7 & 1) << 4 | word & 0xF
        expected = {command for pattern, command in CONTROLWORDS.items() if matches(five, pattern)}
        assert {command_of(word, previous=0x80)} == (expected or {None})


def test_fault_reset_is_the_rising_edge_of_bit_7():
    for word in (0x80, 0x8F, 0xFFFF):
        assert command_of(word, previous=0x0000) is C.FAULT_RESET
        assert command_of(word, previous=0x0080) is None
        assert command_of(word & ~0x80, previous=0x0080) is not C.FAULT_RESET
    assert command_of(0x000F, previous=0x000F) is C.ENABLE_OPERATION


def test_disable_operation_is_the_pattern_of_switch_on():
    assert C.DISABLE_OPERATION is C.SWITCH_ON


@pytest.mark.parametrize("state", S)
def test_every_command_from_every_state(state):
    """Conformance points 49 and 50: what is not a transition changes nothing."""
    reached = tuple(cia402.TRANSITIONS.get((state, command), state) for command in COMMANDS)
    assert reached == NEXT[state]


def test_transition_numbers_are_complete_0_to_16():
    by_command = {number for number, *_ in cia402.NUMBERED_TRANSITIONS}
    automatic = {1, 12, 13, 14}
    assert by_command | automatic | {0} == set(range(17))
    assert by_command & automatic == {12}
    assert cia402.INITIAL_STATE is NO  # transition 0
    assert len(cia402.TRANSITIONS) == len(cia402.NUMBERED_TRANSITIONS)


def test_automatic_transitions():
    table = dict(cia402.AUTOMATIC_TRANSITIONS)
    assert table.pop((NO, Event.INITIALISED)) is SOD
    assert table.pop((QSA, Event.QUICK_STOP_DONE)) is SOD
    assert table.pop((FRA, Event.FAULT_REACTION_DONE)) is F
    assert table == {(state, Event.FAULT_DETECTED): FRA for state in (NO, SOD, RTSO, SO, OE, QSA)}


def test_bits_stand_where_the_standard_has_them():
    assert (cia402.VOLTAGE_ENABLED_BIT, cia402.REMOTE_BIT) == (4, 9)
    assert (cia402.TARGET_REACHED_BIT, cia402.INTERNAL_LIMIT_BIT) == (10, 11)
    assert (cia402.DRIVE_FOLLOWS_BIT, cia402.FOLLOWING_ERROR_BIT, cia402.HALT_BIT) == (12, 13, 8)
    assert [m.value for m in cia402.OperationMode] == [0, 1, 6, 7, 8, 9, 10]
    assert (cia402.ENABLE_INTERPOLATION_BIT, cia402.INTERPOLATION_ACTIVE_BIT) == (4, 12)


def run_drive(state, goal, cycles=12, resets_fail=0):
    """A drive by the tables under a master that calls `controlword_toward` every cycle; returns the states seen."""
    previous, seen = 0, [state]
    for _ in range(cycles):
        word = controlword_toward(state, goal, previous)
        command = command_of(word, previous)
        if command is C.FAULT_RESET and resets_fail:
            resets_fail -= 1
        else:
            state = cia402.TRANSITIONS.get((state, command), state)
        previous = word
        if state in (NO, FRA):
            event = Event.INITIALISED if state is NO else Event.FAULT_REACTION_DONE
            state = cia402.AUTOMATIC_TRANSITIONS[state, event]
        seen.append(state)
    return seen


@pytest.mark.parametrize("start", S)
def test_enabling_reaches_operation_from_every_state_and_stays(start):
    seen = run_drive(start, OE)
    assert seen[-4:] == [OE] * 4


def test_enabling_goes_step_by_step():
    assert run_drive(F, OE, cycles=4) == [F, SOD, RTSO, SO, OE]


def test_a_fault_that_does_not_reset_is_tried_again_with_a_new_edge():
    assert run_drive(F, OE, resets_fail=2)[-1] is OE


@pytest.mark.parametrize("start", S)
def test_disabling_ends_without_power_and_never_resets_a_fault(start):
    seen = run_drive(start, SOD)
    assert seen[-1] is (F if start in (F, FRA) else SOD)
    assert not set(seen[2:]) & cia402.POWERED_STATES


@pytest.mark.parametrize("start", S)
def test_quick_stop_is_never_left_upward(start):
    seen = run_drive(start, QSA)
    assert seen[-1] is {OE: QSA, QSA: QSA, F: F, FRA: F}.get(start, SOD)
    assert OE not in seen[1:]


def test_quick_stop_words():
    assert controlword_toward(OE, QSA) == 0x0002
    assert controlword_toward(QSA, QSA) == 0x0002


@pytest.mark.parametrize("goal", [S.FAULT, S.READY_TO_SWITCH_ON, S.NOT_READY_TO_SWITCH_ON])
def test_other_goals_are_refused(goal):
    with pytest.raises(ProtocolError, match=goal.name):
        controlword_toward(SOD, goal)
