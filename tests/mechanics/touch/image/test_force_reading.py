"""The force without its creep, and its standard deviation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from canprobe.mechanics.touch import ForceReading, Patch, PatchCalibration
from canprobe.mechanics.touch.image.force_creep import ForceCreep, decades_after
from canprobe.mechanics.touch.image.force_errors import UNSTATED, ForceErrors, upper_end

ERRORS = ForceErrors(creep=0.05, creep_sigma=0.006, creep_decades=1.8, array=0.01, spread=0.0)
CALIBRATION = PatchCalibration(force_errors=ERRORS, reference_sigma=0.005)
PATCH = Patch(2.0, 0.0, 0.0, 40, 50e3, False, False, False, False)


def shown_of(loads, dt, growth, taus=(0.3, 3.0, 30.0, 300.0)):
    """Readings of an array that creeps by relaxations a decade apart, in closed form for loads that hold for dt."""
    relaxed, shown = np.zeros(len(taus)), []
    for load in loads:
        kept = np.exp(-dt / np.array(taus))
        relaxed = kept * relaxed + (1.0 - kept) * load
        shown.append(load + growth * relaxed.sum())
    return np.array(shown)


@pytest.mark.parametrize("growth", [0.02, 0.05, 0.08])
def test_under_changing_loads_the_correction_leaves_a_fifth_of_the_creep(growth):
    dt = 0.02
    loads = np.concatenate([np.full(n, load) for n, load in ((500, 2.0), (400, 1.0), (200, 0.0), (1900, 3.0))])
    shown = shown_of(loads, dt, growth)
    creep = ForceCreep(growth)
    found = np.array([creep.step(k * dt, one, touching=one > 0.1) for k, one in enumerate(shown.tolist())])
    pressed = loads > 0.0
    before, after = (shown - loads)[pressed] / loads[pressed], (found - loads)[pressed] / loads[pressed]
    assert np.std(after) < 0.2 * np.std(before) and np.abs(after).max() < 0.3 * np.abs(before).max()
    assert np.all(found >= 0.0)


def test_a_reading_that_is_taken_twice_is_the_same():
    creep = ForceCreep(0.05)
    for t in (0.0, 0.1, 0.3):
        once = creep.step(t, 2.0)
        assert creep.step(t, 2.0) == pytest.approx(once, rel=1e-12)


def test_a_reading_is_right_where_its_touch_is_as_old_as_those_of_the_calibration():
    reading = ForceReading(CALIBRATION)
    times = np.arange(0.0, 40.0, 0.02)
    parts = [reading.step(t, PATCH) for t in times.tolist()]
    at = int(np.argmin(np.abs([decades_after(t) - ERRORS.creep_decades for t in times.tolist()])))
    assert parts[at].force == pytest.approx(PATCH.force, rel=2e-3)  # its newtons rest on readings of this age
    assert parts[0].force > PATCH.force > parts[-1].force
    assert parts[at].sigma.creep < 0.01 * parts[0].sigma.creep and parts[at].sigma.creep < parts[-1].sigma.creep


def test_the_causes_add_up_and_a_lower_bound_has_an_open_end():
    sigma = ForceReading(CALIBRATION).step(0.0, PATCH).sigma
    assert sigma.reference == pytest.approx(0.005 * 2.0, rel=0.1) and sigma.taxels == 0.0
    assert sigma.total == pytest.approx(np.linalg.norm(sigma))
    for doubt in ({"saturated": True}, {"off_pad": True}):
        bound = ForceReading(CALIBRATION).step(0.0, PATCH._replace(**doubt)).sigma
        assert math.isinf(bound.total) and math.isinf(upper_end(2.0, bound.total))
    dead = ForceReading(CALIBRATION).step(0.0, PATCH._replace(bridged=0.3)).sigma
    assert dead.taxels == pytest.approx(0.03 * 2.0, rel=0.1)
    high = ForceReading(CALIBRATION).step(0.0, PATCH._replace(peak_pa=95e3)).sigma
    assert high.taxels == pytest.approx(0.05 * 2.0, rel=0.1)
    light = ForceReading(CALIBRATION).step(0.0, PATCH._replace(peak_pa=10e3)).sigma
    assert light.array > 1.5 * sigma.array


def test_a_faint_touch_a_cut_patch_and_time_since_the_tare_make_a_force_doubtful():
    reading = ForceReading(CALIBRATION)
    sigma = reading.step(0.0, PATCH).sigma
    faint = ForceReading(CALIBRATION).step(0.0, PATCH._replace(peak_pa=5e3)).sigma  # the level is 2.35 kPa
    assert faint.taxels > 0.07 * 2.0 > 5.0 * sigma.array
    cut = ForceReading(CALIBRATION).step(0.0, PATCH._replace(cut_by_window=0.6)).sigma
    assert (cut.taxels, sigma.taxels) == (pytest.approx(0.03 * 2.0, rel=0.1), 0.0)
    later = reading.step(60.0, PATCH).sigma
    assert later.array == pytest.approx(math.hypot(sigma.array, 0.015 * 2.0), rel=0.1)


def test_without_a_fit_nothing_is_corrected_and_a_long_touch_is_doubtful():
    reading = ForceReading(replace(CALIBRATION, force_errors=UNSTATED))
    touched = [reading.step(t, PATCH) for t in np.arange(0.0, 700.0, 0.5).tolist()]
    assert {patch.force for patch in touched} == {2.0}
    assert touched[-1].sigma.creep > 2.0 * UNSTATED.creep_sigma  # more than a decade beyond the calibration
