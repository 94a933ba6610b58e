"""What was on the bus against what was planned: counts, bits and times of every message, and what nobody planned.

Counted from the first SYNC to the last one, while the cell runs: bring-up and the way out have no rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

from canprobe.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, SYNC_OVERFLOW, Plan
from canprobe.planning.pdos import TACTILE_TPDO1
from canprobe.planning.traffic import on_the_wire
from canprobe.protocol.frame_bits import best_case_bits, exact_bits, worst_case_bits
from canprobe.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, NMT_ID, SDO_RX_BASE, SDO_TX_BASE, SYNC_ID

Kind = Literal["SYNC", "drive TPDO", "drive RPDO", "tactile PDO", "heartbeat", "NMT", "EMCY", "SDO"]
_UNSTUFFED = [best_case_bits(n) for n in range(9)]
TOLERANCE = 0.02
"""Share by which a count may differ from the plan; a frame of each message may always be missing at the edges."""


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


def expected_messages(plan: Plan) -> dict[int, Expected]:
    """Every message that the plan lists, by identifier."""
    sync_bytes = 1 if SYNC_OVERFLOW else 0
    shortest_ns = best_case_bits(sync_bytes) * 1_000_000_000 // plan.scene.bus.bitrate
    found = [Expected(SYNC_ID, "SYNC", plan.sync.rate_hz, worst_case_bits(sync_bytes)), Expected(NMT_ID, "NMT")]
    for pdo in on_the_wire(plan.pdos):
        kind: Kind = "drive RPDO" if pdo.direction == "rpdo" else "drive TPDO"
        triggered = pdo.response_ns is not None and pdo.transmission_type <= 240
        latest = pdo.response_ns - shortest_ns if triggered and pdo.response_ns is not None else None
        tactile = pdo.direction == "tpdo" and pdo.cob_id >= TACTILE_TPDO1
        found.append(Expected(pdo.cob_id, "tactile PDO" if tactile else kind, pdo.rate_hz, pdo.bits_worst, latest))
    beat = 1000 / HEARTBEAT_PRODUCED_MS
    for node in (*plan.node_ids, MASTER_NODE_ID):
        found.append(Expected(HEARTBEAT_BASE + node, "heartbeat", beat, worst_case_bits(1)))
    for node in plan.node_ids:
        found += [Expected(EMCY_BASE + node, "EMCY"), Expected(SDO_TX_BASE + node, "SDO")]
        found.append(Expected(SDO_RX_BASE + node, "SDO"))
    return {message.cob_id: message for message in found}


@dataclass(slots=True)
class ClassTraffic:
    """What was counted of one class of messages.

    Attributes:
        kind: the class.
        messages: identifiers in it.
        frames: counted.
        planned_frames: in the same time; None for services.
        bits: counted, exact where the meter measured them, else without stuff bits.
        planned_bits: in the same time at most; None for services.
        late: frames that came later behind their SYNC than the plan's worst case.
        slowest: the largest share of its worst case behind SYNC that a frame took; None where there is none.
    """

    kind: Kind
    messages: int = 0
    frames: int = 0
    planned_frames: float | None = None
    bits: int = 0
    planned_bits: float | None = None
    late: int = 0
    slowest: float | None = None

    @property
    def as_planned(self) -> bool:
        """The count is the plan's within its tolerance, and its bits are no more than the worst case."""
        if self.planned_frames is None or self.planned_bits is None:
            return True
        allowed = max(TOLERANCE * self.planned_frames, self.messages)
        return abs(self.frames - self.planned_frames) <= allowed and self.bits <= self.planned_bits


@dataclass(frozen=True, slots=True)
class MeasuredTraffic:
    """A bus as it was, beside its plan.

    Attributes:
        duration_s: from the first SYNC to the last one.
        bitrate: bit/s.
        exact: bits were counted with their stuff bits.
        classes: by kind.
        unlisted: identifiers that the plan does not list, with their counts; in the whole log.
        missing: planned PDOs that never came.
        error_frames: in the whole log.
        planned_worst: load of the plan.
    """

    duration_s: float
    bitrate: int
    exact: bool
    classes: tuple[ClassTraffic, ...]
    unlisted: dict[int, int]
    missing: tuple[int, ...]
    error_frames: int
    planned_worst: float

    @property
    def load(self) -> float:
        """Share of the bit rate that was used."""
        bits = sum(one.bits for one in self.classes)
        return bits / (self.bitrate * self.duration_s) if self.duration_s > 0 else 0.0

    @property
    def as_planned(self) -> bool:
        """Every class is, nothing is missing, and nothing else was on the bus."""
        return not self.unlisted and not self.missing and all(one.as_planned for one in self.classes)

    def as_dict(self) -> dict[str, Any]:
        """As JSON types."""
        return {
            "duration_s": self.duration_s,
            "as_planned": self.as_planned,
            "load": self.load,
            "planned_worst": self.planned_worst,
            "stuff_bits_counted": self.exact,
            "classes": {
                one.kind: {
                    "messages": one.messages,
                    "frames": one.frames,
                    "planned_frames": one.planned_frames,
                    "load": one.bits / (self.bitrate * self.duration_s) if self.duration_s > 0 else None,
                    "planned_worst": _load(one.planned_bits, self.bitrate, self.duration_s),
                    "late": one.late,
                    "slowest_share": one.slowest,
                    "as_planned": one.as_planned,
                }
                for one in self.classes
            },
            "unlisted": [{"cob_id": cob_id, "frames": frames} for cob_id, frames in sorted(self.unlisted.items())],
            "missing": list(self.missing),
            "error_frames": self.error_frames,
        }

    def text(self) -> str:
        """For people."""
        return "\n".join(self._lines()) + "\n"

    def _lines(self) -> Iterator[str]:
        yield f"measured in {self.duration_s:.2f} s, from the first SYNC to the last:"
        yield f"  load {100 * self.load:.1f} %, planned at most {100 * self.planned_worst:.1f} %"
        yield f"  {'':<12} {'frames':>8} {'planned':>9} {'load %':>7} {'at most':>8}  latest of its worst case"
        for one in self.classes:
            load = _load(one.bits, self.bitrate, self.duration_s)
            worst = _load(one.planned_bits, self.bitrate, self.duration_s)
            planned = "" if one.planned_frames is None else f"{one.planned_frames:.0f}"
            slowest = "" if one.slowest is None else f"{100 * one.slowest:.0f} %"
            note = "" if one.as_planned else "  not as planned"
            yield (
                f"  {one.kind:<12} {one.frames:>8} {planned:>9} {_percent(load):>7} {_percent(worst):>8}"
                f"  {slowest}{note}"
            ).rstrip()
        for cob_id, frames in sorted(self.unlisted.items()):
            yield f"  not in the plan: {cob_id:03X}h, {frames} frames"
        for cob_id in self.missing:
            yield f"  never came: {cob_id:03X}h"
        if self.error_frames:
            yield f"  error frames: {self.error_frames}"


def _load(bits: float | None, bitrate: int, duration_s: float) -> float | None:
    return None if bits is None or duration_s <= 0 else bits / (bitrate * duration_s)


def _percent(share: float | None) -> str:
    return "" if share is None else f"{100 * share:.1f}"


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
        exact: count stuff bits too, which costs a few µs a frame.
        error_frames: to be counted by the reader.
    """

    plan: Plan
    exact: bool = True
    error_frames: int = 0
    _expected: dict[int, Expected] = field(init=False)
    _counts: dict[int, _Count] = field(init=False, default_factory=dict)
    _before: dict[int, _Count] = field(init=False, default_factory=dict)
    _cycle: list[tuple[int, bytes, int]] = field(init=False, default_factory=list)
    _first_ns: int | None = field(init=False, default=None)
    _sync_ns: int = field(init=False, default=0)
    _by_counter: dict[int, int] = field(init=False, default_factory=dict)
    _header_id: int | None = field(init=False, default=None)
    _tactile_ns: int | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self._expected = expected_messages(self.plan)
        self._header_id = min((e.cob_id for e in self._expected.values() if e.kind == "tactile PDO"), default=None)

    def write(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take one frame; it is counted with the next SYNC."""
        if can_id == SYNC_ID:
            self._count()
            self._sync_ns = t_ns
            if self._first_ns is None:
                self._first_ns = t_ns
                self._before, self._counts = self._counts, {}
            self._by_counter[data[0] if data else 0] = t_ns
        self._cycle.append((can_id, data, t_ns))

    def report(self) -> MeasuredTraffic:
        """What was counted so far, beside the plan."""
        counts = self._counts if self._first_ns is not None else {}
        ns = 0 if self._first_ns is None else self._sync_ns - self._first_ns
        seen = Counter(can_id for can_id, _, _ in self._cycle)
        for part in (self._before, self._counts):
            seen.update({can_id: one.frames for can_id, one in part.items()})
        return MeasuredTraffic(
            duration_s=ns * 1e-9,
            bitrate=self.plan.scene.bus.bitrate,
            exact=self.exact,
            classes=tuple(self._classes(counts, ns * 1e-9)),
            unlisted={can_id: n for can_id, n in seen.items() if can_id not in self._expected},
            missing=tuple(
                one.cob_id
                for one in self._expected.values()
                if one.kind in ("drive TPDO", "drive RPDO", "tactile PDO") and one.cob_id not in seen
            ),
            error_frames=self.error_frames,
            planned_worst=self.plan.traffic.load,
        )

    def _count(self) -> None:
        """Count the frames since the last SYNC."""
        counts = self._counts
        for can_id, data, t_ns in self._cycle:
            count = counts.get(can_id)
            if count is None:
                count = counts[can_id] = _Count()
            count.frames += 1
            count.bits += exact_bits(can_id, data) if self.exact else _UNSTUFFED[len(data)]
            expected = self._expected.get(can_id)
            if expected is None or expected.latest_ns is None:
                continue
            trigger = self._trigger(expected, data)
            if trigger is not None:
                took = t_ns - trigger
                count.slowest_ns = max(count.slowest_ns, took)
                count.late += took > expected.latest_ns
        self._cycle.clear()

    def _trigger(self, expected: Expected, data: bytes) -> int | None:
        """When the SYNC behind a frame was through: the last one, or the one that a tactile header names."""
        if expected.kind != "tactile PDO":
            return self._sync_ns
        if expected.cob_id == self._header_id:
            self._tactile_ns = self._by_counter.get(data[1]) if len(data) == 8 else None
        return self._tactile_ns

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
