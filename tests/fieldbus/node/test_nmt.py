"""NMT slave, CiA 301 "Network management": boot-up, every state and command, what is served where."""

from __future__ import annotations

import pytest

from canprobe.fieldbus.node import Quirks
from canprobe.fieldbus.protocol.frames import NmtState

PRE, OP, STOPPED = NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED
TO = {PRE: [0x80], OP: [0x01], STOPPED: [0x02]}
READ_1000 = "4000100000000000"


@pytest.mark.parametrize("state", [PRE, OP, STOPPED])
@pytest.mark.parametrize(("command", "goal"), [(0x01, OP), (0x02, STOPPED), (0x80, PRE)])
@pytest.mark.parametrize("address", [0, 5])
def test_cia301_nmt_every_command_from_every_state(bench, state, command, goal, address):
    bench.nmt(TO[state][0])
    assert bench.send(0, bytes((command, address)).hex()) == []
    assert bench.node.state is goal


@pytest.mark.parametrize("frame", ["", "01", "010500", "0106", "0305", "0005", "ff00", "8305"])
def test_cia301_nmt_03_wrong_length_id_or_command_is_ignored(bench, frame):
    assert bench.send(0, frame) == []
    assert bench.node.state is PRE


def test_cia301_nmt_04_nothing_is_served_in_initialisation(make_bench):
    bench = make_bench(quirks=Quirks(boot_ns=1_000))
    assert bench.send(0x605, READ_1000) == []
    assert bench.node.start(0) == []
    for can_id, text in ((0x605, READ_1000), (0, "0105"), (0x80, "")):
        assert bench.send(can_id, text, 500) == []
    assert bench.node.next_deadline_ns == 1_000
    assert bench.advance(1_000) == [(0x705, "00")]
    assert bench.send(0x605, READ_1000) == [(0x585, "4300100078563412")]


def test_foreign_frames_are_not_answered(bench):
    for can_id in (0x606, 0x185, 0x701, 0x586, 0x7FF):
        assert bench.send(can_id, "0000000000000000") == []
