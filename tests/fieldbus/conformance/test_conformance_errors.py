"""Points 42–46: EMCY, error behaviour, store. Source: CiA 301, the objects named."""

from __future__ import annotations

import pytest
from conformance_bench import ON_BOTH_BUSES

from canprobe.fieldbus.node.stored_file import keep_in_file

OFF = 0x80000000
PRE, OP, STOPPED = 0x7F, 0x05, 0x04
TPDO = (0x185, "04030201feff")
SYNC_LENGTH, PDO_SHORT = (0x85, "4082110000000000"), (0x85, "1082110000000000")
MASTER_300 = 127 << 16 | 300
SAVE, LOAD = 0x65766173, 0x64616F6C


@ON_BOTH_BUSES
def test_cia301_emcy_42_history(tiny):
    assert (tiny.read(0x1003), tiny.refusal(0x1003, 1)) == (0, 0x08000024)
    tiny.nmt(0x01)
    tiny.send(0x80, "01")
    tiny.send(0x205, "00")
    tiny.expect(SYNC_LENGTH, PDO_SHORT)
    assert tiny.read(0x1003) == 2
    assert [tiny.read(0x1003, sub) for sub in (1, 2)] == [0x8210, 0x8240]  # the newest first
    assert tiny.refusal(0x1003, 3) == 0x08000024
    assert tiny.write(0x1003, 0, 1, 1) == 0x06090030
    tiny.set((0x1003, 0, 0, 1))
    assert (tiny.read(0x1003), tiny.refusal(0x1003, 1)) == (0, 0x08000024)


def test_cia301_emcy_43_identifier(tiny):
    for value in (0x86, 0x20000085, 0x40000085):
        assert tiny.write(0x1014, 0, value, 4) == 0x06090030
    tiny.set((0x1014, 0, OFF | 0x85, 4))
    assert tiny.write(0x1014, 0, 0x701, 4) == 0x06090030
    tiny.nmt(0x01)
    tiny.send(0x80, "01")
    tiny.set((0x1014, 0, 0x333, 4))
    tiny.send(0x205, "00")
    tiny.expect((0x333, PDO_SHORT[1]))


@pytest.mark.parametrize(
    ("behaviour", "before", "after", "guarded"),
    [
        (0, OP, PRE, False),
        (0, STOPPED, STOPPED, False),
        (1, OP, OP, False),
        (2, OP, STOPPED, True),
        (2, PRE, STOPPED, False),
    ],
)
def test_cia301_error_behaviour_45(tiny, behaviour, before, after, guarded):
    tiny.set((0x1029, 1, behaviour, 1))
    tiny.set(*([(0x100C, 0, 150, 2), (0x100D, 0, 2, 1)] if guarded else [(0x1016, 1, MASTER_300, 4)]))
    tiny.nmt({OP: 0x01, PRE: 0x80, STOPPED: 0x02}[before])
    assert tiny.state() == before  # which starts life guarding
    if not guarded:
        tiny.send(0x77F, "05")
    if before != STOPPED:
        tiny.expect((0x85, "308111" + ("00" if guarded else "7f") + "00000000"), within_ms=300)
    else:
        tiny.silence(400)
    assert tiny.state() == after


def test_cia301_store_46_needs_its_signature(tiny):
    for order in ((0x1010, 1, 1, 4), (0x1010, 1, LOAD, 4), (0x1011, 1, SAVE, 4), (0x1011, 1, 0, 4)):
        assert tiny.write(*order) == 0x08000020
    assert (tiny.read(0x1010, 1), tiny.read(0x1011, 1)) == (1, 1)


@pytest.fixture
def power_on(connect, make_bench, tmp_path):
    """Start the tiny node with its file, as often as it is called."""

    def power_on():
        node = make_bench().node
        keep_in_file(node, tmp_path / "node5.json")
        return connect(node).boot()

    return power_on


@pytest.mark.parametrize(("group", "cob_id", "value"), [(1, 0x444, 77), (2, 0x444, 50), (3, 0x185, 77)])
def test_cia301_store_46_values_survive_a_restart(power_on, group, cob_id, value):
    first = power_on()
    first.set((0x1800, 1, OFF | 0x185, 4), (0x1800, 1, 0x444, 4), (0x2000, 0, 77, 1), (0x1010, group, SAVE, 4))
    first.set((0x2000, 0, 33, 1))
    first.nmt(0x81)
    first.expect((0x705, "00"))
    assert (first.read(0x1800, 1), first.read(0x2000)) == (cob_id, value)
    first.end()

    second = power_on()
    assert (second.read(0x1800, 1), second.read(0x2000)) == (cob_id, value)
    second.nmt(0x01)
    second.send(0x80)
    second.expect((cob_id, TPDO[1]))
    second.set((0x1011, 1, LOAD, 4))
    assert second.read(0x2000) == value  # from the next start on
    second.end()

    third = power_on()
    assert (third.read(0x1800, 1), third.read(0x2000)) == (0x185, 50)
