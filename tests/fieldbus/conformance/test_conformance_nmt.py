"""Points 1–9: NMT, boot-up, heartbeat and guarding, by raw frames. Source: CiA 301, "Network management"."""

from __future__ import annotations

import pytest

from canprobe.fieldbus.node.quirks import Quirks

PRE, OP, STOPPED = 0x7F, 0x05, 0x04
TO = {PRE: 0x80, OP: 0x01, STOPPED: 0x02}
READ = "4000100000000000"
DEVICE_TYPE = (0x585, "4300100078563412")


def test_cia301_nmt_01_boot_up_then_pre_operational(connect, make_bench):
    bench = connect(make_bench().node)
    bench.silence()
    bench.power_on()
    bench.expect((0x705, "00"))
    assert bench.state() == PRE
    assert bench.ask(READ) == DEVICE_TYPE[1]


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


def test_cia301_nmt_03_wrong_length_id_or_command_is_ignored(tiny):
    for before in (PRE, OP, STOPPED):
        tiny.nmt(TO[before])
        for text in ("", "01", "02", "010500", "0206", "8006", "8106", "0305", "0005", "ff00", "8305"):
            tiny.send(0, text)
        assert tiny.state() == before


def test_cia301_nmt_03_commands_to_all(tiny):
    for goal in (OP, STOPPED, PRE, STOPPED, OP, PRE):
        tiny.send(0, f"{TO[goal]:02x}00")
        assert tiny.state() == goal


def test_cia301_nmt_04_nothing_is_served_in_initialisation(connect, make_bench):
    bench = connect(make_bench(quirks=Quirks(boot_ns=400_000_000)).node)
    bench.power_on()
    for can_id, text in ((0x605, READ), (0, "0105"), (0x80, ""), (0x40000705, "")):
        bench.send(can_id, text)
    bench.silence(100)
    bench.expect((0x705, "00"), within_ms=300)
    assert bench.state() == PRE


def test_cia301_nmt_05_sdo_is_silent_when_stopped(tiny):
    tiny.nmt(0x02)
    tiny.send(0x605, READ)
    assert tiny.state() == STOPPED
    tiny.nmt(0x80)
    assert tiny.ask(READ) == DEVICE_TYPE[1]


def test_cia301_nmt_05_an_open_transfer_does_not_survive(tiny):
    tiny.ask("2104200014000000")
    tiny.nmt(0x02)
    tiny.nmt(0x80)
    assert tiny.ask("0030313233343536")[-8:] == "01000405"


def test_cia301_nmt_06_pdos_only_in_operational(tiny):
    for state in (PRE, STOPPED):
        tiny.nmt(TO[state])
        tiny.send(0x205, "aabbccdd0100")
        tiny.send(0x80)
        tiny.send(0x40000185)
        assert tiny.state() == state
    tiny.nmt(0x01)
    tiny.send(0x80)
    tiny.expect((0x185, "04030201feff"))


def test_cia301_nmt_07_state_change_is_heard_at_once(tiny):
    tiny.send(0x605, "2b171000ffff0000")
    tiny.expect((0x705, "7f"), (0x585, "6017100000000000"))
    for command, state in ((0x01, "05"), (0x02, "04"), (0x80, "7f"), (0x01, "05"), (0x80, "7f"), (0x02, "04")):
        tiny.nmt(command)
        tiny.expect((0x705, state))


def test_cia301_nmt_07_the_state_is_told_before_anything_else(tiny):
    tiny.set((0x1800, 2, 255, 1))
    tiny.send(0x605, "2b171000ffff0000")
    tiny.expect((0x705, "7f"), (0x585, "6017100000000000"))
    tiny.nmt(0x01)
    tiny.expect((0x705, "05"), (0x185, "04030201feff"))


def test_cia301_heartbeat_08_a_write_acts_at_once(tiny):
    first = tiny.send(0x605, "2b17100032000000")
    tiny.expect((0x705, "7f"), (0x585, "6017100000000000"))
    for beat in (1, 2, 3):
        tiny.assert_after(first, tiny.expect((0x705, "7f"), within_ms=50), beat * 50)
    tiny.send(0x605, "2b17100000000000")
    while tiny.next().can_id == 0x705:
        pass
    tiny.silence(120)


def test_cia301_guarding_09_toggle_bit_and_state(tiny):
    answers = []
    for command in (0x80, 0x01, 0x02, 0x80):
        tiny.nmt(command)
        tiny.send(0x40000705)
        answers.append(tiny.next()[:2])
    assert answers == [(0x705, "7f"), (0x705, "85"), (0x705, "04"), (0x705, "ff")]
    tiny.nmt(0x82)
    tiny.expect((0x705, "00"))
    tiny.send(0x40000705)
    tiny.expect((0x705, "7f"))  # the toggle bit starts anew


def test_cia301_guarding_09_is_not_served_with_a_heartbeat(tiny):
    tiny.send(0x605, "2b171000ffff0000")
    tiny.expect((0x705, "7f"), (0x585, "6017100000000000"))
    tiny.send(0x40000705)
    tiny.read(0x1000)


def test_cia301_guarding_09_life_guard_loss_and_return(tiny):
    tiny.set((0x100C, 0, 100, 2), (0x100D, 0, 3, 1))
    tiny.nmt(0x01)
    tiny.silence(350)  # it runs from the first request on
    tiny.send(0x40000705)
    tiny.expect((0x705, "05"))
    asked = tiny.send(0x40000705)
    tiny.expect((0x705, "85"))
    tiny.assert_after(asked, tiny.expect((0x85, "3081110000000000"), within_ms=300), 300)
    tiny.send(0x40000705)
    tiny.expect((0x705, "7f"), (0x85, "0000000000000000"))  # 1029h:01 = 0 led to pre-operational
    tiny.set((0x100D, 0, 0, 1))
    tiny.silence(350)
