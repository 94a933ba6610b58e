"""Points 39 to 41: SYNC. Source: CiA 301, "Synchronization object", objects 1005h, 1006h, 1019h."""

from __future__ import annotations

from canprobe.fieldbus.protocol.emcy import SYNC_LENGTH_CODE, SYNC_LOST_CODE
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.pdo_bench import PdoBench
from canprobe.fieldbus.tools.conform.point import PointGroup

point = PointGroup("sync", "CiA 301")
_PERIOD_US = 100_000
_RESERVED = (1, 241, 248, 255)


@point(39, "reserved overflow", "1019h", accepted.VALUE)
def reserved_overflow(bench: PdoBench) -> None:
    """1019h with 1 and with 241 to 255."""
    bench.need((0x1019, 0))
    if bench.device.number(0x1006):
        bench.put(0x1006, 0, 0)
    for value in _RESERVED:
        bench.must_refuse_write(0x1019, 0, bytes((value,)), accepted.VALUE, f"{value} for 1019h")


@point(39, "overflow while a period is set", "1019h", accepted.SYNC_LOCKED, needs="sync")
def overflow_while_period(bench: PdoBench) -> None:
    """1019h while 1006h is not 0, and again while it is."""
    bench.need((0x1019, 0), (0x1006, 0))
    bench.put(0x1006, 0, _PERIOD_US)
    value = bytes((10 if bench.device.number(0x1019) != 10 else 20,))
    bench.must_refuse_write(0x1019, 0, value, accepted.SYNC_LOCKED, "1019h while 1006h is not 0")
    bench.put(0x1006, 0, 0)
    bench.put(0x1019, 0, value[0])


@point(40, "wrong length", "SYNC; 8240h", "EMCY 8240h, and no TPDO", needs="nmt sync")
def wrong_length(bench: PdoBench) -> None:
    """A SYNC with a byte while 1019h is 0; a right one ends the error."""
    cob_id = bench.synchronous_tpdo()
    bench.start()
    bench.syncs(cob_id, [None])
    bench.expect(bench.syncs(cob_id, [1]) == [0], "a SYNC with a byte too many brings a TPDO")
    bench.emcy(SYNC_LENGTH_CODE)
    bench.syncs(cob_id, [None])


@point(41, "lost SYNC", "1006h", "in time no EMCY; 8100h after the period, if at all", needs="nmt sync")
def lost_sync(bench: PdoBench) -> None:
    """1006h is 100 ms: SYNCs in time, then none. A device may watch from a SYNC on that came long before."""
    bench.need((0x1006, 0))
    bench.plain_sync()
    bench.put(0x1006, 0, _PERIOD_US)
    bench.start()
    for _ in range(2):
        bench.sync_and_wait()
    bench.asked.add(SYNC_LOST_CODE)
    bench.emergencies.clear()
    for _ in range(5):
        last_ns = bench.sync()
        bench.pass_time(_PERIOD_US * 1e-6)
    bench.expect(not bench.errors(), "EMCY although SYNC comes in its period")
    t_ns = bench.optional_emcy(SYNC_LOST_CODE, 3e-6 * _PERIOD_US)
    if (t_ns - last_ns) * 1e-3 < 1.1 * _PERIOD_US:
        bench.deviates(f"EMCY 8100h {(t_ns - last_ns) * 1e-6:.0f} ms after a SYNC, the period is 100 ms")
    bench.sync_and_wait()
