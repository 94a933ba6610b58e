"""PDOs of the device, taken out of use, changed and put to work for a point."""

from __future__ import annotations

from canprobe.fieldbus.eds.description import DescribedEntry
from canprobe.fieldbus.protocol.frames import INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import RPDOS, TO_MAPPING, TPDOS, PdoSub
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.outcome import PointNotApplicable
from canprobe.fieldbus.tools.conform.permits import MOTION_OBJECTS, is_object

EVENT_TYPE = 255
_DUMMY_WORDS = (0x00070020, 0x00060010, 0x00050008)
"""UNSIGNED32, UNSIGNED16, UNSIGNED8 as dummy entries."""


def changeable_pdo(bench: Bench, area: range, *, mapping: bool = False) -> int:
    """A PDO whose identifier can be written, with a mapping; with `mapping` one whose mapping can be written, too.

    Raises:
        PointNotApplicable: there is none.
    """
    what = "TPDO" if area is TPDOS else "RPDO"
    for pdo in bench.device.pdos(area):
        places = ((pdo, 1), (pdo + TO_MAPPING, 0), (pdo + TO_MAPPING, 1))[: 3 if mapping else 1]
        if all(bench.device.writable(*place) for place in places) and (area is RPDOS or bench.device.mapping(pdo)):
            return pdo
    raise PointNotApplicable(f"the device has no {what} {'with a mapping that' if mapping else 'that'} can be changed")


def switch_off(bench: Bench, pdo: int) -> None:
    """Take a PDO out of use."""
    bench.put(pdo, 1, bench.device.number(pdo, 1) | INVALID_FLAG, 4)


def idle_pdo(bench: Bench, area: range, *, mapping: bool = False) -> int:
    """A PDO that can be changed, as `changeable_pdo` finds it, out of use."""
    pdo = changeable_pdo(bench, area, mapping=mapping)
    switch_off(bench, pdo)
    return pdo


def switch_on(bench: Bench, pdo: int) -> int:
    """Put a PDO to work under its own identifier, or the pre-defined one; return the identifier."""
    word = bench.device.number(pdo, 1) & ~INVALID_FLAG
    if not word & 0x7FF:
        area, base = (RPDOS, 0x200) if pdo in RPDOS else (TPDOS, 0x180)
        word |= base + 0x100 * (area.index(pdo) % 4) + bench.node_id
    bench.put(pdo, 1, word, 4)
    return word & 0x7FF


def map_entries(bench: Bench, pdo: int, words: list[int]) -> None:
    """Map entries to a PDO that is out of use. Raises Deviation where the device refuses."""
    bench.put(pdo + TO_MAPPING, 0, 0)
    for subindex, word in enumerate(words, start=1):
        bench.put(pdo + TO_MAPPING, subindex, word, 4)
    bench.put(pdo + TO_MAPPING, 0, len(words))


def put_to_work(
    bench: Bench, pdo: int, kind: int, *, inhibit: int = 0, event_ms: int = 0, start: int | None = None
) -> int:
    """Set transmission type and times of a PDO that is out of use, and switch it on; return its identifier.

    Raises:
        PointNotApplicable: the device has not all of them, or does not take the transmission type.
    """
    if bench.device.number(pdo, PdoSub.TYPE) != kind and not bench.takes(pdo, PdoSub.TYPE, kind):
        raise PointNotApplicable(f"the device does not take transmission type {kind}")
    for subindex, value in ((PdoSub.INHIBIT_TIME, inhibit), (PdoSub.EVENT_TIMER, event_ms), (PdoSub.SYNC_START, start)):
        if value is not None and (value or bench.device.number(pdo, subindex)):
            bench.need((pdo, subindex))
            bench.put(pdo, subindex, value)
    return switch_on(bench, pdo)


def synchronous_tpdo(bench: Bench, every: int = 1, start: int | None = None) -> int:
    """A TPDO that is sent at every n-th SYNC; return its identifier. SYNC has no counter, unless a start is given."""
    pdo = idle_pdo(bench, TPDOS)
    if start is None:
        plain_sync(bench)
    return put_to_work(bench, pdo, every, start=start)


def plain_sync(bench: Bench) -> None:
    """Let the device expect SYNC without a counter, and not watch its period."""
    if bench.device.number(0x1006):
        bench.put(0x1006, 0, 0)
    if bench.device.number(0x1019):
        bench.put(0x1019, 0, 0)


def permitted_entry(bench: Bench, *, transmits: bool) -> DescribedEntry:
    """An entry that the user lets be written and that such a PDO may map.

    Raises:
        PointNotApplicable: there is none.
    """
    for entry in bench.device.entries():
        mappable = entry.in_tpdo and entry.writable if transmits else entry.in_rpdo and entry.readable
        if is_object(entry.index, *MOTION_OBJECTS) or entry.index < 0x2000 or not entry.is_integer:
            continue
        if mappable and bench.permits.written.permits(entry.place):
            return entry
    way = "a TPDO" if transmits else "an RPDO"
    raise PointNotApplicable(f"--write names no entry that {way} may map, and whose value can be read and written")


def word_of(entry: DescribedEntry) -> int:
    """A described entry as a mapping entry."""
    return entry.index << 16 | entry.subindex << 8 | entry.bits


def rpdo_of_dummies(bench: Bench) -> tuple[int, int, int]:
    """An RPDO that carries nothing; return its index, identifier and length.

    Raises:
        PointNotApplicable: no mapping can be changed, or none takes a dummy.
    """
    pdo = idle_pdo(bench, RPDOS, mapping=True)
    bench.put(pdo + TO_MAPPING, 0, 0)
    word = next((word for word in _DUMMY_WORDS if bench.takes(pdo + TO_MAPPING, 1, word)), 0)
    if not word or not bench.takes(pdo + TO_MAPPING, 0, 1):
        raise PointNotApplicable("no RPDO takes a dummy entry, so none can be sent without changing something")
    return pdo, _harmless(bench, pdo, EVENT_TYPE), (word & 0xFF) // 8


def rpdo_of(bench: Bench, entry: DescribedEntry, kind: int) -> int:
    """An RPDO that carries one entry that the user lets be written; return its identifier."""
    pdo = idle_pdo(bench, RPDOS, mapping=True)
    map_entries(bench, pdo, [word_of(entry)])
    return _harmless(bench, pdo, kind)


def _harmless(bench: Bench, pdo: int, kind: int) -> int:
    cob_id = put_to_work(bench, pdo, kind)
    bench.permits.harmless.add(cob_id)
    return cob_id
