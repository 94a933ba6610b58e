"""Drives that are difficult on request: what `Quirks` asks for, and that a node without them is as before."""

from __future__ import annotations

from statistics import fmean, stdev

import pytest

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node
from canprobe.fieldbus.node import Quirks

MS = 1_000_000
REFUSED, READ_ONLY, VALUE = 0x06010000, 0x06010002, 0x06090030
STATUS_AND_POSITION = "5002" + "00000000" + "0000"


@pytest.fixture
def quirky(drive, plant):
    """A drive with quirks, powered on at 0; what it sends then."""

    def made(eds="puma260_joint", **quirks):
        drive.node = make_drive_node(load_eds(eds, 1), 1, 0, plant, lambda n: load_eds(eds, n), quirks=Quirks(**quirks))
        drive.t_ns = 0
        return drive, drive.node.start(0)

    return made


def test_a_slow_boot_serves_nothing_before_the_boot_up(quirky):
    bench, sent = quirky(boot_ns=2000 * MS)
    assert sent == []
    assert bench.send(0x601, "4000100000000000", 1999 * MS) == []
    assert bench.advance(2000 * MS) == [(0x701, "00")]
    assert bench.read(0x1000) == 0x00020192
    assert bench.nmt(0x82) == []
    assert bench.advance(4000 * MS) == [(0x701, "00")]


def test_sdo_answers_come_late_and_in_order(quirky):
    bench, _ = quirky(sdo_ns=50 * MS)
    assert bench.send(0x601, "4000100000000000", 10 * MS) == []
    assert bench.send(0x601, "4000300000000000", 20 * MS) == []
    assert bench.node.next_deadline_ns == 60 * MS
    assert bench.advance(60 * MS) == [(0x581, "4300100092010200")]
    assert bench.advance(70 * MS) == [(0x581, "8000300000000206")]


def test_a_slow_segmented_upload_is_not_given_up(quirky):
    bench, _ = quirky(sdo_ns=900 * MS)
    assert bench.send(0x601, "4008100000000000", 0) == []
    (answer,) = bench.advance(900 * MS)
    assert answer[1].startswith("41081000")
    assert bench.send(0x601, "6000000000000000", 1800 * MS) == []
    (answer,) = bench.advance(2700 * MS)
    assert answer[0] == 0x581 and answer[1][:2] in ("00", "01")


def test_answers_of_before_a_reset_are_not_sent_after_it(quirky):
    bench, _ = quirky(sdo_ns=50 * MS)
    bench.send(0x601, "4000100000000000", 10 * MS)
    assert bench.nmt(0x81) == [(0x701, "00")]
    assert bench.advance(100 * MS) == []


def test_fixed_mappings_and_cob_ids_are_read_only(quirky):
    bench, _ = quirky(fixed_mapping=True)
    for index, sub in ((0x1400, 1), (0x1801, 1), (0x1600, 0), (0x1600, 1), (0x1A00, 0), (0x1A03, 2)):
        size = bench.node.dictionary.find(index, sub).bits // 8
        assert bench.write(index, sub, bench.read(index, sub), size) == READ_ONLY, (hex(index), sub)
    assert bench.write(0x1800, 2, 2, 1) == 0, "how often it is sent may be changed"
    bench.nmt(0x01)
    bench.send(0x80, "")
    assert bench.send(0x80, "") == [(0x181, STATUS_AND_POSITION)]


@pytest.mark.parametrize(("bit", "same"), [(0x00000000, True), (0x40000000, False)])
def test_bit_30_of_a_tpdo_is_to_be_kept(quirky, bit, same):
    bench, _ = quirky(keep_bit30=True)
    assert bench.write(0x1800, 1, 0x80000181 | bit, 4) == (0 if same else VALUE)
    assert bench.write(0x1400, 1, 0x80000201, 4) == 0


def test_tpdos_come_late_with_the_values_of_the_sync(quirky, plant):
    bench, _ = quirky(tpdo_delay_ns=1 * MS)
    bench.nmt(0x01)
    assert bench.send(0x80, "", 10 * MS) == []
    plant.counts[0] = 500.0
    plant.ramps.clear()
    assert bench.node.next_deadline_ns == 11 * MS
    assert bench.advance(11 * MS) == [(0x181, STATUS_AND_POSITION)]
    assert bench.send(0x80, "", 20 * MS) == []
    assert bench.advance(21 * MS) == [(0x181, "5002" + "f4010000" + "0000")]


def test_a_delay_longer_than_the_period_loses_nothing(quirky):
    bench, _ = quirky(tpdo_delay_ns=25 * MS)
    bench.nmt(0x01)
    sent = [(t, frame) for t in range(10, 61, 5) for frame in bench.advance(t * MS) + bench.send(0x80, "", t * MS)]
    assert [t for t, _ in sent] == [35, 40, 45, 50, 55, 60]
    assert bench.nmt(0x02) == []
    assert bench.advance(100 * MS) == []


def test_the_encoder_is_noisy(quirky):
    bench, _ = quirky(noise_counts=12.0)
    bench.nmt(0x01)
    positions = []
    for k in range(1, 1001):
        ((_, text),) = bench.send(0x80, "", k * MS)
        positions.append(int.from_bytes(bytes.fromhex(text)[2:6], "little", signed=True))
    assert fmean(positions) == pytest.approx(0.0, abs=1.5)
    assert stdev(positions) == pytest.approx(12.0, rel=0.1)


def test_the_noise_follows_from_seed_and_axis(plant):
    def first(seed, axis):
        node = make_drive_node(
            load_eds("puma260_joint", 1), 1, axis, plant, quirks=Quirks(noise_counts=50.0), seed=seed
        )
        node.start(0)
        node.receive(0, b"\x01\x01", 0)
        return [node.receive(0x80, b"", k * MS) for k in range(1, 6)]

    assert first(3, 0) == first(3, 0)
    assert len({str(first(seed, axis)) for seed in (3, 4) for axis in (0, 1)}) == 4


def test_quirks_survive_a_new_node_id(quirky):
    bench, _ = quirky(fixed_mapping=True, refuse=(0x605A,))
    node = bench.node
    node.lss.pending = 9
    bench.nmt(0x82)
    assert node.node_id == 9
    assert bench.write(0x605A, 0, 6, 2) == REFUSED
    assert bench.write(0x1A00, 0, 0, 1) == READ_ONLY
