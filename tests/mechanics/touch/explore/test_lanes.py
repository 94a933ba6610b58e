"""Lanes go round a rectangle from its border inwards, no farther apart than the spacing allows, and end.

Spacing: wide on smooth ground, narrow on fine structure, and the map states no more than was forecast.
"""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree

from canprobe.mechanics.touch import PAD_NOISE, PadLayer
from canprobe.mechanics.touch.explore.lanes import DISTANCES_M, MAX_MARGIN_M, InwardLanes, LaneForecast, Spacing
from canprobe.mechanics.touch.explore.stretches import Heading, stretches_to
from canprobe.mechanics.touch.map.surface_map import REACH_M

RADIUS = 2e-3
PAD, DEPTH = PadLayer(0.04, 1.27e8), 0.43e-3
FORECAST = LaneForecast(PAD.radius, DEPTH, PAD_NOISE)


def lanes_of(size, spacing):
    lanes = InwardLanes(size, RADIUS)
    found = []
    while (lane := lanes.next(spacing)) is not None:
        found.append(lane)
        assert len(found) < 60
    return found


def walked(lanes):
    """Points of the lanes and of the turns to them, and the turns' lengths."""
    x, y, angle = lanes[0].start
    aside = RADIUS * (math.cos(angle) + math.sin(angle)), RADIUS * (math.cos(angle) - math.sin(angle))
    end = Heading(x - aside[0], y + aside[1], angle - 0.5 * math.pi)
    points, turns = [], []
    for lane in lanes:
        turn, rest = stretches_to(end, lane.start, RADIUS, lane.length)[0]
        turns.append(turn.length + rest.length - lane.length)
        points += [one.point(way) for one in (turn, rest) for way in np.linspace(0.0, one.length, 60)]
        end = rest.at(rest.length)
    return np.array(points), turns


@given(st.floats(0.016, 0.06), st.floats(0.016, 0.06), st.floats(4e-3, 8e-3), st.floats(2e-3, 3e-3))
def test_no_place_is_farther_from_a_lane_than_the_spacing_allows(length, width, gap, margin):
    lanes = lanes_of((length, width), Spacing(gap, margin))
    points, turns = walked(lanes)
    ring = 4 if all(lane.length > 0.0 for lane in lanes[:4]) else 0
    assert turns[:ring] == pytest.approx([0.5 * math.pi * RADIUS] * ring, abs=1e-9)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 25) * length, np.linspace(-0.5, 0.5, 25) * width)
    places = np.column_stack([x.ravel(), y.ravel()])
    apart, _ = KDTree(points).query(places)
    cut = RADIUS * (math.sqrt(2.0) - 1.0)  # what a turn leaves of a corner
    assert apart.max() < max(0.5 * gap, math.sqrt(2.0) * margin) + cut + 0.5e-3


def test_a_ring_and_a_line_within_it_cover_a_rectangle():
    lanes = lanes_of((30e-3, 20e-3), Spacing(8e-3, 3e-3))
    assert [round(math.degrees(lane.start.angle)) for lane in lanes] == [0, 90, 180, 270, 0]
    assert lanes[0].start[:2] == pytest.approx((-10e-3, -10e-3 + 3e-3 * 20 / 22))
    assert lanes[-1].start[:2] == pytest.approx((-10e-3, 0.0))
    assert lanes[-1].length == pytest.approx(14e-3)


def test_lanes_are_closer_from_where_the_ground_is_less_smooth():
    lanes = InwardLanes((30e-3, 20e-3), RADIUS)
    ring = [lanes.next(Spacing(8e-3, 3e-3)) for _ in range(4)]
    assert ring[1].start.x == pytest.approx(12e-3)
    inner = [lanes.next(Spacing(4e-3, 2e-3)) for _ in range(3)]
    assert inner[0].start.y == pytest.approx(0.0)  # the last lane of the ring ends there
    assert inner[1].start.x == pytest.approx(8e-3)


def test_an_edge_moves_the_border():
    lanes, spacing = InwardLanes((30e-3, 20e-3), RADIUS), Spacing(8e-3, 3e-3)
    lanes.next(spacing)
    lanes.close(6e-3, -7e-3, 0.1)
    assert 3e-3 <= lanes.next(spacing).start.x < 4e-3
    before = lanes.next(spacing).start.y
    lanes.close(0.0, 30e-3, 0.5 * math.pi)  # beyond the border: nothing new
    assert before == pytest.approx(10e-3 - 3e-3 * 20 / 22)


def test_nothing_is_left_to_lay_in_a_rectangle_that_is_closed():
    lanes = InwardLanes((30e-3, 20e-3), RADIUS)
    lanes.close(-15e-3, 0.0, 0.0)
    assert lanes.next(Spacing(8e-3, 3e-3)) is None


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
