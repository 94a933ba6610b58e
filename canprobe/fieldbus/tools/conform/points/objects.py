"""Points 77 to 92: what the EDS promises, entry by entry. Source: CiA 306-1; CiA 301, "Object dictionary"."""

from __future__ import annotations

from canprobe.fieldbus.protocol.frames import RESTRICTED_IDS, is_restricted
from canprobe.fieldbus.protocol.pdo import RPDOS, TO_MAPPING, TPDOS
from canprobe.fieldbus.protocol.sdo import ABORT, Abort, pack_read, place_text
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.permits import WriteRule, rule_of
from canprobe.fieldbus.tools.conform.point import PointGroup
from canprobe.fieldbus.tools.conform.sdo_client import SdoRefused

point = PointGroup("objects")
_MANDATORY = ((0x1000, 0), (0x1001, 0), (0x1018, 1))
_SHOWN = 5
"""Entries that a verdict names."""
_MAY_HAVE_NOTHING = (Abort.NO_DATA, Abort.DEVICE_STATE, Abort.LOCAL_CONTROL_PREVENTS_IT)
"""Codes of an entry that is there and has no value now."""


def _named(entries: list[str]) -> str:
    more = f" and {len(entries) - _SHOWN} more" if len(entries) > _SHOWN else ""
    return "; ".join(entries[:_SHOWN]) + more


@point(77, "read all", "CiA 306-1, AccessType, DataType", "every entry that can be read, in its length", needs="eds")
def read_all(bench: Bench) -> None:
    """Every readable entry of the EDS: it is there, and as long as its type."""
    wrong = []
    for entry in bench.device.entries():
        mandatory = entry.place in _MANDATORY  # which point 92 reads
        if not entry.readable or mandatory or rule_of(entry.index) is WriteRule.HISTORY:
            continue
        place, size = place_text(*entry.place), -(-entry.bits // 8) if entry.is_integer else 0
        try:
            value = bench.upload(*entry.place)
        except SdoRefused as refused:
            if refused.code not in _MAY_HAVE_NOTHING:
                wrong.append(str(refused))
            continue
        if size and len(value) != size and not (len(value) == 4 > size):
            wrong.append(f"{place} has {len(value)} bytes, its type {size}")
    bench.expect(not wrong, _named(wrong))


@point(78, "write every ro", "CiA 306-1, AccessType", accepted.READ_ONLY, needs="eds")
def write_every_read_only(bench: Bench) -> None:
    """Every ro and const entry of the EDS gets its own value: 1000h is point 10, the application area needs --write."""
    tried = 0
    for entry in bench.device.entries():
        value = bench.device.values.get(entry.place, b"")
        allowed = rule_of(entry.index) in (WriteRule.REFUSED, WriteRule.CHANGED, WriteRule.SAME)
        if entry.writable or entry.index == 0x1000 or not 0 < len(value) <= 4:
            continue
        if allowed or bench.permits.written.permits(entry.place):
            tried += 1
            what = f"write to {place_text(*entry.place)}"
            bench.must_refuse_write(*entry.place, value, accepted.READ_ONLY, what)
    bench.require(tried, "the EDS describes no further entry as ro in the communication area")


@point(79, "sub-index FFh", "CiA 301, structure of an object", "four bytes, or " + accepted.text(accepted.NO_ENTRY))
def structure(bench: Bench) -> None:
    """Sub-index FFh of the identity."""
    answer = bench.ask(pack_read(0x1018, 0xFF))
    if answer[0] == ABORT:
        bench.check_abort(answer, accepted.NO_ENTRY, "read of 1018h:FF")
    elif answer[0] not in (0x43, 0x42):
        bench.deviates(f"1018h:FF is answered with {answer.hex(' ')}")


@point(81, "defaults", "CiA 306-1, DefaultValue", "for information: what differs is noted", needs="eds")
def defaults(bench: Bench) -> None:
    """Values that differ from the EDS: a device that was configured has others."""
    differing = []
    for entry in bench.device.entries():
        stated, value = entry.default, bench.device.number(*entry.place)
        if not (isinstance(stated, int) and entry.bits and bench.device.has(*entry.place)):
            continue
        varies = rule_of(entry.index) is WriteRule.NEVER or entry.index in (0x1001, 0x1003)
        if not varies and value != stated & (1 << entry.bits) - 1:
            differing.append(f"{place_text(*entry.place)} is {value:#x}, EDS {stated:#x}")
    if differing:
        bench.notes.append(_named(differing))


@point(82, "PDOs of the EDS", "CiA 306-1; CiA 301, 14xxh 18xxh", "those that the EDS names, and no others", needs="eds")
def pdos_of_the_eds(bench: Bench) -> None:
    """Each PDO that the EDS names is there; the one behind the last is not."""
    description = bench.device.description
    assert description is not None
    for area, numbers in ((RPDOS, description.rpdos), (TPDOS, description.tpdos)):
        for number in numbers:
            index = area[number - 1]
            for place in ((index, 1), (index, 2), (index + TO_MAPPING, 0)):
                if bench.device.described(*place) is not None and not bench.device.has(*place):
                    bench.deviates(f"the device has no {place_text(*place)}, which the EDS describes")
        beyond = area[max(numbers, default=0)]
        bench.must_refuse(pack_read(beyond, 1), accepted.NO_OBJECT, f"read of {beyond:04X}h:01")


@point(86, "SYNC identifier", "CiA 301, 1005h", "080h, bit 30 as it may be")
def sync_identifier(bench: Bench) -> None:
    """1005h names the identifier of SYNC."""
    bench.need((0x1005, 0), written=False)
    if (value := bench.number(0x1005)) & 0x7FF != 0x80:
        if bench.device.described(0x1005) is None or is_restricted(value & 0x7FF):
            bench.deviates(f"1005h is {value:08X}h")
        bench.notes.append(f"SYNC has identifier {value & 0x7FF:03X}h")


@point(87, "restricted identifiers", "CiA 301, restricted CAN-IDs", accepted.VALUE)
def restricted_identifiers(bench: Bench) -> None:
    """1005h, 1012h and 1014h with restricted identifiers; one that is accepted is put back."""
    indices = [index for index in (0x1005, 0x1012, 0x1014) if bench.device.writable(index)]
    bench.require(indices, "none of 1005h, 1012h and 1014h can be written")
    for index in indices:
        for cob_id in RESTRICTED_IDS:
            bench.must_refuse_write(index, 0, cob_id, accepted.VALUE, f"{cob_id:03X}h for {index:04X}h")


@point(90, "identity", "CiA 306-1, DeviceInfo; CiA 301, 1018h", "the numbers of the EDS", needs="eds")
def identity(bench: Bench) -> None:
    """1000h and 1018h:01 and :02 as the EDS names them; a revision that differs is noted."""
    for place in ((0x1000, 0), (0x1018, 1), (0x1018, 2), (0x1018, 3)):
        entry = bench.device.described(*place)
        if entry is None or not isinstance(entry.default, int) or place not in bench.device.values:
            continue
        if (found := bench.device.number(*place)) == entry.default:
            continue
        text = f"{place_text(*place)} is {found:#x}, the EDS says {entry.default:#x}"
        if place == (0x1018, 3) and found >> 16 == entry.default >> 16:
            bench.notes.append(text)
        elif entry.default or place == (0x1000, 0):
            bench.deviates(text)


@point(92, "mandatory objects", "CiA 301, object dictionary", "1000h, 1001h, 1018h:01")
def mandatory_objects(bench: Bench) -> None:
    """The objects that every device has."""
    for place in _MANDATORY:
        bench.upload(*place)
