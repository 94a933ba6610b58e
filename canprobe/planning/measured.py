"""What was on the bus against what was planned: counts, bits and times of every message, and what nobody planned.

Counted from the first SYNC to the last one, while the cell runs: bring-up and the way out have no rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from canprobe.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, SYNC_OVERFLOW, Plan, PlannedBus, PlannedPdo
from canprobe.planning.traffic import SYNCHRONOUS, exact_frame_bits, on_the_wire, unstuffed_frame_bits
from canprobe.protocol.frame_bits import FD_LENGTHS, best_case_bits, worst_case_bits
from canprobe.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, NMT_ID, SDO_RX_BASE, SDO_TX_BASE, SYNC_ID

Kind = Literal["SYNC", "drive TPDO", "drive RPDO", "tactile PDO", "event PDO", "heartbeat", "NMT", "EMCY", "SDO"]
TOLERANCE = 0.02
"""Share by which a count may differ from the plan; a frame of each message may always be missing at the edges."""


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
        """The count is the plan's within its tolerance, and its bits are no more than the worst case.

        What is sent on a change, too, is planned at its slowest rate: there may be more of it.
        """
        if self.planned_frames is None or self.planned_bits is None:
            return True
        allowed = max(TOLERANCE * self.planned_frames, self.messages)
        if self.kind == "event PDO":
            return self.frames >= self.planned_frames - allowed
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
        error_frames: bus errors in the whole log.
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
        """Every class is, nothing is missing, nothing else was on the bus, and no frame went wrong."""
        nothing_else = not self.unlisted and not self.missing and not self.error_frames
        return nothing_else and all(one.as_planned for one in self.classes)

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
        yield f"measured in {self.duration_s:.2f} s, from its first SYNC to its last:"
        yield f"  load {100 * self.load:.1f} %, planned at most {100 * self.planned_worst:.1f} %"
        yield f"  {'':<12} {'frames':>8} {'planned':>9} {'load %':>7} {'at most':>8}  latest of its worst case"
        for one in self.classes:
            load = _load(one.bits, self.bitrate, self.duration_s)
            worst = _load(one.planned_bits, self.bitrate, self.duration_s)
            least = "≥ " if one.kind == "event PDO" else ""
            planned = "" if one.planned_frames is None else f"{least}{one.planned_frames:.0f}"
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


# How far behind their SYNC the frames of a bus come: those of a whole stretch of traffic at once.

Ints = NDArray[np.int64]
NEVER = np.iinfo(np.int64).max
"""Time of a SYNC that nobody saw."""
HEADER_BYTES = 8


@dataclass(frozen=True, slots=True)
class Delay:
    """Frames of one identifier.

    Attributes:
        cob_id: the identifier.
        late: how many were later than the plan's worst case.
        slowest_ns: the longest from the end of the SYNC's frame to the end of theirs.
    """

    cob_id: int
    late: int
    slowest_ns: int


@dataclass(slots=True)
class Lateness:
    """Measures stretch after stretch, each from one SYNC to before another.

    Attributes:
        latest_ns: worst case of each identifier that is to be measured.
        tactile_ids: those of them whose SYNC is the one that the header names.
        header_id: the first of the tactile PDOs; None without.
    """

    latest_ns: Mapping[int, int]
    tactile_ids: frozenset[int]
    header_id: int | None
    _by_counter: dict[int, int] = field(init=False, default_factory=dict)
    _tactile_ns: int = field(init=False, default=NEVER)

    def take(self, ids: Sequence[int], data: Sequence[bytes], times_ns: Sequence[int]) -> Iterator[Delay]:
        """The delays in a stretch that begins with a SYNC."""
        numbers, times = np.array(ids, np.int64), np.array(times_ns, np.int64)
        syncs = np.flatnonzero(numbers == SYNC_ID)
        triggers = times[syncs][np.cumsum(numbers == SYNC_ID) - 1]
        of_tactile = self._tactile_triggers(numbers, data, times)
        for cob_id, latest in self.latest_ns.items():
            at = np.flatnonzero(numbers == cob_id)
            trigger = (of_tactile if cob_id in self.tactile_ids else triggers)[at]
            known = trigger != NEVER
            took = (times[at] - trigger)[known]
            if took.size:
                yield Delay(cob_id, int(np.count_nonzero(took > latest)), int(took.max()))

    def _tactile_triggers(self, numbers: Ints, data: Sequence[bytes], times: Ints) -> Ints:
        """For each frame, when the SYNC was through that the last tactile header named."""
        places, named = [0], [self._tactile_ns]
        measured = self.header_id in self.latest_ns
        for at in np.flatnonzero((numbers == SYNC_ID) | (numbers == (self.header_id or SYNC_ID))).tolist():
            head = data[at]
            if numbers[at] == SYNC_ID:
                self._by_counter[head[0] if head else 0] = int(times[at])
            elif measured:
                places.append(at)
                named.append(self._by_counter.get(head[1], NEVER) if len(head) == HEADER_BYTES else NEVER)
        self._tactile_ns = named[-1]
        return np.array(named, np.int64)[np.searchsorted(places, np.arange(len(numbers)), "right") - 1]


# Counts what is on a bus, frame by frame, for `canprobe.planning.measured`.

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
