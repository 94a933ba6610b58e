"""The SDO server's state machine: every command byte in every state, against a table written out from the standard."""

from __future__ import annotations

import pytest

from canprobe.emulator.sdo_server import SdoServer
from canprobe.emulator.sdo_states import SDO_TRANSITIONS, SdoRequest, SdoState

S = SdoState
OBJECT = "042000"  # 2004h, a domain that holds 16 bytes
PATHS = {
    S.IDLE: [],
    S.DOWNLOAD: ["21" + OBJECT + "14000000"],
    S.UPLOAD: ["40" + OBJECT + "00000000"],
    S.BLOCK_DOWNLOAD: ["c2" + OBJECT + "15000000"],
    S.BLOCK_DOWNLOAD_END: ["c2" + OBJECT + "07000000", "8130313233343536"],
    S.BLOCK_UPLOAD_START: ["a0" + OBJECT + "02000000"],
    S.BLOCK_UPLOAD: ["a0" + OBJECT + "02000000", "a300000000000000"],
    S.BLOCK_UPLOAD_END: ["a0" + OBJECT + "7f000000", "a300000000000000", "a2037f0000000000"],
}
CONTENT = b"sixteen bytes!!!"
COMMAND, TOGGLE, SEQUENCE, TOO_SHORT = 0x05040001, 0x05030000, 0x05040003, 0x06070013
REST = OBJECT + "7f000000"  # of an initiate: 127 segments a block, or 127 bytes announced


def initiates(command: int) -> SdoState | None:
    """Where an initiate request leads; the client command specifier is in the three highest bits."""
    expedited = command & 2
    goals = {1: S.IDLE if expedited else S.DOWNLOAD, 2: S.UPLOAD}
    if command & 3 == 0:
        goals[5] = S.BLOCK_UPLOAD_START
    if command & 1 == 0:
        goals[6] = S.BLOCK_DOWNLOAD
    return goals.get(command >> 5)


def numbered(command: int) -> tuple[SdoState, int]:
    """A segment of a block download: only number 1 is the next, with bit 7 it is the last."""
    if command & 0x7F == 0:
        return S.IDLE, SEQUENCE
    return (S.BLOCK_DOWNLOAD_END if command == 0x81 else S.BLOCK_DOWNLOAD), 0


def right_step(state: SdoState, command: int) -> tuple[SdoState, int] | None:
    """What the one kind of frame does that goes on with the transfer; None for every other frame."""
    toggled, last = bool(command & 0x10), bool(command & 1)
    ends = (S.IDLE, TOO_SHORT) if last else (S.DOWNLOAD, 0)
    # state: (mask and pattern of the command byte, what follows)
    steps = {
        S.DOWNLOAD: (0xE0, 0x00, (S.IDLE, TOGGLE) if toggled else ends),
        S.UPLOAD: (0xE0, 0x60, (S.IDLE, TOGGLE) if toggled else (S.UPLOAD, 0)),
        S.BLOCK_UPLOAD_START: (0xE3, 0xA3, (S.BLOCK_UPLOAD, 0)),
        S.BLOCK_UPLOAD: (0xE3, 0xA2, (S.IDLE, SEQUENCE)),  # acknowledges segment 4 (of OBJECT), and two were sent
        S.BLOCK_UPLOAD_END: (0xE3, 0xA1, (S.IDLE, 0)),
        S.BLOCK_DOWNLOAD_END: (0xE1, 0xC1, (S.IDLE, TOO_SHORT if command & 0x1C else 0)),
    }
    mask, pattern, follows = steps.get(state, (0, 1, None))
    return follows if command & mask == pattern else None


def expected(state: SdoState, command: int) -> tuple[SdoState, int]:
    """State after the command (its other bytes being REST) and abort code: the standard in other words than the code's.

    Source: CiA 301, SDO protocols.
    """
    if command == 0x80:
        return S.IDLE, 0
    if state is S.BLOCK_DOWNLOAD:
        return numbered(command)
    if (goal := initiates(command)) is not None:
        return goal, 0
    return right_step(state, command) or (S.IDLE, COMMAND)


def bring(bench, state):
    bench.node.dictionary.values[0x200400] = CONTENT
    for text in PATHS[state]:
        bench.send(0x605, text)
    server = next(service for service in bench.node._services if isinstance(service, SdoServer))
    assert server.state is state
    return server


@pytest.mark.parametrize("state", S)
def test_cia301_sdo_every_command_byte_in_every_state(bench, state):
    for command in range(256):
        server = bring(bench, state)
        answers = bench.send(0x605, f"{command:02x}" + REST)
        after, code = expected(state, command)
        assert server.state is after, f"{command:02x}"
        aborts = [answer for _, answer in answers if answer.startswith("80")]
        assert [int.from_bytes(bytes.fromhex(text)[4:], "little") for text in aborts] == [code] * bool(code)
        bench.send(0x605, "80" + OBJECT + "00000000")


@pytest.mark.parametrize("state", [state for state in S if state is not S.IDLE])
def test_cia301_sdo_time_out_and_stopped_lead_to_idle_from_every_state(bench, state):
    server = bring(bench, state)
    assert bench.advance(bench.node.next_deadline_ns) == [(0x585, "80" + OBJECT + "00000405")]
    assert server.state is S.IDLE
    bring(bench, state)
    bench.nmt(0x02)
    assert server.state is S.IDLE
    bench.nmt(0x80)
    assert server.state is S.IDLE


def test_every_state_can_be_left_and_reached():
    assert {state for goals in SDO_TRANSITIONS.values() for state in goals} == set(S)
    for state in S:
        assert SDO_TRANSITIONS[state, SdoRequest.ABORT] == (S.IDLE,)
        assert any(state in goals for (before, _), goals in SDO_TRANSITIONS.items() if before is not state)
