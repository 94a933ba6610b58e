"""Points 2, 5 and 7: NMT, by raw frames. Source: CiA 301, "Network management"."""

from __future__ import annotations

import pytest
from conformance_bench import ON_BOTH_BUSES

PRE, OP, STOPPED = 0x7F, 0x05, 0x04
TO = {PRE: 0x80, OP: 0x01, STOPPED: 0x02}


@pytest.mark.parametrize("command", [0x81, 0x82])
@pytest.mark.parametrize("before", [PRE, OP, STOPPED])
def test_cia301_nmt_02_resets_boot_again_from_every_state(tiny, before, command):
    tiny.set((0x2000, 0, 77, 1), (0x1015, 0, 500, 2))
    tiny.nmt(TO[before])
    assert tiny.state() == before
    tiny.nmt(command)
    tiny.expect((0x705, "00"))
    assert tiny.state() == PRE
    assert (tiny.read(0x2000), tiny.read(0x1015)) == ({0x81: 50, 0x82: 77}[command], 0)


@ON_BOTH_BUSES
def test_cia301_nmt_05_an_open_transfer_does_not_survive(tiny):
    tiny.ask("2104200014000000")
    tiny.nmt(0x02)
    tiny.nmt(0x80)
    assert tiny.ask("0030313233343536")[-8:] == "01000405"


def test_cia301_nmt_07_state_change_is_heard_at_once_and_before_anything_else(tiny):
    tiny.set((0x1800, 2, 255, 1))
    tiny.send(0x605, "2b171000ffff0000")
    tiny.expect((0x705, "7f"), (0x585, "6017100000000000"))
    for command, state in ((0x01, "05"), (0x02, "04"), (0x80, "7f"), (0x01, "05"), (0x80, "7f"), (0x02, "04")):
        tiny.nmt(command)
        tiny.expect((0x705, state), *[(0x185, "04030201feff")] * (state == "05"))
