"""The tasks without touch: swing the joints, or only listen to the sensor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.measurement import Command, Measurement
from canprobe.cell.supervision import Contact, Limits
from canprobe.cell.supervisor import touch_finding
from canprobe.cell.tasks.probe_motion import smooth_step
from canprobe.cell.tasks.sensing import patch_of
from canprobe.touch.patch import PatchCalibration

Vector = NDArray[np.float64]


class FreeTask:
    """Swing every joint sinusoidally about where it stood, with a soft start and end.

    Args:
        amplitude: of each joint (6,), rad.
        swing_period_s: of the swing.
        duration_s: of the whole task.
        period_s: of the cycle.
    """

    def __init__(self, amplitude: Vector, swing_period_s: float, duration_s: float, period_s: float) -> None:
        self._amplitude = amplitude
        self._omega = 2 * math.pi / swing_period_s
        self._duration = duration_s
        self._soft = min(1.0, duration_s / 4)
        self._period = period_s
        self._t = 0.0
        self._q0: Vector | None = None

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        if self._q0 is None:
            assert measurement.q is not None
            self._q0 = measurement.q
        left = self._duration - self._t
        envelope = smooth_step(min(self._t, left) / self._soft)
        target = self._q0 + self._amplitude * (envelope * math.sin(self._omega * self._t))
        self._t += self._period
        return Command(q_target=target, done=left <= 0)


class ListenTask:
    """Read the sensor and do nothing.

    Args:
        calibration: of the array.
        duration_s: how long.
        period_s: of the cycle.
        limits: of the cell.
    """

    def __init__(self, calibration: PatchCalibration, duration_s: float, period_s: float, limits: Limits) -> None:
        self._calibration = calibration
        self._left = duration_s
        self._period = period_s
        self._limits = limits
        self.taxels: NDArray[np.uint8] | None = None
        self._columns: dict[str, float | Vector] = {}

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        self._left -= self._period
        if measurement.tactile is not None:
            self.taxels = measurement.tactile.frame.taxels
            patch = patch_of(measurement.tactile, self._calibration)
            self._columns = {
                "sample_cycle": float(measurement.tactile.cycle),
                "force_n": patch.force,
                "pad_u_mm": patch.u * 1e3,
                "pad_v_mm": patch.v * 1e3,
            }
        finding = touch_finding(Contact(self._limits, 0.0, measurement.tactile_age))
        silent = str(finding.error) if finding is not None else None
        return Command(done=self._left <= 0, stop_reason=silent, columns=self._columns)
