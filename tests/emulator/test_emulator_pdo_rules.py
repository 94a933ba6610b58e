"""What a PDO parameter may become and when: CiA 301, objects 1400h–1BFFh, points 25–29."""

from __future__ import annotations

import pytest

OFF = 0x80000000

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


@pytest.mark.parametrize(
    "cob_id", [0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x601, 0x67F, 0x6E0, 0x6FF, 0x701, 0x77F, 0x780, 0x7FF]
)
@pytest.mark.parametrize("index", [0x1400, 0x1800])
def test_cia301_pdo_28_restricted_identifiers(bench, index, cob_id):
    bench.write(index, 1, OFF | 0x222, 4)
    assert bench.write(index, 1, cob_id, 4) == 0x06090030
    assert bench.write(index, 1, OFF | cob_id, 4) == 0


@pytest.mark.parametrize("value", range(256))
def test_cia301_pdo_29_reserved_transmission_types(bench, value):
    assert bench.write(0x1400, 2, value, 1) == (0x06090030 if 0xF1 <= value <= 0xFD else 0)
    assert bench.write(0x1800, 2, value, 1) == (0x06090030 if 0xF1 <= value <= 0xFB else 0)
