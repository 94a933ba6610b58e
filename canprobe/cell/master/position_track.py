"""The position of one motor as its TPDOs report it: what it can have reached, and where it is when one is missing."""

from __future__ import annotations

from math import copysign

import numpy as np

from canprobe.mechanics.robot.model import ArmModel, units_per_motor

REST_NS = 12_500_000
"""Time without a motion after which a drive is at rest."""
REST_RAD = 1e-3
"""Angle of a joint by which a report may be off, whatever the motion, and within which a drive at rest stays."""
MIN_REST_COUNTS = 8
"""Least of these bounds in counts: a coarse encoder has a count or two a milliradian, and its drive starts in steps."""
CARRIED_CYCLES = 3
"""Periods for which a motion is carried on without a report. After a late cycle too: a drive that gets no new target
stops at its last one, however long the cycle lasts."""
FOLLOWED_CYCLES = 20
"""Periods within which a drive has followed its target."""
_STEP_DECAY = 0.9
"""Share of the largest step of the target that still counts one period later: an eighth after `FOLLOWED_CYCLES`."""
PERIOD_NS = 2_500_000
"""Period of a cycle at 400 Hz."""


class PositionTrack:
    """Positions of one motor, counts, and its rate.

    A drive cannot change its speed within a cycle by more than its own speed and what its target asks for together, and
    an enabled one is no faster than its target. Without the second, wrong reports, each believed for the last, would
    make up a motion that grows from nothing.

    Args:
        base: largest error of a report, whatever the motion, counts: see `rest_counts`.
        period_ns: period of the cycle. A late cycle lasts many periods: all bounds are times.

    Attributes:
        counts: the last position that was believed.
        cycle: cycle of that position; −1 before the first.
        rested_ns: time in which the reports have stayed within ``base`` of the first of them.
    """

    def __init__(self, base: float, period_ns: int = PERIOD_NS) -> None:
        self.counts = 0
        self.cycle = -1
        self.rested_ns = 0
        self._base = base
        self._period_ns = period_ns
        self._still: int | None = None
        self._still_ns = 0
        self._t_ns = 0
        self._rate = 0.0  # counts per ns
        self._asked = 0.0  # counts per period
        self._heard = False  # since the target moved on
        self._way, self._periods = 0.0, 0.0  # what was asked since the last report, up to the last target; counts

    def aim(self, step_counts: float, periods: float) -> None:
        """The target moves on by this much, so many periods after it did so last."""
        if not self._heard:
            self._way += self._followed(periods)
            self._periods += periods
        self._heard = False
        faded = _STEP_DECAY**periods * self._asked
        self._asked = step_counts if step_counts > faded else faded

    def take(self, counts: int, cycle: int, t_ns: int, *, guarded: bool) -> bool:
        """Take a report.

        Args:
            counts: the position.
            cycle: cycle of the SYNC at which it was sampled.
            t_ns: deadline of that SYNC.
            guarded: the drive is enabled, so that it can only be where it can have gone.

        Returns:
            Whether it is believed.
        """
        if self._still is None or abs(counts - self._still) > self._base:
            self._still, self._still_ns = counts, t_ns
        self.rested_ns = t_ns - self._still_ns
        if self.cycle >= 0:
            step, passed_ns = counts - self.counts, t_ns - self._t_ns
            moved: float = step
            if guarded:
                carried = self._carried(passed_ns)
                asked = self._way + self._followed(passed_ns / self._period_ns - self._periods)
                if abs(step - carried) > self._base + abs(carried) + asked:
                    return False
                moved = step if abs(step) <= asked else copysign(asked, step)
            if passed_ns > 0:
                self._rate = moved / passed_ns
        self.counts, self.cycle, self._t_ns = counts, cycle, t_ns
        self._heard, self._way, self._periods = True, 0.0, 0.0
        return True

    def position(self, cycle: int, t_ns: int) -> float:
        """Position of the motor at a SYNC: as reported, or carried on by its rate for a bounded time."""
        if cycle <= self.cycle:
            return float(self.counts)
        return self.counts + self._carried(t_ns - self._t_ns)

    def way(self, time_ns: int) -> float:
        """Way of the motor in a time at its last rate, counts."""
        return abs(self._rate) * time_ns

    def _followed(self, periods: float) -> float:
        """Largest motion of a drive towards its last targets after so many periods, counts."""
        return min(periods, FOLLOWED_CYCLES) * self._asked

    def _carried(self, passed_ns: int) -> float:
        """Estimated motion since the last report, counts."""
        return self._rate * min(passed_ns, CARRIED_CYCLES * self._period_ns)


def rest_counts(model: ArmModel) -> list[float]:
    """A milliradian (0.2 mm) of each drive's joint in its units: more than encoders are noisy, less than a motion."""
    counts = np.abs(units_per_motor(model)) * model.radian * REST_RAD
    return np.maximum(counts, MIN_REST_COUNTS).tolist()  # type: ignore[no-any-return]
