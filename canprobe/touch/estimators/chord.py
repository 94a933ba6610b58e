"""`chord`: differences from the last sample, linear, cheap; exact for constant |∇f| only."""

from __future__ import annotations

from canprobe.touch.batch import Touches
from canprobe.touch.differences import chord_pairs, solve_pairs
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.estimators.base import WindowEstimator


class ChordEstimator(WindowEstimator):
    """`n_i − n_0 = 2 S₃ (p_i − p_0)` over a window, p_0 the last sample (`differences`)."""

    def _solve(self, touches: Touches) -> SurfaceEstimate:
        return solve_pairs(touches, chord_pairs(touches), "chord")
