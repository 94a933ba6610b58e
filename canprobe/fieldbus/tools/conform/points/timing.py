"""Points 100 to 103: how long things take, and work under load. The times go into the report as distributions."""

from __future__ import annotations

from itertools import pairwise

from canprobe.fieldbus.protocol.frame_bits import NS_PER_S
from canprobe.fieldbus.tools.conform.bench import HEARTBEAT_MS
from canprobe.fieldbus.tools.conform.pdo_bench import PdoBench
from canprobe.fieldbus.tools.conform.point import PointGroup
from canprobe.fieldbus.tools.conform.sdo_client import READ_TYPE

point = PointGroup("timing", "CiA 301")
SDO_TIME, SYNC_TIME, HEARTBEAT_TIME = "SDO answer", "SYNC to TPDO", "heartbeat period"
"""Names of the distributions."""
_SDO_COUNT, _SYNC_COUNT, _BEAT_COUNT = 100, 50, 20
_SYNC_PERIOD_S = 0.01
_BEAT_SHARE = 0.2
_LOAD_IDS = (0x06A, 0x06B)
"""Identifiers above the device's in the arbitration that belong to no service."""
_LOAD_GAP_BITS = 260
"""Time between two of them: one of eight bytes has about 130 bits, so that the load is a half."""
_LOADED_COUNT = 50


def _sdo_times(bench: PdoBench, count: int) -> tuple[float, ...]:
    """Times of reads of 1000h, ms. Raises Deviation where one is not answered or wrong."""
    times: list[float] = []
    for _ in range(count):
        bench.taken(bench.answer_id)
        t_ns = bench.send(bench.request_id, READ_TYPE)
        frame = bench.next(bench.answer_id, bench.times.sdo_s)
        if frame is None or frame.data != bench.first_answer:
            bench.deviates(f"read {len(times) + 1} of {count} of 1000h is not answered within {bench.times.sdo_s:g} s")
        times.append((frame.t_ns - t_ns) * 1e-6)
    return tuple(times)


@point(100, "SDO", "SDO time-out of the client", "each of 100 reads of 1000h is answered in time")
def sdo_time(bench: PdoBench) -> None:
    """Times of 100 reads, one after another."""
    bench.distributions[SDO_TIME] = _sdo_times(bench, _SDO_COUNT)


@point(101, "SYNC to TPDO", "synchronous TPDO", "one TPDO for each of 50 SYNCs, within 10 ms", needs="nmt sync stamps")
def sync_time(bench: PdoBench) -> None:
    """Times from SYNC to a TPDO of type 1, at 100 Hz."""
    cob_id = bench.synchronous_tpdo()
    bench.start()
    times = []
    for _ in range(_SYNC_COUNT):
        bench.taken(cob_id)
        t_ns = bench.sync()
        bench.pass_time(_SYNC_PERIOD_S)
        times += [(frame.t_ns - t_ns) * 1e-6 for frame in bench.taken(cob_id)[:1]]
    if len(times) < _SYNC_COUNT:
        bench.deviates(f"{_SYNC_COUNT} SYNCs bring {len(times)} TPDOs within {_SYNC_PERIOD_S * 1e3:.0f} ms")
    bench.distributions[SYNC_TIME] = tuple(times)


@point(102, "heartbeat", "1017h", "no period differs by more than 20 % from 1017h", needs="stamps")
def heartbeat_time(bench: PdoBench) -> None:
    """Twenty periods of 50 ms."""
    bench.need((0x1017, 0))
    bench.put(0x1017, 0, HEARTBEAT_MS)
    frames = bench.during((_BEAT_COUNT + 2) * 1e-3 * HEARTBEAT_MS, bench.beat_id)
    gaps = tuple((b.t_ns - a.t_ns) * 1e-6 for a, b in pairwise(frames[1:]))
    bench.distributions[HEARTBEAT_TIME] = gaps
    allowed_ms = _BEAT_SHARE * HEARTBEAT_MS + bench.times.slack_s * 1e3
    if not gaps or max(abs(gap - HEARTBEAT_MS) for gap in gaps) > allowed_ms:
        bench.deviates(
            f"heartbeat periods from {min(gaps, default=0):.1f} to {max(gaps, default=0):.1f} ms, 1017h is 50 ms"
        )


@point(103, "under load", "SDO, heartbeat", "reads are answered and heartbeats come under half load", needs="alone")
def under_load(bench: PdoBench) -> None:
    """Frames of higher priority take half the bus, while 1000h is read and the heartbeat runs."""
    bench.need((0x1017, 0))
    bench.put(0x1017, 0, HEARTBEAT_MS)
    bench.load = [(can_id, bytes(range(8))) for can_id in _LOAD_IDS], _LOAD_GAP_BITS * NS_PER_S // bench.bitrate
    began_ns = bench.now_ns
    beats = bench.during(4e-3 * HEARTBEAT_MS, bench.beat_id)
    bench.distributions[f"{SDO_TIME} under load"] = _sdo_times(bench, _LOADED_COUNT)
    bench.expect(len(beats) >= 3, f"{len(beats)} heartbeats in {(bench.now_ns - began_ns) * 1e-6:.0f} ms under load")
    bench.load = None
