"""The drive's finite state automaton, CiA 402-2: what leads from state to state beside the commands, faults.

Every command in every state: test_options.py.
"""

from __future__ import annotations

import pytest

from canprobe.fieldbus.protocol.cia402 import DriveState as S

MS = 1_000_000
CYCLE = 2_500_000

# Controlwords that lead from power on into each state (605Ah = 6, so that a quick stop stays).
PATHS = {
    S.SWITCH_ON_DISABLED: [],
    S.READY_TO_SWITCH_ON: [0x06],
    S.SWITCHED_ON: [0x06, 0x07],
    S.OPERATION_ENABLED: [0x06, 0x07, 0x0F],
    S.QUICK_STOP_ACTIVE: [0x06, 0x07, 0x0F, 0x02],
}


def bring(drive, state, option=6):
    assert drive.write(0x605A, 0, option, 2) == 0
    for word in PATHS[state]:
        assert drive.write(0x6040, 0, word, 2) == 0
    assert drive.node.application.state is state


def fault(drive, code):
    drive.node.application.inject_fault(code)
    assert drive.node.next_deadline_ns <= drive.t_ns
    frames = drive.advance(drive.t_ns)
    frames += drive.advance(drive.t_ns + CYCLE)
    return frames


@pytest.mark.parametrize("word", [0x0F, 0x1F, 0x4F, 0x10F, 0xF0F])
def test_cia402_48_controlword_bits_beside_the_command_do_not_matter(drive, word):
    bring(drive, S.SWITCHED_ON)
    drive.write(0x6040, 0, word, 2)
    assert drive.node.application.state is S.OPERATION_ENABLED


def test_cia402_49_enabling_from_ready_passes_through_switched_on(drive):
    bring(drive, S.READY_TO_SWITCH_ON)
    drive.write(0x6040, 0, 0x0F, 2)
    assert drive.node.application.state is S.SWITCHED_ON
    drive.advance(drive.node.next_deadline_ns)
    assert drive.node.application.state is S.OPERATION_ENABLED


@pytest.mark.parametrize("state", PATHS)
def test_cia402_52_a_fault_leads_to_fault_from_every_state(drive, state):
    bring(drive, state)
    assert fault(drive, 0x2310) == [(0x81, "1023030000000000")]
    assert drive.node.application.state is S.FAULT
    assert (drive.read(0x603F), drive.read(0x1001)) == (0x2310, 0x03)


def test_cia402_52_fault_reset_needs_a_rising_edge(drive):
    drive.write(0x6040, 0, 0x80, 2)
    fault(drive, 0x2310)
    drive.write(0x6040, 0, 0x80, 2)
    assert drive.node.application.state is S.FAULT
    drive.write(0x6040, 0, 0x00, 2)
    assert drive.send(0x601, "2b40600080000000") == [(0x81, "0000000000000000"), (0x581, "6040600000000000")]
    assert drive.node.application.state is S.SWITCH_ON_DISABLED
    assert (drive.read(0x603F), drive.read(0x1001)) == (0, 0)


def test_cia402_52_a_second_fault_is_reset_by_a_second_edge(drive):
    for _ in range(2):
        fault(drive, 0x2310)
        for word in (0x00, 0x00, 0x80):
            drive.write(0x6040, 0, word, 2)
        assert drive.node.application.state is S.SWITCH_ON_DISABLED


@pytest.mark.parametrize("option", [1, 2])
def test_cia402_51_transition_16_only_with_options_that_stay(drive, option):
    bring(drive, S.OPERATION_ENABLED, option)
    for word in (0x02, 0x0F):
        drive.write(0x6040, 0, word, 2)
    assert drive.node.application.state is S.QUICK_STOP_ACTIVE


def test_cia402_53_csp_bit_12_and_remote_bit_9(drive):
    bring(drive, S.OPERATION_ENABLED)
    assert drive.read(0x6041) & 0x1200 == 0x1000
    drive.nmt(0x01)
    assert drive.read(0x6041) & 0x1200 == 0x1200
    drive.write(0x6060, 0, 0, 1)
    assert drive.read(0x6041) & 0x1000 == 0


def test_cia402_statusword_change_sends_an_event_tpdo(drive):
    drive.write(0x1800, 2, 255, 1)
    assert drive.nmt(0x01)[0][0] == 0x181
    frames = drive.send(0x601, "2b40600006000000")
    assert frames[0] == (0x181, "31020000000000" + "00")


@pytest.mark.parametrize("command", [0x02, 0x81, 0x82])
def test_cia402_nmt_stop_and_resets_abort_the_connection(drive, command):
    bring(drive, S.OPERATION_ENABLED)
    drive.nmt(command)
    goal = {0x02: S.QUICK_STOP_ACTIVE, 0x81: S.SWITCH_ON_DISABLED, 0x82: S.QUICK_STOP_ACTIVE}[command]
    assert drive.node.application.state is goal


@pytest.mark.parametrize(
    ("option", "goal"),
    [(0, S.OPERATION_ENABLED), (1, S.FAULT_REACTION_ACTIVE), (2, S.SWITCH_ON_DISABLED), (3, S.QUICK_STOP_ACTIVE)],
)
def test_cia402_6007_heartbeat_loss(drive, option, goal):
    drive.write(0x6007, 0, option, 2)
    drive.write(0x1029, 1, 1, 1)
    drive.write(0x1016, 1, 127 << 16 | 250, 4)
    bring(drive, S.OPERATION_ENABLED)
    drive.node.application.parts.supervision.stop()  # the SYNC watch would be quicker
    drive.send(0x77F, "05", 0)
    assert drive.advance(250 * MS)[0] == (0x81, "3081117f00000000")
    assert drive.node.application.state is goal
