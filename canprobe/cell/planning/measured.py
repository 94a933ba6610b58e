"""Recorded traffic beside the plan: counts, bits and times of every message, and frames that are not in the plan.

Frames are counted from the first SYNC to the last one: bring-up and shutdown have no rate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Part, Plan, PlannedBus, PlannedFrames
from canprobe.cell.planning.traffic import SYNC_BITS, SYNC_BITS_LEAST, on_the_wire
from canprobe.cell.planning.wire_time import exact_frame_bits, unstuffed_frame_bits
from canprobe.fieldbus.protocol.frame_bits import FD_LENGTHS, worst_case_bits
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, NMT_ID, SDO_RX_BASE, SDO_TX_BASE, SYNC_ID

Kind = Literal[
    "SYNC", "drive TPDO", "drive RPDO", "tactile PDO", "raw frame", "event PDO", "heartbeat", "NMT", "EMCY", "SDO"
]
_KINDS: dict[Part, Kind] = {"event": "event PDO", "command": "drive RPDO", "tactile": "tactile PDO"}
TOLERANCE = 0.02
"""Share by which a count may differ from the plan; a frame of each message may always be missing at the edges."""


@dataclass(slots=True)
class ClassTraffic:
    """Frames and bits of one class of messages, counted and planned.

    Attributes:
        kind: the class.
        messages: number of identifiers in it.
        frames: number of frames that were counted.
        planned_frames: planned number in the same time; None for services.
        bits: number of bits, with stuff bits where the meter counts them, else without.
        planned_bits: highest planned number in the same time; None for services.
        late: frames that came later behind their SYNC than the plan's worst case.
        slowest: the largest share of its worst case behind SYNC that a frame took; None where no time was measured.
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
        """Whether the frames are the planned ones within the tolerance, and the bits no more than the worst case.

        A message that is sent on changes too is planned at its slowest rate: more frames are no fault.
        """
        if self.planned_frames is None or self.planned_bits is None:
            return True
        allowed = max(TOLERANCE * self.planned_frames, self.messages)
        if self.kind == "event PDO":
            return self.frames >= self.planned_frames - allowed
        return abs(self.frames - self.planned_frames) <= allowed and self.bits <= self.planned_bits

    def add(self, expected: Expected, count: _Count, seconds: float) -> None:
        """Add one message that was counted for a time, s."""
        self.messages += 1
        self.frames += count.frames
        self.bits += count.bits
        self.late += count.late
        if expected.rate_hz is not None and expected.bits_worst is not None:
            planned = expected.rate_hz * seconds
            self.planned_frames = (self.planned_frames or 0.0) + planned
            self.planned_bits = (self.planned_bits or 0.0) + planned * expected.bits_worst
        if expected.latest_ns and count.slowest_ns:
            self.slowest = max(self.slowest or 0.0, count.slowest_ns / expected.latest_ns)


@dataclass(frozen=True, slots=True)
class MeasuredTraffic:
    """The measured traffic of a bus, compared with its plan.

    Attributes:
        duration_s: time from the first SYNC to the last one, s.
        bitrate: bit/s.
        exact: whether stuff bits were counted.
        classes: counts, bits and times of each kind of message.
        unlisted: counts of identifiers that the plan does not list, in the whole log.
        missing: COB-IDs of planned PDOs that never came.
        error_frames: bus errors in the whole log.
        planned_worst: planned load in the worst case, as a share of the bit rate.
        xl_frames: CAN XL frames, which no plan lists; in the whole log.
        lost_by_candump: frames that candump did not receive.
        notes: what was repaired in the log.
    """

    duration_s: float
    bitrate: int
    exact: bool
    classes: tuple[ClassTraffic, ...]
    unlisted: dict[int, int]
    missing: tuple[int, ...]
    error_frames: int
    planned_worst: float
    xl_frames: int = 0
    lost_by_candump: int = 0
    notes: tuple[str, ...] = ()

    @property
    def load(self) -> float:
        """Share of the bit rate that was used."""
        return self.share(sum(one.bits for one in self.classes)) or 0.0

    def share(self, bits: float | None) -> float | None:
        """Share of the bit rate that a number of bits takes; None where nothing was measured."""
        return None if bits is None or self.duration_s <= 0 else bits / (self.bitrate * self.duration_s)

    @property
    def as_planned(self) -> bool:
        """Whether each class is as planned, no message is missing or foreign, and no bus error was recorded."""
        nothing_else = not (self.unlisted or self.missing or self.error_frames or self.xl_frames)
        return nothing_else and all(one.as_planned for one in self.classes)

    def as_dict(self) -> dict[str, Any]:
        """The comparison in JSON types."""
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
                    "load": self.share(one.bits),
                    "planned_worst": self.share(one.planned_bits),
                    "late": one.late,
                    "slowest_share": one.slowest,
                    "as_planned": one.as_planned,
                }
                for one in self.classes
            },
            "unlisted": [{"cob_id": cob_id, "frames": frames} for cob_id, frames in sorted(self.unlisted.items())],
            "missing": list(self.missing),
            "error_frames": self.error_frames,
            "xl_frames": self.xl_frames,
            "lost_by_candump": self.lost_by_candump,
            "notes": list(self.notes),
        }

    def text(self) -> str:
        """The comparison as text."""
        return "\n".join(self._lines()) + "\n"

    def _lines(self) -> Iterator[str]:
        yield f"measured in {self.duration_s:.2f} s, from its first SYNC to its last:"
        yield f"  load {100 * self.load:.1f} %, planned at most {100 * self.planned_worst:.1f} %"
        yield f"  {'':<12} {'frames':>8} {'planned':>9} {'load %':>7} {'at most':>8}  latest of its worst case"
        for one in self.classes:
            load, worst = (
                "" if share is None else f"{100 * share:.1f}"
                for share in (self.share(one.bits), self.share(one.planned_bits))
            )
            least = "≥ " if one.kind == "event PDO" else ""
            planned = "" if one.planned_frames is None else f"{least}{one.planned_frames:.0f}"
            slowest = "" if one.slowest is None else f"{100 * one.slowest:.0f} %"
            note = "" if one.as_planned else "  not as planned"
            yield (f"  {one.kind:<12} {one.frames:>8} {planned:>9} {load:>7} {worst:>8}  {slowest}{note}").rstrip()
        for cob_id, frames in sorted(self.unlisted.items()):
            yield f"  not in the plan: {cob_id:03X}h, {frames} frames"
        for cob_id in self.missing:
            yield f"  never came: {cob_id:03X}h"
        if self.error_frames:
            yield f"  error frames: {self.error_frames}"
        if self.xl_frames:
            yield f"  not in the plan: {self.xl_frames} CAN XL frames"
        if self.lost_by_candump:
            yield f"  lost by candump: {self.lost_by_candump} frames"
        yield from (f"  {note}" for note in self.notes)


Ints = NDArray[np.int64]
_NEVER = np.iinfo(np.int64).max
_HEADER_BYTES = 8
_AT_ONCE = 4096


@dataclass(frozen=True, slots=True)
class Expected:
    """One message of the plan.

    Attributes:
        cob_id: identifier.
        kind: its class.
        rate_hz: planned rate; None for a service, which has no rate.
        bits_worst: most bits of one frame; None where its length is open.
        latest_ns: worst case from the end of the SYNC frame to the end of this one; None: SYNC does not trigger it.
    """

    cob_id: int
    kind: Kind
    rate_hz: float | None = None
    bits_worst: int | None = None
    latest_ns: int | None = None


def expected_messages(plan: Plan, bus: PlannedBus) -> dict[int, Expected]:
    """Every message that may be on one of the plan's buses, by identifier; anything else is foreign."""
    shortest_ns = SYNC_BITS_LEAST * 1_000_000_000 // plan.setup.bus.bitrate
    found = [Expected(SYNC_ID, "SYNC", plan.sync.rate_hz, SYNC_BITS), Expected(NMT_ID, "NMT")]
    for pdo in on_the_wire([pdo for pdo in plan.pdos if pdo.node_id in bus.node_ids]):
        triggered = pdo.layout.synchronous
        latest = pdo.response_ns - shortest_ns if triggered and pdo.response_ns is not None else None
        found.append(Expected(pdo.cob_id, _KINDS.get(pdo.part, "drive TPDO"), pdo.rate_hz, pdo.bits_worst, latest))
    raw: dict[int, list[PlannedFrames]] = {}
    for frames in plan.raw:
        if frames.channel == bus.channel:
            raw.setdefault(frames.can_id, []).append(frames)
    for can_id, all_of_it in raw.items():
        rate = sum(frames.count * frames.rate_hz for frames in all_of_it)
        longest = max(-(-frames.bits_worst // frames.count) for frames in all_of_it)
        found.append(Expected(can_id, "raw frame", rate or None, longest))
    beat = 1000 / HEARTBEAT_PRODUCED_MS
    for node in (*bus.node_ids, MASTER_NODE_ID):
        found.append(Expected(HEARTBEAT_BASE + node, "heartbeat", beat, worst_case_bits(1)))
    for node in bus.node_ids:
        found += [Expected(EMCY_BASE + node, "EMCY"), Expected(SDO_TX_BASE + node, "SDO")]
        found.append(Expected(SDO_RX_BASE + node, "SDO"))
    return {message.cob_id: message for message in found}


@dataclass(slots=True)
class _Count:
    """Frames of one identifier, their bits, the number that came too late, and the longest time behind SYNC."""

    frames: int = 0
    bits: int = 0
    late: int = 0
    slowest_ns: int = 0


_Frame = tuple[int, bytes, int]


class TrafficMeter:
    """Counts frames in the order of the bus; `report` sets them beside the plan.

    Attributes:
        error_frames: number of error frames; the reader counts them here.
    """

    def __init__(self, plan: Plan, channel: str | None = None, exact: bool = True) -> None:
        """Make a meter without counts.

        Args:
            plan: the plan with which frames are compared.
            channel: channel of the bus, as the plan names it; None: its first one.
            exact: whether to count stuff bits, which costs a few µs a frame.
        """
        self.error_frames = 0
        self._plan, self._exact = plan, exact
        self._bus = next((bus for bus in plan.buses if bus.channel == channel), plan.buses[0])
        self._expected = expected_messages(plan, self._bus)
        self._unstuffed = {n: unstuffed_frame_bits(n, plan.setup.bus) for n in FD_LENGTHS}
        self._counts: dict[int, _Count] = {}
        self._before: dict[int, _Count] = {}
        self._taken: list[_Frame] = []
        self._enough = _AT_ONCE
        self._first_ns: int | None = None
        self._sync_ns = 0
        # time of the SYNC with each counter, and of the one that the last tactile header named
        self._tactile_ids = {one.cob_id for one in self._expected.values() if one.kind == "tactile PDO"}
        self._header_id = min(self._tactile_ids, default=SYNC_ID)
        self._by_counter: dict[int, int] = {}
        self._named_ns = _NEVER

    def write(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take a frame; it is counted after the next SYNC, with many others."""
        self._taken.append((can_id, data, t_ns))
        if len(self._taken) >= self._enough:
            self._count()
            self._enough = len(self._taken) + _AT_ONCE

    def _count(self) -> None:
        """Count the frames up to the last SYNC; those since then wait."""
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
        self._tally(taken[begin:end], self._counts)
        self._compare_times(taken[begin:end])
        self._taken = taken[end:]

    def _tally(self, frames: Sequence[_Frame], counts: dict[int, _Count]) -> None:
        """Add frames and their bits."""
        for (can_id, n_data), frames_of in Counter([(can_id, len(data)) for can_id, data, _ in frames]).items():
            count = counts.setdefault(can_id, _Count())
            count.frames += frames_of
            count.bits += 0 if self._exact else frames_of * self._unstuffed[n_data]
        if self._exact:
            for can_id, data, _ in frames:
                counts[can_id].bits += exact_frame_bits(can_id, data, self._plan.setup.bus)

    def _compare_times(self, frames: Sequence[_Frame]) -> None:
        """Compare the times of frames behind their SYNC with the plan; the frames begin with a SYNC."""
        ids, times = (np.array([frame[at] for frame in frames], np.int64) for at in (0, 2))
        syncs = ids == SYNC_ID
        triggers = times[syncs][np.cumsum(syncs) - 1] if len(frames) else times
        of_tactile = self._tactile_triggers(ids, frames)
        for cob_id, count in self._counts.items():
            latest_ns = self._expected[cob_id].latest_ns if cob_id in self._expected else None
            at = np.flatnonzero(ids == cob_id) if latest_ns is not None else ()
            if latest_ns is not None and len(at):
                trigger = (of_tactile if cob_id in self._tactile_ids else triggers)[at]
                took = (times[at] - trigger)[trigger != _NEVER]
                count.late += int(np.count_nonzero(took > latest_ns))
                count.slowest_ns = max(count.slowest_ns, int(took.max(initial=0)))

    def _tactile_triggers(self, ids: Ints, frames: Sequence[_Frame]) -> Ints:
        """For each frame the time of the SYNC that the last tactile header named."""
        places, named = [0], [self._named_ns]
        for at in np.flatnonzero((ids == SYNC_ID) | (ids == self._header_id)).tolist():
            can_id, data, t_ns = frames[at]
            if can_id == SYNC_ID:
                self._by_counter[data[0] if data else 0] = t_ns
            else:
                places.append(at)
                named.append(self._by_counter.get(data[1], _NEVER) if len(data) == _HEADER_BYTES else _NEVER)
        self._named_ns = named[-1]
        return np.array(named, np.int64)[np.searchsorted(places, np.arange(len(ids)), "right") - 1]

    @property
    def frames(self) -> int:
        """Number of frames so far, bring-up included."""
        return sum(one.frames for one in self._all_counts())

    @property
    def bits(self) -> int:
        """Number of their bits, with stuff bits where the meter is `exact`."""
        return sum(one.bits for one in self._all_counts())

    def _all_counts(self) -> list[_Count]:
        self._count()
        waiting: dict[int, _Count] = {}
        self._tally(self._taken, waiting)
        return [*self._before.values(), *self._counts.values(), *waiting.values()]

    def report(self) -> MeasuredTraffic:
        """The counts so far, beside the plan."""
        self._count()
        seconds = 0.0 if self._first_ns is None else (self._sync_ns - self._first_ns) * 1e-9
        seen = Counter(can_id for can_id, _, _ in self._taken)
        for part in (self._before, self._counts):
            seen.update({can_id: one.frames for can_id, one in part.items()})
        classes: dict[Kind, ClassTraffic] = {}
        for expected in self._expected.values():
            one = classes.setdefault(expected.kind, ClassTraffic(expected.kind))
            one.add(expected, self._counts.get(expected.cob_id, _Count()), seconds)
        pdos = [one.cob_id for one in self._expected.values() if one.kind.endswith("PDO")]
        return MeasuredTraffic(
            duration_s=seconds,
            bitrate=self._plan.setup.bus.bitrate,
            exact=self._exact,
            classes=tuple(classes.values()),
            unlisted={can_id: n for can_id, n in seen.items() if can_id not in self._expected},
            missing=tuple(cob_id for cob_id in pdos if cob_id not in seen),
            error_frames=self.error_frames,
            planned_worst=self._bus.load,
        )
