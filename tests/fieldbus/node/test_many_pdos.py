"""As many PDOs as CiA 301 knows: 512 of each direction, and PDOs that change while others are at work."""

import io

import pytest
from canopen.objectdictionary.eds import import_eds

from canprobe.fieldbus import SlaveNode
from canprobe.fieldbus.eds.packaged import LONG_PDOS, load_eds
from canprobe.fieldbus.node import Abort, SdoAbort
from canprobe.fieldbus.node.dictionary import Dictionary, key_of
from canprobe.fieldbus.node.pdo_rules import PdoRules

MS = 1_000_000
COUNT = 512


def section(name, data_type, access, default, pdo=0):
    lines = (f"[{name}]", f"ParameterName={name}", "ObjectType=0x7", f"DataType=0x{data_type:04X}")
    return "\n".join((*lines, f"AccessType={access}", f"DefaultValue={default}", f"PDOMapping={pdo}")) + "\n"


def record(index, subs):
    head = f"[{index:04X}]\nParameterName={index:04X}\nObjectType=0x9\nSubNumber={len(subs)}\n"
    return head + "".join(section(f"{index:04X}sub{sub:X}", kind, "rw", value) for sub, (kind, value) in subs.items())


@pytest.fixture(scope="module")
def od():
    """Objects 2000h:01.. and 3000h:01.. of 16 bits; PDO n maps the n-th. RPDOs 185h + n, TPDOs 385h + n."""
    parts = ["[DeviceInfo]\nVendorName=test\n", section("1000", 7, "ro", 0)]
    for base in (0x2000, 0x3000):
        for block in range(4):
            subs = {0: (5, 128)} | {sub: (6, 0) for sub in range(1, 129)}
            parts.append(record(base + block, subs).replace("PDOMapping=0", "PDOMapping=1"))
    for number in range(COUNT):
        target = (number // 128) << 16 | (number % 128 + 1) << 8 | 16
        for index, cob_id, base in ((0x1400, 0x185, 0x2000), (0x1800, 0x385, 0x3000)):
            parts.append(record(index + number, {0: (5, 2), 1: (7, cob_id + number), 2: (5, 1)}))
            parts.append(record(index + 0x200 + number, {0: (5, 1), 1: (7, (base << 16) + target)}))
    return import_eds(io.StringIO("\n".join(parts)), 5)


def test_512_rpdos_and_tpdos_at_one_sync(od):
    node = SlaveNode(od, 5)
    node.start(0)
    node.receive(0, b"\x01\x05", 0)
    for number in range(COUNT):
        assert node.receive(0x185 + number, (1000 + number).to_bytes(2, "little"), MS) == []
        key = (0x3000 + number // 128) << 8 | number % 128 + 1
        node.dictionary.values[key] = 2000 + number
    frames = node.receive(0x80, b"", 2 * MS)
    assert frames == [(0x385 + number, (2000 + number).to_bytes(2, "little")) for number in range(COUNT)]
    got = [node.dictionary.number(0x2000 + n // 128, n % 128 + 1) for n in range(COUNT)]
    assert got == list(range(1000, 1000 + COUNT))


def sync(bench, counter):
    return [can_id for can_id, _ in bench.send(0x80, f"{counter:02x}", bench.t_ns + MS)]


def test_a_pdo_that_is_written_to_leaves_the_phase_of_the_others(bench):
    bench.configure(0x1800, cob_id=0x511, words=[0x20010020], type=4, start=3)
    bench.write(0x1019, 0, 240, 1)
    bench.nmt(0x01)
    assert [sync(bench, k) for k in (1, 2, 3, 4, 5, 6)] == [[], [], [0x511], [], [], []]
    bench.configure(0x1801, cob_id=0x285, words=[0x20050040], type=1)
    assert [sync(bench, k) for k in (7, 8, 9, 10, 11)] == [[0x511, 0x285], [0x285], [0x285], [0x285], [0x511, 0x285]]


def test_event_timer_of_a_pdo_that_is_switched_on_in_operational(bench):
    bench.nmt(0x01)
    bench.configure(0x1801, cob_id=0x285, words=[0x20050040], type=255, event=10)
    assert bench.advance(10 * MS) == [(0x285, "8877665544332211")]
    assert bench.advance(20 * MS) == [(0x285, "8877665544332211")]


def test_request_is_answered_in_operational_only_and_by_all_that_share_the_identifier(bench):
    bench.configure(0x1801, cob_id=0x185, words=[0x20050040], type=253)
    assert bench.send(0x40000185, "") == []
    bench.nmt(0x01)
    assert bench.send(0x40000185, "") == [(0x185, "04030201feff"), (0x185, "8877665544332211")]
    assert bench.send(0x40000605, "") == bench.send(0x40000080, "") == bench.send(0x40000205, "") == []


def test_requests_keep_the_inhibit_time_of_event_driven_pdos(bench):
    bench.configure(0x1800, cob_id=0x185, words=[0x20010020], type=255, inhibit=50)  # 5 ms
    bench.nmt(0x01, 0)
    assert bench.send(0x40000185, "", 1 * MS) == []
    assert bench.advance(5 * MS) == [(0x185, "04030201")]
    assert bench.send(0x40000185, "", 10 * MS) == [(0x185, "04030201")]


def test_type_252_forgets_its_sample_out_of_operational(bench):
    bench.write(0x1800, 2, 252, 1)
    bench.nmt(0x01)
    bench.send(0x80, "")
    bench.nmt(0x80)
    bench.write(0x2001, 0, 0xAA, 4)
    bench.nmt(0x01)
    assert bench.send(0x40000185, "") == [(0x185, "aa000000feff")]


def test_a_request_does_not_use_up_an_event_that_waits_for_a_sync(bench):
    bench.write(0x1800, 2, 0, 1)
    bench.nmt(0x01)
    bench.write(0x2001, 0, 0xAA, 4)
    assert bench.send(0x40000185, "") == [(0x185, "aa000000feff")]
    assert bench.send(0x80, "") == [(0x185, "aa000000feff")]
    assert bench.send(0x80, "") == []


# A TPDO of more than 64 bits: only where the device has them, and only when they were switched on.


@pytest.mark.parametrize(("eds", "switch", "fits"), [
    ("tactile_array_fd", 1, True), ("tactile_array_fd", 0, False), ("tactile_array", 1, False),
])  # fmt: skip
def test_mapping_of_512_bits(eds, switch, fits):
    dictionary = Dictionary(load_eds(eds, 16))
    dictionary.put(LONG_PDOS, 0, switch)
    rules = PdoRules(dictionary, 0x1801, transmits=True)
    count = 8 if eds.endswith("fd") else 4
    for subindex in range(1, count + 1):
        dictionary.values[key_of(0x1A01, subindex)] = 0x21000040 | subindex << 8
    if fits:
        assert len(rules.entries(8)) == 8
        return
    with pytest.raises(SdoAbort) as refused:
        rules.entries(2)
    assert refused.value.code == Abort.MAPPING_LENGTH
