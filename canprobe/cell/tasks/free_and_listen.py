"""The tasks without touch: hold, swing the joints, or only listen to the sensor."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.tasks.task import Task, TaskRecord
from canprobe.mechanics.robot.motion_profile import smooth_step
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.master.patch_reader import PatchReader
    from canprobe.mechanics.touch import PatchCalibration


class FreeTask(Task):
    """Swing every joint sinusoidally about where it stood, with a soft start and end.

    Args:
        amplitude: amplitude of each joint (n,), rad or m.
        swing_period_s: period of the swing.
        duration_s: duration of the whole task.
        period_s: period of the cycle.
    """

    def __init__(self, amplitude: Floats, swing_period_s: float, duration_s: float, period_s: float) -> None:
        self._amplitude = amplitude
        self._omega = 2 * math.pi / swing_period_s
        self._duration = duration_s
        self._soft = min(1.0, duration_s / 4)
        self._period = period_s
        self._t = 0.0
        self._q0: Floats | None = None

    def step(self, measurement: Measurement) -> Command:
        if self._q0 is None:
            assert measurement.q is not None
            self._q0 = measurement.q
        left = self._duration - self._t
        envelope = smooth_step(min(self._t, left) / self._soft)
        target = self._q0 + self._amplitude * (envelope * math.sin(self._omega * self._t))
        self._t += self._period
        return Command(q_target=target, done=left <= 0)


class ListenTask(Task):
    """Read the sensor and do nothing.

    Args:
        calibration: calibration of the array.
        duration_s: duration of the task.
        period_s: period of the cycle.
    """

    resumable = True

    def __init__(self, calibration: PatchCalibration, duration_s: float, period_s: float) -> None:
        # not at the top, for `free`: with all its imports as late as this it starts in 0.66 times the processor time
        from canprobe.cell.master.patch_reader import PatchReader, sample_columns

        self.reader: PatchReader = PatchReader(calibration)
        self._columns_of = sample_columns
        self._left = duration_s
        self._period = period_s
        self.taxels: NDArray[np.uint8] | None = None
        self._columns: dict[str, float | Floats] = {}

    def record(self) -> TaskRecord:
        return TaskRecord(taxels=self.taxels)

    def step(self, measurement: Measurement) -> Command:
        self._left -= self._period
        if measurement.tactile is not None:
            self.taxels = measurement.tactile.frame.taxels
            self._columns = self._columns_of(measurement.tactile, self.reader.read(measurement.tactile))
        return Command(done=self._left <= 0, columns=self._columns)


class HoldTask(Task):
    """Stay where the drives are."""

    resumable = True

    def step(self, _: Measurement) -> Command:
        """Do nothing."""
        return Command()
