"""A cell whose array has dead rows: the force is right and the row is named, or the touch ends."""

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.supervision import Reaction
from canprobe.errors import PlanError, SafetyStop

SCAN = {
    "task.duration_s": 1.0,
    "task.clearance_mm": 0.3,
    "bus.interface": "direct",
    "shape.also": [],
    "outputs.figures": False,
}


def test_a_dead_row_is_named_once_and_the_force_is_right():
    """A servo that believed the rest pressed with 2.5 N for 2 N."""
    result = canprobe.run(canprobe.load_scene("cylinder", SCAN | {"plant.dead_rows": [7]}), files=False)
    (named,) = [fault for fault in result.summary["faults"] if "of the array reads nothing" in fault]
    assert named.startswith("row 7 of the array reads nothing: interpolated")
    assert result.summary["completed"]
    scan = result.log["phase"] == 3
    true = result.truth["force_n"][: len(scan)][scan]
    assert np.mean(true) == pytest.approx(2.0, rel=0.04)
    assert np.nanmean(result.log["force_n"][scan]) == pytest.approx(np.mean(true), rel=0.05)


def test_three_dead_rows_under_the_patch_end_the_touch():
    with pytest.raises(SafetyStop, match=r"% of the force lies on taxels that do not measure") as stopped:
        canprobe.run(canprobe.load_scene("cylinder", SCAN | {"plant.dead_rows": [6, 7, 8]}), files=False)
    assert BY_KEY["taxels_hidden"].reaction is Reaction.RETREAT
    faults = " ".join(stopped.value.summary["faults"])
    assert all(f"row {number} of the array reads nothing" in faults for number in (6, 7, 8))
    assert BY_KEY["silent_taxels"].reaction is Reaction.DEGRADE  # that they were found is noted, and stops nothing


def test_rows_beyond_the_array_are_refused():
    with pytest.raises(PlanError, match=r"plant.dead_taxels: expected taxels of 16 × 16, got \(20, 0\)"):
        canprobe.run(canprobe.load_scene("cylinder", {"plant.dead_rows": [20]}))
