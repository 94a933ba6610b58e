"""Study `calibration`: its words and groups, and a figure that many studies have."""

import math

import numpy as np
import pytest

from canprobe.cell.plant.taxels import TaxelConfig
from canprobe.cell.scene.calibrations import load_calibration
from canprobe.cell.tasks.calibrate import Press
from canprobe.lab.studies import calibration
from canprobe.lab.studies.array_presses import Presses, pad_of
from canprobe.lab.studies.calibration import FAR_RATIO, differences, findings, force_findings, group_of, scan_row
from canprobe.lab.studies.figure import draw_points
from canprobe.lab.studies.random_scenes import FOREIGN, SceneSeed
from canprobe.lab.studies.region_scores import ScoredScan
from canprobe.mechanics.touch import ForceReading, compute_patch, make_patch_calibration


def scan(number, *, foreign, noticed, squares=()):
    scores = np.array([[0.0, 1.0, 1.0, square, 0.0] for square in squares]).reshape(-1, 5)
    seed, array = SceneSeed(3, FOREIGN, number).value(), FOREIGN if foreign else "calibrated"
    facts = (seed, "sphere", "sphere", "prbt", array, "weave", 25.0, 2.0, 100.0, 0.0, "")
    return ScoredScan(*facts, len(scores), scores, 0, scores[:0], noticed)


def test_foreign_arrays_are_grouped_by_how_far_they_are_off():
    assert group_of(scan(0, foreign=False, noticed=False)) == "own"
    groups = set()
    for number in range(12):
        off = max(abs(math.log(ratio)) for ratio in differences(SceneSeed(3, FOREIGN, number).value()))
        group = group_of(scan(number, foreign=True, noticed=False))
        assert group == f"foreign, {'unlike' if off > math.log(FAR_RATIO) else 'alike'}"
        groups.add(group)
    assert len(groups) == 2


def test_a_row_counts_notices_and_the_regions_that_hold_the_truth():
    row = scan_row(
        "own", [scan(0, foreign=False, noticed=True, squares=(1.0, 9.0)), scan(1, foreign=False, noticed=False)]
    )
    assert (row["scans"], row["noticed"], row["coverage"], row["coverage_noticed"]) == (2, 1, 0.5, 0.5)
    assert scan_row("own", [])["coverage"] is None
    said = calibration.scan_findings([row, row, row])
    assert said[0] == "an array's own calibration is doubted in 1 of 2 scans."


def test_findings_have_the_worst_array_and_the_goals():
    rows = [dict.fromkeys(calibration.GOALS, value) for value in (3.0, -4.0)]
    assert findings(rows)[0] == "force: RMS 3.5 % over 2 arrays, worst 4.0 %, goal 2 %."
    numbers = {"seconds": 10, "uncorrected_percent": 4.0, "error_percent": 2.0, "stated_percent": 3.0}
    said = force_findings([numbers | {"calibration": group, "within_percent": 90.0} for group in calibration.GROUPS])
    assert "90.0 % of 10 seconds within 2σ" in said[0] and "1.50 (geometric mean)" in said[1]


@pytest.mark.parametrize("log", [False, True])
def test_points_are_drawn_with_a_mark_for_each_kind(log, tmp_path):
    rows = [{"a": 0.0, "b": 2.0, "kind": "x"}, {"a": 1.0, "b": 3.0, "kind": "y"}]
    draw_points(
        rows, ("a", "a"), ("b", "b"), tmp_path / "a.png", title="A", by="kind", log=log, lines=((1.0, "a = b"),)
    )
    assert (tmp_path / "a.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("force", "full_scale_pa", "k"), [(0.22, 300e3, 0.0), (0.3, 300e3, 0.0), (0.25, 100e3, 40.0), (8.0, 300e3, 0.0)]
)
def test_light_and_heavy_forces_are_within_what_is_stated(force, full_scale_pa, k):
    """A plane and a ball, and the array that the packaged calibration was made on, at two scales."""
    presses = Presses(TaxelConfig(full_scale_pa=full_scale_pa), 1.27e8, np.random.default_rng(0))
    touch = presses.dwell("object", (k, k), Press(force, seconds=2.0))
    array = make_patch_calibration(load_calibration("inch16"), pad_of(presses.config))
    reading = ForceReading(array)
    rows = [
        reading.step(t, compute_patch(image, array, window))
        for t, image, window in zip(touch.t_s.tolist(), touch.images, touch.windows, strict=True)
    ]
    error = np.mean([row.force for row in rows[-50:]]) - np.mean(presses.forces[-50:])
    assert abs(error) < 2.0 * rows[-1].sigma.total < 0.4 * force
