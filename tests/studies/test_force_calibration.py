"""The shipped calibration is what the procedure finds, and holds on arrays that it never saw."""

import numpy as np
import pytest

from canprobe.cell.tasks.calibration import FORCE_GAINS, array_calibration
from canprobe.studies.force_calibration import calibrate, pressed_sums


def test_procedure_finds_the_shipped_gains():
    found = calibrate(100e3, seeds=range(3), forces=(0.5, 1.5, 3.0))
    gain, edge = FORCE_GAINS[100e3]
    for force in (0.5, 2.0, 3.0):  # the two numbers trade against each other; what counts is the force
        assert found.force_gain * force + found.edge_gain * np.sqrt(force) == pytest.approx(
            gain * force + edge * np.sqrt(force), rel=0.01
        )


@pytest.mark.parametrize(("full_scale_pa", "spread"), [(100e3, 0.015), (300e3, 0.03)])
def test_bias_on_unseen_arrays_is_within_three_percent(full_scale_pa, spread):
    calibration = array_calibration(full_scale_pa)
    sums, true = map(np.array, zip(*pressed_sums(full_scale_pa, (1.0, 2.0, 3.0), seeds=(77, 78)), strict=True))
    errors = (calibration.force_gain * sums + calibration.edge_gain * np.sqrt(sums)) / true - 1
    assert abs(errors.mean()) < 0.01
    assert errors.std() < spread
    uncalibrated = sums / true - 1
    assert abs(uncalibrated.mean()) > 2 * abs(errors.mean())
