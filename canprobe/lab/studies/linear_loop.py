"""The force loop as a linear sampled system.

Along the contact's normal, about the wanted indentation, the loop is linear: measured force and wanted force become
depths by the same law, so the measured depth is the true one times `g`, the true slope of √F over the depth divided
by the slope that the controller assumes. With heights outward, 0 on the object, `a` of the servo's surface model and
`p` of the probe's tip less the wanted indentation:

    a ← (1 − H) a + H (1 − g) p of the sample's instant,   H = 1 − exp(−2π height_hz dt)

`p` follows `a` as in the cycle: a target is latched at the SYNC after the cycle that made it and reached by a ramp at
the next, with the second-order drive behind; an image is sampled at a trigger, sent at the next one and received a
cycle later. Frames that are late by more than a period delay both by whole cycles. The state's map over one period of
the sensor is one matrix. The model ends where contact is lost, at encoder counts and joint limits, where the array is
saturated, and while the stiffness is being estimated. Damping of the layer (Hunt–Crossley) is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True)
class ForceLoop:
    """Parameters of the linear force loop.

    Attributes:
        depth_ratio: g, measured over true depth.
        period_s: period of the cycle.
        sample_cycles: cycles between two tactile images.
        height_hz: bandwidth of the surface's height correction, the force gain.
        late_s: delay of targets and tactile frames on the bus.
        omega: undamped frequency of the drives, rad/s.
        damping: damping ratio of the drives.
    """

    depth_ratio: float
    period_s: float
    sample_cycles: int
    height_hz: float
    late_s: float
    omega: float
    damping: float = 1.0

    @property
    def late_cycles(self) -> int:
        """Whole cycles of the delay."""
        return math.floor(self.late_s / self.period_s + 1e-9)


@lru_cache(maxsize=64)
def drive_step(period_s: float, omega: float, damping: float) -> Floats:
    """Map (3, 4) of position, rate, reference and the target that is latched to the first three a cycle later."""
    rates = np.zeros((4, 4))  # of position, rate, reference, slope
    rates[0, 1] = 1.0
    rates[1, :3] = -omega * omega, -2.0 * damping * omega, omega * omega
    rates[2, 3] = 1.0
    ramp = np.eye(4)
    ramp[3] = 0.0, 0.0, -1.0 / period_s, 1.0 / period_s
    step: Floats = (expm(rates * period_s) @ ramp)[:3]
    step.flags.writeable = False
    return step


def sample_map(loop: ForceLoop) -> Floats:
    """Map of the whole state over one period of the sensor.

    The state at a SYNC: position, rate, reference, a, the last targets, newest first, and the positions at the SYNCs
    before, newest first.
    """
    drive = drive_step(loop.period_s, loop.omega, loop.damping)
    delay = 1 + loop.late_cycles
    oldest = delay + loop.sample_cycles
    size = 4 + delay + oldest
    share = 1.0 - math.exp(-2.0 * math.pi * loop.height_hz * loop.sample_cycles * loop.period_s)
    whole = np.eye(size)
    for cycle in range(loop.sample_cycles):
        sense = np.eye(size)
        if (cycle - delay) % loop.sample_cycles == 0:
            sense[3, 3] = 1.0 - share
            sense[3, 4 + delay + oldest - 1] = share * (1.0 - loop.depth_ratio)
        move = np.zeros((size, size))
        move[:3, :3] = drive[:, :3]
        move[:3, 4 + delay - 1] = drive[:, 3]  # the target that is latched now
        move[3, 3] = move[4, 3] = 1.0  # this cycle's target is a
        move[range(5, size), range(4, size - 1)] = 1.0  # all others age
        move[4 + delay] = np.eye(size)[0]
        whole = move @ sense @ whole
    return whole


def spectral_radius(loop: ForceLoop) -> float:
    """Largest modulus of the eigenvalues over one period of the sensor; below 1 the force settles."""
    return float(np.abs(np.linalg.eigvals(sample_map(loop))).max())
