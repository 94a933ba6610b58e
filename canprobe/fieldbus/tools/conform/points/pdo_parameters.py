"""Points 25 to 29, 38 and 83 to 85: how PDOs are set. Source: CiA 301, "PDO mapping", objects 1400h to 1BFFh."""

from __future__ import annotations

from collections.abc import Mapping

from canprobe.fieldbus.protocol.frames import RESTRICTED_IDS
from canprobe.fieldbus.protocol.pdo import MAX_SYNC_TYPE, RPDOS, TO_MAPPING, TPDOS, PdoSub
from canprobe.fieldbus.protocol.sdo import ABORT, pack_write
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.pdo_bench import PdoBench, word_of
from canprobe.fieldbus.tools.conform.point import PointGroup
from canprobe.fieldbus.tools.conform.sdo_client import SdoRefused

point = PointGroup("pdo", "CiA 301")
MAPPING = "PDO mapping"
_ABSENT_WORD, _IDENTITY_WORD, _DUMMY_WORD = 0x1FF00020, 0x10180120, 0x00070020
_RESERVED_TYPES = {RPDOS: (0xF1, 0xF8, 0xFD), TPDOS: (0xF1, 0xF6, 0xFB)}
_LONG_ENTRIES = 9
_CHANGED_BIT = 0x08
_SYNC_PACE_S = 0.005
_LONGEST_EVENT_MS = 2000
"""Longest event time (18xxh:05) that is waited for."""


def _valid(bench: PdoBench, area: range, *, mapping: bool = False) -> int:
    """A PDO that can be changed, at work."""
    pdo = bench.changeable_pdo(area, mapping=mapping)
    if bench.device.cob_id(pdo) is None:
        bench.permits.rpdo_ids.add(bench.switch_on(pdo))
    return pdo


def _refused_entry(bench: PdoBench, pdo: int, what: str) -> int:
    """Write another word to the first mapped entry, which must be refused; the word that is there."""
    first = bench.number(pdo + TO_MAPPING, 1)
    other = _IDENTITY_WORD if first != _IDENTITY_WORD else _ABSENT_WORD
    bench.must_refuse_write(pdo + TO_MAPPING, 1, other, (*accepted.MAPPING_LOCKED, *accepted.NOT_MAPPABLE), what)
    return first


@point(25, "mapping while valid", MAPPING, accepted.MAPPING_LOCKED, needs="nmt")
def mapping_while_valid(bench: PdoBench) -> None:
    """An entry of a PDO in use gets another value, and its count 0."""
    pdo = _valid(bench, TPDOS, mapping=True)
    first = _refused_entry(bench, pdo, "an entry of a PDO in use")
    bench.expect(bench.number(pdo + TO_MAPPING, 1) == first, "a mapping entry changes although the write is refused")


@point(
    25,
    "count while valid",
    MAPPING,
    "the count stays, or is refused with " + accepted.text(accepted.MAPPING_LOCKED),
    needs="nmt",
)
def count_while_valid(bench: PdoBench) -> None:
    """The count of a PDO in use gets 0."""
    pdo = _valid(bench, TPDOS, mapping=True)
    bench.must_refuse_write(pdo + TO_MAPPING, 0, b"\0", accepted.MAPPING_LOCKED, "the count of a PDO in use")


@point(25, "mapping while counted", MAPPING, accepted.MAPPING_LOCKED, needs="nmt")
def mapping_while_counted(bench: PdoBench) -> None:
    """An entry of a PDO out of use, whose count is not 0."""
    _refused_entry(bench, bench.idle_pdo(TPDOS, mapping=True), "an entry while the count is not 0")


def _refused_at_last(bench: PdoBench, pdo: int, words: list[int], codes: accepted.AbortSet, what: str) -> None:
    """Map entries to a PDO out of use: one of the writes must be refused."""
    bench.put(pdo + TO_MAPPING, 0, 0)
    requests = [pack_write(pdo + TO_MAPPING, n, word.to_bytes(4, "little")) for n, word in enumerate(words, start=1)]
    for request in (*requests, pack_write(pdo + TO_MAPPING, 0, bytes((len(words),)))):
        answer = bench.ask(request)
        if answer[0] == ABORT:
            bench.check_abort(answer, codes, what)
            return
    bench.deviates(f"{what}: all writes are accepted")


@point(26, "mapping too long", MAPPING, accepted.MAPPING_LENGTH, needs="nmt")
def mapping_too_long(bench: PdoBench) -> None:
    """More than eight bytes: the first entry of a TPDO again and again."""
    pdo = bench.idle_pdo(TPDOS, mapping=True)
    word = bench.device.mapping(pdo)[0]
    places = sum(bench.device.has(pdo + TO_MAPPING, n) for n in range(1, 65))
    count = min(64 // max(word & 0xFF, 1) + 1, _LONG_ENTRIES)
    codes: accepted.AbortSet = accepted.MAPPING_LENGTH
    what = f"{count} entries of {word & 0xFF} bits"
    if count > max(places, bench.device.number(pdo + TO_MAPPING)):
        codes, what = (*codes, *accepted.NO_ENTRY), "more than the places"
    _refused_at_last(bench, pdo, [word] * count, codes, what)


@point(27, "absent object", MAPPING, accepted.NOT_MAPPABLE, needs="nmt")
def map_absent(bench: PdoBench) -> None:
    """An object that the device does not have."""
    pdo = bench.idle_pdo(TPDOS, mapping=True)
    _refused_at_last(bench, pdo, [_ABSENT_WORD], accepted.NOT_MAPPABLE, "mapping of an absent object")


@point(27, "not mappable", MAPPING, accepted.NOT_MAPPABLE, needs="nmt eds")
def map_unmappable(bench: PdoBench) -> None:
    """An entry that the EDS does not let be mapped, in a TPDO; one that is ro, in an RPDO."""
    tried = 0
    for area in (TPDOS, RPDOS):
        if (pdo := bench.find_pdo(area, mapping=True)) is None:
            continue
        numbers = [entry for entry in bench.device.entries() if entry.bits and entry.is_integer]
        unmappable = [e for e in numbers if (not e.in_tpdo if area is TPDOS else e.in_tpdo and not e.in_rpdo)]
        for entry in unmappable[:1]:
            tried += 1
            bench.switch_off(pdo)
            _refused_at_last(bench, pdo, [word_of(entry)], accepted.NOT_MAPPABLE, f"mapping of {entry.index:04X}h")
    bench.require(tried, "no mapping can be changed, or the EDS lets everything be mapped")


@point(28, "identifier while valid", "14xxh 18xxh", accepted.PDO_LOCKED, needs="nmt")
def identifier_while_valid(bench: PdoBench) -> None:
    """Another identifier for a PDO in use."""
    for area in filter(bench.device.pdos, (RPDOS, TPDOS)):
        pdo = _valid(bench, area)
        word = bench.number(pdo, 1) ^ _CHANGED_BIT
        bench.must_refuse_write(pdo, 1, word, accepted.PDO_LOCKED, "another identifier")


@point(28, "times while valid", "18xxh:03, :06", accepted.PDO_LOCKED, needs="nmt")
def times_while_valid(bench: PdoBench) -> None:
    """Inhibit time and SYNC start value of a TPDO in use."""
    pdo = _valid(bench, TPDOS)
    times = [one for one in (PdoSub.INHIBIT_TIME, PdoSub.SYNC_START) if bench.device.writable(pdo, one)]
    bench.require(times, "the TPDOs have neither inhibit time nor start value")
    for subindex in times:
        value = bench.packed(pdo, subindex, bench.number(pdo, subindex) ^ _CHANGED_BIT)
        bench.must_refuse_write(pdo, subindex, value, accepted.PDO_LOCKED, f"{pdo:04X}h:{subindex:02X}")


@point(28, "restricted identifiers", "restricted CAN-IDs", accepted.VALUE, needs="nmt")
def restricted_identifiers_of_pdos(bench: PdoBench) -> None:
    """Restricted identifiers for a PDO out of use."""
    for area in filter(bench.device.pdos, (RPDOS, TPDOS)):
        pdo = bench.idle_pdo(area)
        for cob_id in RESTRICTED_IDS:
            bench.must_refuse_write(pdo, 1, cob_id, accepted.VALUE, f"identifier {cob_id:03X}h for {pdo:04X}h")


@point(29, "reserved types", "transmission type", accepted.VALUE, needs="nmt")
def reserved_types(bench: PdoBench) -> None:
    """Reserved transmission types for a PDO out of use."""
    for area in filter(bench.device.pdos, (RPDOS, TPDOS)):
        pdo = bench.idle_pdo(area)
        bench.need((pdo, 2))
        for kind in _RESERVED_TYPES[area]:
            bench.must_refuse_write(pdo, 2, bytes((kind,)), accepted.VALUE, f"type {kind:02X}h for {pdo:04X}h")


@point(38, "dummies", MAPPING, "an RPDO takes the dummies that the EDS allows", needs="nmt eds")
def dummies(bench: PdoBench) -> None:
    """A dummy entry in an RPDO."""
    description = bench.device.description
    assert description is not None
    allowed = sorted(description.dummies & {0x0005, 0x0006, 0x0007})
    bench.require(allowed, "the EDS allows no dummy")
    pdo = bench.idle_pdo(RPDOS, mapping=True)
    for data_type in allowed:
        bench.map_entries(pdo, [data_type << 16 | 8 << data_type - 5])
    bench.rpdo_of_dummies()


@point(38, "dummies in a TPDO", MAPPING, accepted.NOT_MAPPABLE, needs="nmt")
def dummies_in_tpdo(bench: PdoBench) -> None:
    """A dummy entry in a TPDO."""
    pdo = bench.idle_pdo(TPDOS, mapping=True)
    _refused_at_last(bench, pdo, [_DUMMY_WORD], accepted.NOT_MAPPABLE, "a dummy in a TPDO")


@point(83, "mapped entries", MAPPING, "every mapped entry is there, in the mapped length")
def mapped_entries(bench: PdoBench) -> None:
    """Every entry of every mapping: it can be read, or the EDS says that it is wo."""
    for area in (RPDOS, TPDOS):
        for pdo in bench.device.pdos(area):
            for word in bench.device.mapping(pdo):
                index, subindex, bits = word >> 16, word >> 8 & 0xFF, word & 0xFF
                entry = bench.device.described(index, subindex)
                if index <= 0x1F or (entry is not None and not entry.readable):
                    continue
                try:
                    value = bench.upload(index, subindex)
                except SdoRefused as refused:
                    bench.deviates(f"{pdo:04X}h maps {refused}")
                if len(value) * 8 != bits and len(value) != 4 and bits >= 8:
                    bench.deviates(f"{pdo:04X}h maps {bits} bits of {index:04X}h, which has {len(value)} bytes")


@point(83, "heard lengths", MAPPING, "every TPDO that comes is as long as its mapping")
def heard_lengths(bench: PdoBench) -> None:
    """Every TPDO that was heard before, and that comes in operational by SYNC, request, event timer or by itself."""
    pdos = bench.device.valid_pdos(TPDOS)
    surroundings = bench.permits.surroundings
    heard = {cob_id: surroundings.lengths.get(cob_id, set()) for cob_id in pdos}
    for cob_id in pdos:
        bench.taken(cob_id)
    if not surroundings.lacks("nmt"):
        bench.start()
        _ask_for_tpdos(bench, pdos)
    longest_ms = min(max([bench.device.number(pdo, 5) for pdo in pdos.values()], default=0), _LONGEST_EVENT_MS)
    bench.pass_time(1.5e-3 * longest_ms + bench.times.silence_s)
    wrong = []
    for cob_id, pdo in pdos.items():
        heard[cob_id] |= {len(frame.data) for frame in bench.taken(cob_id)}
        mapped = -(-sum(word & 0xFF for word in bench.device.mapping(pdo)) // 8)
        if mapped and (others := sorted(heard[cob_id] - {mapped})):
            got = " and ".join(map(str, others))
            wrong.append(f"TPDO {cob_id:03X}h ({pdo:04X}h) has {got} bytes, its mapping {mapped}")
    bench.expect(not wrong, "; ".join(wrong))
    bench.require(any(heard.values()), "no TPDO is heard")
    if silent := [f"{cob_id:03X}h" for cob_id, lengths in heard.items() if not lengths]:
        bench.notes.append(f"not heard: TPDO {', '.join(silent)}")


def _ask_for_tpdos(bench: PdoBench, pdos: Mapping[int, int]) -> None:
    """Send as many SYNCs as the slowest cyclic type of the device needs, and remote requests where they are allowed."""
    overflow = bench.device.number(0x1019)
    kinds = [kind for pdo in pdos.values() if (kind := bench.device.number(pdo, 2)) <= MAX_SYNC_TYPE]
    starts = [bench.device.number(pdo, 6) for pdo in pdos.values()]
    if kinds and not bench.permits.surroundings.lacks("sync"):
        for number in range(max(kinds) + max(starts) + 1):
            bench.sync(number % overflow + 1 if overflow else None)
            bench.pass_time(_SYNC_PACE_S)
    bench.request_pdos(pdos)


@point(84, "mapped anew", MAPPING, "out of use, 0, entries, count, in use: all writes are accepted", needs="nmt")
def mapped_anew(bench: PdoBench) -> None:
    """The own mapping of a TPDO, in the order that the standard demands."""
    pdo = bench.idle_pdo(TPDOS, mapping=True)
    words = bench.device.mapping(pdo)
    bench.map_entries(pdo, words)
    bench.switch_on(pdo)
    if (found := [bench.number(pdo + TO_MAPPING, n) for n in range(1, len(words) + 1)]) != words:
        bench.deviates(f"the mapping is {found}, written was {words}")


@point(85, "what the EDS lets map", MAPPING, "a ro entry in a TPDO, a wo or rww entry in an RPDO", needs="nmt eds")
def mappable(bench: PdoBench) -> None:
    """One entry of each access that the EDS lets be mapped."""
    for area, accesses in ((TPDOS, ("ro", "rw", "rwr")), (RPDOS, ("wo", "rw", "rww"))):
        entries = {e.access: e for e in bench.device.entries() if e.mappable and e.is_integer and e.access in accesses}
        if not entries or (pdo := bench.find_pdo(area, mapping=True)) is None:
            continue
        bench.switch_off(pdo)
        for entry in entries.values():
            bench.map_entries(pdo, [word_of(entry)])
