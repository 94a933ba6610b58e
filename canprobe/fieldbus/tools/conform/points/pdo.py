"""Points 30 to 37: PDOs at work. Source: CiA 301, "Process data object"."""

from __future__ import annotations

from itertools import pairwise

from canprobe.fieldbus.eds.description import DescribedEntry
from canprobe.fieldbus.protocol.emcy import PDO_TOO_LONG_CODE, PDO_TOO_SHORT_CODE, RPDO_TIMEOUT_CODE
from canprobe.fieldbus.protocol.pdo import NO_RTR_FLAG, TPDOS
from canprobe.fieldbus.tools.conform.pdo_bench import EVENT_TYPE, PdoBench, word_of
from canprobe.fieldbus.tools.conform.point import PointGroup

point = PointGroup("pdo", "CiA 301")
TRANSMISSION = "PDO transmission types"
_EVENT_MS, _INHIBIT_MS, _WATCHED_MS = 50, 100, 200
_WINDOW_US = 100_000
_SHARE = 0.1
_NO_EVENT = "a value that is written over SDO is no event for this device, which CiA 301 leaves open"


def _event_tpdo(bench: PdoBench, kind: int) -> tuple[DescribedEntry, int]:
    """A started TPDO of an entry that the user lets be written; return the entry and the identifier."""
    entry, pdo = bench.permitted_entry(transmits=True), bench.idle_pdo(TPDOS, mapping=True)
    bench.plain_sync()
    bench.map_entries(pdo, [word_of(entry)])
    cob_id = bench.put_to_work(pdo, kind)
    bench.start()
    return entry, cob_id


@point(30, "type 1", TRANSMISSION, "one TPDO a SYNC, as long as its mapping", needs="nmt sync")
def type_1(bench: PdoBench) -> None:
    """Five SYNCs bring five TPDOs."""
    cob_id = bench.synchronous_tpdo()
    pdo = bench.changeable_pdo(TPDOS)
    bench.start()
    if (found := bench.syncs(cob_id, [None] * 5)) != [1] * 5:
        bench.deviates(f"five SYNCs bring {found} TPDOs, expected one each")
    bench.sync()
    frame = bench.next(cob_id, bench.times.slack_s)
    length = -(-sum(word & 0xFF for word in bench.device.mapping(pdo)) // 8)
    if frame is None or len(frame.data) != length:
        bench.deviates(f"the TPDO has {len(frame.data) if frame else 0} bytes, its mapping {length}")


@point(30, "type n", TRANSMISSION, "one TPDO at every n-th SYNC", needs="nmt sync")
def type_n(bench: PdoBench) -> None:
    """Type 3, nine SYNCs."""
    cob_id = bench.synchronous_tpdo(every=3)
    bench.start()
    found = bench.syncs(cob_id, [None] * 9)
    bench.expect(sum(found) == 3 and found == found[:3] * 3, f"with type 3 nine SYNCs bring {found} TPDOs")


@point(30, "type 0", TRANSMISSION, "after an event one TPDO, at the next SYNC", needs="nmt sync eds")
def type_0(bench: PdoBench) -> None:
    """An entry that the user lets be written changes between SYNCs."""
    entry, cob_id = _event_tpdo(bench, 0)
    bench.syncs(cob_id, [None])
    quiet = bench.syncs(cob_id, [None, None])
    bench.put(*entry.place, bench.number(*entry.place) ^ 1)
    bench.require((found := quiet + bench.syncs(cob_id, [None, None])) != [0, 0, 0, 0], _NO_EVENT)
    bench.expect(found == [0, 0, 1, 0], f"two SYNCs, an event and two SYNCs bring {found} TPDOs, expected [0, 0, 1, 0]")


@point(30, "type 255", TRANSMISSION, "an event brings a TPDO at once, SYNC brings none", needs="nmt sync eds")
def type_255(bench: PdoBench) -> None:
    """An entry that the user lets be written changes; then a SYNC."""
    entry, cob_id = _event_tpdo(bench, EVENT_TYPE)
    bench.taken(cob_id)
    bench.put(*entry.place, bench.number(*entry.place) ^ 1)
    at_once = bench.next(cob_id, bench.times.slack_s)
    bench.expect(bench.syncs(cob_id, [None]) == [0], "SYNC brings a TPDO of type 255")
    bench.require(at_once is not None, _NO_EVENT)


@point(30, "remote request", TRANSMISSION, "type 253 answers a remote request, and no SYNC", needs="nmt")
def remote_request(bench: PdoBench) -> None:
    """A remote request for a TPDO whose bit 30 permits it."""
    pdo = bench.changeable_pdo(TPDOS)
    bench.require(not bench.device.number(pdo, 1) & NO_RTR_FLAG, "bit 30 of the COB-ID permits no remote request")
    bench.switch_off(pdo)
    cob_id = bench.put_to_work(pdo, 253)
    bench.start()
    bench.taken(cob_id)
    bench.request_pdos({cob_id: pdo})
    if bench.next(cob_id, bench.times.slack_s) is None:
        bench.deviates("a remote request for a TPDO of type 253 is not answered")


def _event_driven(bench: PdoBench, event_ms: int, inhibit: int = 0) -> list[int]:
    """A TPDO of type 255 with its times; return when it came in half a second."""
    cob_id = bench.put_to_work(bench.idle_pdo(TPDOS), EVENT_TYPE, inhibit=inhibit, event_ms=event_ms)
    bench.start()
    return [frame.t_ns for frame in bench.during(0.5, cob_id)]


@point(31, "event timer", "18xxh:05", "the TPDO repeats within 10 % of its event time", needs="nmt")
def event_timer(bench: PdoBench) -> None:
    """50 ms, for half a second: an event may bring more frames, none less."""
    times = _event_driven(bench, _EVENT_MS)
    gaps = [(after - before) * 1e-6 for before, after in pairwise(times)]
    if not gaps or max(gaps) > (1 + _SHARE) * _EVENT_MS + bench.times.slack_s * 1e3:
        longest = f", the longest gap is {max(gaps):.0f} ms" if gaps else ""
        bench.deviates(f"{len(times)} TPDOs in 0.5 s with an event time of {_EVENT_MS} ms{longest}")


@point(31, "inhibit time", "18xxh:03", "no two TPDOs within the inhibit time", needs="nmt")
def inhibit_time(bench: PdoBench) -> None:
    """An event time of 20 ms within an inhibit time of 100 ms."""
    times = _event_driven(bench, 20, inhibit=_INHIBIT_MS * 10)
    gaps = [(after - before) * 1e-6 for before, after in pairwise(times)]
    if gaps and min(gaps) < (1 - _SHARE) * _INHIBIT_MS:
        bench.deviates(f"two TPDOs within {min(gaps):.0f} ms, the inhibit time is {_INHIBIT_MS} ms")
    bench.expect(gaps, "no TPDOs come with an event time of 20 ms")


@point(32, "synchronous RPDO", "synchronous RPDO", "applied at the next SYNC, not before", needs="nmt sync eds")
def synchronous_rpdo(bench: PdoBench) -> None:
    """An entry that the user lets be written, by an RPDO of type 1."""
    entry = bench.permitted_entry(transmits=False)
    bench.plain_sync()
    cob_id, before = bench.rpdo_of(entry, 1)
    _send_value(bench, cob_id, before ^ 1, entry.bits)
    bench.expect(bench.number(*entry.place) == before, "a synchronous RPDO is applied before SYNC")
    bench.sync_and_wait()
    bench.expect(bench.number(*entry.place) == before ^ 1, "a synchronous RPDO is not applied at SYNC")


def _send_value(bench: PdoBench, cob_id: int, value: int, bits: int) -> None:
    """Send an RPDO with a value, and let the device take it."""
    bench.send(cob_id, value.to_bytes(bits // 8, "little"))
    bench.pass_time(0.005)


@point(33, "short RPDO", "RPDO length", "EMCY 8210h", needs="nmt")
def short_rpdo(bench: PdoBench) -> None:
    """A dummy RPDO without a byte; a whole one ends the error."""
    _, cob_id, length = bench.rpdo_of_dummies()
    bench.start()
    bench.send(cob_id, bytes(length))
    bench.pass_time(bench.times.slack_s)
    bench.expect(not bench.errors(), "EMCY after an RPDO of the right length")
    bench.send(cob_id, bytes(length - 1))
    bench.emcy(PDO_TOO_SHORT_CODE)
    bench.send(cob_id, bytes(length))
    bench.pass_time(bench.times.slack_s)


@point(33, "short RPDO applied", "RPDO length", "a short RPDO is not applied", needs="nmt eds")
def short_rpdo_applied(bench: PdoBench) -> None:
    """An entry that the user lets be written keeps its value."""
    entry = bench.permitted_entry(transmits=False)
    bench.require(entry.bits >= 16, "the entry has one byte only")
    cob_id, before = bench.rpdo_of(entry, EVENT_TYPE)
    bench.asked.add(PDO_TOO_SHORT_CODE)
    bench.send(cob_id, bytes((before & 0xFF ^ 1,)))
    bench.pass_time(bench.times.slack_s)
    bench.expect(bench.number(*entry.place) == before, "a short RPDO is applied")
    _send_value(bench, cob_id, before, entry.bits)


@point(34, "long RPDO", "RPDO length", "its first bytes are used; EMCY 8220h is optional", needs="nmt eds")
def long_rpdo(bench: PdoBench) -> None:
    """An entry that the user lets be written, by an RPDO with a byte too many."""
    entry = bench.permitted_entry(transmits=False)
    bench.require(entry.bits < 64, "the entry fills a whole frame")
    cob_id, before = bench.rpdo_of(entry, EVENT_TYPE)
    bench.asked.add(PDO_TOO_LONG_CODE)
    _send_value(bench, cob_id, before ^ 1, entry.bits + 8)
    bench.expect(bench.number(*entry.place) == before ^ 1, "the first bytes of a long RPDO are not used")
    _send_value(bench, cob_id, before, entry.bits)


@point(35, "RPDO event timer", "14xxh:05", "EMCY 8250h after the time, not before the first RPDO", needs="nmt")
def rpdo_event_timer(bench: PdoBench) -> None:
    """A dummy RPDO with 200 ms, sent twice and then no more."""
    pdo, cob_id, length = bench.rpdo_of_dummies()
    bench.need((pdo, 5))
    bench.switch_off(pdo)
    bench.put_to_work(pdo, EVENT_TYPE, event_ms=_WATCHED_MS)
    bench.start()
    bench.pass_time(1.5e-3 * _WATCHED_MS)
    for _ in range(2):
        last_ns = bench.send(cob_id, bytes(length))
        bench.pass_time(0.5e-3 * _WATCHED_MS)
    bench.expect(not bench.errors(), "EMCY before the first RPDO, or while they come in time")
    t_ns = bench.optional_emcy(RPDO_TIMEOUT_CODE, 1e-3 * _WATCHED_MS)
    if (t_ns - last_ns) * 1e-6 < (1 - _SHARE) * _WATCHED_MS:
        bench.deviates(f"EMCY 8250h {(t_ns - last_ns) * 1e-6:.0f} ms after the last RPDO, the time is {_WATCHED_MS} ms")
    bench.send(cob_id, bytes(length))
    bench.pass_time(bench.times.slack_s)


@point(
    36,
    "synchronous window",
    "1007h",
    "an RPDO within the window is applied; one behind may be dropped",
    needs="nmt sync eds",
)
def synchronous_window(bench: PdoBench) -> None:
    """An RPDO within 100 ms of a SYNC, and one behind."""
    entry = bench.permitted_entry(transmits=False)
    bench.need((0x1007, 0))
    bench.plain_sync()
    bench.put(0x1007, 0, _WINDOW_US)
    cob_id, before = bench.rpdo_of(entry, 1)
    seen = []
    for wait_s in (0.0, 1.5e-6 * _WINDOW_US):
        bench.sync()
        bench.pass_time(wait_s)
        _send_value(bench, cob_id, before ^ (2 if wait_s else 1), entry.bits)
        bench.sync_and_wait()
        seen.append(bench.number(*entry.place) ^ before)
    bench.expect(seen[0] == 1, "an RPDO within the window is not applied at the next SYNC")
    if seen[1] != 1:
        bench.notes.append("an RPDO behind the window is applied; it may be dropped")


@point(37, "SYNC start value", "18xxh:06", "the first TPDO at the SYNC with this counter", needs="nmt sync")
def sync_start_value(bench: PdoBench) -> None:
    """Type 2 with start value 3, SYNC counters 1 to 8 with overflow 10."""
    bench.need((0x1019, 0), (bench.changeable_pdo(TPDOS), 6))
    if bench.device.number(0x1006):
        bench.put(0x1006, 0, 0)
    bench.put(0x1019, 0, 10)
    cob_id = bench.synchronous_tpdo(every=2, start=3)
    bench.start()
    found = bench.syncs(cob_id, list(range(1, 9)))
    if found != [0, 0, 1, 0, 1, 0, 1, 0]:
        bench.deviates(f"SYNCs 1 to 8 bring {found} TPDOs; type 2 from 3 on is [0, 0, 1, 0, 1, 0, 1, 0]")
