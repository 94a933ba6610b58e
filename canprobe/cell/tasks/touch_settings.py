"""What a touch task is told, and the phases that it goes through."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.supervision import TOUCH_FORCE, Limits
from canprobe.touch.servo import SurfaceGains

Vector = NDArray[np.float64]


class Phase(IntEnum):
    """Phases of a touch task, in their order; a scan that loses its contact goes to and fro between it and REGAIN."""

    MOVE = 0
    APPROACH = 1
    SETTLE = 2
    SCAN = 3
    RETREAT = 4
    DONE = 5
    REGAIN = 6


@dataclass(frozen=True, slots=True)
class TouchSettings:
    """What a touch task does, in SI units.

    Attributes:
        period_s: of the cycle.
        limits: of the cell; beyond them the probe retreats and the cell stops.
        target_force: N.
        touch_force: N; contact is made above it, lost below half of it or a tenth of the target.
        approach_speed, retreat_speed: m/s.
        start: expected contact point (3,), m, base frame.
        axes: (3, 3) rows heading, across, approach normal (outward), base frame.
        clearance: distance of the probe's surface from ``start`` before the approach, m.
        search: distance beyond ``start`` at which the approach gives up, m.
        settle_s: time at rest in contact before the scan.
        duration_s: of the scan, or of the hold where ``speed`` is 0.
        speed: contact speed, m/s; 0 holds.
        ramp_s: time to reach the speed.
        rolling_share: 0…1.
        lead_s: from a SYNC to the moment its command has taken effect.
    """

    period_s: float
    limits: Limits
    target_force: float
    start: Vector
    axes: Vector
    duration_s: float
    speed: float
    rolling_share: float
    lead_s: float
    gains: SurfaceGains = field(default_factory=SurfaceGains)
    touch_force: float = TOUCH_FORCE
    approach_speed: float = 4e-3
    retreat_speed: float = 20e-3
    clearance: float = 3e-3
    search: float = 8e-3
    retreat: float = 6e-3
    settle_s: float = 0.5
    ramp_s: float = 0.05
