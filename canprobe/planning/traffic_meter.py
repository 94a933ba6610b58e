"""Counts what is on a bus, frame by frame, for `canprobe.planning.measured`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from canprobe.planning.measured import ClassTraffic, Kind, MeasuredTraffic
from canprobe.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, SYNC_OVERFLOW, Plan, PlannedBus, PlannedPdo
from canprobe.planning.traffic import SYNCHRONOUS, on_the_wire
from canprobe.planning.traffic_lateness import Lateness
from canprobe.planning.wire_bits import exact_frame_bits, unstuffed_frame_bits
from canprobe.protocol.frame_bits import FD_LENGTHS, best_case_bits, worst_case_bits
from canprobe.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, NMT_ID, SDO_RX_BASE, SDO_TX_BASE, SYNC_ID

_AT_ONCE = 4096
"""Frames that are counted together, which is quicker than cycle by cycle."""


@dataclass(frozen=True, slots=True)
class Expected:
    """One message of the plan.

    Attributes:
        cob_id: identifier.
        kind: its class.
        rate_hz: planned; None for a service that has no rate.
        bits_worst: of one frame; None where its length is open.
        latest_ns: worst case from the end of the SYNC's frame to the end of its own; None where it keeps its own time.
    """

    cob_id: int
    kind: Kind
    rate_hz: float | None = None
    bits_worst: int | None = None
    latest_ns: int | None = None


def expected_messages(plan: Plan, bus: PlannedBus) -> dict[int, Expected]:
    """Every message that the plan lists for one of its buses, by identifier."""
    sync_bytes = 1 if SYNC_OVERFLOW else 0
    shortest_ns = best_case_bits(sync_bytes) * 1_000_000_000 // plan.setup.bus.bitrate
    found = [Expected(SYNC_ID, "SYNC", plan.sync.rate_hz, worst_case_bits(sync_bytes)), Expected(NMT_ID, "NMT")]
    for pdo in on_the_wire([pdo for pdo in plan.pdos if pdo.node_id in bus.node_ids]):
        triggered = pdo.transmission_type <= SYNCHRONOUS
        latest = pdo.response_ns - shortest_ns if triggered and pdo.response_ns is not None else None
        found.append(Expected(pdo.cob_id, _kind(pdo), pdo.rate_hz, pdo.bits_worst, latest))
    beat = 1000 / HEARTBEAT_PRODUCED_MS
    for node in (*bus.node_ids, MASTER_NODE_ID):
        found.append(Expected(HEARTBEAT_BASE + node, "heartbeat", beat, worst_case_bits(1)))
    for node in bus.node_ids:
        found += [Expected(EMCY_BASE + node, "EMCY"), Expected(SDO_TX_BASE + node, "SDO")]
        found.append(Expected(SDO_RX_BASE + node, "SDO"))
    return {message.cob_id: message for message in found}


def _kind(pdo: PlannedPdo) -> Kind:
    if pdo.transmission_type > SYNCHRONOUS:
        return "event PDO"
    if pdo.kind == "tactile":
        return "tactile PDO"
    return "drive RPDO" if pdo.direction == "rpdo" else "drive TPDO"


@dataclass(slots=True)
class _Count:
    frames: int = 0
    bits: int = 0
    late: int = 0
    slowest_ns: int = 0


@dataclass(slots=True)
class TrafficMeter:
    """Counts frames in the order of the bus; `report` sets them beside the plan.

    Attributes:
        plan: what to expect.
        channel: of the bus, as the plan names it; None: its first one.
        exact: count stuff bits too, which costs a few µs a frame.
        error_frames: to be counted by the reader.
    """

    plan: Plan
    channel: str | None = None
    exact: bool = True
    error_frames: int = 0
    _bus: PlannedBus = field(init=False)
    _expected: dict[int, Expected] = field(init=False)
    _counts: dict[int, _Count] = field(init=False, default_factory=dict)
    _before: dict[int, _Count] = field(init=False, default_factory=dict)
    _taken: list[tuple[int, bytes, int]] = field(init=False, default_factory=list)
    _enough: int = field(init=False, default=_AT_ONCE)
    _first_ns: int | None = field(init=False, default=None)
    _sync_ns: int = field(init=False, default=0)
    _lateness: Lateness = field(init=False)
    _unstuffed: dict[int, int] = field(init=False)

    def __post_init__(self) -> None:
        buses = self.plan.buses
        self._bus = next((bus for bus in buses if bus.channel == self.channel), buses[0])
        self._expected = expected_messages(self.plan, self._bus)
        self._unstuffed = {n: unstuffed_frame_bits(n, self.plan.setup.bus) for n in FD_LENGTHS}
        tactile = frozenset(e.cob_id for e in self._expected.values() if e.kind == "tactile PDO")
        latest = {e.cob_id: e.latest_ns for e in self._expected.values() if e.latest_ns is not None}
        self._lateness = Lateness(latest, tactile, min(tactile, default=None))

    def write(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take one frame; it is counted after the next SYNC, with many others."""
        self._taken.append((can_id, data, t_ns))
        if len(self._taken) >= self._enough:
            self._count()
            self._enough = len(self._taken) + _AT_ONCE

    def _count(self) -> None:
        """Count what was taken up to the last SYNC; the frames since then wait."""
        taken = self._taken
        ids = [frame[0] for frame in taken]
        if SYNC_ID not in ids:
            return
        end = len(ids) - 1 - ids[::-1].index(SYNC_ID)
        begin = 0
        if self._first_ns is None:
            begin = ids.index(SYNC_ID)
            self._tally(taken[:begin], self._before)
            self._first_ns = taken[begin][2]
        self._sync_ns = taken[end][2]
        self._count_cycles(taken[begin:end])
        self._taken = taken[end:]

    def _count_cycles(self, frames: Sequence[tuple[int, bytes, int]]) -> None:
        """Count frames from one SYNC to before another, and how far behind theirs they were."""
        if not frames:
            return
        self._tally(frames, self._counts)
        for delay in self._lateness.take(*zip(*frames, strict=True)):
            count = self._counts[delay.cob_id]
            count.late += delay.late
            count.slowest_ns = max(count.slowest_ns, delay.slowest_ns)

    def _tally(self, frames: Sequence[tuple[int, bytes, int]], counts: dict[int, _Count]) -> None:
        """Add frames and their bits."""
        for (can_id, n_data), frames_of in Counter([(can_id, len(data)) for can_id, data, _ in frames]).items():
            count = counts.setdefault(can_id, _Count())
            count.frames += frames_of
            count.bits += 0 if self.exact else frames_of * self._unstuffed[n_data]
        if self.exact:
            bus = self.plan.setup.bus
            for can_id, data, _ in frames:
                counts[can_id].bits += exact_frame_bits(can_id, data, bus)

    @property
    def frames(self) -> int:
        """Frames so far, bring-up included."""
        return sum(one.frames for one in self._all_counts())

    @property
    def bits(self) -> int:
        """Their bits, counted as `exact` says."""
        return sum(one.bits for one in self._all_counts())

    def _all_counts(self) -> list[_Count]:
        self._count()
        waiting: dict[int, _Count] = {}
        self._tally(self._taken, waiting)
        return [*self._before.values(), *self._counts.values(), *waiting.values()]

    def report(self) -> MeasuredTraffic:
        """What was counted so far, beside the plan."""
        self._count()
        counts = self._counts if self._first_ns is not None else {}
        ns = 0 if self._first_ns is None else self._sync_ns - self._first_ns
        seen = Counter(can_id for can_id, _, _ in self._taken)
        for part in (self._before, self._counts):
            seen.update({can_id: one.frames for can_id, one in part.items()})
        return MeasuredTraffic(
            duration_s=ns * 1e-9,
            bitrate=self.plan.setup.bus.bitrate,
            exact=self.exact,
            classes=tuple(self._classes(counts, ns * 1e-9)),
            unlisted={can_id: n for can_id, n in seen.items() if can_id not in self._expected},
            missing=tuple(
                one.cob_id for one in self._expected.values() if one.kind.endswith("PDO") and one.cob_id not in seen
            ),
            error_frames=self.error_frames,
            planned_worst=self._bus.traffic.load,
        )

    def _classes(self, counts: dict[int, _Count], seconds: float) -> Iterator[ClassTraffic]:
        found: dict[Kind, ClassTraffic] = {}
        for expected in self._expected.values():
            one = found.setdefault(expected.kind, ClassTraffic(expected.kind))
            count = counts.get(expected.cob_id, _Count())
            one.messages += 1
            one.frames += count.frames
            one.bits += count.bits
            one.late += count.late
            if expected.rate_hz is not None and expected.bits_worst is not None:
                planned = expected.rate_hz * seconds
                one.planned_frames = (one.planned_frames or 0.0) + planned
                one.planned_bits = (one.planned_bits or 0.0) + planned * expected.bits_worst
            if expected.latest_ns and count.slowest_ns:
                one.slowest = max(one.slowest or 0.0, count.slowest_ns / expected.latest_ns)
        yield from found.values()
