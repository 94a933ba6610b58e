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


def expected(state: SdoState, command: int) -> tuple[SdoState, int]:
    """State after the command (its other bytes being REST) and abort code: the standard in other words than the code's.

    Source: CiA 301, SDO protocols; the client command specifier is in the three highest bits.
    """
    specifier = command >> 5
    if command == 0x80:
        return S.IDLE, 0
    if state is S.BLOCK_DOWNLOAD:
        if command & 0x7F == 0:
            return S.IDLE, SEQUENCE
        right = command & 0x7F == 1
        return (S.BLOCK_DOWNLOAD_END if right and command & 0x80 else S.BLOCK_DOWNLOAD), 0
    if specifier == 1:
        return (S.IDLE if command & 2 else S.DOWNLOAD), 0
    if specifier == 2:
        return S.UPLOAD, 0
    if specifier == 5 and command & 3 == 0:
        return S.BLOCK_UPLOAD_START, 0
    if specifier == 6 and command & 1 == 0:
        return S.BLOCK_DOWNLOAD, 0
    if specifier == 0 and state is S.DOWNLOAD:
        if command & 0x10:
            return S.IDLE, TOGGLE
        return (S.IDLE, TOO_SHORT) if command & 1 else (S.DOWNLOAD, 0)
    if specifier == 3 and state is S.UPLOAD:
        return (S.IDLE, TOGGLE) if command & 0x10 else (S.UPLOAD, 0)
    if specifier == 5 and command & 3 == 3 and state is S.BLOCK_UPLOAD_START:
        return S.BLOCK_UPLOAD, 0
    if specifier == 5 and command & 3 == 2 and state is S.BLOCK_UPLOAD:
        return S.IDLE, SEQUENCE  # acknowledges segment 4 (of OBJECT), and two were sent
    if specifier == 5 and command & 3 == 1 and state is S.BLOCK_UPLOAD_END:
        return S.IDLE, 0
    if specifier == 6 and command & 1 and state is S.BLOCK_DOWNLOAD_END:
        unused = command >> 2 & 7
        return S.IDLE, 0 if unused == 0 else TOO_SHORT
    return S.IDLE, COMMAND


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
