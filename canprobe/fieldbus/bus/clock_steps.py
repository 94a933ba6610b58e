"""Frames of a bus whose clock was set while it was recorded (NTP, suspend), with their stamps on one clock.

The cell sends SYNC in one period, so the SYNCs of a channel show a clock that was set: their stamps go back, or leap
over a pause in which nothing else was sent either, and go on from there for good. The lines keep their order, and all
later stamps of that channel are shifted until SYNC goes on in its period. A step back that is smaller than the disorder
of lines shows by the SYNCs on both sides, counted in periods. A step back before the first SYNC is mended too, but
without the time that passed. Frames whose lines are in another order than their stamps keep that order.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from statistics import median

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.candump import CandumpLine
from canprobe.fieldbus.bus.logs import open_log
from canprobe.fieldbus.protocol.frames import SYNC_ID

MAX_DISORDER_NS = 10_000_000
"""Largest difference of stamps by which lines may be out of order; a SYNC that is older by more was set back."""
MIN_STRAY_NS = 1_000_000_000
"""Age of a single SYNC from which on it belongs to no place in the log."""
MIN_PAUSE_NS = 500_000_000
"""Time without a frame of a running cell that shows that the recorder slept, or its clock was set forward."""
_CONFIRMING_SYNCS = 3
"""SYNCs after a step that show that it is permanent."""
_MAX_PERIODS_LEFT = 20
"""Most SYNC periods between a pause and the SYNCs beside it; the bring-up of a cell takes longer."""
_COUNTED_SYNCS = 12
"""SYNCs on each side of a small step that give its size."""
_MIN_SYNC_DISTANCE_NS = 100_000
"""Distance of SYNCs, by the middle half of their stamps, below which the stamps are of no clock."""
_MAX_REPORTED_STEPS = 5


@dataclass(frozen=True, slots=True)
class ClockStep:
    """Step of the clock in a log.

    Attributes:
        line: number of the line of the first frame behind it.
        channel: channel whose stamps step.
        step_ns: step of the clock, without the time that passed; negative: back.
    """

    line: int
    channel: str
    step_ns: int

    def text(self) -> str:
        """One line of a report."""
        way = "forward" if self.step_ns > 0 else "back"
        return (
            f"line {self.line}: the stamps of {self.channel} step {way} by {abs(self.step_ns) * 1e-9:.3f} s for good:"
            " the clock was set, or slept; the lines keep their order and later stamps are shifted"
        )


@dataclass(slots=True)
class _Leap:
    """Difference between two lines of a channel: number of the second, and its stamp less the latest before it."""

    line: int = 0
    ns: int = 0


@dataclass(frozen=True, slots=True)
class _Sync:
    """A SYNC in a log: its line, its stamp, and the farthest leaps back and forward since the SYNC before."""

    line: int
    t_ns: int
    back: _Leap
    forward: _Leap


@dataclass(slots=True)
class _ChannelSyncs:
    """Data of a channel that the first pass keeps."""

    latest_ns: int | None = None
    back: _Leap = field(default_factory=_Leap)
    forward: _Leap = field(default_factory=_Leap)
    syncs: list[_Sync] = field(default_factory=list)

    def take(self, line: int, t_ns: int, can_id: int) -> None:
        leap = 0 if self.latest_ns is None else t_ns - self.latest_ns
        if leap < self.back.ns:
            self.back = _Leap(line, leap)
        elif leap > self.forward.ns:
            self.forward = _Leap(line, leap)
        self.latest_ns = t_ns
        if can_id == SYNC_ID:
            self.syncs.append(_Sync(line, t_ns, self.back, self.forward))
            self.back, self.forward = _Leap(), _Leap()


def _are_early(syncs: list[_Sync], i: int, period: int) -> bool:
    """Whether the SYNCs from the i-th on are early for good, against those before, by more than half a period."""
    sides = []
    for side in (range(max(i - _COUNTED_SYNCS, 0), i), range(i, min(i + _COUNTED_SYNCS, len(syncs)))):
        offsets = [syncs[k].t_ns - k * period for k in side]
        middle = round(median(offsets))
        if 4 * sum(abs(offset - middle) <= period // 4 for offset in offsets) < 3 * _COUNTED_SYNCS:
            return False  # too few go on in their period: lines are out of order, or the SYNCs are those of two masters
        sides.append(middle)
    return 2 * (sides[0] - sides[1]) > period


class RecordedBus:
    """The frames of a log, in the order of its lines, with stamps on one clock. It is read twice.

    Args:
        path: path of the log, as for `open_log`.

    Attributes:
        steps: steps of the clock, by line.
        lost: number of frames that candump did not receive, by channel.
        xl: number of CAN XL frames, by channel.

    Raises:
        UsageError: the file cannot be read, its stamps are no times, or the clock was set to and fro.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._reader = open_log(path)
        channels: dict[str, _ChannelSyncs] = {}
        for t_ns, name, can_id, _ in self._reader:
            channel = channels.get(name)
            if channel is None:
                channel = channels[name] = _ChannelSyncs()
            channel.take(self._reader.number, t_ns, can_id)
        self.lost, self.xl = dict(self._reader.lost), dict(self._reader.xl)
        self._shifts: dict[tuple[str, int], int] = {}
        found = (step for name, channel in channels.items() for step in self._steps_of(name, channel.syncs))
        self.steps = tuple(sorted(found, key=lambda step: step.line))

    def __iter__(self) -> Iterator[CandumpLine]:
        if not self._shifts:
            yield from self._reader
            return
        shift_of: dict[str, int] = {}
        for t_ns, channel, can_id, data in self._reader:
            if (shift := self._shifts.get((channel, self._reader.number))) is not None:
                shift_of[channel] = shift
            yield t_ns + shift_of.get(channel, 0), channel, can_id, data

    def notes(self) -> list[str]:
        """Lines of a report on what was mended."""
        told = [step.text() for step in self.steps[:_MAX_REPORTED_STEPS]]
        more = len(self.steps) - _MAX_REPORTED_STEPS
        return [*told, f"and {more} more steps of the clock"] if more > 0 else told

    def _steps_of(self, channel: str, syncs: list[_Sync]) -> Iterator[ClockStep]:
        """The steps of one channel; the shift of its stamps is kept by the line from which on it holds."""
        if len(syncs) <= _CONFIRMING_SYNCS:
            return
        self._refuse_no_times(channel, [sync.t_ns for sync in syncs])
        period = round(median(b.t_ns - a.t_ns for a, b in pairwise(syncs)))
        shift, first = 0, syncs[0]
        if first.back.ns < -MAX_DISORDER_NS and first.back.ns + first.forward.ns < -MAX_DISORDER_NS:  # no stray frame
            shift = self._shifts[channel, first.back.line] = -first.back.ns
            yield ClockStep(first.back.line, channel, first.back.ns)
        last_ns = first.t_ns + shift
        for i, sync in enumerate(syncs[1:], 1):
            at_ns = sync.t_ns + shift
            if last_ns - MAX_DISORDER_NS <= at_ns < last_ns + period // 2 and _are_early(syncs, i, period):
                step, line = last_ns + period - at_ns, sync.back.line or sync.line
                shift += step
                last_ns = at_ns + step
                self._shifts[channel, line] = shift
                yield ClockStep(line, channel, -step)
                continue
            pause = sync.forward.ns >= MIN_PAUSE_NS and at_ns - last_ns - sync.forward.ns <= _MAX_PERIODS_LEFT * period
            if at_ns >= last_ns - MAX_DISORDER_NS and not pause:
                last_ns = max(last_ns, at_ns)
                continue
            leap = sync.forward if pause else sync.back
            after = [later.t_ns + shift - k * period for k, later in enumerate(syncs[i : i + 1 + _CONFIRMING_SYNCS])]
            for_good = all((2 * t_ns > at_ns + last_ns) == pause for t_ns in after)
            if not for_good and (pause or at_ns < last_ns - MIN_STRAY_NS):
                raise UsageError(
                    f"{self._path}:{sync.line}: the SYNC of {channel} is {abs(at_ns - last_ns) * 1e-9:.3f} s"
                    f" {'after' if pause else 'before'} the one above, and later ones are not: its clock was set to"
                    " and fro, or lines of two logs are mixed; cut the log there"
                )
            if not for_good:  # a stray frame: its stamp says where it belongs
                continue
            step = max(last_ns + period - at_ns, -leap.ns)
            shift += step
            last_ns = at_ns + step
            self._shifts[channel, leap.line] = shift
            yield ClockStep(leap.line, channel, -step)

    def _refuse_no_times(self, channel: str, stamps: list[int]) -> None:
        quarter = len(stamps) // 4
        middle = sorted(stamps)[quarter : len(stamps) - quarter]
        if middle[-1] - middle[0] >= _MIN_SYNC_DISTANCE_NS * (len(middle) // 2):
            return
        if stamps[0] == stamps[-1] == min(stamps) == max(stamps):
            what = "all the same, as of candump without -t, or with -H without stamps of the hardware"
        else:
            what = "differences from line to line, no times"
        raise UsageError(
            f"{self._path}: the stamps of {channel} are {what}; record with `candump -l`, or -L with -ta or -tz"
        )
