"""Points 10 to 17: expedited SDO and its abort codes. Source: CiA 301, "SDO abort codes"."""

from __future__ import annotations

from collections.abc import Iterator

from canprobe.fieldbus.eds.description import DescribedEntry
from canprobe.fieldbus.protocol.sdo import pack_read, pack_request, place_text
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.permits import MOTION_OBJECTS, WriteRule, is_object, rule_of
from canprobe.fieldbus.tools.conform.point import PointGroup
from canprobe.fieldbus.tools.conform.sdo_client import READ_TYPE

point = PointGroup("sdo", "CiA 301")
CODES = "SDO abort codes"
_ABSENT = (0x1FF0, 0x5FFE, 0x9FFE)
"""Indices that hardly any device has, in three areas; they are read only."""


@point(10, "write ro", CODES, accepted.READ_ONLY)
def write_read_only(bench: Bench) -> None:
    """1000h gets its own value."""
    bench.need((0x1000, 0), written=False)
    bench.must_refuse_write(0x1000, 0, bench.device.values[0x1000, 0], accepted.READ_ONLY, "write to 1000h")


@point(11, "read wo", CODES, accepted.WRITE_ONLY, needs="eds")
def read_write_only(bench: Bench) -> None:
    """Every entry that the EDS describes as wo."""
    entries = [entry for entry in bench.device.entries() if not entry.readable]
    bench.require(entries, "the EDS describes no entry as wo")
    for entry in entries:
        bench.must_refuse(pack_read(*entry.place), accepted.WRITE_ONLY, f"read of {place_text(*entry.place)}")


@point(12, "absent object", CODES, accepted.NO_OBJECT)
def absent_object(bench: Bench) -> None:
    """Reads of indices that the device does not have."""
    for index in _ABSENT:
        if bench.device.described(index) is None:
            bench.must_refuse(pack_read(index), accepted.NO_OBJECT, f"read of {index:04X}h")


@point(13, "absent sub-index", CODES, accepted.NO_SUBINDEX)
def absent_subindex(bench: Bench) -> None:
    """1018h beyond its highest sub-index: a read, and a write of zeros."""
    bench.need((0x1018, 0), written=False)
    beyond = bench.device.number(0x1018) + 1
    bench.must_refuse(pack_read(0x1018, beyond), accepted.NO_SUBINDEX, f"read of 1018h:{beyond:02X}")
    bench.must_refuse_write(0x1018, beyond, bytes(4), accepted.NO_SUBINDEX, f"write to 1018h:{beyond:02X}")


@point(14, "unknown command", CODES, accepted.UNKNOWN_COMMAND)
def unknown_command(bench: Bench) -> None:
    """Command byte E0h."""
    bench.must_refuse(pack_request(0xE0, 0x1000, 0), accepted.UNKNOWN_COMMAND, "command E0h")


@point(15, "too long", CODES, accepted.TOO_LONG)
def too_long(bench: Bench) -> None:
    """1017h in four bytes."""
    bench.need((0x1017, 0))
    value = bench.device.values[0x1017, 0].ljust(4, b"\0")
    bench.must_refuse_write(0x1017, 0, value, accepted.TOO_LONG, "4 bytes for 1017h")


@point(16, "too short", CODES, accepted.TOO_SHORT)
def too_short(bench: Bench) -> None:
    """1017h in one byte."""
    bench.need((0x1017, 0))
    value = bench.device.values[0x1017, 0][:1]
    bench.must_refuse_write(0x1017, 0, value, accepted.TOO_SHORT, "1 byte for 1017h")


def _limited(bench: Bench) -> Iterator[tuple[DescribedEntry, int, bool]]:
    """Entries that may be written, with a value beyond a limit of the EDS and whether it is above."""
    for entry in bench.device.entries():
        permitted = rule_of(entry.index) is WriteRule.CHANGED or bench.permits.written.permits(entry.place)
        permitted = permitted and not is_object(entry.index, *MOTION_OBJECTS)
        if not (permitted and entry.writable and entry.is_integer and bench.device.has(*entry.place)):
            continue
        least = -(1 << entry.bits - 1) if entry.signed else 0
        for limit, beyond, above in ((entry.high, 1, True), (entry.low, -1, False)):
            if limit is not None and least <= (value := int(limit) + beyond) < least + (1 << entry.bits):
                yield entry, value, above


@point(17, "limits", CODES, "above 06090031h, below 06090032h, or 06090030h", needs="eds")
def limits(bench: Bench) -> None:
    """A value beyond each limit that the EDS states, for entries that may be written."""
    limited = [*_limited(bench)]
    bench.require(limited, "no entry that may be written has a limit; --write names more")
    for entry, value, above in limited:
        codes, what = accepted.ABOVE if above else accepted.BELOW, f"{value} for {place_text(*entry.place)}"
        bench.must_refuse_write(*entry.place, bench.packed(*entry.place, value), codes, what)


@point(75, "default channel", "1200h", "1200h:01 is 600h+id, 1200h:02 is 580h+id")
def default_channel(bench: Bench) -> None:
    """The identifiers of the default SDO server."""
    bench.need((0x1200, 1), (0x1200, 2), written=False)
    for subindex, base in ((1, 0x600), (2, 0x580)):
        if (found := bench.number(0x1200, subindex)) != base + bench.node_id:
            bench.deviates(f"1200h:{subindex:02X} is {found:08X}h, expected {base + bench.node_id:08X}h")


@point(76, "further channels", "1201h to 127Fh", accepted.NO_OBJECT, needs="eds")
def further_channels(bench: Bench) -> None:
    """Channels that the EDS does not describe are not there."""
    for index in (0x1201, 0x1202, 0x1240, 0x127F):
        if bench.device.described(index) is None and bench.device.described(index, 1) is None:
            bench.must_refuse(pack_read(index), accepted.NO_OBJECT, f"read of {index:04X}h")


@point(24, "two channels", "1200h to 127Fh", "transfers on two channels do not disturb each other")
def two_channels(bench: Bench) -> None:
    """A segmented upload on the default channel, and an expedited one on 1201h within it."""
    bench.need((0x1201, 1), (0x1201, 2), written=False)
    request_id, answer_id = bench.number(0x1201, 1), bench.number(0x1201, 2)
    bench.require(not (request_id | answer_id) >> 11, "channel 1201h is not in use")
    name = bench.device.values.get((0x1008, 0), b"")
    answer = bench.request(0x40, 0x1008)
    bench.send(request_id, READ_TYPE)
    frame = bench.next(answer_id, bench.times.sdo_s)
    bench.expect(frame and frame.data == bench.first_answer, "no answer with 1000h on the channel of 1201h")
    segment = b"" if answer[0] & 2 else bench.ask(bytes((0x60,)) + bytes(7))[1:8]
    if segment and segment != name[:7].ljust(7, b"\0"):
        bench.deviates("a segment of 1008h is wrong after a transfer on the other channel")
    bench.abort(0x1008)
