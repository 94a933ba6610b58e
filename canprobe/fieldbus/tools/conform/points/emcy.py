"""Points 42, 43 and 47: EMCY. Source: CiA 301, "Emergency object", objects 1001h, 1003h, 1014h, 1015h.

The error that is provoked is a SYNC of the wrong length (8240h), which a right SYNC ends: it changes nothing else.
"""

from __future__ import annotations

from canprobe.fieldbus.protocol.emcy import SYNC_LENGTH_CODE, Emcy, is_no_error
from canprobe.fieldbus.protocol.frames import EMCY_BASE
from canprobe.fieldbus.protocol.sdo import pack_read
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.outcome import Deviation, PointNotApplicable
from canprobe.fieldbus.tools.conform.pdo_bench import PdoBench
from canprobe.fieldbus.tools.conform.point import PointGroup

point = PointGroup("emcy", "CiA 301")
_INHIBIT_MS = 200
_GENERIC, _COMMUNICATION = 0x01, 0x10


def _provoke(bench: PdoBench) -> tuple[Emcy, int]:
    """Provoke 8240h; return it and when it came."""
    bench.plain_sync()
    bench.start()
    bench.sync_and_wait()
    bench.sync(1)
    try:
        return bench.emcy(SYNC_LENGTH_CODE, 1.5e-3 * _INHIBIT_MS)
    except Deviation as error:
        raise PointNotApplicable("no EMCY could be provoked: a SYNC of the wrong length brings none") from error


@point(42, "history", "1003h", "the newest error first: its code in the low 16 bits", needs="nmt sync")
def history(bench: PdoBench) -> None:
    """The count and the first entry after an error."""
    bench.need((0x1003, 0), written=False)
    before = bench.number(0x1003)
    _provoke(bench)
    count, newest = bench.number(0x1003), bench.number(0x1003, 1)
    bench.sync_and_wait()
    bench.expect(count and count in (before, before + 1), f"1003h:00 is {count} after an error, it was {before}")
    bench.expect(newest & 0xFFFF == SYNC_LENGTH_CODE, f"1003h:01 is {newest:08X}h after EMCY 8240h")


@point(42, "write to the history", "1003h", accepted.VALUE)
def write_to_history(bench: PdoBench) -> None:
    """1003h:00 takes nothing but 0."""
    bench.need((0x1003, 0))
    bench.must_refuse_write(0x1003, 0, b"\1", (*accepted.VALUE, *accepted.READ_ONLY), "1 for 1003h:00")


@point(42, "empty entry", "1003h", accepted.text(accepted.NO_DATA) + ", or 06090011h")
def empty_entry(bench: PdoBench) -> None:
    """The entry behind the last error."""
    bench.need((0x1003, 0), written=False)
    beyond = bench.number(0x1003) + 1
    codes = (*accepted.NO_DATA, *accepted.NO_SUBINDEX)
    bench.must_refuse(pack_read(0x1003, beyond), codes, f"read of 1003h:{beyond:02X}, which is empty")


@point(42, "clearing the history", "1003h", "0 to 1003h:00 empties it")
def clear_history(bench: PdoBench) -> None:
    """Where the user permits it."""
    bench.need((0x1003, 0))
    bench.put(0x1003, 0, 0)
    if count := bench.number(0x1003):
        bench.deviates(f"1003h:00 is {count} after 0 was written")


@point(43, "identifier", "1014h", "080h+id by default, and the one of the messages", needs="nmt sync")
def identifier(bench: PdoBench) -> None:
    """1014h names the identifier on which an error comes."""
    bench.need((0x1014, 0), written=False)
    value = bench.number(0x1014)
    if value & 0x7FF != 0x80 + bench.node_id:
        bench.notes.append(f"1014h is {value:08X}h, the default is {0x80 + bench.node_id:08X}h")
    bench.require(not value >> 31, "bit 31 of 1014h says that there is no EMCY")
    others = [can_id for can_id in range(EMCY_BASE + 1, EMCY_BASE + 128) if can_id != bench.emcy_id]
    for can_id in others:
        bench.taken(can_id)
    try:
        _provoke(bench)
    except PointNotApplicable:
        code = SYNC_LENGTH_CODE.to_bytes(2, "little")
        if any(frame.data[:2] == code for can_id in others for frame in bench.taken(can_id)):
            bench.deviates(f"EMCY comes under another identifier than 1014h, {bench.emcy_id:03X}h")
        raise
    bench.sync_and_wait()


@point(43, "inhibit time", "1015h", "no two messages within the inhibit time", needs="nmt sync")
def inhibit_time(bench: PdoBench) -> None:
    """An error and its end within 200 ms."""
    bench.need((0x1015, 0))
    bench.put(0x1015, 0, _INHIBIT_MS * 10)
    _, first_ns = _provoke(bench)
    bench.emergencies.clear()
    bench.sync()
    bench.pass_time(3e-3 * _INHIBIT_MS)  # the end comes after one inhibit time, which runs once more
    times = [t_ns for emcy, t_ns in bench.emergencies if is_no_error(emcy.code)]
    if times and (times[0] - first_ns) * 1e-6 < 0.9 * _INHIBIT_MS:
        bench.deviates(f"two EMCY messages within {(times[0] - first_ns) * 1e-6:.0f} ms, 1015h is {_INHIBIT_MS} ms")


@point(
    47,
    "error register",
    "1001h",
    "bits 0 and 4 with 8240h, at least one of them; as the EMCY says; as before after its end",
    needs="nmt sync",
)
def error_register(bench: PdoBench) -> None:
    """1001h before, during and after an error."""
    before = bench.number(0x1001)
    emcy, _ = _provoke(bench)
    during = bench.number(0x1001)
    bench.expect(emcy.register == during, f"EMCY 8240h says {emcy.register:02X}h, 1001h is {during:02X}h")
    if not during & (_GENERIC | _COMMUNICATION):
        bench.deviates(f"1001h is {during:02X}h during a communication error, expected bits 0 and 4")
    if not during & _GENERIC:
        bench.notes.append(f"1001h is {during:02X}h during an error: bit 0 is for any error")
    bench.emergencies.clear()
    bench.sync_and_wait()
    ended = any(is_no_error(emcy.code) for emcy, _ in bench.emergencies)
    if ended and (after := bench.number(0x1001)) != before:
        bench.deviates(f"1001h is {after:02X}h after the end of the error, it was {before:02X}h")
