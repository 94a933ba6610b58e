"""Spacing of lanes: wide on smooth ground, narrow on fine structure, and the map states no more than was forecast."""

import math
from dataclasses import replace

import numpy as np
import pytest

from canprobe.mechanics.touch import PAD_NOISE, PadLayer, SurfaceMap
from canprobe.mechanics.touch.explore.spacing import DISTANCES_M, MAX_MARGIN_M, LaneForecast
from canprobe.mechanics.touch.map.nodes import COLUMNS
from canprobe.mechanics.touch.map.quartic import USUAL_CHANGE
from canprobe.mechanics.touch.map.stiffness import Stiffness
from canprobe.mechanics.touch.map.surface_map import REACH_M

PAD, DEPTH = PadLayer(0.04, 1.27e8), 0.43e-3
FORECAST = LaneForecast(PAD.radius, DEPTH, PAD_NOISE)


def test_one_lane_leaves_the_height_open_and_a_second_one_beside_it_does_not():
    """The depth of the layer depends on the curvature across a lane, which the lane does not show."""
    alone, both = (FORECAST.sigma(np.array(lanes), 300.0) for lanes in ([0.0], [0.0, 4e-3]))
    assert alone > 40e-6
    assert both < 0.3 * alone


@pytest.mark.parametrize("change", [15.0, 300.0, 2000.0])
def test_between_lanes_of_the_spacing_the_deviation_is_within_what_is_wanted(change):
    spacing = FORECAST.spacing(12e-6, change)
    lanes = spacing.gap * np.arange(-5.0, 6.0)
    if spacing.gap > 2.0 * DISTANCES_M[0]:
        assert FORECAST.sigma(lanes + 0.5 * spacing.gap, change) < 12.5e-6
    if spacing.margin > DISTANCES_M[0]:
        assert FORECAST.sigma(spacing.gap * np.arange(5.0) + spacing.margin, change) < 12.5e-6


def test_lanes_lie_closer_where_the_ground_changes_more_or_more_is_wanted():
    gaps = [FORECAST.spacing(12e-6, change).gap for change in (0.0, 1000.0, 2000.0, 12000.0)]
    assert gaps == sorted(gaps, reverse=True)
    assert REACH_M < gaps[0] < 2.0 * REACH_M
    assert gaps[-1] == 2.0 * DISTANCES_M[0]
    assert FORECAST.spacing(6e-6, 1000.0).gap < FORECAST.spacing(12e-6, 1000.0).gap
    assert FORECAST.spacing(12e-6, 15.0).margin == MAX_MARGIN_M


def test_the_map_states_about_as_much_as_was_forecast():
    ball, gap = 0.06, 7e-3
    rng = np.random.default_rng(2)
    noise = replace(PAD_NOISE, common=(0.0, 0.0, 0.0, 0.0))  # what a scan has in common no lane changes
    scanned = SurfaceMap.of_nodes(np.zeros((0, COLUMNS)), PAD, noise, Stiffness(PAD.stiffness, 1e-6))

    def on_ball(x, y):
        return np.array([x, y, math.sqrt(ball**2 - x * x - y * y)])

    for y in (-gap, 0.0, gap, 2 * gap):
        for x in np.arange(-15e-3, 15e-3, 2.5e-4):
            point = on_ball(x, y)
            scanned.add(point, point / ball + rng.normal(0.0, 3e-4, 3), 2.0)
    _, stated = scanned.distance(np.array([on_ball(x, 0.5 * gap) for x in (-4e-3, 0.0, 4e-3)]))
    forecast = FORECAST.sigma(gap * np.array([-1.5, -0.5, 0.5, 1.5]), USUAL_CHANGE)
    assert np.median(stated) / forecast == pytest.approx(1.0, abs=0.6)
