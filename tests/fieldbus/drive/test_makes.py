"""Any CiA 402 EDS is served as a drive: makes that lack objects, have them read-only, or with other defaults."""

from __future__ import annotations

from pathlib import Path

import pytest
from canopen.objectdictionary import ObjectDictionary
from makes import MAKES, Make, changed, pdo, standard_drive, without, word, write_eds

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import IdealAxis, make_drive_node

CYCLE = 10_000_000
TPDO = 0x181
SYNC_LOST = (0x81, "0081110000000000")


class Served:
    """A drive of some make on a plant of numbers, driven by a master that knows its objects."""

    def __init__(self, rig, od: ObjectDictionary) -> None:
        self.rig, self.bench, self.plant = rig, rig.drive, rig.plant
        self.bench.node = make_drive_node(od, 1, 0, self.plant)
        self.dictionary = self.bench.node.dictionary
        self.bench.node.start(0)
        self.k = 0

    def wish(self, index: int, sub: int, value: int) -> int:
        """Write what the make may lack, have read-only or limit; its abort code."""
        entry = self.dictionary.entries.get(index << 8 | sub)
        return self.bench.write(index, sub, value, entry.bits // 8 if entry is not None else 4)

    def cycle(self) -> None:
        """60C2h = 10 ms, in whatever index the make takes."""
        assert self.wish(0x60C2, 2, -3) in (0, 0x06010002)
        assert self.wish(0x60C2, 1, 10 ** (-2 - self.rig.signed(0x60C2, 2))) == 0

    def enable(self, mode: int) -> Served:
        assert self.wish(0x6060, 0, mode) == 0
        self.bench.nmt(0x01)
        for controlword in (0x06, 0x07, 0x0F):
            self.sync()
            assert self.wish(0x6040, 0, controlword) == 0
        self.sync()
        assert self.bench.read(0x6041) & 0x6F == 0x27
        assert self.rig.signed(0x6061) == mode
        return self

    def sync(self) -> list[tuple[int, str]]:
        self.k += 1
        return self.bench.advance(self.k * CYCLE) + self.bench.send(0x80, "", self.k * CYCLE)

    def rest(self) -> None:
        self.bench.advance(self.k * CYCLE + CYCLE - 1)


@pytest.fixture
def serve(rig, tmp_path: Path):
    """Serve a make, or a packaged EDS by its name."""

    def served(make: Make | str) -> Served:
        packaged = isinstance(make, str) and make not in MAKES
        return Served(rig, load_eds(make if packaged else write_eds(make, tmp_path), 1))

    return served


@pytest.mark.parametrize(
    ("make", "modes"),
    [("interpolated", 0x41), ("prbt_joint", 0x41), ("no_cyclic_mode", 0x21), ("tpdo_without_rtr", 0x81)],
)
def test_cia402_53_6502_holds_what_make_and_emulator_both_have(serve, make, modes):
    served = serve(make)
    shown = served.bench.read(0x6502)
    assert shown & ~served.dictionary.delivered(0x6502) == 0
    assert shown & 0xE1 == modes & 0xE1


def test_a_fixed_mapping_is_served_as_it_is(serve):
    served = serve("fixed_mapping")
    served.cycle()
    for index, sub in ((0x1600, 0), (0x1602, 1), (0x1A02, 2), (0x1402, 1), (0x1802, 1)):
        assert served.wish(index, sub, 0) == 0x06010002
    served.enable(8)
    served.plant.torque = 77
    target = (-400).to_bytes(4, "little", signed=True).hex()
    for _ in range(3):
        served.bench.send(0x401, "0f00" + target)
        frames = served.sync()
        served.rest()
    frames = served.sync()
    assert (0x381, "3712" + target + "4d00") in frames


def test_a_fixed_mapping_may_hold_what_the_file_does_not_list_as_mappable(serve):
    objects = standard_drive()
    changed(objects, 0x6077, mappable=False)
    without(objects, 0x1800, 0x1A00)
    objects |= pdo("tpdo", 1, (word(0x6041, 0, 16), word(0x6077, 0, 16)), fixed=True)
    served = serve(Make("unlisted", 0x0200, objects=objects))
    served.plant.torque = -2
    served.bench.nmt(0x01)
    assert served.sync() == [(TPDO, "5002feff")]
    assert served.wish(0x1801, 1, 0x80000281) == 0
    assert served.wish(0x1A01, 1, word(0x6077, 0, 16)) == 0x06040041, "it cannot be mapped anew"


@pytest.mark.parametrize(("make", "index"), [("puma260_joint", 0x2000), ("interpolated", 0x200E), ("bare", None)])
def test_cia402_59_syncs_missed_are_counted_by_the_object_of_the_make(serve, make, index):
    served = serve(make)
    mode = 7 if make == "interpolated" else 8
    served.cycle()
    misses = 5
    if index is not None:
        misses = 9
        assert served.wish(index, 0, misses) == 0
    last_ns = served.enable(mode).k * CYCLE
    silence_ns = misses * CYCLE + CYCLE // 2
    assert served.bench.advance(last_ns + silence_ns - 1) == []
    assert served.bench.advance(last_ns + silence_ns) == [SYNC_LOST]


def test_an_unknown_object_at_2000h_is_not_taken_for_ours(serve):
    objects = standard_drive()
    objects[0x2000, 0] = objects[0x6066, 0]
    served = serve(Make("other_2000", 0x0201, objects=objects))
    assert served.bench.node.application.parts.parameters.misses == 5


def test_60c2_as_delivered_of_0_does_not_divide_by_it(serve):
    served = serve("milliseconds_only")
    assert served.bench.read(0x60C2, 1) == 0
    served.enable(8)
    for target in (100, 200, 200):
        assert served.wish(0x607A, 0, target) == 0
        served.sync()
    assert served.rig.counts == 200


def test_60c2_without_an_index_counts_milliseconds_as_the_plan_takes_it(serve):
    objects = standard_drive()
    del objects[0x60C2, 2]
    served = serve(Make("without_index", 0x0203, objects=objects))
    assert served.wish(0x60C2, 1, 10) == 0
    assert served.bench.node.application.parts.parameters.interpolation_ns == 10_000_000


def test_a_unit_of_the_plant_is_the_position_unit_as_delivered(serve):
    """An EDS with degrees as delivered: 4096 lines, gear 100, feed 360."""
    objects = standard_drive()
    for index, (numerator, denominator) in {0x608F: (4096, 1), 0x6091: (100, 1), 0x6092: (360, 1)}.items():
        objects[index, 0] = objects[0x60C2, 0]
        objects[index, 1] = objects[0x6083, 0].__class__("numerator", "U32", "rw", numerator)
        objects[index, 2] = objects[0x6083, 0].__class__("denominator", "U32", "rw", denominator)
    served = serve(Make("degrees", 0x0202, objects=objects))
    units = served.bench.node.application.parts.parameters.units
    assert (units.scale, units.turn) == (1.0, pytest.approx(3.6))
    assert served.wish(0x6092, 1, 36_000) == 0  # hundredths of a degree
    assert (units.scale, units.turn) == (pytest.approx(0.01), pytest.approx(3.6))


def test_a_drive_without_a_plant_has_no_limit_switches():
    assert IdealAxis().limit_switches(0) == (float("-inf"), float("inf"))
