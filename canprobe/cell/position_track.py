"""The position of one motor as its TPDOs tell it: what it can have reached, and where it is when one is missing."""

from __future__ import annotations

from math import copysign

STEADY = 5
"""Equal reports after which a motor is at rest."""
BASE_COUNTS = 8
"""A millirad of a joint: what a report may be off by, whatever the motion."""
CARRIED_CYCLES = 3
"""Cycles for which a motion is carried on without a report."""
_FORGET = 0.9
"""Share of the largest step of the target that still counts one cycle later: a drive follows within twenty cycles."""


class PositionTrack:
    """Positions of one motor, counts, and its rate.

    A drive cannot change its speed within a cycle by more than its own speed and what its target asks for together, and
    an enabled one is no faster than its target. Without the second, wrong reports, each believed for the last, would
    tell of a motion that grows from nothing.

    Attributes:
        counts: the last position that was believed.
        cycle: of that position; −1 before the first.
        steady: reports in a row that differed by no more than ``BASE_COUNTS``.
    """

    __slots__ = ("_asked", "_last", "_rate", "_t_ns", "counts", "cycle", "steady")

    def __init__(self) -> None:
        self.counts = 0
        self.cycle = -1
        self.steady = 0
        self._last = 0
        self._t_ns = 0
        self._rate = 0.0  # counts per ns
        self._asked = 0.0  # counts per cycle

    def aim(self, step_counts: float) -> None:
        """The target moves on by this much in this cycle."""
        faded = _FORGET * self._asked
        self._asked = step_counts if step_counts > faded else faded

    def take(self, counts: int, cycle: int, t_ns: int, *, guarded: bool) -> bool:
        """Take a report.

        Args:
            counts: the position.
            cycle: of the SYNC at which it was sampled.
            t_ns: that SYNC's deadline.
            guarded: the drive is enabled, so that it can only be where it can have gone.

        Returns:
            Whether it is believed.
        """
        self.steady = self.steady + 1 if abs(counts - self._last) <= BASE_COUNTS else 0
        self._last = counts
        if self.cycle >= 0:
            step, passed_ns = counts - self.counts, t_ns - self._t_ns
            moved: float = step
            if guarded:
                carried = self._rate * passed_ns
                asked = (cycle - self.cycle) * self._asked
                if abs(step - carried) > BASE_COUNTS + abs(carried) + asked:
                    return False
                moved = step if abs(step) <= asked else copysign(asked, step)
            if passed_ns > 0:
                self._rate = moved / passed_ns
        self.counts, self.cycle, self._t_ns = counts, cycle, t_ns
        return True

    def position(self, cycle: int, t_ns: int) -> float:
        """Where the motor is at a SYNC: as reported, or carried on by its rate."""
        age = cycle - self.cycle
        if age <= 0 or self.cycle < 0:
            return float(self.counts)
        passed_ns = (t_ns - self._t_ns) * min(age, CARRIED_CYCLES) / age
        return self.counts + self._rate * passed_ns
