"""Study `explore`: what it counts, and that fixed paths are closed curves inside their rectangle."""

import math

import numpy as np
import pytest

from canprobe.lab.studies.explore import LIMITS, STRATEGIES, ExploreCase, findings, fixed, measure, path_to, row_of


@pytest.mark.parametrize("name", STRATEGIES[1:])
def test_fixed_paths_begin_in_the_middle_and_are_closed(name):
    path = fixed(name)
    assert [*path.point(0.0), *path.point(2.0 * math.pi)] == pytest.approx([0.0] * 4, abs=1e-9)
    x, y = np.array([path.point(phase) for phase in np.linspace(0.0, 2.0 * math.pi, 400)]).T
    assert np.abs(x).max() <= 15.01e-3
    assert np.abs(y).max() <= 10.01e-3


def test_an_error_counts_as_reached_where_it_stays_below():
    scan = {"path": [0.01, 0.02, 0.03, 0.04], "height": [1.0, 1e-5, 1.0, 1e-5]}
    assert path_to(scan, "height", 2e-5) == 0.04
    assert path_to(scan, "height", 1e-6) is None
    assert path_to(scan, "height", 2.0) == 0.01


def test_explore_is_compared_with_the_best_of_the_others():
    def scans(path):
        one = {"path": [path], "seconds": [1.0], "force_percent": 3.0, "contact": 1.0, "stopped": None}
        return [one | {key: [0.0] for key in LIMITS}] * 3

    each = {"explore": scans(0.06), "weave 12 mm": scans(0.12), "raster 8 mm": scans(0.1)}
    rows = [row_of(name, found) for name, found in each.items()]
    assert [row["height_mm"] for row in rows] == pytest.approx([60.0, 120.0, 100.0])
    said = findings(rows, each, ["ball-45", "rod-38", "groove-1"])
    assert "needs 0.60 (0.60 to 0.60)" in said[1]
    assert "raster 8 mm" in said[1]
    assert "no shape" in said[1]


@pytest.mark.slow(reason="a scene of a study")
def test_a_scan_shows_more_as_its_path_grows():
    found = measure(ExploreCase("ball-45", "explore", 1.6))
    assert found["stopped"] is None
    assert found["contact"] == 1.0
    assert found["path"][-1] > 0.03
    assert found["height"][0] > found["height"][-1] > 0.0


def test_a_strategy_that_a_plan_refuses_says_why_and_leaves_its_shape_out():
    assert "the path leaves the object" in measure(ExploreCase("drawn-44-10", "raster 8 mm", 1.0))["refused"]
