"""PDOs at work, CiA 301 "Process data object": triggers, types, lengths, timers, dummies."""

import pytest

from canprobe.errors import ProtocolError
from canprobe.fieldbus.node.dictionary import key_of

MS = 1_000_000
OFF = 0x80000000


def sync(bench, *counters: int | None) -> list[str]:
    """SYNCs, one a millisecond; what each caused."""
    results = []
    for counter in counters:
        frames = bench.send(0x80, "" if counter is None else f"{counter:02x}", bench.t_ns + MS)
        results.append(" ".join(f"{can_id:03x}" for can_id, _ in frames))
    return results


@pytest.mark.parametrize("every", [1, 2, 3, 240])
def test_cia301_pdo_30_every_nth_sync(bench, every):
    bench.write(0x1800, 2, every, 1)
    bench.nmt(0x01)
    assert [bool(x) for x in sync(bench, *[None] * (2 * every))] == ([False] * (every - 1) + [True]) * 2


def test_cia301_pdo_31_inhibit_time_holds_back_and_sends_the_latest(bench):
    bench.configure(0x1800, cob_id=0x185, words=[0x20010020], type=255, inhibit=50)  # 5 ms
    assert bench.nmt(0x01, 0) == [(0x185, "04030201")]
    for value in (1, 2):
        bench.t_ns = 1 * MS
        bench.write(0x2001, 0, value, 4)
    assert bench.node.next_deadline_ns == 5 * MS
    assert bench.advance(5 * MS) == [(0x185, "02000000")]
    assert bench.node.next_deadline_ns is None


def test_cia301_pdo_31_event_timer_repeats_and_skips_what_was_missed(bench):
    bench.configure(0x1800, cob_id=0x185, words=[0x20010020], type=254, event=10)
    assert len(bench.nmt(0x01, 0)) == 1
    assert bench.node.next_deadline_ns == 10 * MS
    assert bench.advance(10 * MS) == [(0x185, "04030201")]
    assert bench.advance(1000 * MS) == [(0x185, "04030201")]
    bench.nmt(0x02)
    assert bench.node.next_deadline_ns is None


def test_cia301_pdo_value_outside_the_limits_is_dropped_and_the_others_kept(bench):
    bench.write(0x1400, 2, 255, 1)
    bench.nmt(0x01)
    bench.send(0x205, "112233446500")  # 2002h: 101, limit 100
    assert (bench.read(0x2001), bench.read(0x2002)) == (0x44332211, 0xFFFE)


def test_cia301_pdo_34_long_rpdo_is_reported_and_applied(bench):
    bench.write(0x1400, 2, 255, 1)
    bench.nmt(0x01)
    assert bench.send(0x205, "112233440500ff") == [(0x85, "2082110000000000")]
    assert (bench.read(0x2001), bench.read(0x2002)) == (0x44332211, 5)


def test_cia301_pdo_35_rpdo_event_timer_runs_from_the_first_reception(bench):
    bench.write(0x1400, 5, 20, 2)
    bench.nmt(0x01, 0)
    assert bench.node.next_deadline_ns is None
    bench.send(0x205, "112233440500", 5 * MS)
    bench.send(0x205, "112233440500", 15 * MS)
    assert bench.advance(34 * MS) == []
    assert bench.advance(35 * MS) == [(0x85, "5082110000000000")]
    assert bench.send(0x205, "112233440500", 40 * MS) == [(0x85, "0000000000000000")]


def test_cia301_pdo_36_synchronous_rpdo_after_the_window_is_dropped(bench):
    bench.write(0x1007, 0, 1000, 4)
    bench.nmt(0x01, 0)
    for arrival, expected in ((1_000_000, "112233440500"), (1_000_001, "04030201feff")):
        bench.nmt(0x81)
        bench.write(0x1007, 0, 1000, 4)
        bench.nmt(0x01)
        bench.send(0x80, "", 10 * MS)
        bench.send(0x205, "112233440500", 10 * MS + arrival)
        assert bench.send(0x80, "", 12 * MS) == [(0x185, expected)]


def test_cia301_pdo_remapped_in_operational(bench):
    bench.nmt(0x01)
    bench.configure(0x1800, cob_id=0x444, words=[0x20020010, 0x20010020])
    assert bench.send(0x80, "") == [(0x444, "feff04030201")]
    bench.write(0x1800, 1, OFF | 0x444, 4)
    assert bench.send(0x80, "") == []


def test_cia301_pdo_rpdo_identifier_changes_are_heard(bench):
    bench.write(0x1400, 1, OFF | 0x205, 4)
    bench.write(0x1400, 1, 0x333, 4)
    bench.write(0x1400, 2, 255, 1)
    bench.nmt(0x01)
    bench.send(0x205, "112233440500")
    assert bench.read(0x2001) == 0x01020304
    bench.send(0x333, "112233440500")
    assert bench.read(0x2001) == 0x44332211


def test_cia301_pdo_35_one_pdo_that_is_back_does_not_hide_another_that_is_lost(bench):
    bench.configure(0x1400, cob_id=0x205, words=[0x20010020], type=255, event=20)
    bench.configure(0x1401, cob_id=0x305, words=[0x20070008], type=255, event=30)
    bench.nmt(0x01, 0)
    bench.send(0x205, "11223344", 0)
    bench.send(0x305, "55", 0)
    assert bench.advance(20 * MS) == [(0x85, "5082110000000000")]
    assert bench.advance(30 * MS) == []  # the same error, of the other one
    assert bench.send(0x305, "55", 35 * MS) == []
    assert bench.send(0x205, "11223344", 36 * MS) == [(0x85, "0000000000000000")]


def test_cia301_pdo_33_the_error_of_a_pdo_ends_when_it_is_switched_off(bench):
    bench.nmt(0x01)
    assert bench.send(0x205, "1122334405") == [(0x85, "1082110000000000")]
    head = bytes((0x23, 0x00, 0x14, 1)).hex()
    assert bench.send(0x605, head + "05020080") == [(0x85, "0000000000000000"), (0x585, "6000140100000000")]
    assert bench.read(0x1001) == 0


@pytest.mark.parametrize(
    ("type_", "at_once", "at_sync"), [(255, ["185 aabbccdd0500"], []), (0, [], ["185 aabbccdd0500"])]
)
@pytest.mark.parametrize("words", [[0x20010020], [0x20010020, 0x20020010], [0x20020010, 0x20010020]])
def test_cia301_pdo_30_values_of_an_rpdo_are_one_event(bench, type_, at_once, at_sync, words):
    bench.write(0x2002, 0, 5, 2)
    bench.configure(0x1800, cob_id=0x185, words=[0x20010020, 0x20020010], type=type_)
    bench.configure(0x1400, cob_id=0x205, words=words, type=255)
    bench.nmt(0x01, 0)
    bench.send(0x80, "")
    parts = {0x20010020: "aabbccdd", 0x20020010: "0500"}
    frames = [bench.send(0x205, "".join(parts[word] for word in words)), bench.send(0x80, ""), bench.send(0x80, "")]
    assert [[f"{can_id:x} {data}" for can_id, data in some] for some in frames] == [at_once, at_sync, []]


def test_pdos_before_one_that_cannot_be_packed_are_sent_once(bench):
    bench.configure(0x1801, cob_id=0x285, words=[0x20020010], type=1)
    bench.nmt(0x01)
    bench.node.dictionary.values[key_of(0x2002)] = 1 << 16
    bench.write(0x1800, 1, OFF | 0x185, 4)
    bench.configure(0x1800, cob_id=0x185, words=[0x20010020], type=1)
    with pytest.raises(ProtocolError, match="PDO 0x285: cannot pack"):
        bench.send(0x80, "")
    assert [can_id for can_id, _ in bench.node.core.out] == [0x185]


# What a PDO parameter may become and when: CiA 301, objects 1400h–1BFFh, points 25–29.

# what, preparation [(index, sub, value, size)], write (index, sub, value, size), abort code (0: accepted)
OPEN_TPDO = [(0x1800, 1, OFF | 0x185, 4), (0x1A00, 0, 0, 1)]
OPEN_RPDO = [(0x1400, 1, OFF | 0x205, 4), (0x1600, 0, 0, 1)]
RULES = [
    ("25 mapping count while valid", [], (0x1A00, 0, 0, 1), 0x06010000),
    ("25 mapping entry while valid", [], (0x1A00, 1, 0x20070008, 4), 0x06010000),
    ("25 mapping entry while count is not 0", OPEN_TPDO[:1], (0x1A00, 1, 0x20070008, 4), 0x06010000),
    ("25 the same value passes", [], (0x1A00, 1, 0x20010020, 4), 0),
    ("25 mapping entry when open", OPEN_TPDO, (0x1A00, 1, 0x20070008, 4), 0),
    ("25 rpdo mapping while valid", [], (0x1600, 0, 0, 1), 0x06010000),
    ("25 rpdo entry while count is not 0", OPEN_RPDO[:1], (0x1600, 1, 0x20070008, 4), 0x06010000),
    ("26 more than 64 bits", [*OPEN_TPDO, (0x1A00, 3, 0x20010020, 4)], (0x1A00, 0, 3, 1), 0x06040042),
    ("26 exactly 64 bits", [*OPEN_TPDO, (0x1A00, 2, 0x20010020, 4)], (0x1A00, 0, 2, 1), 0),
    ("26 more entries than subindices", OPEN_TPDO, (0x1A00, 0, 5, 1), 0x06040042),
    ("27 absent object", OPEN_TPDO, (0x1A00, 1, 0x30000020, 4), 0x06040041),
    ("27 not mappable object", OPEN_TPDO, (0x1A00, 1, 0x20000008, 4), 0x06040041),
    ("27 wrong length", OPEN_TPDO, (0x1A00, 1, 0x20010010, 4), 0x06040041),
    ("27 ro object into an rpdo", OPEN_RPDO, (0x1600, 1, 0x20050040, 4), 0x06040041),
    ("27 rwr object into an rpdo", OPEN_RPDO, (0x1600, 1, 0x20080020, 4), 0x06040041),
    ("27 rww object into a tpdo", OPEN_TPDO, (0x1A00, 1, 0x20090020, 4), 0x06040041),
    ("27 rww object into an rpdo", OPEN_RPDO, (0x1600, 1, 0x20090020, 4), 0),
    ("27 count over an empty entry", [*OPEN_TPDO, (0x1A00, 1, 0, 4)], (0x1A00, 0, 1, 1), 0x06040041),
    ("28 changed identifier while valid", [], (0x1800, 1, 0x186, 4), 0x06090030),
    ("28 same identifier while valid", [], (0x1800, 1, 0x185, 4), 0),
    ("28 changed identifier through invalid", [(0x1800, 1, OFF | 0x185, 4)], (0x1800, 1, 0x511, 4), 0),
    ("28 29-bit identifier", [(0x1800, 1, OFF | 0x185, 4)], (0x1800, 1, 0x20000185, 4), 0x06090030),
    ("28 inhibit time while valid", [], (0x1800, 3, 10, 2), 0x06090030),
    ("28 inhibit time while not valid", [(0x1800, 1, OFF | 0x185, 4)], (0x1800, 3, 10, 2), 0),
    ("28 start value while valid", [], (0x1800, 6, 2, 1), 0x06090030),
    ("28 start value while not valid", [(0x1800, 1, OFF | 0x185, 4)], (0x1800, 6, 240, 1), 0),
    ("28 start value above 240", [(0x1800, 1, OFF | 0x185, 4)], (0x1800, 6, 241, 1), 0x06090030),
    ("38 dummy allowed by DummyUsage", OPEN_RPDO, (0x1600, 1, 0x00040020, 4), 0),
    ("38 dummy not allowed by DummyUsage", OPEN_RPDO, (0x1600, 1, 0x00070020, 4), 0x06040041),
    ("38 dummy in a tpdo", OPEN_TPDO, (0x1A00, 1, 0x00040020, 4), 0x06040041),
]


@pytest.mark.parametrize(("what", "before", "write", "code"), RULES, ids=[row[0] for row in RULES])
def test_cia301_pdo_rules(bench, what, before, write, code):
    for order in before:
        assert bench.write(*order) == 0, order
    old = bench.read(write[0], write[1])
    assert bench.write(*write) == code
    assert bench.read(write[0], write[1]) == (old if code else write[2])


@pytest.mark.parametrize(("index", "reserved"), [(0x1400, range(0xF1, 0xFE)), (0x1800, range(0xF1, 0xFC))])
def test_cia301_pdo_29_reserved_transmission_types(bench, index, reserved):
    answers = [bench.write(index, 2, value, 1) for value in range(256)]
    assert answers == [0x06090030 if value in reserved else 0 for value in range(256)]
