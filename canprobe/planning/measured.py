"""What was on the bus against what was planned: counts, bits and times of every message, and what nobody planned.

Counted from the first SYNC to the last one, while the cell runs: bring-up and the way out have no rate.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

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
