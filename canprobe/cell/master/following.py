"""Whether motors follow their targets: a stuck brake, a power stage that is off, a drive that goes too slowly.

A drive that lags moves as its targets did a little earlier: in a while it goes as far as they went in a while of the
same length, begun up to four stated lags before. So its motion lies between the least and the largest of those motions,
whatever its lag is, up to one and a half times the stated one, or beyond them by what its loop overshoots where they
differ, at a sharp turn. Why not a model of second order: its bounds would be as narrow, but a drive that lags less or
more than stated would be taken for one that does not follow. Why motions and not positions: a drive without an
integral part stands beside its target by what its load takes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from canprobe.cell.planning.sync import CYCLES_TO_EFFECT
from canprobe.mechanics.robot.model import ArmModel, units_per_motor

LAGS = 4.0
"""Stated lags before which a drive may have begun a motion: with 1.5 times the lag it has then followed to 97 %."""
WHILES_S = (0.005, 0.02, 0.08, 0.32)
"""Whiles in which the motions are compared, s: a fast joint that stands shows in the first, a slow one in the last."""
OVERSHOOT_SHARE = 0.25
"""Share of a jump of the target's speed by which a drive overshoots it, 18 % on the dynamic plant."""
MARGIN_RAD = 0.5e-3
"""Angle of a joint by which a motion may differ: rounding of target and position, noise of the encoder, friction."""
LATE_PERIODS = 1.5
"""Periods from a SYNC to the next beyond which that one is late."""
MIN_MARGIN_COUNTS = 3
"""Least margin in counts."""


class Following:
    """Targets and positions of the motors in the last while.

    Args:
        model: the arm, for the units of its drives.
        lag_s: lag of the drives behind a ramp.
        period_ns: period of the cycle.
    """

    def __init__(self, model: ArmModel, lag_s: float, period_ns: int) -> None:
        margins = np.abs(units_per_motor(model)) * model.radian * MARGIN_RAD
        self._margins: list[float] = np.maximum(margins, MIN_MARGIN_COUNTS).tolist()
        self._period_ns = period_ns
        self._whiles = sorted({max(1, round(s * 1e9 / period_ns)) for s in WHILES_S})
        self._delays = range(1, CYCLES_TO_EFFECT + 1 + int(-(-LAGS * lag_s * 1e9 // period_ns)))
        self._usual = 1 + len(self._delays) // 2
        size = self._whiles[-1] + len(self._delays) + 1
        self._cycles: deque[tuple[int, Sequence[int], Sequence[int | None], int]] = deque(maxlen=size)
        self._moving_before = False  # before the first of these cycles

    def forget(self) -> None:
        """Forget all cycles, as before the first one."""
        self._cycles.clear()
        self._moving_before = False

    def aim(self, targets: Sequence[int], counts: Sequence[int | None], t_ns: int, jitter_ns: int = 0) -> None:
        """Take a cycle.

        Args:
            targets: the targets that follow it.
            counts: positions at its SYNC; None: not reported.
            t_ns: time of its SYNC.
            jitter_ns: time by which drives may have seen it later than usual: a gateway or an emulator that stalls.
        """
        # behind a late cycle the drives have stopped at their last targets, and nothing before says how they go on
        if self._cycles and t_ns - self._cycles[-1][0] > LATE_PERIODS * self._period_ns:
            self._cycles.clear()
            self._moving_before = True
        self._cycles.append((t_ns, targets, counts, jitter_ns))

    def beyond(self, motor: int, counts: int, t_ns: int, jitter_ns: int = 0) -> float:
        """Counts by which a motor's motion until now is less or more than its targets explain; 0 where it follows.

        Args:
            motor: number of the motor, from 0.
            counts: its position at the SYNC of this cycle.
            t_ns: time of that SYNC.
            jitter_ns: time by which drives may have seen it later than usual.
        """
        cycles, margin, most = self._cycles, self._margins[motor], 0.0
        last = len(cycles) - 1
        for span in self._whiles:
            if span > last or (self._moving_before and last + 1 - self._delays[-1] < span):
                break
            begin_ns, _, before, _ = cycles[-span]
            if (was := before[motor]) is None:
                continue
            moved = counts - was
            few = [  # mostly the motion lies between these, and thus between the least and the largest of all
                cycles[max(last + 1 - delay, 0)][1][motor] - cycles[max(last + 1 - delay - span, 0)][1][motor]
                for delay in (self._delays[0], self._usual, self._delays[-1])
            ]
            if min(few) - margin <= moved <= max(few) + margin:
                continue
            ends = [cycles[max(last + 1 - delay, 0)][1][motor] for delay in self._delays]
            starts = [cycles[max(last + 1 - delay - span, 0)][1][motor] for delay in self._delays]
            asks = [end - start for end, start in zip(ends, starts, strict=True)]
            outside = max(moved - max(asks), min(asks) - moved) - margin - OVERSHOOT_SHARE * (max(asks) - min(asks))
            if outside > most:
                late_ns = abs(t_ns - begin_ns - span * self._period_ns) + self._late_ns(span, t_ns, jitter_ns)
                step = max([abs(b - a) for a, b in pairwise((*starts, *ends))])
                most = max(most, outside - late_ns / self._period_ns * step)
        return most

    def _late_ns(self, span: int, t_ns: int, jitter_ns: int) -> int:
        """Time by which a drive may have begun a ramp late that it went on in these cycles, or broken it off early."""
        late_ns, after_ns = jitter_ns, t_ns
        for k in range(1, min(span + self._usual, len(self._cycles)) + 1):
            sync_ns, _, _, seen_later_ns = self._cycles[-k]
            late_ns = max(late_ns, seen_later_ns, abs(after_ns - sync_ns - self._period_ns))
            after_ns = sync_ns
        return late_ns
